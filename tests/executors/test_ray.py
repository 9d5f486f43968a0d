"""Runs as tasks of Ray: whatever dies, they end as runs left alone do."""

import json
import os
import pathlib
import re
import signal
import subprocess
import sys
import time

import pytest

from credo import executors
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments import cluster as clusters
from credo.environments.sequence_classification import SequenceClassification
from credo.executors import Job, Place, node
from credo.networks.mmu import MMU
from credo.runs import config, lock
from credo.runs.options import RunOptions
from credo.runs.record import RunError

linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
ALGORITHM = Neuroevolution(
    SequenceClassification(depth=2, min_gap=1, max_gap=2),
    MMU(hidden=3),
    population_size=10,
    episodes=4,
    test_episodes=6,
)
GENERATIONS = 4000
TRAIN = (
    "train neuroevolution sequence-classification --depth 2 --min-gap 1 --max-gap 2 "
    "--population-size 10 --episodes 4 --test-episodes 6 --network.hidden 3 --tensorboard False "
    f"--generations {GENERATIONS} --checkpoint-every 0.2 --seeds 2 --path runs"
)


# What a node says, without Ray.


def test_a_node_says_why_it_cannot_train(tmp_path):
    mark, home = str(tmp_path / "mark"), str(tmp_path)
    assert node.blind(mark, home).startswith(f"does not see what the command writes into {home}: ")
    with lock.lock(tmp_path / "mark"):
        assert node.blind(mark, home) == ""
        assert node.blind(mark, home + "/gone").startswith(f"has no folder {home}/gone, ")
        assert node.look([mark], home, clusters.versions()) == ""
        other = clusters.versions() | {"jax": "0.1"}
        jax = clusters.versions()["jax"]
        assert node.look([mark], home, other).startswith(f"has jax {jax}, not 0.1: ")
    assert node.blind(mark, home).startswith("does not see that the command locked a file in ")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"on": "ray:"}, "on is 'ray:': runs are trained on local, slurm, ray or ray:HOST:PORT"),
        ({"on": "ray:ray://head:10001"}, ".*; on a machine of the cluster give ray:auto"),
        ({"ray": {"num_gpus": 1}}, "ray is for runs on ray: give --on ray with it"),
    ],
)
def test_settings_that_cannot_be(given, told):
    with pytest.raises(ValueError, match=f"^{told}"):
        Place(**given)


# With Ray, each test with a cluster of its own.


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """Two runs left alone, in processes of this machine."""
    folder = tmp_path_factory.mktemp("straight")
    options = RunOptions(generations=GENERATIONS, tensorboard=False)
    executors.run([Job(folder / f"seed-{s}", ALGORITHM, s, options) for s in range(2)])
    return folder


def assert_same(folder, straight):
    for seed in (0, 1):
        for name in ("metrics.csv", "champion.safetensors", "best.safetensors"):
            path = f"seed-{seed}/{name}"
            assert (folder / path).read_bytes() == (straight / path).read_bytes(), path
        assert list(folder.glob(".credo-*")) == []


class Command:
    """`credo train` of two seeds, in a process of its own, with `more` flags. `before`: Python that
    it runs first."""

    def __init__(self, on, *more, before="pass"):
        program = f"{before}; import sys; from credo import cli; cli.main(sys.argv[1:])"
        words = [sys.executable, "-c", program, *TRAIN.split(), "--on", on, *more]
        self.said = pathlib.Path("said")
        with self.said.open("w") as file:
            self.process = subprocess.Popen(words, stdout=file, stderr=file)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()

    def wait_until(self, true):
        deadline = time.monotonic() + 180
        while not true():
            assert self.process.poll() is None, self.said.read_text()
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def end(self):
        """Its exit code, and what it said."""
        return self.process.wait(timeout=300), self.said.read_text()


def under_way(seed):
    try:
        rows = pathlib.Path(f"runs/seed-{seed}/metrics.csv").read_bytes().count(b"\n")
    except FileNotFoundError:
        return False
    return 50 < rows < GENERATIONS and trainer(seed) is not None


def both_under_way():
    """Whether both runs have 50 rows of metrics, and are trained. The first that has them waits for
    the other: a process of Ray may take longer to begin than a run to end."""
    ready = [under_way(seed) for seed in (0, 1)]
    for seed in (0, 1):
        if ready[seed]:
            os.kill(trainer(seed), signal.SIGCONT if all(ready) else signal.SIGSTOP)
    return all(ready)


def trainer(seed):
    """The process that trains a run; None if none does."""
    try:
        return json.loads(pathlib.Path(f"runs/seed-{seed}/lock").read_text())["pid"]
    except (OSError, ValueError):
        return None


def parent(pid):
    return int(pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def process_of_ray(seed):
    """That which waits for the training of a run: its guardian is between them."""
    return parent(parent(trainer(seed)))


@linux
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_process_of_ray_that_is_killed_and_a_node_that_is_lost(cluster, straight):
    """The first is slow to save, so that its second try has to wait for it."""
    with Command(f"ray:{cluster.address}") as command:
        command.wait_until(both_under_way)
        slow, nodes = trainer(0), {raylet(x): x for x in cluster.worker_nodes}
        lost = nodes[parent(process_of_ray(1))]
        os.kill(slow, signal.SIGSTOP)
        os.kill(process_of_ray(0), signal.SIGKILL)
        waits = f"waiting for it: {pathlib.Path('runs/seed-0')} is in use by process {slow}"
        command.wait_until(lambda: waits in command.said.read_text())
        os.kill(slow, signal.SIGCONT)
        cluster.remove_node(lost, allow_graceful=False)
        code, told = command.end()
    assert code == 0, told
    assert_same(pathlib.Path("runs"), straight)


def raylet(node):
    return node.all_processes["raylet"][0].process.pid


@linux
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_command_that_is_killed_goes_on_when_it_is_given_again(cluster, straight):
    with Command(f"ray:{cluster.address}") as command:
        command.wait_until(both_under_way)
        command.process.kill()
    with Command(f"ray:{cluster.address}") as command:
        code, told = command.end()
    assert code == 0, told
    assert_same(pathlib.Path("runs"), straight)


@linux
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_signal_saves_on_every_node(cluster, straight):
    with Command(f"ray:{cluster.address}") as command:
        command.wait_until(both_under_way)
        command.process.send_signal(signal.SIGINT)
        code, told = command.end()
    assert code == 130, told
    assert "credo: stopped and saved; the same command goes on where it was" in told
    for seed in (0, 1):
        folder = pathlib.Path(f"runs/seed-{seed}")
        newest = max(int(path.name) for path in (folder / "checkpoints").glob("[0-9]*"))
        last = (folder / "metrics.csv").read_text().splitlines()[-1]
        assert newest == int(last.split(",")[0])
        assert trainer(seed) is None
    with Command(f"ray:{cluster.address}") as command:
        code, told = command.end()
    assert code == 0, told
    assert_same(pathlib.Path("runs"), straight)


@linux
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_second_signal_ends_what_cannot_save(cluster):
    with Command(f"ray:{cluster.address}") as command:
        command.wait_until(both_under_way)
        deaf = [trainer(0), trainer(1)]
        for pid in deaf:
            os.kill(pid, signal.SIGSTOP)
        command.process.send_signal(signal.SIGINT)
        time.sleep(2)
        assert command.process.poll() is None
        command.process.send_signal(signal.SIGINT)
        code, told = command.end()
        assert code == 130, told
        deadline = time.monotonic() + 20
        while any(os.path.exists(f"/proc/{pid}") for pid in deaf):
            assert time.monotonic() < deadline
            time.sleep(0.05)


@linux
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_each_run_has_a_gpu_of_its_own(cluster):
    """Ray counts them, and this one believes what it is told."""
    cluster.add_node(num_cpus=2, num_gpus=2)
    with Command(f"ray:{cluster.address}", "--ray", "num_gpus=1") as command:
        command.wait_until(both_under_way)
        seen = set()
        for seed in (0, 1):
            text = pathlib.Path(f"/proc/{trainer(seed)}/environ").read_text()
            seen |= set(re.findall(r"CUDA_VISIBLE_DEVICES=(\d+)", text))
        command.process.send_signal(signal.SIGTERM)
        code, told = command.end()
    assert seen == {"0", "1"}
    assert code == 143, told


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_what_fails_on_this_machine_alone_is_told(tmp_path, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    options = RunOptions(generations=5, tensorboard=False)
    tree = config.to_tree(ALGORITHM)
    tree["env"] = tree["env"] | {"depth": 0}
    good, bad = (
        Job(tmp_path / "good", ALGORITHM, 0, options),
        Job(tmp_path / "bad", tree, 0, options),
    )
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(RunError) as error:
        executors.run([bad, good], 1, on="ray")
    told = f"1 of 2 runs failed:\n{bad.path}: ValueError: depth is 0: it must be at least 1"
    assert str(error.value) == told
    assert good.finished()
    assert signal.getsignal(signal.SIGTERM) == before
    with pytest.raises(RunError, match="--ray asks for 1 CPU, 99999 GPU a run, "):
        executors.run([bad], on=Place("ray", ray={"num_gpus": 99999}))
    with pytest.raises(RunError, match=r"no Ray cluster answers at 127\.0\.0\.1:1: .* refused"):
        executors.run([bad], on="ray:127.0.0.1:1")
    with pytest.raises(RunError, match="Invalid option keyword num_cores"):
        executors.run([bad], on=Place("ray", ray={"num_cores": 1}))
    assert sorted(os.listdir(tmp_path)) == ["good"]


@linux
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_head_that_is_lost_is_named_and_another_cluster_goes_on(cluster, straight):
    soon, address = "import credo.environments.cluster as ray; ray.HEAD = 1.0", cluster.address
    with Command(f"ray:{address}", before=soon) as command:
        command.wait_until(both_under_way)
        trainers = [trainer(0), trainer(1)]
        for pid in trainers:  # neither may end before the head is missed
            os.kill(pid, signal.SIGSTOP)
        cluster.remove_node(cluster.head_node, allow_graceful=False)
        code, told = command.end()
        for pid in trainers:
            os.kill(pid, signal.SIGCONT)
    assert code == 1, told
    assert f"credo: the head of the Ray cluster at {address} has not answered" in told
    assert "the same command goes on where they are" in told
    with Command("ray") as command:  # a cluster of its own, on this machine
        code, told = command.end()
    assert code == 0, told
    assert_same(pathlib.Path("runs"), straight)
