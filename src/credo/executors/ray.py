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
import os
import pathlib
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..environments import cluster
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
SEEN = 70.0  # seconds after which NFS shows what was written on another node
LEFT = ": runs under way are saved as their nodes end. Start the cluster again"
MARK = ".credo-"  # before the name of a folder by which nodes show that they see the storage


def train(jobs: Sequence[Job], workers: int | None, place: Place, title: str) -> Ending:
    """Train jobs as tasks of Ray, `workers` at a time; None: as many as there is room for.

    Raises `RunError` without Ray or the cluster, and if a node does not see the storage of the
    runs or has other versions.
    """
    needs = {"num_cpus": 1, "max_retries": TRIES} | place.ray
    if any(job.options.rollouts != "local" for job in jobs):
        raise ValueError(
            "rollouts cannot be on ray too: a task of Ray trains each run, and plays it"
        )
    try:
        ray, room = cluster.library("--on ray"), (workers or 0) * needs["num_cpus"]
        with cluster.connected(ray, place.address, "--on", room) as alone, _marks(jobs) as marks:
            _check_nodes(ray, list(marks.values()), needs, alone)
            crew = _Crew(ray, jobs, marks, needs, title)
            number = crew.work(workers or len(jobs))
            return Ending(crew.failures, number, lost=crew.lost)
    except cluster.ClusterLost as error:
        raise RunError(str(error)) from error


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
        self.setup = cluster.home() | {"arguments": [ALL_CORES] * (needs["num_cpus"] > 1)}
        self.head = cluster.Head(ray)

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
                    self.lost += LEFT if self.lost else ""
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
            return {
                "error": f"{cluster.brief(error)} What was saved stands: the same command goes on"
            }

    def wait_for_files(self) -> None:
        """Wait for what other nodes wrote to be seen here: NFS may show a folder as it was."""
        until = time.monotonic() + SEEN
        for job in [job for job in self.trained if job.options.wall_clock is None]:
            while not job.finished() and time.monotonic() < until:
                time.sleep(1.0)


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
            why = f"cannot train: {cluster.brief(error)}"
        if why:
            raise RunError(f"node {found['NodeManagerHostname']} {why}")


def _asked(ray: Any, node_id: str, marks: Sequence[str]) -> Any:
    """The task that looks at a node."""
    module = importlib.import_module("ray.util.scheduling_strategies")
    there = module.NodeAffinitySchedulingStrategy(node_id, soft=False)
    look = ray.remote(node.look).options(num_cpus=0, scheduling_strategy=there)
    return look.remote(marks, os.getcwd(), cluster.versions())
