"""What environments of others have in common: a worker process plays them.

`Gymnasium` and `PettingZoo` are configs compared by value; their copies are kept open here.
"""

import atexit
import os
import warnings
from typing import Any, ClassVar

import equinox as eqx
import numpy as np

from . import names, worker
from .host import (
    AbstractCopies,
    AbstractHostEnvironment,
    EnvironmentFailure,
    HostStep,
    UnfitEnvironment,
)


def _pairs(kwargs: Any) -> Any:
    """A dict as a tuple of pairs, so that a config can be compared and hashed."""
    return tuple(kwargs.items()) if isinstance(kwargs, dict) else kwargs


def _plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(_plain(item) for item in value)
    return value is None or isinstance(value, str | int | float)


class AbstractForeignEnvironment(AbstractHostEnvironment):
    """An environment made by name, whose copies are stepped in a worker process."""

    id: str = eqx.field(static=True)
    """By what name it is made."""
    api: ClassVar[str]  # whose interface it has: a key of adapters.APIS
    kwargs: tuple[tuple[str, Any], ...] = eqx.field(static=True, default=(), converter=_pairs)
    max_episode_steps: int | None = eqx.field(static=True, default=None)  # None: its own
    timeout: float = eqx.field(static=True, default=60.0)  # seconds that one call may take
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
        limit = self.max_episode_steps
        if limit is not None and limit < 1:
            raise ValueError(f"max_episode_steps is {limit}: it must be at least 1, or None")
        if not self.timeout > 0:
            raise ValueError(f"timeout is {self.timeout}: it must be more than 0 seconds")

    @property
    def obs_size(self) -> int:
        return self._sizes()["obs_size"]

    @property
    def action_size(self) -> int:
        return self._sizes()["action_size"]

    @property
    def max_steps(self) -> int:
        return self._sizes()["max_steps"]

    @property
    def obs_dtype(self) -> str:
        return self._sizes()["obs_dtype"]

    @property
    def discrete(self) -> bool:
        return bool(self._sizes()["discrete"])

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
        return names.foreign_code(self.api, self.id, dict(self.kwargs)) or next(makers, None)

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

    def copies(self, n: int) -> "ForeignCopies":
        if n < 1:
            raise ValueError(f"copies({n}): ask for at least 1")
        key = (self, n)
        if key in _OPEN and not _OPEN[key].usable:
            _OPEN.pop(key).close()
        if key not in _OPEN:
            _OPEN[key] = ForeignCopies(self, n)
            self._warn()
        return _OPEN[key]

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
        if self not in _WARNED:
            _WARNED.add(self)
            for told in self.warnings:
                warnings.warn(f"{self.id}: {told}", stacklevel=4)


class ForeignCopies(AbstractCopies):
    """`n` copies in one worker. Rewards are float64, as Gymnasium has them.

    A team's `local` rewards are its agents' own, `global` is their mean.
    """

    def __init__(self, env: AbstractForeignEnvironment, n: int):
        self.n, self._id = n, env.id
        self._seeds, self._steps = np.zeros(n, np.uint32), np.zeros(n, np.int64)
        self._backend: worker.Environments | worker.Process | None = None
        try:
            if env.here:
                self._backend = worker.Environments(env.spec(), n)
            else:
                self._backend = worker.Process(env.spec(), n, env.timeout)
        except worker.Fault as fault:
            raise UnfitEnvironment(f"{env.id} {fault.what}: {fault.fix}") from fault
        _SIZES[env] = sizes = self._backend.sizes()
        team = () if sizes["agents"] is None else (sizes["agents"],)
        self._actions = (n, *team, sizes["action_size"])

    @property
    def usable(self) -> bool:
        return self._backend is not None and self._backend.usable

    def reset(self, seeds: np.ndarray, active: np.ndarray) -> np.ndarray:
        seeds = _form(seeds, (self.n,), np.uint32)
        active = _form(active, (self.n,), np.bool_)
        np.copyto(self._seeds, seeds, where=active)
        self._steps[active] = 0
        return self._call("reset", seeds, active).obs

    def step(self, actions: np.ndarray, active: np.ndarray) -> HostStep:
        actions = _form(actions, self._actions, np.float32)
        active = _form(active, (self.n,), np.bool_)
        self._steps += active
        frame = self._call("step", actions, active)
        ended = frame.terminated | frame.truncated
        acting = None if frame.active is None else frame.active & ~ended[:, None]
        ends = (frame.terminated, frame.truncated)
        return HostStep(frame.obs, frame.rewards, *ends, acting, frame.failed, frame.gone)

    def _call(self, name: str, *arguments: np.ndarray) -> worker.Frame:
        if self._backend is None:
            raise EnvironmentFailure(
                f"{self._id}: these copies are closed: ask for copies(n) again"
            )
        try:
            return getattr(self._backend, name)(*arguments)
        except worker.Fault as fault:
            copy = self._backend.current[0]
            self.close(grace=0.0)
            where = f"step {self._steps[copy]}" if name == "step" else "the reset"
            raise EnvironmentFailure(
                f"{self._id} {fault.what}, in copy {copy} at {where} of the episode with seed "
                f"{self._seeds[copy]}: {fault.fix}"
            ) from fault

    def close(self, grace: float = worker.GRACE) -> None:
        """End the worker; asking the environment for copies again starts another."""
        if self._backend is not None:
            self._backend.close(grace)
        self._backend = None


def _form(x: np.ndarray, shape: tuple[int, ...], dtype: type) -> np.ndarray:
    x = np.asarray(x, dtype)
    if x.shape != shape:
        raise ValueError(f"an array of shape {x.shape} was given: it must be {shape}")
    return x


RECORDED = ("obs_size", "action_size", "agents", "discrete", "actions", "observations")
_OPEN: dict[tuple[AbstractForeignEnvironment, int], ForeignCopies] = {}
_WARNED: set[AbstractForeignEnvironment] = set()
_SIZES: dict[AbstractForeignEnvironment, dict[str, Any]] = {}


def close_all() -> None:
    """End every worker of this process."""
    while _OPEN:
        _OPEN.popitem()[1].close()


atexit.register(close_all)
os.register_at_fork(after_in_child=_OPEN.clear)  # the pipes are the parent's
