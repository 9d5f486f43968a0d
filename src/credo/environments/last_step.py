"""Observations with what was done and earned just before: for a policy with memory the rest of its
history, from which it can work out what a task rewards (Duan et al. 2016, "RL²", section 2.2)."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from ..types import TimeStep
from .base import AbstractEnvironment, AbstractTask
from .host import AbstractCopies, AbstractHostEnvironment, HostStep
from .wrappers import AbstractHostWrapper, AbstractWrappedCopies, AbstractWrapper


def with_last_step(env: AbstractEnvironment | AbstractHostEnvironment):
    """A task whose observations end with the last action, in [-1, 1], and the last reward, of its
    first signal; zeros at the start of an episode. Of the options of a choice the one that a policy
    took is 1 and the others are -1, whatever numbers it chose by."""
    if isinstance(env, AbstractHostEnvironment):
        return LastHostStep(env)
    return LastStep(env)


def chosen(xp: Any, action: Any, env: AbstractTask, allowed: Any) -> Any:
    """Actions `[..., act]` with 1 for the option that each choice took, of those that were
    `allowed` (all, where the task bars none), and -1 for the others. `xp`: NumPy or that of JAX."""
    if env.masked:
        n = env.barrable
        options = xp.where(allowed > 0.5, action[..., :n], -xp.inf)
        action = xp.concatenate([options, action[..., n:]], axis=-1)
    told, start = [], 0
    for n in env.choices:
        part = action[..., start : start + n]
        largest = xp.argmax(part, axis=-1)[..., None]
        options = xp.broadcast_to(xp.arange(n), part.shape)
        told.append(xp.where(options == largest, xp.float32(1.0), xp.float32(-1.0)))
        start += n
    return xp.concatenate([*told, xp.clip(action[..., start:], -1.0, 1.0)], axis=-1)


class LastState(eqx.Module):
    inner: PyTree
    allowed: Float[Array, "..."]  # the first numbers of the last observation


class LastStep(AbstractWrapper):
    """`with_last_step` of a task in JAX."""

    env: AbstractEnvironment  # the task whose observations are extended
    # Of `obs_range` the default is left: rewards have no bounds.

    @property
    def obs_size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.env.obs_size + self.env.action_size + 1

    def bare(self, state: LastState) -> PyTree:
        return self.env.bare(state.inner)

    def reset(self, *, key: PRNGKeyArray) -> tuple[LastState, TimeStep]:
        state, first = self.env.reset(key=key)
        nothing = jnp.zeros((*first.obs.shape[:-1], self.env.action_size))
        return self._told(state, first, nothing)

    def step(
        self, state: LastState, action: Array, *, key: PRNGKeyArray
    ) -> tuple[LastState, TimeStep]:
        inner, now = self.env.step(state.inner, action, key=key)
        if self.env.choices:
            action = chosen(jnp, action, self.env, state.allowed)
        return self._told(inner, now, action)

    def _told(self, inner: PyTree, now: TimeStep, action: Array) -> tuple[LastState, TimeStep]:
        earned = now.rewards[self.env.signals[0]]
        earned = jnp.broadcast_to(earned, now.obs.shape[:-1])[..., None]
        obs = jnp.concatenate([now.obs, action, earned], axis=-1)
        state = LastState(inner, now.obs[..., : self.env.barrable])
        return state, dataclasses.replace(now, obs=obs)


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
        other = {"obs_size": self.obs_size, "observations": None, "shown": None}
        return self.env.task_record() | other

    def around(self, inner: AbstractCopies) -> "LastStepCopies":
        return LastStepCopies(inner, self.env)


class LastStepCopies(AbstractWrappedCopies):
    """Copies whose observations end with the last step."""

    def __init__(self, inner: AbstractCopies, env: AbstractHostEnvironment):
        self.inner, self.n, self._env = inner, inner.n, env
        self._allowed: Any = None  # the first numbers of each copy's last observation

    def reset(self, seeds: np.ndarray, active: np.ndarray) -> np.ndarray:
        obs = self.inner.reset(seeds, active)
        self._remember(obs, active)
        nothing = np.zeros((*obs.shape[:-1], self._env.action_size))
        return self._told(obs, nothing, np.float32(0.0))

    def step(self, actions: np.ndarray, active: np.ndarray) -> HostStep:
        now = self.inner.step(actions, active)
        done = chosen(np, actions, self._env, self._allowed)
        self._remember(now.obs, active)
        obs = self._told(now.obs, done, now.rewards[self._env.signals[0]])
        return dataclasses.replace(now, obs=obs)

    def _remember(self, obs: np.ndarray, active: np.ndarray) -> None:
        allowed = obs[..., : self._env.barrable]
        if self._allowed is None:
            self._allowed = np.ones_like(allowed)
        self._allowed[active] = allowed[active]

    def _told(self, obs: np.ndarray, action: np.ndarray, earned: Any) -> np.ndarray:
        """Of a team a reward of all is told to each."""
        earned = np.asarray(earned, np.float32)
        earned = earned.reshape(*earned.shape, *(1,) * (obs.ndim - earned.ndim))
        parts = (obs, action, np.broadcast_to(earned, (*obs.shape[:-1], 1)))
        return np.concatenate([x.astype(np.float32) for x in parts], axis=-1)
