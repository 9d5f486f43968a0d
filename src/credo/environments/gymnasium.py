"""Gymnasium, both ways.

Its environments as tasks of ours, played by a worker process:

    task = Gymnasium("Hopper-v5")

Credo's tasks as Gymnasium environments, for anybody's training code:

    import credo.environments.gymnasium  # registers the tasks
    env = gymnasium.make("credo/SequenceClassification-v0", depth=5)

Gymnasium can do the import too: make("credo.environments.gymnasium:credo/SequenceRecall-v0").
"""

from typing import Any, ClassVar

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from . import names
from .base import AbstractEnvironment
from .foreign import AbstractForeignEnvironment, close_all

__all__ = ["TASKS", "Gymnasium", "GymnasiumEnvironment", "close_all", "make"]

TASKS = {
    "credo/SequenceClassification-v0": (
        "credo.environments.sequence_classification:SequenceClassification"
    ),
    "credo/SequenceRecall-v0": "credo.environments.sequence_recall:SequenceRecall",
    "credo/SequenceCopy-v0": "credo.environments.sequence_copy:SequenceCopy",
    "credo/RepeatCopy-v0": "credo.environments.sequence_copy:RepeatCopy",
    "credo/PassiveTMaze-v0": "credo.environments.passive_tmaze:PassiveTMaze",
    "credo/EndlessTMaze-v0": "credo.environments.endless_tmaze:EndlessTMaze",
    "credo/DistractedCue-v0": "credo.environments.distracted_cue:DistractedCue",
    "credo/DoublePole-v0": "credo.environments.double_pole:DoublePole",
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
    cls = names.resolve(task, AbstractEnvironment)
    return GymnasiumEnvironment(cls(**fields), signal)


for _name, _task in TASKS.items():
    if _name not in gymnasium.registry:
        gymnasium.register(_name, f"{__name__}:make", kwargs={"task": _task})


class Gymnasium(AbstractForeignEnvironment):
    """A Gymnasium environment whose copies are stepped in a worker process.

    Observations: a Box of any shape is flattened and cast to float32 (one of uint8 stays uint8),
    whether or not the numbers lie within its bounds, which `check_environment` says; a Discrete is
    one-hot, a Dict or Tuple is its parts one after the other. Actions: a Box is scaled so that -1
    is its low and 1 its high; of a Discrete the largest entry is taken, or the largest that
    `action_mask` allows, where a Dict observation or `info` has one. Without any time limit an
    episode is truncated after 1,000 steps. `kwargs` may be given as a dict. An episode in
    which something goes wrong has a return of NaN and is discarded; if more than the share
    `tolerated` are such, `EnvironmentFailure` is raised, and the next `copies` start a new worker.
    """

    id: str = eqx.field(static=True, converter=names.name_of)
    """"Hopper-v5", "package.module:name" of a class or of a function that makes one, the class or
    function itself, or "package:Name-v0" of a package that registers it. An id that this process
    registered is registered in the worker too. What no other process can import, such as a class
    of a notebook, is played in this process, and its runs can be resumed there alone."""
    api: ClassVar[str] = "gymnasium"
    agents: ClassVar[None] = None
    signals: ClassVar[tuple[str, ...]] = ("reward",)
