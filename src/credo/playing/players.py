"""Who plays episodes outside JAX: this process, or several, here or on a Ray cluster.

Whatever is asked for by the time the first outcome is wanted is played together, lane beside lane:
so the champion's test costs a population's rollout little. How many processes there are changes no
bit. A player holds JAX on one thread and the environments, without a worker between, which a step
would have to wait for; on this machine it is begun when this process has played for `PATIENCE`
seconds by itself, so that short runs pay nothing. What one that dies was playing is played again;
in case the task was the reason, from then on the task has a worker, that can tell.
"""

import contextlib
import dataclasses
import pickle
import sys
import threading
import time
import weakref
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from ..environments import foreign
from ..environments.host import AbstractHostEnvironment, EnvironmentFailure
from ..environments.processes import cores, others
from . import Outcome, Part, joined, play, shared
from .crew import AbstractCrew, Answer, Batch
from .local import Processes

PATIENCE = 2.0  # seconds of playing here before others are asked


class NotPlayed(RuntimeError):
    """Those who were asked cannot play this."""


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
    """This process, and a crew that plays what is worth sending; None: nobody else.

    **Arguments:** `patience`: seconds that this process plays by itself at first.
    """

    def __init__(self, crew: AbstractCrew | None = None, patience: float | None = None):
        self.crew, self._spent = crew, 0.0
        self._patience = PATIENCE if patience is None else patience
        self._waiting: list[weakref.ref[Asked]] = []
        self._away: tuple[list[Asked], Batch] | None = None  # what the crew plays just now
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
                self._away = together, batch
            else:
                self._waiting += map(weakref.ref, together)

    def settle(self, wanted: Asked) -> None:
        """Play what was asked for, until there is an outcome of this."""
        away, self._away = self._away, None
        if away is not None:
            self._take(*away)
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
        if batch := self._sent(together, least=1 if self.crew and self.crew.awake() else 2):
            self._take(together, batch)
            return
        began = time.monotonic()
        for asked, outcome in zip(together, play([x.part for x in together]), strict=True):
            asked.outcome = outcome
        self._spent += time.monotonic() - began

    def _sent(self, together: list[Asked], least: int) -> Batch | None:
        """Shares for the crew, `least` or more; None if it must be played here."""
        env: Any = together[0].part.env
        if self.crew is None or self._spent < self._patience or not _sendable(env):
            return None
        shares = shared([asked.part for asked in together], self.crew.number)
        if len(shares) < least:
            return None
        batch = Batch([_plain(asked.part) for asked in together], foreign.told(env), shares)
        with self._or_close():
            try:
                self.crew.begin(batch)
                for k in range(len(shares)):
                    self.crew.give(batch, k, env in self._suspects)
            except (pickle.PicklingError, AttributeError, TypeError) as error:
                self._dismiss(str(error))
                return None
        foreign.close(env)  # here it will not be played any more
        return batch

    def _take(self, together: list[Asked], batch: Batch) -> None:
        """The outcomes of what was sent."""
        with self._or_close():
            answers = [self._taken(k, batch) for k in range(len(batch.shares))]
        if unknown := [said for kind, said in answers if kind == "unknown"]:
            self._dismiss(unknown[0])
            return self._play(together)
        slices: list[list[Outcome]] = [[] for _ in together]
        tally = foreign.tally(batch.parts[0].env)  # pyright: ignore[reportArgumentType]
        with self._or_close():
            for share, answer in zip(batch.shares, answers, strict=True):
                outcomes, endings = _heard(answer)
                tally.add(endings)
                for (i, _, _), outcome in zip(share, outcomes, strict=True):
                    slices[i].append(outcome)
            tally.check()
        for asked, parts in zip(together, slices, strict=True):
            asked.outcome = joined(parts)
        return None

    def _taken(self, k: int, batch: Batch) -> Answer:
        """What came of share `k`, given out again whenever its process dies."""
        assert self.crew is not None
        for again in range(self.crew.tries):
            if again:
                self._suspects.add(batch.parts[0].env)
                self.crew.give(batch, k, spared=True)
            answer = self.crew.take(k)
            if answer is not None:
                return answer
        why = self.crew.lost()
        raise NotPlayed(
            f"a process that plays episodes ended {self.crew.tries} times over the same ones"
            f"{f' ({why})' * bool(why)}: give it more memory, or --processes 1 to see what happens"
        )

    def _dismiss(self, why: str) -> None:
        """Play here from now on what the crew cannot have, of a class of the user's script, or one
        that was made in a function. Raises `NotPlayed` if the crew was asked for."""
        assert self.crew is not None
        if self.crew.instead:
            raise NotPlayed(f"{self.crew.instead}: {why}. Put what it names into a module")
        with contextlib.suppress(OSError, ValueError):  # it is not read any more
            print(f"credo: this process plays alone: {why}", file=sys.stderr)
        self.close()
        self.crew = None

    @contextlib.contextmanager
    def _or_close(self) -> Iterator[None]:
        """If this fails no process stays: an answer that nobody took would pass for the next."""
        try:
            yield
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End all processes, and give up what they were playing."""
        self._away = None
        if self.crew is not None:
            self.crew.close()


def _sendable(env: AbstractHostEnvironment) -> bool:
    """Whether several other processes can open it at the same time."""
    return isinstance(env, foreign.AbstractForeignEnvironment) and not env.here and not env.at_once


def _plain(part: Part) -> Part:
    """The same in arrays of NumPy."""
    population = jax.tree.map(
        lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, part.population
    )
    return dataclasses.replace(part, population=population)


def _heard(answer: Answer) -> Any:
    """What a player says; what it raised is raised here."""
    kind, said = answer
    if kind == "outcome":
        return said
    raise {"failure": EnvironmentFailure}.get(kind, NotPlayed)(said)


class _Current(threading.local):
    def __init__(self):
        self.players = Players()


_CURRENT = _Current()


def require(number: int | None, task: Any) -> None:
    """Raise `ValueError` if several processes are to play a task that is played in this one."""
    if number is not None and number > 1 and not isinstance(task, AbstractHostEnvironment):
        raise ValueError(
            f"processes is {number}, and {type(task).__name__} runs in JAX: its episodes are all "
            "played in one process; leave it out (--devices shares them out among devices)"
        )


@contextlib.contextmanager
def using(number: int | None, on: str = "local") -> Iterator[None]:
    """In here this thread's rollouts are shared out among so many processes; None: one for each
    core, but for that on which this process is `settled`. `on`: "local", "ray" or "ray:ADDRESS".
    Raises `ClusterLost` if no cluster answers."""
    before = _CURRENT.players
    with contextlib.ExitStack() as stack:
        kind, _, address = on.partition(":")
        if kind == "ray":
            from .ray import crew  # it is not needed elsewhere

            players = Players(stack.enter_context(crew(address, number)), patience=0.0)
        elif number is None and others():
            players = Players(Processes(others()))
        else:
            number = number or len(cores())
            players = Players(Processes(number) if number > 1 else None)
        _CURRENT.players = players
        try:
            yield
        finally:
            players.close()
            _CURRENT.players = before


def ask(part: Part) -> Asked:
    """Ask for episodes: played here, or where `using` says, when somebody wants their outcome."""
    return _CURRENT.players.ask(part)


def start() -> None:
    """Let other processes, where there are any, begin with all that was asked for."""
    _CURRENT.players.start()
