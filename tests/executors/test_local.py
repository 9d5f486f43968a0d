"""Many runs, a process each: what is finished stays, what fails is told, the rest goes on."""

import dataclasses
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from credo import executors
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments import processes
from credo.environments.sequence_classification import SequenceClassification
from credo.evolution.breeder import altered
from credo.executors import Job, local
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.runs import config, loop
from credo.runs.options import RunOptions

ALGORITHM = Neuroevolution(
    SequenceClassification(depth=2, min_gap=1, max_gap=2),
    MMU(hidden=3),
    population_size=10,
    episodes=4,
    test_episodes=6,
)
FIVE = RunOptions(generations=5, tensorboard=False)
IMPOSSIBLE = config.to_tree(ALGORITHM)
IMPOSSIBLE["env"] = IMPOSSIBLE["env"] | {"depth": 0}


def wanting(job, **changes):
    """The same run with other options."""
    return dataclasses.replace(job, options=job.options.changed(changes))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Three jobs, one of them impossible, by two workers; and what was said."""
    folder = tmp_path_factory.mktemp("jobs")
    jobs = [
        Job(folder / "0", ALGORITHM, 0, FIVE),
        Job(folder / "bad", IMPOSSIBLE, 0, FIVE),
        Job(folder / "1", ALGORITHM, 1, FIVE),
    ]
    with pytest.raises(loop.RunError) as error:
        executors.run(jobs, workers=2)
    return jobs, str(error.value)


def test_a_failure_is_told_and_the_others_finish(trained):
    (first, bad, second), told = trained
    assert told.startswith("1 of 3 runs failed:")
    assert f"{bad.path}: ValueError: depth is 0: it must be at least 1" in told
    assert (first.finished(), bad.finished(), second.finished()) == (True, False, True)
    for seed, job in enumerate((first, second)):
        run = loop.Run(job.path)
        assert run.config["seed"] == seed
        assert run.algorithm == ALGORITHM
        assert run.metrics["generation"].tolist() == [1, 2, 3, 4, 5]


def test_a_worker_trains_like_this_process(trained, tmp_path):
    (first, *_), _ = trained
    path = tmp_path / "here"
    loop.train(ALGORITHM, generations=5, path=path, tensorboard=False, progress=False)
    for name in ("metrics.csv", "champion.safetensors"):
        assert (path / name).read_bytes() == (first.path / name).read_bytes()


def test_what_is_finished_is_not_run_again(trained, monkeypatch):
    (first, _, second), _ = trained
    started = []
    monkeypatch.setattr(local, "_start", lambda: started.append(1))
    executors.run([first, second], workers=2)
    assert started == []
    longer = wanting(first, generations=6)
    assert not longer.finished()
    # Results of more generations would be reported under fewer.
    with pytest.raises(loop.RunError, match="generations: 5 != 4"):
        wanting(first, generations=4).finished()


def test_what_reached_its_score_is_finished(trained):
    (first, *_), _ = trained
    score = float(loop.Run(first.path).metrics["champion_score"][-1])
    longer = wanting(first, generations=100)
    assert wanting(longer, stop_at=score - 0.01).finished()
    assert not wanting(longer, stop_at=score + 0.01).finished()
    assert np.isfinite(score)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"seed": 7}, "other settings .seed."),
        (
            {"algorithm": dataclasses.replace(ALGORITHM, episodes=5)},
            "other settings .episodes: 4 != 5.: remove it or choose another folder",
        ),
    ],
)
def test_a_folder_with_another_run_is_refused(trained, changes, told):
    (first, *_), _ = trained
    before = (first.path / "config.json").read_bytes()
    with pytest.raises(loop.RunError, match=told):
        executors.run([dataclasses.replace(first, **changes)])
    assert (first.path / "config.json").read_bytes() == before


DIES_ONCE = """
import json, os, sys
def main():
    for line in sys.stdin:
        job = json.loads(line)
        if job["seed"] == 0:
            os.kill(os.getpid(), 9)
        print(json.dumps({"ok": job["path"]}), flush=True)
"""


def test_a_process_that_dies_is_told_and_replaced(tmp_path, monkeypatch):
    started = []
    (tmp_path / "dies_once.py").write_text(DIES_ONCE)
    monkeypatch.syspath_prepend(str(tmp_path))

    def start():
        pipe = subprocess.PIPE
        started.append(processes.Child("dies_once", stdin=pipe, stdout=pipe, text=True))
        return started[-1]

    monkeypatch.setattr(local, "_start", start)
    jobs = [Job(tmp_path / str(seed), ALGORITHM, seed, FIVE) for seed in range(3)]
    with pytest.raises(loop.RunError) as error:
        executors.run(jobs, workers=1)
    assert str(error.value) == (
        f"1 of 3 runs failed:\n{jobs[0].path}: its process ended with exit code -9"
    )
    assert error.value.failures == {jobs[0].path: "its process ended with exit code -9"}
    assert [process.returncode for process in started] == [-9, 0]


def test_a_job_stopped_half_way_goes_on(trained, tmp_path):
    (first, *_), _ = trained
    path = tmp_path / "half"
    quiet = {"tensorboard": False, "progress": False}
    loop.train(ALGORITHM, generations=5, path=path, callbacks=(lambda *_: True,), **quiet)
    job = dataclasses.replace(first, path=path)
    assert not job.finished()
    executors.run([job])
    assert job.finished()
    assert (path / "metrics.csv").read_bytes() == (first.path / "metrics.csv").read_bytes()


def test_what_the_clock_left_is_named_with_how_to_go_on(tmp_path, capsys):
    options = FIVE.changed({"generations": 10**6, "wall_clock": 0.0})
    jobs = [Job(tmp_path / f"seed-{seed}", ALGORITHM, seed, options) for seed in range(2)]
    executors.run(jobs, workers=1)
    assert (
        "credo: 2 of 2 runs are not finished for want of time (seed-0 generation 1/1000000, seed-1 "
        "generation 1/1000000): go on with the same command"
    ) in capsys.readouterr().err


def test_runs_go_on_with_another_setting_and_a_larger_budget(trained, tmp_path):
    (first, _, second), _ = trained
    paths = [shutil.copytree(job.path, tmp_path / job.path.name) for job in (first, second)]
    options = RunOptions(generations=7, tensorboard=False)
    again = {"set": {"breeder.crossover_probability": 0.5}}
    executors.run([Job.resumed(path, options, **again) for path in paths])
    for path in paths:
        run = loop.Run(path)
        assert run.metrics["generation"][-1] == 7
        assert run.algorithm == altered(ALGORITHM, crossover_probability=0.5)
        assert run.config["changes"][0]["set"] == {"breeder.crossover_probability": 0.5}
    executors.run([Job.resumed(path, RunOptions()) for path in paths])  # nothing to do
    with pytest.raises(loop.RunError, match=f"{paths[0]}: this run's budget is 7 generations: a n"):
        Job.resumed(paths[0], RunOptions(generations=3)).finished()


def test_callbacks_stay_here(tmp_path):
    options = RunOptions(callbacks=(print,))
    with pytest.raises(ValueError, match="callbacks stay in this process"):
        Job(tmp_path, ALGORITHM, 0, options)


def test_a_signal_reaches_every_worker_and_each_saves(tmp_path):
    arguments = "train neuroevolution sequence-classification --depth 2 --min-gap 1 --max-gap 2"
    arguments += " --population-size 10 --episodes 4 --test-episodes 6 --network.hidden 3"
    arguments += f" --generations 1000000 --seeds 2 --path {tmp_path}"
    command = [
        sys.executable,
        "-c",
        # Two workers, also where there is one core.
        "import sys; from credo import cli, executors as e; run = e.run\n"
        "e.run = lambda jobs, **given: run(jobs, workers=2, **given)\ncli.main(sys.argv[1:])",
        *arguments.split(),
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    paths = [tmp_path / "seed-0", tmp_path / "seed-1"]
    try:
        give_up = time.monotonic() + 120
        while not all((path / "metrics.csv").exists() for path in paths):
            assert process.poll() is None
            assert time.monotonic() < give_up
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, told
    assert "credo: stopped and saved; the same command goes on where it was" in told
    assert "Traceback" not in told
    for path in paths:
        newest = sorted(folder.name for folder in (path / "checkpoints").glob("[0-9]*"))[-1]
        assert int(newest) == loop.Run(path).metrics["generation"][-1] >= 1


def test_a_worker_finds_modules_where_this_process_does(monkeypatch, tmp_path):
    """A folder may have a colon in its name, and a script may have added to the path."""
    folder = tmp_path / "a:b"
    folder.mkdir()
    (folder / "mine_alone.py").write_text("def main(): print('found')")
    monkeypatch.syspath_prepend(str(folder))
    child = processes.Child("mine_alone", stdout=subprocess.PIPE, text=True)
    assert child.communicate(timeout=60) == ("found\n", None)
    assert child.returncode == 0


def gone(pid, seconds=20):
    """Whether a process ends in this time; one that nobody waits for has ended too."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            with open(f"/proc/{pid}/stat") as file:
                if file.read().rpartition(")")[2].split()[0] == "Z":
                    return True
        except OSError:
            return True
        time.sleep(0.05)
    return False


linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
# With a child in its group; it says who they are. Told "deaf" it does not end by a signal.
STUBBORN = """
import os, signal, subprocess, sys, time
def main():
    if sys.argv[2] == "deaf":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    child = subprocess.Popen(["sleep", "100"])
    open(sys.argv[1], "w").write(f"{os.getpid()} {child.pid} ")
    time.sleep(100)
"""
RUNS = """
import subprocess, sys
from credo.environments.processes import Child
from credo import executors
from credo.executors import Job, local
from credo.runs.options import RunOptions
folder, hearing = sys.argv[1:]
sys.path.append(folder)
given = {"grace": 3600.0, "stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
local._start = lambda: Child("stubborn", folder + "/told", hearing, **given)
Job.finished = lambda self: False
options = RunOptions(generations=5)
executors.run([Job(folder + "/run", {"class": "a:B"}, 0, options)], workers=1)
"""


@pytest.fixture
def runs(tmp_path, request):
    """A process that has a worker, and the numbers of this and of its child."""
    (tmp_path / "stubborn.py").write_text(STUBBORN)
    told = tmp_path / "told"
    command = [sys.executable, "-c", RUNS, str(tmp_path), request.param]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 60
        while not (told.exists() and told.read_text().endswith(" ")):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.02)
        yield process, [int(pid) for pid in told.read_text().split()]
    finally:
        process.kill()
        process.wait()
        assert process.stderr is not None
        process.stderr.close()


@linux
@pytest.mark.parametrize("runs", ["deaf"], indirect=True)
def test_a_second_signal_ends_workers_that_are_deaf_to_it(runs):
    process, workers = runs
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    began = time.monotonic()
    _, said = process.communicate(timeout=30)
    assert time.monotonic() - began < 15
    assert process.returncode == 130, said
    assert "credo: stopping after this generation; once more to stop at once" in said
    assert [gone(pid) for pid in workers] == [True, True]


@linux
@pytest.mark.parametrize("runs", ["hearing"], indirect=True)
def test_workers_end_with_a_parent_that_is_killed(runs):
    process, workers = runs
    assert not gone(workers[0], 0.2)
    process.kill()
    process.communicate()
    assert [gone(pid) for pid in workers] == [True, True]


def test_what_a_stranger_recorded_is_not_trusted_by_a_worker(tmp_path):
    job = Job(tmp_path, ALGORITHM, 0, FIVE)
    assert json.loads(job.message())["again"]["trust"] is True
    tree = json.loads(json.dumps(config.to_tree(ALGORITHM))) | {"class": "nowhere:Algorithm"}
    job = Job(tmp_path, tree, 0, FIVE)
    assert json.loads(job.message())["again"]["trust"] is False  # and nothing was imported for it
    assert config.changed(tree, tree) == []
    assert os.listdir(tmp_path) == []


def test_modules_that_open_a_task_while_they_are_imported_are_trained(tmp_path, monkeypatch):
    lines = (
        "from credo.environments.gymnasium import Gymnasium",
        "from credo.environments.probes import Copy",
        "SIZE = Gymnasium('Pendulum-v1').obs_size",
        "class Mine(Copy):",
        "    '''Opened while its module is imported.'''",
    )
    (tmp_path / "opens_1.py").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    mine = importlib.import_module("opens_1").Mine()
    algorithm = Neuroevolution(mine, MLP((2,)), population_size=10, episodes=1, test_episodes=1)
    jobs = [Job(tmp_path / f"{seed}", algorithm, seed, FIVE) for seed in (0, 1)]
    executors.run(jobs, 2)
    assert all(job.finished() for job in jobs)
