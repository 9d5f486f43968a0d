"""Runs as tasks of Ray, on this machine or on a cluster: `pip install credo[ray]`.

A task is a process of Ray's that starts a worker (see `worker`) as its child, gives it one job and
waits: training has its own signals, threads and memory, and is saved when Ray's process is gone. A
task whose process or node dies is tried again, on whichever node has room. It goes on from the
run's last checkpoint, once the worker before it has saved and let go of the run's lock. So folders
of runs must be on storage that all nodes see, with locks that hold between them: each node is
asked, at the start and before each task.
"""

import contextlib
import importlib
import math
import os
import pathlib
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..environments import processes
from ..runs import files, screen
from ..runs.lock import RunLocked, lock
from ..runs.record import RunError
from ..runs.signals import Signals
from . import node
from .array import ALL_CORES
from .board import Board
from .jobs import PATIENCE, Ending, Job
from .places import Place

TRIES = 100  # of a job whose process or node dies: more are no bad luck
HEAD = 40.0  # seconds without its head after which a cluster is given up; after 60 Ray ends us
SEEN = 70.0  # seconds after which NFS shows what was written on another node
STORE = 10**8  # bytes of memory for Ray's objects, of which there are hardly any
TAKEN = ("CREDO_", "JAX_", "XLA_")  # variables of the environment that are so on all nodes
MARK = ".credo-"  # before the name of a folder by which nodes show that they see the storage


def train(jobs: Sequence[Job], workers: int | None, place: Place, title: str) -> Ending:
    """Train jobs as tasks of Ray, `workers` at a time; None: as many as there is room for.

    Raises `RunError` without Ray or the cluster, and if a node does not see the storage of the
    runs or has other versions.
    """
    try:
        ray = importlib.import_module("ray")
    except ImportError as error:
        raise RunError("--on ray needs Ray: pip install 'credo[ray]'") from error
    needs = {"num_cpus": 1, "max_retries": TRIES} | place.ray
    with _connected(ray, place.address, workers, needs) as alone, _marks(jobs) as marks:
        _check_nodes(ray, list(marks.values()), needs, alone)
        crew = _Crew(ray, jobs, marks, needs, title)
        number = crew.work(workers or len(jobs))
        return Ending(crew.failures, number, lost=crew.lost)


class _Crew:
    """Tasks, one for each job.

    - `queue`: jobs that Ray was not given yet; `under_way`: tasks with their jobs; `trained`: jobs
      whose tasks ended well.
    - `failures`: why jobs failed, by the folders of their runs. `lost`: why there is no cluster any
      more, in words.
    """

    def __init__(
        self, ray: Any, jobs: Sequence[Job], marks: Mapping[str, str], needs: Any, title: str
    ):
        self.ray, self.queue, self.marks = ray, iter(jobs), marks
        self.under_way, self.trained = dict[Any, Job](), list[Job]()
        self.failures, self.lost = dict[pathlib.Path, str](), ""
        self.board, self.signals = Board(title, len(jobs)), Signals(quiet=False)
        try:
            self.remote = ray.remote(**needs)(node.train)
        except (TypeError, ValueError) as error:
            raise RunError(f"--ray {needs}: {error}") from error
        self.setup = {
            "home": os.getcwd(),
            "path": [os.path.abspath(entry) for entry in sys.path],
            "env": {name: x for name, x in os.environ.items() if name.startswith(TAKEN)},
            "arguments": [ALL_CORES] * (needs["num_cpus"] > 1),
        }
        self.head = _Head(ray)

    def work(self, number: int) -> int:
        """Do all jobs, so many at a time; the signal that ended it, or 0."""
        asked = False
        with self.signals:
            try:
                self.board.start()
                self.give(number)
                while self.under_way and not self.lost:
                    if self.signals.received and not asked:
                        asked = True
                        self.cancel()  # by which they save
                    self.listen()
                    self.lost = self.head.missing() if self.under_way else ""
                    self.board.show(job for job in self.under_way.values() if _begun(job))
                self.wait_for_files()
            except SystemExit:  # after a second signal; Ray may have made its code another
                self.cancel()  # by which they end at once
                if tasks := list(self.under_way):
                    self.ray.wait(tasks, num_returns=len(tasks), timeout=1.0)
                raise SystemExit(128 + self.signals.received) from None
            finally:
                self.board.stop()
        return self.signals.received

    def give(self, number: int) -> None:
        """Give the next jobs to Ray, until it has so many."""
        while len(self.under_way) < number and not self.signals.received:
            job = next(self.queue, None)
            if job is None:
                return
            mark = self.marks[_parent(job)]
            train = self.remote.options(name="/".join(job.path.parts[-2:]))
            self.under_way[train.remote(job.message(PATIENCE), mark, self.setup)] = job

    def listen(self) -> None:
        """Take the answers that are there, and give what is next."""
        number = len(self.under_way)
        for task in self.ray.wait(list(self.under_way), timeout=0.2)[0]:
            job, answer = self.under_way.pop(task), self.answer(task)
            if not self.signals.received:  # else it was stopped and saved, not finished
                self.board.over(job)
                if "error" in answer:
                    self.failures[job.path] = answer["error"]
                else:
                    self.trained.append(job)
        self.give(number)

    def cancel(self) -> None:
        """Interrupt all tasks."""
        for task in self.under_way:
            self.ray.cancel(task)

    def answer(self, task: Any) -> dict[str, Any]:
        """What a task returned, or why Ray has nothing of it."""
        try:
            return self.ray.get(task)
        except self.ray.exceptions.RayError as error:
            return {"error": f"{_brief(error)} What was saved stands: the same command goes on"}

    def wait_for_files(self) -> None:
        """Wait for what other nodes wrote to be seen here: NFS may show a folder as it was."""
        until = time.monotonic() + SEEN
        for job in [job for job in self.trained if job.options.wall_clock is None]:
            while not job.finished() and time.monotonic() < until:
                time.sleep(1.0)


class _Head:
    """Whether the head of the cluster is there. Ray itself says nothing until it ends the process
    that asks."""

    def __init__(self, ray: Any):
        self.address = ray.get_runtime_context().gcs_address
        self.answered = self.asked = time.monotonic()

    def missing(self) -> str:
        """Why the cluster is given up, in words; "" as long as there is hope."""
        now = time.monotonic()
        if now - self.asked < 1.0:
            return ""
        self.asked = now
        try:
            _reach(self.address, 1.0)
            self.answered = now
        except OSError as error:
            if now - self.answered > HEAD:
                return (
                    f"the head of the Ray cluster at {self.address} has not answered for "
                    f"{HEAD:.0f} s ({error}): runs under way are saved as their nodes end. Start "
                    "the cluster again"
                )
        return ""


def _brief(error: Exception) -> str:
    """An error of Ray's in a line: what was raised on a node comes last, behind its traceback."""
    lines = str(error).strip().splitlines() or [""]
    raised = type(error).__name__.startswith("RayTaskError")
    return lines[-1] if raised else f"{type(error).__name__}: {lines[0]}"


def _reach(address: str, patience: float) -> None:
    """Raise `OSError` if nothing answers at HOST:PORT within so many seconds, and `ValueError` if
    the address is none."""
    host, _, port = address.rpartition(":")
    socket.create_connection((host.strip("[]"), int(port)), timeout=patience).close()


def _begun(job: Job) -> bool:
    """Whether a worker has the run now, as far as can be seen from here."""
    try:
        return os.stat(job.path / "lock").st_size > 0
    except OSError:
        return False


def _parent(job: Job) -> str:
    return os.path.dirname(os.path.abspath(job.path))


# Before and after.


@contextlib.contextmanager
def _connected(
    ray: Any, address: str, workers: int | None, needs: Mapping[str, Any]
) -> Iterator[bool]:
    """Use the cluster at an address, or that of $RAY_ADDRESS; without either one of this machine's
    cores, which ends with the block. One that the caller is connected to already is kept. Yields
    whether no other machine can join."""
    if ray.is_initialized():
        yield False
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    address = address or os.environ.get("RAY_ADDRESS", "local")
    how: dict[str, Any] = {"address": address, "logging_level": "WARNING"}
    if address == "local":
        room = max(len(processes.cores()), math.ceil((workers or 0) * needs["num_cpus"]))
        how |= {"num_cpus": room, "include_dashboard": False, "object_store_memory": STORE}
        how |= {"logging_level": "ERROR"}  # nobody can reach it whom it might warn of
    before = signal.getsignal(signal.SIGTERM)
    try:
        try:
            if address not in ("local", "auto"):
                _reach(address, 5.0)  # Ray itself would try for minutes
            ray.init(**how)
        except (OSError, ValueError) as error:
            raise RunError(
                f"no Ray cluster answers at {address}: {error}. Start one (ray start --head), or "
                "give --on ray, and no RAY_ADDRESS, for this machine alone"
            ) from error
        yield address == "local"
    finally:
        ray.shutdown()
        with contextlib.suppress(ValueError):  # in another thread nothing was changed
            signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _marks(jobs: Sequence[Job]) -> Iterator[dict[str, str]]:
    """A locked folder in each folder in which runs lie, by that folder; gone afterwards. Those of
    commands that were killed are removed."""
    with contextlib.ExitStack() as held:
        marks = {}
        for parent in sorted({_parent(job) for job in jobs}):
            os.makedirs(parent, exist_ok=True)
            for old in pathlib.Path(parent).glob(f"{MARK}*"):
                with contextlib.suppress(RunLocked), lock(old):
                    files.remove(old)
            mark = tempfile.mkdtemp(prefix=MARK, dir=parent)
            held.callback(files.remove, mark)
            held.enter_context(lock(pathlib.Path(mark)))
            marks[parent] = mark
        yield marks


def _check_nodes(ray: Any, marks: Sequence[str], needs: Mapping[str, Any], alone: bool) -> None:
    """Raise `RunError` if a node that may get a run cannot train it as this machine would, or if
    there is none and none can join."""
    room = {"CPU": needs["num_cpus"], "GPU": needs.get("num_gpus") or 0}
    able = [
        found
        for found in ray.nodes()
        if found["Alive"] and all(found["Resources"].get(x, 0) >= n for x, n in room.items())
    ]
    if not able:
        told = ", ".join(f"{number:g} {name}" for name, number in room.items() if number)
        if alone:
            raise RunError(f"--ray asks for {told} a run, which this machine has not")
        screen.say(f"credo: no node of the cluster has {told} now: runs wait for one")
    asked = [_asked(ray, found["NodeID"], marks) for found in able]
    for found, task in zip(able, asked, strict=True):
        try:
            why = ray.get(task)
        except ray.exceptions.RayError as error:
            why = f"cannot train: {_brief(error)}"
        if why:
            raise RunError(f"node {found['NodeManagerHostname']} {why}")


def _asked(ray: Any, node_id: str, marks: Sequence[str]) -> Any:
    """The task that looks at a node."""
    module = importlib.import_module("ray.util.scheduling_strategies")
    there = module.NodeAffinitySchedulingStrategy(node_id, soft=False)
    look = ray.remote(node.look).options(num_cpus=0, scheduling_strategy=there)
    return look.remote(marks, os.getcwd(), node.versions())
