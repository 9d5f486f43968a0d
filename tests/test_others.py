"""The examples in which others train on tasks of ours: each runs, where its package is there."""

import importlib.util
import pathlib
import re
import subprocess
import sys

import pytest

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
