"""Runs as a job array of Slurm, against a stand-in for its commands that runs tasks here."""

import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest
from standin import Slurm

from credo import cli, executors
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.sequence_classification import SequenceClassification
from credo.executors import Job, Place
from credo.executors.jobs import Pending
from credo.networks.mmu import MMU
from credo.runs import config
from credo.runs.options import RunOptions
from credo.runs.record import RunError

ALGORITHM = Neuroevolution(
    SequenceClassification(depth=2, min_gap=1, max_gap=2),
    MMU(hidden=3),
    population_size=10,
    episodes=4,
    test_episodes=6,
)
OPTIONS = RunOptions(generations=4000, tensorboard=False, checkpoint_every=0.2)
SUBMIT = Place("slurm", submit=True, slurm={"time": "4:00:00"})


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """A cluster, and a folder with a space in its name as the place where people work."""
    cluster = Slurm(tmp_path / "slurm")
    cluster.install(monkeypatch)
    home = tmp_path / "a home"
    home.mkdir()
    monkeypatch.chdir(home)
    return cluster


def jobs(*seeds):
    return [Job(pathlib.Path(f"runs/seed-{seed}"), ALGORITHM, seed, OPTIONS) for seed in seeds]


def pending(wanted, place=SUBMIT, **given):
    """What `run` says of runs that are not done."""
    with pytest.raises(Pending) as told:
        executors.run(wanted, on=place, **given)
    assert told.value.code == 0
    return str(told.value)


def script_of(told):
    """The script that a message names."""
    return pathlib.Path(re.search(r"/.*array\.sh", told)[0])


def test_a_script_is_written_and_not_submitted_unless_asked(slurm):
    place = Place(
        "slurm", slurm={"time": "4:00:00", "mem": "8G", "exclusive": True, "requeue": False}
    )
    told = pending(jobs(0, 1, 2), place, workers=2, title="three runs")
    script = script_of(told)
    assert told == (
        f"wrote {script} for 3 runs: submit it by sbatch, or give --submit. Once these have ended, "
        "the same command submits what stopped, or goes on when every run is finished"
    )
    assert slurm.arrays() == []
    lines = script.read_text().splitlines()
    folder = script.parent
    assert lines[0] == "#!/bin/bash"
    assert lines[1].startswith("# three runs: 3 runs, ")
    assert [line for line in lines if line.startswith("#SBATCH")] == [
        f"#SBATCH --job-name=credo-{folder.name}",
        "#SBATCH --array=0-2%2",
        f'#SBATCH --output="{folder}/%a.out"',
        "#SBATCH --open-mode=append",
        "#SBATCH --cpus-per-task=1",
        "#SBATCH --signal=B:USR1@120",
        "#SBATCH --time=4:00:00",
        "#SBATCH --mem=8G",
        "#SBATCH --exclusive",
    ]
    assert subprocess.run(["bash", "-n", str(script)]).returncode == 0


def test_what_is_queued_is_not_submitted_again(slurm):
    told = pending(jobs(0, 1))
    assert told.startswith(f"submitted 2 runs as job array 1 of Slurm, {script_of(told)}. ")
    assert pending(jobs(0, 1)).startswith("already queued or running: 2 runs. ")
    assert slurm.arrays() == [1]
    told = pending(jobs(1, 2))
    assert told.startswith("submitted 1 run as job array 2 of Slurm, ")
    assert "; already queued or running: 1 run. " in told
    os.symlink("runs", "same")  # the same runs by another name
    other = [Job(pathlib.Path("same/seed-0"), ALGORITHM, 0, OPTIONS)]
    assert pending(other).startswith("already queued or running: 1 run. ")
    assert slurm.arrays() == [1, 2]
    # By hand, too.
    script = script_of(pending(jobs(3), Place("slurm")))
    subprocess.run(["sbatch", "--parsable", str(script)], check=True, stdout=subprocess.DEVNULL)
    assert pending(jobs(3)).startswith("already queued or running: 1 run. ")


def test_what_slurm_refuses_is_said(slurm, monkeypatch):
    place = Place("slurm", submit=True, slurm={"partition": "nowhere"})
    with pytest.raises(RunError, match="sbatch: error: invalid partition specified: nowhere"):
        executors.run(jobs(0), on=place)
    assert slurm.arrays() == []
    monkeypatch.setenv("PATH", os.path.dirname(shutil.which("env")))
    with pytest.raises(RunError, match="there is no squeue on this machine: give the command wher"):
        executors.run(jobs(0), on=SUBMIT)
    assert pending(jobs(0), Place("slurm")).startswith("wrote ")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"on": "slurm:here"}, "on is 'slurm:here': runs are trained on local, "),
        ({"submit": True}, "submit is for runs on slurm: give --on slurm with it"),
        ({"slurm": {"time": 5}}, "slurm is for runs on slurm: give --on slurm with it"),
        ({"on": "slurm", "slurm": {"job-name": "x"}}, "slurm cannot set job_name: "),
        ({"on": "slurm", "slurm": {"array": "0-3"}}, "slurm cannot set array: "),
        ({"on": "slurm", "slurm": {"signal": "TERM@60"}}, "slurm sets signal to TERM@60: "),
    ],
)
def test_settings_that_cannot_be(given, told):
    with pytest.raises(ValueError, match=f"^{told}"):
        Place(**given)


# Tasks that run.


def begun(rows):
    """Wait until a run has so many rows of metrics."""

    def wait(path, process):
        deadline, file = time.monotonic() + 120, path / "metrics.csv"
        while not file.exists() or file.read_bytes().count(b"\n") <= rows:
            assert process.poll() is None, (path, process.returncode)
            assert time.monotonic() < deadline
            time.sleep(0.005)

    return wait


def when_begun(path, do):
    """For `Slurm.run`: do something to the processes of a task once its run has 50 rows."""

    def during(process):
        begun(50)(path, process)
        do(process)

    return during


def near_the_limit(process):
    process.send_signal(signal.SIGUSR1)  # as B: in --signal has it, to the first process alone


def cancelled(process):
    os.killpg(process.pid, signal.SIGTERM)


def node_failed(process):
    os.killpg(process.pid, signal.SIGKILL)


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """Three runs left alone, in processes of this machine."""
    folder = tmp_path_factory.mktemp("straight")
    executors.run([Job(folder / f"seed-{s}", ALGORITHM, s, OPTIONS) for s in range(3)])
    return folder


def assert_same(folder, straight, seeds):
    for seed in seeds:
        for name in ("metrics.csv", "champion.safetensors", "best.safetensors"):
            path = f"seed-{seed}/{name}"
            assert (folder / path).read_bytes() == (straight / path).read_bytes(), path


@pytest.mark.slow
def test_whatever_stops_a_task_the_result_is_that_of_a_run_left_alone(slurm, straight, capfd):
    """The limit of time, a node that fails, and a task that is cancelled."""
    three, paths = jobs(0, 1, 2), [job.path for job in jobs(0, 1, 2)]
    pending(three)
    slurm.run(1, 0, when_begun(paths[0], near_the_limit))
    assert slurm.states(1)[0] == "PENDING"  # it put itself back
    slurm.run(1, 1, when_begun(paths[1], node_failed))
    slurm.requeue(1, 1)
    assert slurm.run(1, 2, when_begun(paths[2], cancelled)) == 143
    assert slurm.states(1) == {0: "PENDING", 1: "PENDING", 2: "FAILED"}
    assert [job.finished() for job in three] == [False, False, False]
    # What was cancelled is submitted again, alone.
    assert "submitted 1 run as job array 2 of Slurm" in pending(three)
    assert [slurm.run(*task) for task in ((1, 0), (1, 1), (2, 0))] == [0, 0, 0]
    executors.run(three, on=SUBMIT)  # nothing is left to do
    assert slurm.arrays() == [1, 2]
    assert_same(pathlib.Path("runs"), straight, (0, 1, 2))
    assert capfd.readouterr().err.count("failed") == 0


@pytest.mark.slow
def test_what_fails_is_told_by_the_next_command(slurm, capfd):
    tree = config.to_tree(ALGORITHM)
    tree["env"] = tree["env"] | {"depth": 0}
    wanted = [Job(pathlib.Path("runs/bad"), tree, 0, OPTIONS)]
    pending(wanted)
    assert slurm.run(1, 0) == 1
    told = "runs/bad: ValueError: depth is 0: it must be at least 1"
    with pytest.raises(executors.RunsFailed, match=f"1 of 1 runs failed:\n{told}"):
        executors.run(wanted, on=SUBMIT, retry=False)
    assert slurm.arrays() == [1]
    assert "submitted 1 run as job array 2 of Slurm" in pending(wanted)
    err = capfd.readouterr().err
    assert f"credo: failed on Slurm and tried again:\n{told}" in err


@pytest.mark.slow
def test_a_task_without_a_generation_in_its_time_is_not_put_back_for_ever(slurm, straight, capfd):
    (one,) = jobs(0)
    shutil.copytree(straight / "seed-0", one.path)
    longer = [Job(one.path, ALGORITHM, 0, OPTIONS.changed({"generations": 5000}))]
    pending(longer)

    def at_once(process):
        """Before its worker has begun."""
        while not list(pathlib.Path("/proc").glob(f"{process.pid}/task/*/children")) or not (
            pathlib.Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text()
        ):
            time.sleep(0.005)
        near_the_limit(process)

    assert slurm.run(1, 0, at_once) == 1
    assert slurm.states(1) == {0: "FAILED"}
    pending(longer)
    assert "no generation ended before the limit of time" in capfd.readouterr().err


@pytest.mark.slow
def test_several_seeds_by_the_command_line(slurm, straight, tmp_path):
    words = "train neuroevolution sequence-classification --depth 2 --min-gap 1 --max-gap 2"
    words += " --population-size 10 --episodes 4 --test-episodes 6 --network.hidden 3"
    words += " --generations 4000 --tensorboard False --seeds 2 --path runs"
    command = [sys.executable, "-m", "credo", *words.split()]
    given = {"capture_output": True, "text": True}
    more = ["--on", "slurm", "--submit", "--slurm", "time=4:00:00", "mem=2G"]
    first = subprocess.run([*command, *more], **given)
    assert first.returncode == 0, first.stderr
    assert "credo: submitted 2 runs as job array 1 of Slurm" in first.stderr
    assert first.stdout == ""
    assert [slurm.run(1, task) for task in (0, 1)] == [0, 0]
    last = subprocess.run(command, **given)
    assert last.returncode == 0, last.stderr
    assert last.stdout.startswith("runs/seed-0: generation 4000, ")
    assert_same(pathlib.Path("runs"), straight, (0, 1))


SWEEP = """
algorithm = "neuroevolution"
task = "sequence-classification"
generations = 20
depth = 2
min-gap = 1
max-gap = 2
population-size = 10
episodes = 4
test-episodes = 6
network.hidden = 3
tensorboard = false

[ranges]
mutation-strength = { low = 1e-3, high = 1.0, log = true }

[sweep]
trials = 2
together = 1
seeds = 2
startup = 1
"""


@pytest.mark.slow
def test_a_sweep_takes_a_command_for_each_round_and_each_seed_that_may_be_the_last(slurm, capsys):
    """The second trial may be pruned after its first seed. The trials are those of a sweep here."""
    pytest.importorskip("optuna", reason="Optuna is of the extra sweep")
    pathlib.Path("file.toml").write_text(SWEEP)

    def sweep(words):
        code = 0
        try:
            cli.main(["sweep", "file.toml", *words.split()])
        except SystemExit as end:  # what is submitted ends the command
            code = end.code
        assert code == 0
        return capsys.readouterr()

    told = []
    while "page: runs/file/report.html" not in (said := sweep("--on slurm --submit")).out:
        told.append(said.err)
        newest = slurm.arrays()[-1]
        assert {slurm.run(newest, task) for task in slurm.states(newest)} == {0}
    assert "submitted 2 runs as job array 1 of Slurm" in told[0]
    assert "credo sweep runs/file submits what stopped, or goes on when every run" in told[0]
    assert "submitted 1 run as job array 2 of Slurm" in told[1]
    sweep("--path here")
    pages = [pathlib.Path(x, "report.html").read_text() for x in ("runs/file", "here")]
    assert pages[0].replace("runs/file", "here").replace("sweep file", "sweep here") == pages[1]
    seeds = sorted(pathlib.Path("here").glob("trial-*/seed-*"))
    assert len(seeds) == len(told) + 1
    for seed in seeds:
        for name in ("metrics.csv", "champion.safetensors"):
            there = pathlib.Path("runs/file") / seed.relative_to("here") / name
            assert there.read_bytes() == (seed / name).read_bytes()
