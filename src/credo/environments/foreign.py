"""What environments of others have in common: a worker process plays them.

`Gymnasium` and `PettingZoo` are configs compared by value; their copies are kept open here.
"""

import atexit
import collections
import contextlib
import math
import os
import sys
import threading
import warnings
import weakref
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import numpy as np

from .. import require
from . import names, processes, worker
from .host import (
    AbstractCopies,
    AbstractHostEnvironment,
    EnvironmentFailure,
    HostStep,
    InTurn,
    UnfitEnvironment,
)


def _pairs(kwargs: Any) -> Any:
    """A dict as a tuple of pairs, so that a config can be compared and hashed."""
    return tuple(kwargs.items()) if isinstance(kwargs, dict) else kwargs


def _plain(value: Any) -> bool:
    """Whether JSON and a hash can hold it."""
    if isinstance(value, tuple):
        return all(_plain(item) for item in value)
    return value is None or isinstance(value, str | int | float)


def _size(name: str) -> Any:
    """A property that only the environment itself can tell."""
    return property(lambda self: self._sizes()[name])


class AbstractForeignEnvironment(AbstractHostEnvironment):
    """An environment made by name, whose copies are stepped in a worker process."""

    id: str = eqx.field(static=True)
    """By what name it is made."""
    api: ClassVar[str]  # whose interface it has: a key of adapters.APIS
    kwargs: tuple[tuple[str, Any], ...] = eqx.field(static=True, default=(), converter=_pairs)
    """What the task is made with, by name."""
    max_episode_steps: int | None = eqx.field(static=True, default=None)
    """Steps of an episode at most, at least 1; None: the task's own limit."""
    timeout: float = eqx.field(static=True, default=60.0)
    """Seconds that one copy may take for a reset or a step, above 0."""
    tolerated: float = eqx.field(static=True, default=0.1)
    """The share of the last 100 episodes that may fail, each with a return of NaN; if more do, and
    at least 3, `EnvironmentFailure` is raised. 0: the first one raises it."""
    at_once: int | None = eqx.field(static=True, default=None)
    """Most copies that are open at the same time, at least 1; None: as many as play together."""
    in_process: bool = eqx.field(static=True, default=False)
    """No worker. For debugging and for classes of a prompt: here nothing stops an environment
    that hangs, and one that crashes takes this process with it."""

    def __check_init__(self):
        pairs = (isinstance(p, tuple) and len(p) == 2 and _plain(p) for p in self.kwargs)
        if not all(pairs):
            raise ValueError(
                f"kwargs is {self.kwargs!r}: it must be pairs (name, value) or a dict, and a value "
                "a number, a string, a bool, None or a tuple of these, so that a run can record it"
            )
        require.at_least("max_episode_steps", self.max_episode_steps, 1)
        require.at_least("at_once", self.at_once, 1)
        if not 0 <= self.tolerated <= 1:
            raise ValueError(f"tolerated is {self.tolerated}: it must be a share, from 0 to 1")
        if not self.timeout > 0:
            raise ValueError(f"timeout is {self.timeout}: it must be more than 0 seconds")

    obs_size = _size("obs_size")
    action_size = _size("action_size")
    max_steps = _size("max_steps")
    obs_dtype = _size("obs_dtype")
    agents = _size("agents")

    @property
    def choices(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return tuple(self._sizes()["choices"])

    masked = _size("masked")

    @property
    def image(self) -> tuple[int, int, int, int] | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        said = self._sizes()["image"]
        return said and tuple(said)

    @property
    def groups(self) -> tuple[int, ...] | None:
        said = self._sizes()["groups"]
        return said and tuple(said)

    def spec(self) -> dict[str, Any]:
        """What a worker must know to open it, as JSON has it."""
        return {
            "api": self.api,
            "id": self.id,
            "kwargs": dict(self.kwargs),
            "max_episode_steps": self.max_episode_steps,
            "registered": names.registered(self.id) if self.api == "gymnasium" else None,
            **self._paid(),
        }

    def _paid(self) -> dict[str, Any]:
        """Of a team: pairs of a reward and of what pays it, and which rewards all share."""
        return {"rewards": [], "shared": []}

    @property
    def foreign_code(self) -> str | None:
        """Whose code opening this would import, by name; None for what Gymnasium, PettingZoo, MPE2
        and Credo themselves have."""
        makers = (at for _, at in self._paid()["rewards"])
        code = names.foreign_code(self.api, self.id, dict(self.kwargs))
        return next(makers, None) if code is None else code

    @property
    def here(self) -> bool:
        """Whether it is played in this process: asked for, or because no other can import it."""
        return self.in_process or names.here_alone(self.id)

    def task_record(self) -> dict[str, Any]:
        """What a run records of its task, so that a policy acts in the task's units without it."""
        return {name: self._sizes()[name] for name in RECORDED}

    @property
    def obs_range(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and the largest of each observed number, `[*agents, obs]`, as the observation
        space says; no one looks whether they are kept but `check_environment`."""
        said, size = self._sizes()["obs_range"], self.obs_size
        if self.agents is None:
            low, high = (np.broadcast_to(np.float32(x), (size,)) for x in said)
        else:
            low, high = (
                np.stack([np.broadcast_to(np.float32(x), (size,)) for x in column])
                for column in zip(*said, strict=True)
            )
        return low, high

    def copies(self, n: int) -> "ForeignCopies | InTurn":
        """`n` copies, kept open for the life of this thread: asking again returns the same. With
        `at_once` they share that many and play in turn."""
        if n < 1:
            raise ValueError(f"copies({n}): ask for at least 1")
        some, kept = self.at_once or n, _OPEN.copies
        if (self, some) in kept and not kept[self, some].usable:
            kept.pop((self, some)).close()
        if (self, some) not in kept:
            kept[self, some] = ForeignCopies(self, some)
            self._warn()
        return kept[self, some] if self.at_once is None else InTurn(kept[self, some], n)

    def _sizes(self) -> dict[str, Any]:
        """What only the environment itself can tell: it is opened for this, once."""
        if self not in _SIZES:
            ForeignCopies(self, 1).close()
            self._warn()
        return _SIZES[self]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What its users should know, although it can be played."""
        return tuple(self._sizes()["warnings"])

    def _warn(self) -> None:
        """Warn of what users should know, once in a process."""
        for told in (f"{self.id}: {told}" for told in self.warnings):
            if told not in _WARNED:
                _WARNED.add(told)
                warnings.warn(told, stacklevel=_level_of_user())


def _level_of_user() -> int:
    """The `stacklevel` of a warning given by who calls this, for the line of the user's that led
    to it: the nearest one outside Credo and of what calls functions for it."""
    level, frame = 1, sys._getframe(1)
    inside = (__name__.partition(".")[0], "contextlib", "equinox", "jax")
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in inside:
        level, frame = level + 1, frame.f_back
    return level


class Tally:
    """How the last 100 episodes of a task ended in this thread: "", or why one failed. `elsewhere`:
    another process judges them, and is told all of the `news`."""

    def __init__(self, env: AbstractForeignEnvironment, elsewhere: bool = False):
        self._env, self._elsewhere = env, elsewhere
        self._recent: collections.deque[str] = collections.deque(maxlen=100)
        self._discarded = 0  # episodes so far
        self.news: list[str] = []

    @property
    def failures(self) -> int:
        """How many of the last 100 episodes have failed."""
        return sum(map(bool, self._recent))

    def add(self, endings: Sequence[str]) -> None:
        """Note how some episodes ended."""
        if self._elsewhere:
            self.news += endings
            return
        for why in endings:
            self._recent.append(why)
            if why:
                self._discarded += 1
                self._say(why)

    def check(self, playing: int = 0) -> None:
        """Raise `EnvironmentFailure` if too many have failed, where so many are still `playing`."""
        failures, recent = self.failures, min(len(self._recent) + playing, 100)
        most = self._env.tolerated
        if failures > most * recent and (failures >= 3 or most == 0):
            first = next(filter(None, self._recent))
            self._recent.clear()  # whoever goes on after this begins to count anew
            count = f" ({failures} of {recent} episodes failed)" if failures > 1 else ""
            raise EnvironmentFailure(f"{first}{count}")

    def _say(self, why: str) -> None:
        """The first, tenth, hundredth … failure, on the error stream."""
        if self._env.tolerated and math.log10(self._discarded).is_integer():
            with contextlib.suppress(OSError, ValueError):  # it is not read any more
                print(
                    f"credo: {self._discarded:,} episode{'s' * (self._discarded > 1)} failed and "
                    f"left out, now: {why}. The run ends if more than {self._env.tolerated:.0%} of "
                    "the last 100 fail (--tolerated)",
                    file=sys.stderr,
                )


def tally(env: AbstractForeignEnvironment) -> Tally:
    """That of a task in this thread."""
    return _OPEN.tallies.setdefault(env, Tally(env, _OPEN.elsewhere))


def judged_elsewhere() -> None:
    """From now on failures are counted by who asked for episodes, not in this thread."""
    _OPEN.elsewhere = True


def spare(may_be_lost: bool) -> None:
    """Whether tasks need no worker in this thread: what ends their process, or hangs in it, then
    ends this one, and whoever asked for episodes asks again. If not, those without one are closed.
    """
    _OPEN.spare = may_be_lost
    if not may_be_lost:
        for key in [key for key, kept in _OPEN.copies.items() if kept.fatal]:
            _OPEN.copies.pop(key).close()


class ForeignCopies(AbstractCopies):
    """`n` copies in one worker. Rewards are float64, as Gymnasium has them.

    An episode in which the environment raises, hangs, ends its process or returns what it must not
    has failed, and its copy is opened anew. If the worker is lost, so are the episodes of all its
    copies, which can be played again (`spoiled`). `tolerated` of the task says when that is too
    much.
    """

    def __init__(self, env: AbstractForeignEnvironment, n: int):
        self.n, self._env, self._closed = n, env, False
        self._seeds, self._steps = np.zeros(n, np.uint32), np.zeros(n, np.int64)
        self._running = np.zeros(n, bool)  # in an episode
        self._stranded = np.zeros(n, bool)  # in one that was lost with the worker
        self._broken = np.zeros(n, bool)  # whose episode has failed
        self._hurt = False  # whether there are any such: else a step costs less
        self._tally = tally(env)
        self._whys: dict[int, str] = {}
        self._backend: worker.Environments | worker.Process | None = None
        _SIZES[env] = sizes = self._opened().sizes()
        team = () if sizes["agents"] is None else (sizes["agents"],)
        self._actions = (n, *team, sizes["action_size"])
        _ALL.add(self)

    def _opened(self) -> worker.Environments | worker.Process:
        """The worker that plays the copies, started where there is none.

        **Raises:** `UnfitEnvironment` if the environment cannot be opened as this task."""
        if self._backend is None:
            env, spec = self._env, self._env.spec()
            processes.allow("opens a task", opening=True)
            try:
                if env.here:
                    self._backend = worker.Environments(spec, self.n)
                else:
                    kind = worker.Fatal if _OPEN.spare else worker.Process
                    self._backend = kind(spec, self.n, env.timeout)
            except worker.Fault as fault:
                raise UnfitEnvironment(f"{env.id} {fault.what}: {fault.fix}") from fault
            self._finalizer = weakref.finalize(self, self._backend.close, worker.GRACE)
        return self._backend

    @property
    def here(self) -> Any:
        """The environment of the first copy, where it is played in this process, to draw it."""
        backend = self._opened()
        return backend._envs[0] if isinstance(backend, worker.Environments) else None

    @property
    def usable(self) -> bool:
        """Whether these copies can be reset: not closed, and no call was interrupted."""
        return not self._closed and (self._backend is None or self._backend.usable)

    @property
    def fatal(self) -> bool:
        """Whether this process would be lost with them."""
        return isinstance(self._backend, worker.Fatal)

    @property
    def failures(self) -> int:
        """How many of the last 100 episodes of this task have failed."""
        return self._tally.failures

    def failure_text(self, i: int) -> str:
        """What went wrong, in which copy, at which step, with which seed, and what to do."""
        return self._whys.get(i, "unknown")

    def reset(self, seeds: np.ndarray, active: np.ndarray) -> np.ndarray:
        seeds = _form(seeds, (self.n,), np.uint32)
        active = _form(active, (self.n,), np.bool_)
        np.copyto(self._seeds, seeds, where=active)
        self._steps[active], self._stranded[active], self._broken[active] = 0, False, False
        self._running |= active
        self._hurt = self._hurt and bool((self._stranded | self._broken).any())
        frame, self.failed = self._call("reset", seeds, active)
        return frame.obs

    def step(self, actions: np.ndarray, active: np.ndarray) -> HostStep:
        actions = _form(actions, self._actions, np.float32)
        active = _form(active, (self.n,), np.bool_)
        if self._hurt and (active & self._broken).any():  # whoever asked did not look at `failed`
            raise EnvironmentFailure(self.failure_text(int((active & self._broken).argmax())))
        self._steps += active
        frame, failed = self._call("step", actions, active)
        ended = frame.terminated | frame.truncated
        if ended.any():
            self._running &= ~ended
            self._tally.add([""] * int(ended.sum()))
        acting = None if frame.active is None else frame.active & ~ended[:, None]
        ends = (frame.terminated, frame.truncated)
        return HostStep(frame.obs, frame.rewards, *ends, acting, failed, frame.gone)

    def _call(
        self, name: str, numbers: np.ndarray, active: np.ndarray
    ) -> tuple[worker.Frame, np.ndarray]:
        """What the worker says, and which copies failed."""
        if self._closed:
            raise EnvironmentFailure(
                f"{self._env.id}: these copies are closed: ask for copies(n) again"
            )
        failed, self.spoiled = active & self._stranded if self._hurt else None, None
        while True:
            backend = self._opened()
            asked, frame, faults = active if failed is None else active & ~failed, None, {}
            try:
                frame = getattr(backend, name)(numbers, asked)
                faults = frame.faults
            except worker.Lost as fault:
                faults[int(backend.current[0])] = fault
            except worker.Fault as fault:
                self.close(grace=0.0)
                copy = backend.current[0]
                raise EnvironmentFailure(self._told(name, copy, fault)) from fault
            if faults:
                self._failed(name, faults)
            if frame is not None:
                break
            gone = self._lost(name, asked, backend)
            self.spoiled = gone & (np.arange(self.n) != backend.current[0])
            failed = gone if failed is None else failed | gone
        if failed is None and not faults:
            return frame, frame.failed
        failed = frame.failed if failed is None else failed | frame.failed
        self._running &= ~failed
        self._stranded &= ~failed
        self._broken |= failed
        self._hurt = True
        return frame, failed

    def _lost(self, name: str, asked: np.ndarray, backend: Any) -> np.ndarray:
        """The worker is gone: who failed with it. Those who were to be reset can be asked again;
        the others hear of it when it is their turn."""
        culprit = np.arange(self.n) == backend.current[0]
        gone = asked & culprit if name == "reset" else asked
        self._stranded |= self._running & ~asked
        self._hurt = True
        self._finalizer.detach()
        self._backend = None
        backend.close(0.0)
        for i in np.flatnonzero((gone | self._stranded) & ~culprit).tolist():
            self._whys[i] = self._whys[int(backend.current[0])]
        return gone

    def _failed(self, name: str, faults: dict[int, worker.Fault]) -> None:
        """Count, and say when it is too much."""
        for copy, fault in faults.items():
            self._whys[copy] = self._told(name, copy, fault)
        self._tally.add([self._whys[copy] for copy in faults])
        playing = int(self._running.sum()) - len(faults)  # as good as any until they fail
        try:
            self._tally.check(playing)
        except EnvironmentFailure as failure:
            self.close(grace=0.0)
            raise failure from next(iter(faults.values()))

    def _told(self, name: str, copy: int, fault: worker.Fault) -> str:
        where = f"step {self._steps[copy]}" if name == "step" else "the reset"
        return (
            f"{self._env.id} {fault.what}, in copy {copy} at {where} of the episode with seed "
            f"{self._seeds[copy]}: {fault.fix}"
        )

    def close(self, grace: float = worker.GRACE) -> None:
        """End the worker; asking the environment for copies again starts another."""
        self._closed = True
        if self._backend is not None:
            self._finalizer.detach()
            self._backend.close(grace)
        self._backend = None


def _form(x: np.ndarray, shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """An array of this dtype; `ValueError` if its shape is another one."""
    x = np.asarray(x, dtype)
    if x.shape != shape:
        raise ValueError(f"an array of shape {x.shape} was given: it must be {shape}")
    return x


RECORDED = (
    "obs_size",
    "action_size",
    "agents",
    "choices",
    "masked",
    "lengths",
    "actions",
    "observations",
    "shown",
    "asks",
    "names",
)
_WARNED: set[str] = set()


class _Kept(threading.local):
    """The open copies of this thread: they are closed when it ends."""

    def __init__(self):
        self.copies: dict[tuple[AbstractForeignEnvironment, int], ForeignCopies] = {}
        self.tallies: dict[AbstractForeignEnvironment, Tally] = {}
        self.elsewhere = False  # whether failures are judged by another process
        self.spare = False  # whether this process may be lost with a task


_OPEN = _Kept()
_ALL: weakref.WeakSet[ForeignCopies] = weakref.WeakSet()
_SIZES: dict[AbstractForeignEnvironment, dict[str, Any]] = {}


def told(env: AbstractForeignEnvironment) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """What another process must know to play a task: as which id it is registered, and sizes."""
    return names.registered(env.id) if env.api == "gymnasium" else None, env._sizes()


def know(env: AbstractForeignEnvironment, what: tuple[Any, dict[str, Any]]) -> None:
    """Take what `told` said in another process; the task need not be opened for it here, and what
    its users should know was said there."""
    names.register(what[0])
    _SIZES[env] = what[1]
    _WARNED.update(f"{env.id}: {said}" for said in what[1]["warnings"])


def close(env: AbstractHostEnvironment) -> None:
    """End the workers of a task in this thread; asking it for copies again starts others."""
    for one in [kept for kept in _OPEN.copies if kept[0] == env]:
        _OPEN.copies.pop(one).close()


def close_all() -> None:
    """End every worker of this process."""
    _OPEN.copies.clear()
    for copies in list(_ALL):
        copies.close()


def _after_fork() -> None:
    """The pipes are the parent's."""
    _OPEN.copies.clear()


atexit.register(close_all)
os.register_at_fork(after_in_child=_after_fork)
