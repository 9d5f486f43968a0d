"""Observations with what was done and earned just before: for a policy with memory the rest of its
history, from which it can work out what a task rewards (Duan et al. 2016, "RL²", section 2.2)."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray, PyTree

from ..types import TimeStep
from .base import AbstractEnvironment
from .host import AbstractCopies, AbstractHostEnvironment, HostStep
from .wrappers import AbstractHostWrapper, AbstractWrappedCopies, AbstractWrapper


def with_last_step(env: AbstractEnvironment | AbstractHostEnvironment):
    """A task whose observations end with the last action, in [-1, 1], and the last reward, of its
    first signal; zeros at the start of an episode. Of discrete actions the one that a policy chose
    is 1 and the others are -1, whatever numbers it chose by."""
    if isinstance(env, AbstractHostEnvironment):
        return LastHostStep(env)
    return LastStep(env)


def chosen(xp: Any, action: Any) -> Any:
    """Actions `[..., act]` with 1 for the largest number of each and -1 for the others. `xp`: NumPy
    or that of JAX."""
    largest = xp.argmax(action, axis=-1)[..., None]
    return xp.where(xp.arange(action.shape[-1]) == largest, xp.float32(1.0), xp.float32(-1.0))


class LastStep(AbstractWrapper):
    """`with_last_step` of a task in JAX."""

    env: AbstractEnvironment  # the task whose observations are extended
    # Of `obs_range` the default is left: rewards have no bounds.

    @property
    def obs_size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.env.obs_size + self.env.action_size + 1

    def reset(self, *, key: PRNGKeyArray) -> tuple[PyTree, TimeStep]:
        state, first = self.env.reset(key=key)
        nothing = jnp.zeros((*first.obs.shape[:-1], self.env.action_size))
        return state, self._told(first, nothing)

    def step(self, state: PyTree, action: Array, *, key: PRNGKeyArray) -> tuple[PyTree, TimeStep]:
        state, now = self.env.step(state, action, key=key)
        return state, self._told(now, chosen(jnp, action) if self.env.discrete else action)

    def _told(self, now: TimeStep, action: Array) -> TimeStep:
        earned = now.rewards[self.env.signals[0]]
        earned = jnp.broadcast_to(earned, now.obs.shape[:-1])[..., None]
        obs = jnp.concatenate([now.obs, action, earned], axis=-1)
        return dataclasses.replace(now, obs=obs)


class LastHostStep(AbstractHostWrapper):
    """The same outside JAX."""

    env: AbstractHostEnvironment  # the task whose observations are extended
    obs_dtype = "float32"

    @property
    def obs_size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.env.obs_size + self.env.action_size + 1

    @property
    def obs_range(self) -> tuple[Any, Any]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return -np.inf, np.inf

    def task_record(self) -> dict[str, Any]:
        return self.env.task_record() | {"obs_size": self.obs_size, "observations": None}

    def around(self, inner: AbstractCopies) -> "LastStepCopies":
        env = self.env
        return LastStepCopies(inner, env.action_size, env.signals[0], env.discrete)


class LastStepCopies(AbstractWrappedCopies):
    """Copies whose observations end with the last step."""

    def __init__(self, inner: AbstractCopies, action_size: int, signal: str, discrete: bool):
        self.inner, self.n = inner, inner.n
        self._size, self._signal, self._discrete = action_size, signal, discrete

    def reset(self, seeds: np.ndarray, active: np.ndarray) -> np.ndarray:
        obs = self.inner.reset(seeds, active)
        return self._told(obs, np.zeros((*obs.shape[:-1], self._size)), np.float32(0.0))

    def step(self, actions: np.ndarray, active: np.ndarray) -> HostStep:
        now = self.inner.step(actions, active)
        done = chosen(np, actions) if self._discrete else np.clip(actions, -1.0, 1.0)
        obs = self._told(now.obs, done, now.rewards[self._signal])
        return dataclasses.replace(now, obs=obs)

    def _told(self, obs: np.ndarray, action: np.ndarray, earned: Any) -> np.ndarray:
        """Of a team a reward of all is told to each."""
        earned = np.asarray(earned, np.float32)
        earned = earned.reshape(*earned.shape, *(1,) * (obs.ndim - earned.ndim))
        parts = (obs, action, np.broadcast_to(earned, (*obs.shape[:-1], 1)))
        return np.concatenate([x.astype(np.float32) for x in parts], axis=-1)
