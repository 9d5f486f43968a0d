"""A run that goes on: with other settings, a larger buffer, weights that are no numbers, and files
that are another run's."""

import dataclasses
import json
import shutil
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.algorithms.off_policy import OffPolicy
from credo.environments.probes import Copy
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic
from credo.runs import checkpoint, config, loop, segments, weights
from credo.runs.budget import Budget, fitted
from credo.runs.checkpoint import CheckpointError, DamagedCheckpoint

ALGORITHM = OffPolicy(
    Copy(),
    MLP(hidden=(4,)),
    TD3(critic=Critic(hidden=(4,)), batch_size=4),
    episodes=2,
    start_frames=10,
    replay_capacity=5000,
    test_episodes=2,
    test_every=10,
)
QUIET = {"tensorboard": False, "progress": False}


def train(path, generations=12, **options):
    return loop.train(ALGORITHM, generations=generations, path=path, **QUIET | options)


def resume(path, **options):
    return loop.resume(path, **QUIET | options)


def contents(path) -> dict[str, bytes]:
    newest = max((path / "checkpoints").glob("[0-9]*"))
    names = ["metrics.csv", "champion.safetensors", "best.safetensors"]
    kept = {name: (path / name).read_bytes() for name in names}
    return kept | {file.name: file.read_bytes() for file in newest.iterdir()}


@pytest.fixture
def bounded(monkeypatch):
    """What bounds the frames of a generation."""
    most = property(lambda self: self.episodes * self.env.max_steps)
    monkeypatch.setattr(OffPolicy, "most_frames", most, raising=False)


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    path = tmp_path_factory.mktemp("straight") / "run"
    train(path, checkpoint_every=0.0, keep=100)
    return path


@pytest.fixture
def finished(straight, tmp_path):
    return shutil.copytree(straight, tmp_path / "finished")


# Settings.


def test_other_settings_go_on_with_what_was_learned(finished, straight):
    before = loop.Run(finished).config
    run = resume(finished, set={"learner.actor_lr": 1e-5, "updates_per_frame": 0.5}, generations=16)
    assert run.algorithm.learner.actor_lr == 1e-5
    assert run.algorithm.updates_per_frame == 0.5
    assert run.metrics["generation"][-1] == 16
    np.testing.assert_array_equal(
        run.metrics["updates"][:12], loop.Run(straight).metrics["updates"]
    )
    assert run.metrics["updates"][12] == run.metrics["updates"][11] / 2
    changes = {"learner.actor_lr": 1e-5, "updates_per_frame": 0.5}
    assert [change["generation"] for change in run.config["changes"]] == [12, 12]
    assert run.config["changes"][0]["set"] == changes
    assert before["algorithm"]["learner"]["actor_lr"] != 1e-5
    assert loop.Run(finished).champion is not None
    resume(finished, generations=17)  # and on with them
    assert loop.Run(finished).config["algorithm"] == run.config["algorithm"]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"learner.actor_rl": 1.0}, "there is no 'actor_rl' .did you mean 'actor_lr'"),
        ({"gamma": 0.5}, "no setting 'gamma'"),
        ({"learner.gamma.x": 0.5}, "what stands before 'x' has no parts"),
        ({"learner": 3}, "only numbers and strings can be changed"),
        ({"learner.gamma": (1,)}, "only numbers and strings can be changed"),
        ({"learner.gamma": "high"}, "gamma of .*TD3 is 'high': it must be float"),
        ({"learner.class": "os:system"}, "makes another task or method"),
        ({"learner.batch_size": 0}, "batch_size"),
        ({"replay_capacity": 6000}, "replay_capacity=6000 changes the sizes or the form of what"),
    ],
)
def test_what_cannot_be_set_is_refused_and_changes_nothing(finished, changes, told):
    before = (finished / "config.json").read_bytes(), contents(finished)
    with pytest.raises((loop.RunError, ValueError), match=told):
        resume(finished, set=changes, generations=16)
    assert ((finished / "config.json").read_bytes(), contents(finished)) == before


# The replay buffer.


def test_a_buffer_is_as_large_as_the_budget_fills_it(bounded):
    most = ALGORITHM.most_frames  # pyright: ignore[reportAttributeAccessIssue]
    rows = fitted(ALGORITHM, Budget(frames=300)).replay_capacity
    assert 300 - 1 + most <= rows <= 512
    assert fitted(ALGORITHM, Budget(generations=3)).replay_capacity >= 3 * most
    assert fitted(ALGORITHM, Budget(generations=10**6)).replay_capacity == 5000
    both = Budget(generations=10**6, frames=300)
    assert fitted(ALGORITHM, both).replay_capacity == rows
    assert fitted("no buffer", Budget(frames=300)) == "no buffer"


def test_a_buffer_that_grows_changes_no_bit(bounded, straight, tmp_path, capsys):
    short = train(tmp_path / "short", generations=3, progress=True)
    assert "has a replay buffer of 64 frames, 0.0 MB" in capsys.readouterr().err
    assert short.config["algorithm"]["replay_capacity"] == 5000
    resume(tmp_path / "short", generations=12)
    whole = train(tmp_path / "whole")
    assert contents(tmp_path / "short") == contents(whole.path)
    # And those of a buffer of full size.
    assert (whole.path / "metrics.csv").read_bytes() == (straight / "metrics.csv").read_bytes()
    resume(straight, generations=12)  # whose checkpoints fit the smaller one too


def test_a_setting_that_makes_generations_longer_has_its_buffer(bounded, tmp_path):
    train(tmp_path / "run", generations=2)
    run = resume(tmp_path / "run", set={"episodes": 40}, generations=4)
    frames = int(run.metrics["frames"][-1])
    fit = loop.fitted(run.algorithm, loop.Budget(10))
    ((_, buffer),) = segments.buffers(loop._load(run, fit).state)
    assert int(buffer.written) == int(buffer.size) == frames  # nothing was overwritten
    assert resume(tmp_path / "run", generations=6).metrics["generation"][-1] == 6


# Weights that are no numbers.


@pytest.mark.parametrize("what", ["learner", "champion"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_weights_that_are_no_numbers_end_the_run(tmp_path, monkeypatch, what, value):
    play = loop.play

    def spoiled(algorithm, state, best, root, generation, *rest):
        state, best, rows = play(algorithm, state, best, root, generation, *rest)
        if generation >= 1:  # the second dispatch
            of = (lambda s: s.learner.actor) if what == "learner" else (lambda s: s.champion)
            bad = jax.tree.map(lambda x: x.at[0].set(value), eqx.filter(of(state), eqx.is_array))
            state = eqx.tree_at(of, state, eqx.combine(bad, of(state)))
        return state, best, rows

    monkeypatch.setattr(loop, "play", spoiled)
    words = {"learner": "the actor of the learner", "champion": "the champion"}[what]
    with pytest.raises(loop.RunError, match=rf"weights of .*{words}.* are not finite after"):
        train(tmp_path / "run", checkpoint_every=0.0)
    monkeypatch.undo()
    newest = max((tmp_path / "run" / "checkpoints").glob("[0-9]*"))
    assert int(newest.name) == 1
    champion = eqx.filter(loop.Run(tmp_path / "run").champion, eqx.is_array)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(champion))
    run = resume(tmp_path / "run")
    assert run.metrics["generation"][-1] == 12


def test_numbers_that_are_no_weights_may_be_anything():
    class State(eqx.Module):
        learners: tuple
        champion: jax.Array
        score: jax.Array

    good, bad = jnp.ones(2), jnp.array([1.0, jnp.inf])
    assert weights.broken(State(({"actor": good},), good, bad)) is None
    told = weights.broken(State(({"actor": good}, {"critics": (bad, bad)}), bad, good))
    assert told == "the champion, the critics of learner 1"


# Files of another run, and files that were changed.


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    path = tmp_path_factory.mktemp("other") / "run"
    train(path, seed=7)
    return path


def test_a_champion_of_another_run_is_refused(finished, other):
    shutil.copy(other / "champion.safetensors", finished)
    with pytest.raises(
        loop.RunError,
        match=r"champion\.safetensors is not this run's champion: .*seed 7, this one has 0",
    ):
        _ = loop.Run(finished).champion


def test_what_differs_in_a_champions_settings_is_named(finished, tmp_path):
    algorithm = dataclasses.replace(ALGORITHM, updates_per_frame=0.5)
    loop.train(algorithm, generations=1, path=tmp_path / "half", **QUIET)
    shutil.copy(tmp_path / "half" / "champion.safetensors", finished)
    with pytest.raises(loop.RunError, match=r"another algorithm.*updates_per_frame: 0\.5 != 1\.0"):
        _ = loop.Run(finished).champion
    with pytest.raises(loop.RunError, match="another algorithm"):
        train(tmp_path / "warm", warm_start=finished)
    assert not (tmp_path / "warm").exists()


def test_checkpoints_of_another_run_are_refused(finished, other):
    shutil.rmtree(finished / "checkpoints")
    shutil.copytree(other / "checkpoints", finished / "checkpoints")
    with pytest.raises(CheckpointError, match=r"was written for a run with seed 7, this one has 0"):
        resume(finished, generations=14)


def test_a_run_whose_settings_were_changed_behind_it_is_refused(finished):
    """Also if somebody takes the checksum out."""
    said = json.loads((finished / "config.json").read_text())
    said["algorithm"]["updates_per_frame"] = 0.5
    del said["sha256"], said["signature"]
    (finished / "config.json").write_text(json.dumps(said))
    with pytest.raises(CheckpointError, match="another algorithm, task or settings"):
        resume(finished, generations=14)
    with pytest.raises(loop.RunError, match=r"updates_per_frame: 1\.0 != 0\.5"):
        _ = loop.Run(finished).champion


def test_a_changed_number_of_metrics_is_named_and_trained_again(finished, straight):
    path = finished / "metrics.csv"
    lines = path.read_text().splitlines(keepends=True)
    lines[9] = lines[9].replace("0.", "1.", 1)
    path.write_text("".join(lines))
    with pytest.raises(loop.RunError, match=r"metrics\.csv was changed"):
        _ = loop.Run(finished).metrics
    with pytest.warns(DamagedCheckpoint, match=r"metrics\.csv was changed"):
        resume(finished)
    assert contents(finished) == contents(straight)
    assert loop.Run(finished).metrics["generation"][-1] == 12


def test_a_cut_metrics_file_is_named(finished):
    text = (finished / "metrics.csv").read_text().splitlines(keepends=True)
    (finished / "metrics.csv").write_text("".join(text[:-2]))
    with pytest.raises(loop.RunError, match=r"metrics\.csv was cut"):
        _ = loop.Run(finished).metrics


def test_a_run_that_lost_its_metrics_does_not_begin_anew(finished):
    for folder in (finished / "checkpoints").iterdir():
        if folder.name not in ("00000000", "00000012"):
            shutil.rmtree(folder)
    (finished / "metrics.csv").unlink()
    with pytest.raises(CheckpointError, match=r"metrics\.csv cannot be read"):
        resume(finished, generations=14)
    assert (finished / "checkpoints" / "00000012" / "COMMIT").exists()


def test_the_clock_is_worth_no_run(finished):
    (finished / "timing.csv").write_bytes(b"generation,seconds\n1,\xff\xff\n")
    with pytest.warns(UserWarning, match=r"timing\.csv"):
        resume(finished, generations=14)
    assert loop.Run(finished).metrics["generation"][-1] == 14


# Seeds, prompts and folders.


@pytest.mark.parametrize("seed", [-1, 2**32, 1 << 70, 1.5, True])
def test_a_seed_has_32_bits(tmp_path, seed):
    with pytest.raises(ValueError, match=r"seed is .*from 0 to 2\^32 - 1"):
        train(tmp_path / "run", seed=seed)
    assert not (tmp_path / "run").exists()


NOTEBOOK = """
import credo
from credo.environments.probes import Copy
class Mine(Copy):
    pass
algorithm = credo.Neuroevolution(Mine(), credo.MMU(hidden=2), population_size=4)
run = credo.train(algorithm, generations=1, path="run", progress=False, tensorboard=False)
credo.resume("run", generations=2, progress=False, tensorboard=False)
print(type(run.champion).__name__, run.config["resumable"], run.config["algorithm"]["env"]["class"])
"""


def test_a_class_of_a_notebook_trains_but_goes_on_there_alone(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", NOTEBOOK], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "MMUPolicy False __main__:Mine\n"
    assert (
        "Mine was defined at a prompt or in a notebook: this run can go on in this" in done.stderr
    )
    with pytest.raises(config.ConfigError, match="Mine was defined at a prompt or in a notebook"):
        resume(tmp_path / "run", generations=3)


def test_what_is_advised_is_possible(finished):
    run = loop.Run(finished)
    assert run.advice == f"`credo resume {finished}`"
    run.config["resumable"] = False  # of a class that was made in a notebook
    assert run.advice == (
        f"credo.resume('{finished}') in this process, which alone knows its classes"
    )


def test_a_task_that_changed_is_said_in_words(finished, monkeypatch):
    monkeypatch.setattr(Copy, "obs_size", Copy().obs_size + 1)
    told = r"Copy has \d numbers in an observation today and \d when this run began"
    with pytest.raises(loop.RunError, match=told):
        _ = loop.Run(finished).champion
    with pytest.raises(loop.RunError, match=told):
        resume(finished, generations=14)


def test_a_task_that_is_not_found_says_where_it_began(tmp_path, monkeypatch):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "my_walk.py").write_text(
        "from credo.environments.probes import Copy\nclass Mine(Copy):\n    pass\n"
    )
    script = (
        "import credo, my_walk\n"
        "algorithm = credo.Neuroevolution(my_walk.Mine(), credo.MMU(hidden=2), population_size=4)\n"
        "credo.train(algorithm, generations=1, path='run', progress=False, tensorboard=False)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path / "home", capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    with pytest.raises(
        loop.RunError, match=f"cannot find 'my_walk:Mine'.* It began in {tmp_path}/home: start"
    ):
        resume(tmp_path / "home" / "run", generations=2)


def test_buffers_are_found_in_a_state():
    with loop.shapes_alone():
        like = eqx.filter_eval_shape(ALGORITHM.init, key=jax.random.key(0))
    assert len(segments.buffers(like)) == 1


def test_the_seals_hold_nothing_random(straight, tmp_path):
    train(tmp_path / "again", checkpoint_every=0.0, keep=100)
    assert contents(tmp_path / "again") == contents(straight)
    commit = json.loads((max((straight / "checkpoints").iterdir()) / "COMMIT").read_bytes())
    assert set(commit["seals"]["record"]) == {"algorithm", "seed", "budget", "versions"}
    metadata = checkpoint.read_metadata(straight / "champion.safetensors")
    assert json.loads(metadata["record"]) == commit["seals"]["record"]
