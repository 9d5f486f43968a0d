"""Who hears of a run: hooks in order, loggers that may fail, callbacks that may not."""

import shutil
import struct
import sys
import types
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from credo.algorithms.erl import ERL
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.probes import Copy
from credo.environments.sequence_classification import SequenceClassification
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.runs import callbacks, log
from credo.runs.callbacks import Callback, Listeners, TensorBoard
from credo.runs.loop import resume, train
from credo.runs.options import RunOptions
from credo.runs.record import RunError
from credo.runs.store import Run

ALGORITHM = Neuroevolution(
    SequenceClassification(depth=2, min_gap=1, max_gap=2),
    MMU(hidden=3),
    population_size=10,
    episodes=4,
    test_episodes=6,
)
QUIET = {"tensorboard": False, "progress": False}


class Noted(Callback):
    def __init__(self, stop=None):
        self.told, self.stop = [], stop

    def on_generation(self, run, generation, metrics):
        self.told.append(("generation", generation, metrics["champion_score"]))
        return generation == self.stop

    def on_test(self, run, generation, score):
        self.told.append(("test", generation, score))

    def on_end(self, run, reason):
        saved = max(int(path.name) for path in (run.path / "checkpoints").glob("[0-9]*"))
        self.told.append(("end", reason, saved))


# Options.


def test_options_are_checked_and_named():
    assert RunOptions(frames=1e6).frames == 10**6
    assert isinstance(RunOptions(frames=1e6).frames, int)
    with pytest.raises(ValueError, match="keep is 0: it must be at least 1"):
        RunOptions(keep=0)
    with pytest.raises(ValueError, match="wall_clock is -1: it must be at least 0"):
        RunOptions(wall_clock=-1)
    with pytest.raises(ValueError, match="loggers is 'tensorbord': it must be one of trackio, wa"):
        RunOptions(loggers=("tensorbord",))
    with pytest.raises(TypeError, match=r"no option 'generation' .did you mean 'generations'"):
        RunOptions().changed({"generation": 3})


def test_options_come_back_from_their_record():
    options = RunOptions(frames=7, keep=2, loggers=("wandb",), callbacks=(print,), progress=True)
    assert RunOptions.read(options.record()) == RunOptions(
        frames=7, keep=2, loggers=("wandb",), progress=False
    )


def test_an_unknown_option_of_train_names_the_nearest(tmp_path):
    with pytest.raises(
        TypeError, match=r"no option 'checkpoint_evry' .did you mean 'checkpoint_ev"
    ):
        train(ALGORITHM, path=tmp_path / "run", checkpoint_evry=3.0)
    assert not (tmp_path / "run").exists()


def test_options_and_what_is_recorded_of_them(tmp_path):
    options = RunOptions(generations=2, keep=5, **QUIET)
    run = train(ALGORITHM, options, path=tmp_path / "run", keep=4)
    assert run.config["options"] == options.changed({"keep": 4}).record()
    assert run.config["budget"]["generations"] == 2


# Hooks.


def test_hooks_are_called_in_order_and_the_end_comes_after_the_last_save(tmp_path):
    noted = Noted()
    run = train(ALGORITHM, generations=3, path=tmp_path / "run", callbacks=(noted,), **QUIET)
    scores = np.float32(run.metrics["champion_score"]).tolist()
    kinds = [(kind, at) for kind, at, _ in noted.told]
    tested = [(kind, g) for g in (1, 2, 3) for kind in ("generation", "test")]
    assert kinds == [*tested, ("end", "budget")]
    assert [score for kind, _, score in noted.told if kind == "test"] == pytest.approx(scores)
    assert noted.told[-1] == ("end", "budget", 3)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"generations": 2}, "budget"),
        ({"generations": 10**6, "wall_clock": 0.0}, "wall clock"),
        ({"generations": 10**6, "stop_at": -100.0}, "score"),
    ],
)
def test_why_a_run_ended_is_told(tmp_path, options, reason):
    noted = Noted()
    train(ALGORITHM, path=tmp_path / "run", callbacks=(noted,), **QUIET | options)
    assert noted.told[-1][:2] == ("end", reason)


def test_a_callback_may_end_a_run(tmp_path):
    noted = Noted(stop=1)
    run = train(ALGORITHM, generations=500, path=tmp_path / "run", callbacks=[noted], **QUIET)
    assert noted.told[-1] == ("end", "callback", 1)
    assert run.metrics["generation"].tolist() == [1]


def test_what_a_callback_raises_comes_once_the_run_is_saved(tmp_path):
    def fails(run, generation, metrics):
        raise ZeroDivisionError("mine")

    noted, path = Noted(), tmp_path / "run"
    with pytest.raises(ZeroDivisionError, match="mine") as error:
        train(ALGORITHM, generations=40, path=path, callbacks=(fails, noted), **QUIET)
    assert error.value.__notes__ == [f"{path} was saved before this was raised"]
    assert noted.told[-1] == ("end", "error", 1)
    resume(path, **QUIET)
    train(ALGORITHM, generations=40, path=tmp_path / "alone", **QUIET)
    for name in ("metrics.csv", "champion.safetensors", "best.safetensors"):
        assert (path / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()


def leaves(run, generation, metrics):
    raise SystemExit(3)


def undecided(run, generation, metrics):
    return np.ones(2)  # neither true nor false


@pytest.mark.parametrize(("callback", "raised"), [(leaves, SystemExit), (undecided, ValueError)])
def test_a_run_is_saved_however_a_callback_ends_it(tmp_path, callback, raised):
    with pytest.raises(raised):
        train(ALGORITHM, generations=40, path=tmp_path / "run", callbacks=(callback,), **QUIET)
    assert Run(tmp_path / "run").metrics["generation"].tolist() == [1]
    assert (tmp_path / "run" / "champion.safetensors").exists()


def test_what_is_no_callback_is_refused(tmp_path):
    with pytest.raises(TypeError, match="3 is no callback"):
        train(ALGORITHM, path=tmp_path / "run", callbacks=(3,))
    assert not (tmp_path / "run").exists()


def test_a_score_that_is_carried_on_is_no_test(tmp_path):
    noted = Noted()
    noted.on_end = lambda *_: None
    listeners = Listeners(SimpleNamespace(path=tmp_path), [noted], 1.0, False)
    scores = (1.0, 1.0, 2.0, 2.0, float("nan"), 3.0)
    listeners.hear([{"generation": g, "champion_score": s} for g, s in enumerate(scores)])
    assert [told[1:] for told in noted.told if told[0] == "test"] == [(2, 2.0), (5, 3.0)]


# The best policy.


def test_the_best_policy_is_that_of_the_highest_score(tmp_path):
    path = tmp_path / "run"
    run = train(ALGORITHM, generations=30, path=path, **QUIET)
    scores = run.metrics["champion_score"]
    best = int(np.argmax(scores))
    assert best < 29  # not the last
    assert run.best_test == (best + 1, pytest.approx(scores[best]))
    short = train(ALGORITHM, generations=best + 1, path=tmp_path / "short", **QUIET)
    inputs = np.array([[1.0], [0.0], [-1.0]], np.float32)
    one, other = run.policy(best=True), short.policy()
    np.testing.assert_array_equal([one(x) for x in inputs], [other(x) for x in inputs])
    last = run.policy()
    assert not np.allclose([last(x) for x in inputs], [other(x) for x in inputs])


def test_without_a_best_policy_there_is_a_sentence(tmp_path):
    run = train(ALGORITHM, generations=1, path=tmp_path / "run", **QUIET)
    (run.path / "best.safetensors").unlink()
    with pytest.raises(RunError, match=r"best\.safetensors is not there"):
        _ = run.best


def test_a_score_of_the_task_before_is_no_best_one(tmp_path):
    """Of several generations one test; the others repeat its score, also that of another task."""
    evolution = ERL.ea(Copy(), MLP(hidden=(4,)), population_size=4, elite_fraction=0.25)
    algorithm = replace(evolution, test_every=5, test_episodes=2, replay_capacity=1000)
    run = train(algorithm, generations=7, path=tmp_path / "run", **QUIET)
    assert run.best_test[0] in (1, 6)
    resume(run.path, set={"env.max_steps": 3}, generations=9, **QUIET)
    assert not (run.path / "best.safetensors").exists()
    run = resume(run.path, generations=12, **QUIET)
    assert run.best_test[0] == 11
    assert run.best_test[1] == pytest.approx(run.metrics["champion_score"][10])


def test_a_kill_after_another_task_was_set_brings_no_old_best_back(tmp_path):
    run = train(ALGORITHM, generations=4, path=tmp_path / "run", **QUIET)
    other = tmp_path / "other"
    shutil.copytree(run.path, other)
    again = {"set": {"env.depth": 3}, "generations": 7}
    run = resume(run.path, **again, **QUIET)

    def killed(run, generation, metrics):
        raise KeyboardInterrupt  # nothing is saved

    with pytest.raises(KeyboardInterrupt):
        resume(other, **again, callbacks=(killed,), **QUIET)
    resume(other, generations=7, **QUIET)
    assert Run(other).best_test == run.best_test
    assert (other / "best.safetensors").read_bytes() == (run.path / "best.safetensors").read_bytes()


# Loggers.


def rows(first, last):
    return [{"generation": g, "champion_score": 0.5, "a": 2 * g} for g in range(first, last + 1)]


def events(folder: Path) -> list:
    """All events in the one file of `folder`, their checksums checked."""
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.record_writer import masked_crc32c

    (path,) = folder.iterdir()
    data, found = path.read_bytes(), []
    while data:
        (size,) = struct.unpack("<Q", data[:8])
        body = data[12 : 12 + size]
        sums = struct.unpack("<I", data[8:12]) + struct.unpack("<I", data[12 + size : 16 + size])
        assert sums == (masked_crc32c(data[:8]), masked_crc32c(body))
        found.append(Event.FromString(body))
        data = data[16 + size :]
    return found


def scalars(folder: Path) -> list[tuple[str, float, int]]:
    return [(v.tag, v.simple_value, e.step) for e in events(folder) for v in e.summary.value]


def heard(path, *callbacks, every=True):
    return Listeners(SimpleNamespace(path=path), callbacks, 0.0, every)


def test_tensorboard_gets_every_finite_metric_of_every_generation(tmp_path):
    listeners, nan = heard(tmp_path, TensorBoard()), float("nan")
    first = {"generation": 1, "champion_score": 0.5, "b": 2}
    listeners.hear([first, {"generation": 2, "champion_score": nan, "b": 3}])
    folder = tmp_path / "tensorboard"
    expected = [("champion_score", 0.5, 1), ("b", 2.0, 1), ("b", 3.0, 2)]
    assert scalars(folder) == expected  # at once, not when something is flushed
    listeners.hear([{"generation": 3, "champion_score": 1, "b": 4}])
    assert scalars(folder) == [*expected, ("champion_score", 1.0, 3), ("b", 4.0, 3)]
    first, second, *_ = events(folder)
    assert (first.file_version, second.step, second.session_log.status) == ("brain.Event:2", 1, 1)


def test_events_of_a_resumed_run_void_those_that_come_again(tmp_path):
    heard(tmp_path, TensorBoard()).hear(rows(6, 7))
    assert events(tmp_path / "tensorboard")[1].step == 6


def test_without_room_for_events_training_goes_on(tmp_path):
    (tmp_path / "tensorboard").write_text("a file")
    journal, listeners = log.Log(tmp_path, 0), heard(tmp_path, TensorBoard())
    journal.append(rows(1, 3), 1.0, 1.0)
    with pytest.warns(UserWarning, match=r"TensorBoard is no longer told: .*; training goes on"):
        assert not listeners.hear(rows(1, 3))
    assert not listeners.hear(rows(4, 4))  # and without a second warning
    listeners.end("budget")
    assert log.read(tmp_path / "metrics.csv")["generation"].tolist() == [1, 2, 3]


def test_events_that_fail_later_are_dropped_with_one_warning(tmp_path):
    listeners = heard(tmp_path, TensorBoard())
    listeners.hear(rows(1, 1))
    (path,) = (tmp_path / "tensorboard").iterdir()
    path.unlink()
    path.mkdir()
    with pytest.warns(UserWarning, match=r"no longer told: .*events\.out.*; training goes on"):
        listeners.hear(rows(2, 2))
    assert not listeners.hear(rows(3, 3))


@pytest.mark.parametrize("name", ["wandb", "trackio"])
def test_a_logger_that_is_not_installed_says_how_to_get_it(tmp_path, monkeypatch, name):
    monkeypatch.setattr(callbacks.importlib.util, "find_spec", lambda _: None)
    told = rf"{name} is not installed: pip install '.\[{name}\]'"
    with pytest.raises(RunError, match=told):
        train(ALGORITHM, path=tmp_path / "run", loggers=(name,))
    assert not (tmp_path / "run").exists()


class Tracked:
    """Stands for a tracked run of either package."""

    def __init__(self, **given):
        self.given, self.logged, self.finished = given, [], None

    def log(self, metrics, step):
        self.logged.append((step, metrics))

    def finish(self, **given):
        self.finished = given


@pytest.mark.parametrize("name", ["wandb", "trackio"])
def test_a_tracker_gets_every_generation_and_goes_on_with_its_run(tmp_path, monkeypatch, name):
    made = []

    def init(**given):
        made.append(Tracked(**given))
        return made[-1]

    module = types.ModuleType(name)
    module.init = init
    monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(callbacks.importlib.util, "find_spec", lambda _: True)
    path = tmp_path / "run"
    train(ALGORITHM, generations=2, path=path, loggers=(name,), **QUIET)
    resume(path, generations=3, loggers=(name,), **QUIET)
    first, second = made
    assert [step for step, _ in first.logged + second.logged] == [1, 2, 3]
    scores = Run(path).metrics["champion_score"]
    assert first.logged[1][1]["champion_score"] == pytest.approx(scores[1])
    assert first.finished is not None
    assert (first.given["project"], first.given["resume"]) == ("credo", "allow")
    assert first.given["name"] == second.given["name"]
    assert first.given["name"].startswith("run-")
    assert first.given["config"]["algorithm"]["class"].endswith(":Neuroevolution")
    assert first.given.get("id") == second.given.get("id")
