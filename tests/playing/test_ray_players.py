"""Episodes that tasks of Ray play: the same bits, whatever dies."""

import os
import pathlib
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from test_players import ENVIRONMENTS, TASK, played, same

from credo.environments import foreign
from credo.environments.gymnasium import Gymnasium
from credo.networks.mlp import MLP, MLPPolicy
from credo.playing import players
from credo.runs.options import RunOptions

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore"),
    pytest.mark.skipif(sys.platform != "linux", reason="reads /proc"),
]
FILES = ("metrics.csv", "champion.safetensors", "best.safetensors")
TRAIN = (
    "erl Pendulum-v1 --max-episode-steps 100 --generations 30 --population-size 10 --hidden 16 "
    "--updates-per-frame 0.02 "
    "--checkpoint-every 0.2 --tensorboard False --path run"
)


@pytest.fixture(autouse=True)
def _environments(monkeypatch):
    monkeypatch.syspath_prepend(ENVIRONMENTS)


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """The files of a run that this machine played by itself."""
    folder = tmp_path_factory.mktemp("straight")
    subprocess.run(command("local", "train", TRAIN), cwd=folder, check=True, capture_output=True)
    return files(folder)


def files(folder):
    return [(folder / "run" / name).read_bytes() for name in FILES]


def command(where, verb, words, before="pass"):
    """`credo` with `--rollouts`, which runs some Python first."""
    program = f"{before}; import sys; from credo import cli; cli.main(sys.argv[1:])"
    return [sys.executable, "-c", program, verb, *words.split(), "--rollouts", where]


class Training:
    """A command in a process of its own."""

    def __init__(self, *told, **how):
        self.said = pathlib.Path("said")
        with self.said.open("w") as file:
            self.process = subprocess.Popen(command(*told, **how), stdout=file, stderr=file)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()

    def rows(self):
        try:
            return pathlib.Path("run/metrics.csv").read_bytes().count(b"\n")
        except FileNotFoundError:
            return 0

    def wait_for(self, rows):
        """Until there are so many rows of metrics."""
        deadline = time.monotonic() + 120
        while self.rows() < rows:
            assert self.process.poll() is None, self.said.read_text()
            assert time.monotonic() < deadline
            time.sleep(0.02)

    def end(self):
        """Its exit code, and what it said."""
        return self.process.wait(timeout=240), self.said.read_text()


def playing():
    """Processes of Ray that play for us, by the node's process that began them."""
    found = subprocess.run(["ps", "-eo", "pid,ppid,args"], capture_output=True, text=True).stdout
    rows = [line.split(maxsplit=2) for line in found.splitlines()[1:]]
    return {int(pid): int(parent) for pid, parent, name in rows if name.startswith("ray::played")}


def test_their_number_changes_no_bit(cluster):
    import ray

    ray.init(address=cluster.address)
    try:
        alone = played(TASK, MLP(hidden=(16, 16)))
        for number in (1, 2, 4, None):
            with players.using(number, "ray"):
                crew = players._CURRENT.players
                assert same(alone, played(TASK, MLP(hidden=(16, 16)), crew=crew))
                assert crew._spent == 0.0  # seconds that this process played
        kwargs = {"every": 9, "fault": "dies", "at": 2}
        task = Gymnasium("failing:Rare", kwargs=kwargs, max_episode_steps=6, tolerated=1.0)
        with players.using(2, "ray"):
            crew = players._CURRENT.players
            mine = played(task, MLP(hidden=(4,)), 7, 4, common=False, crew=crew)
            assert crew._suspects == set()  # the task has a worker there
            assert same(mine, played(task, MLP(hidden=(4,)), 7, 4, common=False))
            assert np.isnan(mine[0].of("reward")).any()
            with pytest.raises(
                players.NotPlayed, match=r"^--rollouts ray needs policies and tasks"
            ):
                played(TASK, Own(), crew=crew)
    finally:
        foreign.close_all()
        ray.shutdown()


class Own(MLP):
    """A network of a class that the test alone has."""

    def init(self, *sizes, key):
        class Policy(MLPPolicy):
            pass

        made = super().init(*sizes, key=key)
        return Policy(**vars(made))


def test_twenty_kills_and_a_node_that_is_lost_change_no_bit(cluster, straight):
    draw, killed, lost = random.Random(0), set(), next(iter(cluster.worker_nodes))
    with Training(f"ray:{cluster.address}", "train", TRAIN) as training:
        while training.process.poll() is None and len(killed) < 20:
            if victims := sorted(set(playing()) - killed):
                time.sleep(draw.uniform(0.0, 0.05))  # anywhere in what it plays
                killed.add(victim := draw.choice(victims))
                os.kill(victim, signal.SIGKILL)
            if len(killed) == 10 and lost in cluster.worker_nodes:
                cluster.remove_node(lost, allow_graceful=False)
                cluster.add_node(num_cpus=2)
            time.sleep(0.05)
        code, told = training.end()
    assert code == 0, told
    assert len(killed) == 20
    assert files(pathlib.Path()) == straight


def test_a_command_that_is_killed_goes_on(cluster, straight):
    where = f"ray:{cluster.address}"
    with Training(where, "train", TRAIN) as training:
        training.wait_for(8)
    with Training(where, "resume", "run") as training:
        code, told = training.end()
    assert code == 0, told
    assert files(pathlib.Path()) == straight


def test_a_head_that_is_lost_is_named_and_the_run_goes_on_without_it(cluster, straight):
    soon = "import credo.environments.cluster as cluster; cluster.HEAD = 1.0"
    address = cluster.address
    with Training(f"ray:{address}", "train", TRAIN, before=soon) as training:
        training.wait_for(8)
        cluster.remove_node(cluster.head_node, allow_graceful=False)
        code, told = training.end()
    assert code == 1, told
    head = f"the head of the Ray cluster at {address} has not answered for 1 s"
    if head in told or "Ray has ended on this machine" in told:
        assert "resume with `credo resume run`" in told
    else:  # Ray's core found out between our question and its own, and ended the process
        assert "Traceback" not in told, told
    with Training("local", "resume", "run") as training:
        code, told = training.end()
    assert code == 0, told
    assert files(pathlib.Path()) == straight


def test_a_place_that_there_is_not_is_named():
    with pytest.raises(ValueError, match=r"rollouts is 'slurm': episodes are played on local, ray"):
        RunOptions(rollouts="slurm")
