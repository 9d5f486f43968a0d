"""Examples: others train on tasks of ours, where their package is there; a policy for a hub."""

import hashlib
import importlib.util
import pathlib
import re
import subprocess
import sys

import pytest

from credo.runner import Runner

EXAMPLES = pathlib.Path(__file__).parents[1] / "examples"
PACKAGES = {
    "sb3": "stable_baselines3",
    "torchrl": "torchrl",
    "benchmarl": "benchmarl",
    "jaxmarl": "jaxmarl",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PACKAGES)
def test_it_trains_for_a_few_frames_and_says_so(name):
    if importlib.util.find_spec(PACKAGES[name]) is None:
        pytest.skip(f"{PACKAGES[name]} is not installed")
    command = [sys.executable, str(EXAMPLES / f"others_{name}.py"), "--frames", "128"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert re.search(r"128 frames: .* -?\d+", done.stdout)


@pytest.mark.parametrize("name", PACKAGES)
def test_it_is_short_and_named_in_the_docs(name):
    lines = (EXAMPLES / f"others_{name}.py").read_text("utf-8").splitlines()
    assert len(lines) <= 80
    page = EXAMPLES.parent / "docs" / "how-to" / "others.md"
    assert f"others_{name}.py" in page.read_text("utf-8")


@pytest.mark.slow
def test_a_policy_is_prepared_for_a_hub_with_its_card(tmp_path):
    """The folder that would be sent: a policy that can be played, and what it scored."""
    run, folder = tmp_path / "run", tmp_path / "folder"
    train = ["-m", "credo", "train", "neuroevolution", "sequence-classification"]
    publish = [str(EXAMPLES / "publish_policy.py"), str(run), str(folder), "--license", "mit"]
    for words in ([*train, "--generations", "2", "--path", str(run)], publish):
        done = subprocess.run([sys.executable, *words], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    policy = folder / "policy.safetensors"
    assert Runner.load(policy).description["task"] == "SequenceClassification"
    card = (folder / "README.md").read_text("utf-8")
    assert "license: mit" in card
    assert re.search(r"run: \d+ fresh episodes.*accuracy +0?\.?\d", card, re.DOTALL)
    assert hashlib.sha256(policy.read_bytes()).hexdigest() in card
    assert str(tmp_path) not in card  # no path of this machine is published
