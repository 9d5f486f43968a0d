"""Who plays episodes outside JAX: this process, or several, each on a core of its own.

Whatever is asked for by the time the first outcome is wanted is played together, lane beside lane:
so the champion's test costs a population's rollout little. How many processes there are changes no
bit. A player holds JAX on one thread and the environments, without a worker between, which a step
would have to wait for; it is begun when this process has played for `PATIENCE` seconds by itself,
so that short runs pay nothing. One that dies is begun anew, and plays its share again; in case the
task was the reason, from then on the task has a worker, that can tell.
"""

import contextlib
import dataclasses
import pickle
import subprocess
import threading
import time
import weakref
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from ..environments import foreign, worker
from ..environments.host import AbstractHostEnvironment, EnvironmentFailure
from ..environments.processes import Child, cores
from . import Outcome, Part, Share, joined, play, player, shared
from .player import ASKED, LENGTH

PATIENCE = 2.0  # seconds of playing here before others are asked
TRIES = 3  # of a share whose player dies


class Asked:
    """Episodes that somebody asked for. They are played at the latest when `result` is called; what
    nobody holds any more is not played at all."""

    def __init__(self, part: Part, by: "Players"):
        self.part, self._by = part, by
        self.outcome: Outcome | None = None

    def result(self) -> Outcome:
        """What came of them. Raises `EnvironmentFailure` if too many failed, these or others that
        were played with them."""
        if self.outcome is None:
            self._by.settle(self)
        if self.outcome is None:
            raise RuntimeError("these episodes were given up when others failed: ask again")
        return self.outcome


class Players:
    """Up to `number` processes, at least 1: with 1 this one plays all."""

    def __init__(self, number: int, patience: float | None = None):
        self.number, self._spent = number, 0.0
        self._patience = PATIENCE if patience is None else patience
        self._all: list[_Player | None] = [None] * number
        self._waiting: list[weakref.ref[Asked]] = []
        self._away: _Batch | None = None  # what the processes play just now
        self._suspects: set[AbstractHostEnvironment] = set()  # tasks with which a process died

    def ask(self, part: Part) -> Asked:
        """Ask for episodes, which others may be played with."""
        asked = Asked(part, self)
        self._waiting.append(weakref.ref(asked))
        return asked

    def start(self) -> None:
        """Let other processes, where there are any, begin with what was asked for."""
        if self._away is not None:
            return
        for together in self._drawn():
            if self._away is None and (batch := self._sent(together, least=1)):
                self._away = batch
            else:
                self._waiting += map(weakref.ref, together)

    def settle(self, wanted: Asked) -> None:
        """Play what was asked for, until there is an outcome of this."""
        batch, self._away = self._away, None
        if batch is not None:
            self._take(batch)
        if wanted.outcome is None:
            for together in self._drawn():
                self._play(together)

    def _drawn(self) -> list[list[Asked]]:
        """What is still wanted of all that waits, by task."""
        held = [asked for one in self._waiting if (asked := one()) is not None]
        self._waiting, tasks = [], list[list[Asked]]()
        for asked in held:
            mine = [x for x in tasks if x[0].part.env == asked.part.env]
            mine[0].append(asked) if mine else tasks.append([asked])
        return tasks

    def _play(self, together: list[Asked]) -> None:
        """Play it, here or shared out; a lone share goes out only where there is somebody."""
        if batch := self._sent(together, least=1 if any(self._all) else 2):
            self._take(batch)
            return
        began = time.monotonic()
        for asked, outcome in zip(together, play([x.part for x in together]), strict=True):
            asked.outcome = outcome
        self._spent += time.monotonic() - began

    def _sent(self, together: list[Asked], least: int) -> "_Batch | None":
        """One share to each process, `least` or more; None if it must be played here."""
        env = together[0].part.env
        if self.number < 2 or self._spent < self._patience or not _sendable(env):
            return None
        shares = shared([asked.part for asked in together], self.number)
        if len(shares) < least:
            return None
        try:
            batch = _Batch(together, shares, [_told(env, share) for share in shares])
        except _Unknown:
            self.number = 1
            return None
        foreign.close(env)  # here it will not be played any more
        with self._or_close():
            for i in range(len(shares)):
                self._begun(i)  # all at the same time, before the first is spoken to
            for i, message in enumerate(batch.messages):
                self._begun(i).give(message, env in self._suspects)
        return batch

    def _take(self, batch: "_Batch") -> None:
        """The outcomes of what was sent."""
        try:
            with self._or_close():
                answers = [self._taken(i, batch) for i in range(len(batch.messages))]
        except _Unknown:
            self.number = 1
            return self._play(batch.asked)
        slices: list[list[Outcome]] = [[] for _ in batch.asked]
        told = foreign.tally(batch.asked[0].part.env)  # pyright: ignore[reportArgumentType]
        for share, (outcomes, endings) in zip(batch.shares, answers, strict=True):
            told.add(endings)
            for (i, _), outcome in zip(share, outcomes, strict=True):
                slices[i].append(outcome)
        told.check()
        for asked, parts in zip(batch.asked, slices, strict=True):
            asked.outcome = joined(parts)
        return None

    @contextlib.contextmanager
    def _or_close(self) -> Iterator[None]:
        """If this fails no process stays: an answer that nobody took would pass for the next."""
        try:
            yield
        except BaseException:
            self.close()
            raise

    def _begun(self, i: int) -> "_Player":
        """Player `i`, begun if there is none."""
        one = self._all[i]
        if one is None or one.over(0.0):
            one = self._all[i] = _Player()
        return one

    def _taken(self, i: int, batch: "_Batch") -> tuple[list[Outcome], list[str]]:
        """What came of the share that player `i` was given, and how its episodes ended."""
        for _ in range(TRIES):
            one = self._all[i]
            answer = one.take() if one is not None else None
            if answer is not None:
                return _heard(answer)
            self._drop(i)
            self._suspects.add(batch.asked[0].part.env)
            self._begun(i).give(batch.messages[i], spared=True)
        raise RuntimeError(
            f"a process that plays episodes ended {TRIES} times over the same ones: give it more "
            "memory, or --processes 1 to see what happens"
        )

    def _drop(self, i: int) -> None:
        one, self._all[i] = self._all[i], None
        if one is not None:
            one.end(0.0)

    def close(self) -> None:
        """End all processes, and give up what they were playing."""
        self._away = None
        for i in range(len(self._all)):
            self._drop(i)


@dataclasses.dataclass
class _Batch:
    """What was sent out together: a share and a message for each process."""

    asked: list[Asked]
    shares: list[Share]
    messages: list[bytes]


class _Unknown(Exception):
    """A policy or task that another process cannot have: of a class of the user's script, or one
    that was made in a function. It is played here, as well."""


class _Player(Child):
    """One process, and the pipes to it."""

    def __init__(self):
        pipe = subprocess.PIPE
        super().__init__(
            player.__name__, opening=True, stdin=pipe, stdout=pipe, env=worker.one_thread()
        )
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


def _sendable(env: AbstractHostEnvironment) -> bool:
    """Whether several other processes can open it at the same time."""
    return isinstance(env, foreign.AbstractForeignEnvironment) and not env.here and not env.at_once


def _told(env: AbstractHostEnvironment, share: Share) -> bytes:
    """What a player is told: its slices of parts, and what it must know to open the task."""
    plain = [
        dataclasses.replace(part, population=jax.tree.map(_plain, part.population))
        for _, part in share
    ]
    try:
        told = foreign.told(env)  # pyright: ignore[reportArgumentType]
        return pickle.dumps((plain, told), protocol=5)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise _Unknown(str(error)) from error


def _plain(x: Any) -> Any:
    return np.asarray(x) if isinstance(x, jax.Array) else x


def _heard(answer: tuple[str, Any]) -> Any:
    """What a player says; what it raised is raised here."""
    kind, said = answer
    if kind == "outcome":
        return said
    raise {"failure": EnvironmentFailure, "unknown": _Unknown}.get(kind, RuntimeError)(said)


class _Current(threading.local):
    def __init__(self):
        self.players = Players(1)


_CURRENT = _Current()


@contextlib.contextmanager
def using(number: int | None) -> Iterator[None]:
    """In here this thread's rollouts are shared out among so many processes; None: one for each
    core."""
    before, _CURRENT.players = _CURRENT.players, Players(number or len(cores()))
    try:
        yield
    finally:
        _CURRENT.players.close()
        _CURRENT.players = before


def ask(part: Part) -> Asked:
    """Ask for episodes: played here, or where `using` says, when somebody wants their outcome."""
    return _CURRENT.players.ask(part)


def start() -> None:
    """Let other processes, where there are any, begin with all that was asked for."""
    _CURRENT.players.start()
