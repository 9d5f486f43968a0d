"""Players on this machine: child processes, each on a core of its own, and the pipes to them."""

import contextlib
import pickle
import subprocess
from typing import Any

from ..environments import worker
from ..environments.processes import Child
from . import cut, player
from .crew import AbstractCrew, Answer, Batch
from .player import ASKED, LENGTH


class Processes(AbstractCrew):
    """Up to `number` processes, begun when they are needed."""

    tries, instead = 3, ""

    def __init__(self, number: int):
        self.number = number
        self.all: list[_Player | None] = [None] * number

    def awake(self) -> bool:
        return any(self.all)

    def begin(self, batch: Batch) -> None:
        for k in range(len(batch.shares)):
            self._begun(k)  # all at the same time, before the first is spoken to

    def give(self, batch: Batch, k: int, spared: bool) -> None:
        sent = cut(batch.parts, batch.shares[k]), batch.told
        self._begun(k).give(pickle.dumps(sent, protocol=5), spared)

    def take(self, k: int) -> Answer | None:
        one = self.all[k]
        answer = one.take() if one is not None else None
        if answer is None:
            self._drop(k)
        return answer

    def close(self) -> None:
        for k in range(self.number):
            self._drop(k)

    def _begun(self, k: int) -> "_Player":
        """Player `k`, begun if there is none."""
        one = self.all[k]
        if one is None or one.over(0.0):
            self._drop(k)
            one = self.all[k] = _Player()
        return one

    def _drop(self, k: int) -> None:
        one, self.all[k] = self.all[k], None
        if one is not None:
            one.end(0.0)


class _Player(Child):
    """One process, and the pipes to it."""

    def __init__(self):
        pipe = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        super().__init__(player.__name__, opening=True, env=worker.one_thread(), **pipe)
        assert self.stdin is not None
        assert self.stdout is not None
        self._to, self._from = self.stdin, self.stdout

    def give(self, message: bytes, spared: bool) -> None:
        """A share to play; `spared`: the task must not end the process."""
        with contextlib.suppress(BrokenPipeError):  # it is dead, and `take` hears of it
            self._to.write(ASKED.pack(spared, len(message)))
            self._to.write(message)
            self._to.flush()

    def take(self) -> Any:
        """Its answer; None if it is dead."""
        head = self._from.read(LENGTH.size)
        if len(head) < LENGTH.size:
            return None
        (length,) = LENGTH.unpack(head)
        body = self._from.read(length)
        return pickle.loads(body) if len(body) == length else None

    def end(self, grace: float) -> None:
        for stream in (self._to, self._from):
            with contextlib.suppress(OSError):
                stream.close()
        super().end(grace)
