"""Processes that play parts of a population's episodes, each on a core of its own.

How many there are changes no bit. A player holds JAX on one thread and, in a worker of its own, the
environments; it is begun when this process has played for `PATIENCE` seconds by itself, so that
short runs pay nothing. One that dies is begun anew, and plays its part again.
"""

import contextlib
import dataclasses
import pickle
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from ..environments import foreign
from ..environments.host import AbstractHostEnvironment, EnvironmentFailure
from ..environments.processes import Child, cores
from . import Outcome, Part, joined, play, player, split
from .player import LENGTH

PATIENCE = 2.0  # seconds of playing here before others are asked
TRIES = 3  # of a part whose player dies


class Players:
    """Up to `number` processes, at least 1: with 1 this one plays all."""

    def __init__(self, number: int, patience: float = PATIENCE):
        self.number, self._patience, self._spent = number, patience, 0.0
        self._all: list[_Player | None] = [None] * number

    def play(self, part: Part) -> Outcome:
        """Play a part, here or shared out."""
        began = time.monotonic()
        parts = split(part, self.number)
        if len(parts) > 1 and _sendable(part.env) and self._spent >= self._patience:
            try:
                outcome = joined(self._played(parts))
            except _Unknown:
                self.number = 1
            else:
                told = foreign.tally(part.env)  # pyright: ignore[reportArgumentType]
                told.add(outcome.endings)
                told.check()
                return outcome
        outcome = play(part)
        self._spent += time.monotonic() - began
        return outcome

    def _played(self, parts: Sequence[Part]) -> list[Outcome]:
        """One part by each player, at the same time."""
        told = [_told(part) for part in parts]
        try:
            for i, message in enumerate(told):
                self._give(i, message)
            return [self._taken(i, message) for i, message in enumerate(told)]
        except BaseException:  # an answer that nobody took would pass for that to the next part
            self.close()
            raise

    def _give(self, i: int, message: bytes) -> None:
        one = self._all[i]
        if one is None or one.over(0.0):
            one = self._all[i] = _Player()
        one.give(message)

    def _taken(self, i: int, message: bytes) -> Outcome:
        """The outcome of the part that player `i` was given."""
        for _ in range(TRIES):
            one = self._all[i]
            answer = one.take() if one is not None else None
            if answer is not None:
                return _heard(answer)
            self._drop(i)
            self._give(i, message)
        raise RuntimeError(
            f"a process that plays episodes ended {TRIES} times over the same ones: give it more "
            "memory, or --processes 1 to see what happens"
        )

    def _drop(self, i: int) -> None:
        one, self._all[i] = self._all[i], None
        if one is not None:
            one.end(0.0)

    def close(self) -> None:
        """End all processes."""
        for i in range(len(self._all)):
            self._drop(i)


class _Unknown(Exception):
    """A policy or task that another process cannot have: of a class of the user's script, or one
    that was made in a function. It is played here, as well."""


class _Player(Child):
    """One process, and the pipes to it."""

    def __init__(self):
        pipe = subprocess.PIPE
        super().__init__(player.__name__, opening=True, stdin=pipe, stdout=pipe)
        assert self.stdin is not None
        assert self.stdout is not None
        self._to, self._from = self.stdin, self.stdout

    def give(self, message: bytes) -> None:
        with contextlib.suppress(BrokenPipeError):  # it is dead, and `take` hears of it
            self._to.write(LENGTH.pack(len(message)))
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


def _told(part: Part) -> bytes:
    """What a player is told: the part, and what it must know to open the task."""
    plain = jax.tree.map(
        lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, part.population
    )
    part, env = dataclasses.replace(part, population=plain), part.env
    try:
        told = foreign.told(env)  # pyright: ignore[reportArgumentType]
        return pickle.dumps((part, told), protocol=5)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise _Unknown(str(error)) from error


def _heard(answer: tuple[str, Any]) -> Outcome:
    """An outcome; what a player raised is raised here."""
    kind, said = answer
    if kind == "outcome":
        return said
    raise {"failure": EnvironmentFailure, "unknown": _Unknown}.get(kind, RuntimeError)(said)


class _Current(threading.local):
    players: Players | None = None


_CURRENT = _Current()


@contextlib.contextmanager
def using(number: int | None) -> Iterator[None]:
    """In here this thread's rollouts are shared out among so many processes; None: one for each
    core."""
    number = len(cores()) if number is None else number
    before, _CURRENT.players = _CURRENT.players, Players(number) if number > 1 else None
    try:
        yield
    finally:
        if _CURRENT.players is not None:
            _CURRENT.players.close()
        _CURRENT.players = before


def played(part: Part) -> Outcome:
    """Play a part: here, or where `using` says."""
    players = _CURRENT.players
    return play(part) if players is None else players.play(part)
