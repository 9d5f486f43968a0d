"""Gymnasium, both ways.

Its environments as tasks of ours, played by a worker process:

    task = Gymnasium("Hopper-v5")

Credo's tasks as Gymnasium environments, for anybody's training code:

    import credo.environments.gymnasium  # registers the tasks
    env = gymnasium.make("credo/SequenceClassification-v0", depth=5)

Gymnasium can do the import too: make("credo.environments.gymnasium:credo/SequenceRecall-v0").
"""

import atexit
import os
from typing import Any, ClassVar

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from . import worker
from .base import AbstractEnvironment
from .host import AbstractCopies, AbstractHostEnvironment, EnvironmentFailure, HostStep

TASKS = {
    "credo/SequenceClassification-v0": (
        "credo.environments.sequence_classification:SequenceClassification"
    ),
    "credo/SequenceRecall-v0": "credo.environments.sequence_recall:SequenceRecall",
}


class GymnasiumEnvironment(gymnasium.Env):
    """One copy of a single-agent JAX task.

    The reward is one of the task's signals, by default the first (what evolution maximises);
    `info["rewards"]` has them all. Observations are float32, actions lie in [-1, 1].
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, env: AbstractEnvironment, signal: str | None = None):
        if env.agents is not None:
            raise ValueError(f"{type(env).__name__} is a team task: Gymnasium takes one agent")
        if signal is not None and signal not in env.signals:
            raise ValueError(f"no reward signal {signal!r}: there is {', '.join(env.signals)}")
        self.env, self.signal = env, signal or env.signals[0]
        self.observation_space = gymnasium.spaces.Box(*env.obs_range, (env.obs_size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)
        self._reset = jax.jit(lambda key: env.reset(key=key))
        self._step = jax.jit(lambda state, action, key: env.step(state, action, key=key))
        self._state: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        episode = int(self.np_random.integers(2**31))
        reset_key, self._key = jax.random.split(jax.random.key(episode))
        self._state, time_step = self._reset(reset_key)
        self._steps = 0
        return np.array(time_step.obs), self._info(time_step)

    def step(self, action: np.ndarray):
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before the first step()")
        key = jax.random.fold_in(self._key, self._steps)
        self._state, time_step = self._step(self._state, jnp.asarray(action, jnp.float32), key)
        self._steps += 1
        return (
            np.array(time_step.obs),
            float(time_step.rewards[self.signal]),
            bool(time_step.terminated),
            bool(time_step.truncated),
            self._info(time_step),
        )

    def _info(self, time_step) -> dict[str, Any]:
        return {"rewards": {name: np.asarray(r) for name, r in time_step.rewards.items()}}


def make(task: str, signal: str | None = None, **fields: Any) -> GymnasiumEnvironment:
    """The task `package.module:Class` with these fields, as a Gymnasium environment."""
    import importlib

    module, _, name = task.partition(":")
    return GymnasiumEnvironment(getattr(importlib.import_module(module), name)(**fields), signal)


for _name, _task in TASKS.items():
    if _name not in gymnasium.registry:
        gymnasium.register(_name, f"{__name__}:make", kwargs={"task": _task})


def _pairs(kwargs: Any) -> Any:
    """A dict as a tuple of pairs, so that a config can be compared and hashed."""
    return tuple(kwargs.items()) if isinstance(kwargs, dict) else kwargs


def _plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(_plain(item) for item in value)
    return value is None or isinstance(value, str | int | float)


class Gymnasium(AbstractHostEnvironment):
    """A Gymnasium environment whose copies are stepped in a worker process.

    Observations: a Box of any shape is flattened, a Discrete is one-hot, a Dict or Tuple is its
    parts one after the other. Actions: a Box is scaled so that -1 is its low and 1 its high; of
    a Discrete the largest entry is taken. `kwargs` may be given as a dict. Whatever
    goes wrong raises `EnvironmentFailure`, and the next `copies` start a new worker.
    """

    id: str = eqx.field(static=True)
    """"Hopper-v5", "package.module:Class", or "package:Name-v0" of a package that registers it."""
    kwargs: tuple[tuple[str, Any], ...] = eqx.field(static=True, default=(), converter=_pairs)
    max_episode_steps: int | None = eqx.field(static=True, default=None)  # None: its own
    timeout: float = eqx.field(static=True, default=60.0)  # seconds that one call may take
    in_process: bool = eqx.field(static=True, default=False)
    """No worker. For debugging and for classes of a prompt: here nothing stops an environment
    that hangs, and one that crashes takes this process with it."""
    signals: ClassVar[tuple[str, ...]] = ("reward",)

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
    def discrete(self) -> bool:
        return bool(self._sizes()["discrete"])

    def copies(self, n: int) -> "GymnasiumCopies":
        if n < 1:
            raise ValueError(f"copies({n}): ask for at least 1")
        key = (self, n)
        if key in _OPEN and not _OPEN[key].usable:
            _OPEN.pop(key).close()
        if key not in _OPEN:
            _OPEN[key] = GymnasiumCopies(self, n)
        return _OPEN[key]

    def _sizes(self) -> dict[str, int]:
        """What only the environment itself can tell: it is opened for this, once."""
        if self not in _SIZES:
            GymnasiumCopies(self, 1).close()
        return _SIZES[self]


class GymnasiumCopies(AbstractCopies):
    """`n` copies in one worker. Rewards are float64, as Gymnasium has them."""

    def __init__(self, env: Gymnasium, n: int):
        self.n, self._id = n, env.id
        spec = {
            "id": env.id,
            "kwargs": dict(env.kwargs),
            "max_episode_steps": env.max_episode_steps,
        }
        self._seeds, self._steps = np.zeros(n, np.uint32), np.zeros(n, np.int64)
        self._backend: worker.Environments | worker.Process | None = None
        try:
            if env.in_process:
                self._backend = worker.Environments(spec, n)
            else:
                self._backend = worker.Process(spec, n, env.timeout)
        except worker.Fault as fault:
            raise EnvironmentFailure(f"{env.id} {fault.what}: {fault.fix}") from fault
        _SIZES[env] = self._backend.sizes()
        self._actions = (n, self._backend.action_size)

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
        return HostStep(frame.obs, {"reward": frame.rewards}, frame.terminated, frame.truncated)

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


_OPEN: dict[tuple[Gymnasium, int], GymnasiumCopies] = {}
_SIZES: dict[Gymnasium, dict[str, int]] = {}


def close_all() -> None:
    """End every worker of this process."""
    while _OPEN:
        _OPEN.popitem()[1].close()


atexit.register(close_all)
os.register_at_fork(after_in_child=_OPEN.clear)  # the pipes are the parent's
