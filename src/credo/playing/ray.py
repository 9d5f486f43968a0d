"""Players as tasks of Ray, on this machine or on a cluster: `pip install credo[ray]`.

All that a generation plays is put into Ray's object store once; a task is told of it, which slices
are its own, and keeps nothing but the environments that it has opened. So whatever is lost, a
process, a node or an object, is played again, to the same bits. Nodes need no common storage.
Environments have a worker of their own there, which ends with all that it started.
"""

import contextlib
import os
import pickle
import socket
import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ..environments import cluster, processes
from . import Share, cut
from .crew import AbstractCrew, Answer, Batch, answer, enlist

ROOM = 10**9  # bytes of memory for transitions, where this machine is the cluster
LOOK = 10.0  # seconds until the cluster is asked again how many cores it has


class Tasks(AbstractCrew):
    """A task for each share, `number` at a time; None: one for each core that the cluster has."""

    tries = 20  # nodes may be lost one after the other
    instead = "--rollouts ray needs policies and tasks that other processes can import"

    def __init__(self, ray: Any, number: int | None, alone: bool):
        self._ray, self._given = ray, number
        self._counted, self._seen = -LOOK, 1
        self._setup, self._head = cluster.home(), cluster.Head(ray)
        self._lost = ""  # why a task had no answer
        settings: dict[str, Any] = {"num_cpus": 1, "max_retries": 0}
        if self._setup["env"] and not alone:  # before a process there imports JAX
            settings["runtime_env"] = {"env_vars": self._setup["env"]}
        self._play = ray.remote(**settings)(played)
        self._sent: tuple[Batch, Any] | None = None
        self._tasks: dict[int, Any] = {}

    @property
    def number(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        if self._given is not None:
            return self._given
        now = time.monotonic()
        if now - self._counted >= LOOK:
            self._require()
            self._counted = now
            self._seen = max(1, int(self._ray.cluster_resources().get("CPU", 1)))
        return self._seen

    def awake(self) -> bool:
        return True

    def begin(self, batch: Batch) -> None:
        """Put it into the object store, its arrays as they are."""
        buffers: list[pickle.PickleBuffer] = []
        self._require()
        head = pickle.dumps((batch.parts, batch.told), protocol=5, buffer_callback=buffers.append)
        arrays = [np.asarray(buffer.raw()) for buffer in buffers]
        try:
            self._sent = batch, self._ray.put((head, arrays))
        except self._ray.exceptions.RayError as error:
            raise cluster.ClusterLost(f"Ray holds no more: {cluster.brief(error)}") from error

    def give(self, batch: Batch, k: int, spared: bool) -> None:
        if self._sent is None or self._sent[0] is not batch:
            self.begin(batch)
        assert self._sent is not None
        self._tasks[k] = self._play.remote(self._sent[1], batch.shares[k], self._setup)

    def _require(self) -> None:
        """Raise `ClusterLost` rather than let Ray end this process."""
        if lost := self._head.gone() or self._head.missing():
            raise cluster.ClusterLost(lost)

    def take(self, k: int) -> Answer | None:
        """Raises `ClusterLost` when its head does not answer any more."""
        task, errors = self._tasks[k], self._ray.exceptions
        try:
            while not self._ray.wait([task], timeout=1.0)[0]:
                self._require()
            self._require()
            answer = self._ray.get(task)
        except errors.RayError as error:
            raised = isinstance(error, errors.RayTaskError)
            if raised and not isinstance(error.cause, errors.RayError):
                answer = "error", cluster.brief(error)
            else:  # the object may be what was lost
                self._sent, self._lost, answer = None, cluster.brief(error), None
        del self._tasks[k]
        return answer

    def lost(self) -> str:
        return self._lost

    def close(self) -> None:
        tasks, self._tasks, self._sent = list(self._tasks.values()), {}, None
        for task in tasks:
            with contextlib.suppress(self._ray.exceptions.RayError):
                self._ray.cancel(task, force=True)


@contextlib.contextmanager
def crew(address: str, number: int | None) -> Iterator[Tasks]:
    """Tasks on the cluster at an address, or of this machine if it is ""; at most `number` at the
    same time. Raises `ClusterLost` if nobody answers."""
    ray, flag = cluster.library("--rollouts ray"), "--rollouts"
    with cluster.connected(ray, address, flag, number or 0, ROOM) as alone:
        tasks = Tasks(ray, number, alone)
        try:
            yield tasks
        finally:
            tasks.close()


_enlisted = False


def played(sent: tuple[bytes, list[np.ndarray]], share: Share, setup: Mapping[str, Any]) -> Answer:
    """What a task does, in a process of Ray's."""
    global _enlisted
    if not _enlisted:
        if why := cluster.homeless(setup["home"]) or cluster.other(setup["versions"]):
            return "error", f"node {socket.gethostname()} {why}"
        os.environ.update(setup["env"])
        cluster.move_in(setup)
        processes.serves(opening=True)
        enlist()
        _enlisted = True

    def load() -> Any:
        head, arrays = sent
        parts, told = pickle.loads(head, buffers=arrays)
        return cut(parts, share), told

    return answer(load, spared=True)
