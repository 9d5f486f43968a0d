"""Tasks made of other tasks."""

import abc
import dataclasses
import threading
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray, PyTree

from .. import require
from ..types import Sequence, TimeStep, Trace
from .base import AbstractEnvironment, AbstractSequenceTask
from .host import AbstractCopies, AbstractHostEnvironment, HostStep
from .viewer import Viewer


def _of(part: str, name: str) -> Any:
    """A property that is the one of a part, the wrapped task."""
    return property(lambda self: getattr(getattr(self, part), name))


class AbstractCut(AbstractSequenceTask):
    """A sequence task that asks for the answers of another one."""

    task: AbstractSequenceTask  # the task that says what an answer is worth

    unwrapped = _of("task", "unwrapped")
    action_size = _of("task", "action_size")

    def lesson(self, sequence):
        return self.task.lesson(sequence)

    def reward(self, answer, target, scored, perfect):
        return self.task.reward(answer, target, scored, perfect)


class Shortened(AbstractCut):
    """A sequence task that ends after its first `questions` scored steps.

    `questions` is data: a curriculum that changes it compiles nothing. `max_steps` stays that of
    the whole task, but what is cut off is not played.
    """

    questions: Int[Array, ""] | int  # scored steps that are left, at least 1

    obs_size = _of("task", "obs_size")
    max_steps = _of("task", "max_steps")

    def sample(self, *, key: PRNGKeyArray) -> Sequence:
        sequence = self.task.sample(key=key)
        asked = jnp.cumsum(sequence.scored.astype(jnp.int32))
        last = jnp.argmax(asked >= self.questions)  # 0 if there are fewer
        length = jnp.where(asked[-1] >= self.questions, last + 1, sequence.length)
        length = jnp.minimum(length, sequence.length)
        scored = sequence.scored & (jnp.arange(self.max_steps) < length)
        return Sequence(sequence.inputs, sequence.targets, scored, length)


class Given(AbstractCut):
    """A sequence task of which the sequences are given: in `rollout.evaluate` every features-first
    policy answers each of them once. An episode alone draws one of them."""

    sequences: Sequence  # leaves [n, ...], at least one

    @classmethod
    def alone(cls, task: AbstractSequenceTask, sequence: Sequence) -> "Given":
        """This one sequence."""
        return cls(task, jax.tree.map(lambda x: jnp.asarray(x)[None], sequence))

    @property
    def n(self) -> int:
        return self.sequences.inputs.shape[0]

    @property
    def obs_size(self) -> int:
        return self.sequences.inputs.shape[2]

    @property
    def max_steps(self) -> int:
        return self.sequences.inputs.shape[1]

    def require_once(self, population: Any, episodes: int) -> None:
        """Raise `ValueError` unless each sequence is played once, by features-first policies."""
        if not (getattr(population, "features_first", False) and episodes == self.n):
            raise ValueError(
                f"{self.n} given sequences are played once each by features-first policies: "
                f"{episodes} episodes were asked for, of {type(population).__name__}"
            )

    def sample(self, *, key: PRNGKeyArray) -> Sequence:
        i = jax.random.randint(key, (), 0, self.n)
        return jax.tree.map(lambda x: x[i], self.sequences)


class AbstractWrapper(AbstractEnvironment):
    """A JAX task with the sizes and the signals of another one."""

    env: AbstractEnvironment  # the wrapped task

    obs_size = _of("env", "obs_size")
    action_size = _of("env", "action_size")
    max_steps = _of("env", "max_steps")
    signals = _of("env", "signals")
    agents = _of("env", "agents")
    reported = _of("env", "reported")
    unwrapped = _of("env", "unwrapped")
    choices = _of("env", "choices")
    image = _of("env", "image")
    groups = _of("env", "groups")
    masked = _of("env", "masked")

    def bare(self, state: PyTree) -> PyTree:
        return self.env.bare(state)

    def longer(self, times: int) -> Self | None:
        inner = self.env.longer(times)
        return None if inner is None else dataclasses.replace(self, env=inner)

    def viewer(self) -> Viewer | None:
        """That of the task itself."""
        inner = self.unwrapped.viewer()

        def episode(trace: Trace):
            assert inner is not None
            return inner.episode(dataclasses.replace(trace, states=self.bare(trace.states)))

        return inner and dataclasses.replace(inner, episode=episode)


class NoisyObservations(AbstractWrapper):
    """A JAX task whose observations are told with noise N(0, std²), drawn anew for every entry,
    agent and step. What happens in the world is not noisy.

    Named as future work of the server fleet by Khadka (2019), section 4.2.5. Its status must stay
    readable: `NoisyObservations(ServerFleet(), 0.5, spared=1)`. What is allowed is told exactly.
    """

    std: float  # at least 0; one number for all entries, in the units of each
    spared: int = eqx.field(static=True, default=0)
    """How many entries at the end of an observation are told exactly, 0..obs_size - 1."""

    def __check_init__(self):
        if not isinstance(self.env, AbstractEnvironment):
            raise ValueError(
                f"{type(self.env).__name__} is no JAX task: noise is added to those alone"
            )
        require.at_least("std", self.std, 0)
        require.within("spared", self.spared, 0, self.obs_size - 1)

    # Of `obs_range` the default is left: noise has no bounds.

    def reset(self, *, key: PRNGKeyArray) -> tuple[PyTree, TimeStep]:
        world_key, noise_key = jax.random.split(key)
        state, first = self.env.reset(key=world_key)
        return state, self._told(first, key=noise_key)

    def step(self, state: PyTree, action: Array, *, key: PRNGKeyArray) -> tuple[PyTree, TimeStep]:
        world_key, noise_key = jax.random.split(key)
        state, now = self.env.step(state, action, key=world_key)
        return state, self._told(now, key=noise_key)

    def _told(self, now: TimeStep, *, key: PRNGKeyArray) -> TimeStep:
        entry = jnp.arange(self.obs_size)
        noisy = (entry >= self.barrable) & (entry < self.obs_size - self.spared)
        noise = self.std * jax.random.normal(key, now.obs.shape)
        obs = now.obs + jnp.where(noisy, noise, 0.0)
        return dataclasses.replace(now, obs=obs)


def delayed(
    env: AbstractEnvironment | AbstractHostEnvironment,
) -> "DelayedReward | DelayedHostReward":
    """The hard variant of a task: the whole return is paid at the last step of the episode."""
    if isinstance(env, AbstractHostEnvironment):
        return DelayedHostReward(env)
    return DelayedReward(env)


class DelayedState(eqx.Module):
    inner: PyTree
    earned: dict[str, Array]  # since the episode began


class DelayedReward(AbstractWrapper):
    """A JAX task that pays the sum of every reward signal at the last step, and 0 before."""

    def __check_init__(self):
        if not isinstance(self.env, AbstractEnvironment):
            raise ValueError(f"{type(self.env).__name__} is no JAX task: use delayed(env)")

    obs_range = _of("env", "obs_range")

    def bare(self, state: DelayedState) -> PyTree:
        return self.env.bare(state.inner)

    def reset(self, *, key: PRNGKeyArray) -> tuple[DelayedState, TimeStep]:
        inner, first = self.env.reset(key=key)
        return DelayedState(inner, first.rewards), first  # they are 0

    def step(
        self, state: DelayedState, action: Array, *, key: PRNGKeyArray
    ) -> tuple[DelayedState, TimeStep]:
        inner, now = self.env.step(state.inner, action, key=key)
        earned = {name: state.earned[name] + reward for name, reward in now.rewards.items()}
        ended = now.terminated | now.truncated
        paid = {name: jnp.where(ended, sum_, 0.0) for name, sum_ in earned.items()}
        return DelayedState(inner, earned), dataclasses.replace(now, rewards=paid)


class AbstractHostWrapper(AbstractHostEnvironment):
    """A task outside JAX with the sizes and the rewards of another one. Its copies are those of
    `env`: play one at a time."""

    env: AbstractHostEnvironment  # the wrapped task

    obs_size = _of("env", "obs_size")
    action_size = _of("env", "action_size")
    max_steps = _of("env", "max_steps")
    signals = _of("env", "signals")
    agents = _of("env", "agents")
    reported = _of("env", "reported")
    unwrapped = _of("env", "unwrapped")
    choices = _of("env", "choices")
    image = _of("env", "image")
    groups = _of("env", "groups")
    masked = _of("env", "masked")
    reward_shapes = _of("env", "reward_shapes")
    obs_dtype = _of("env", "obs_dtype")
    obs_range = _of("env", "obs_range")
    at_once = _of("env", "at_once")
    warnings = _of("env", "warnings")
    task_record = _of("env", "task_record")

    def copies(self, n: int) -> Any:
        inner, kept = self.env.copies(n), _KEPT.copies
        if (self, n) not in kept or kept[self, n].inner is not inner:
            kept[self, n] = self.around(inner)
        return kept[self, n]

    @abc.abstractmethod
    def around(self, inner: AbstractCopies) -> "AbstractWrappedCopies":
        """Copies that play these."""


class AbstractWrappedCopies(AbstractCopies):
    """Copies around others."""

    inner: AbstractCopies
    failed = _of("inner", "failed")
    spoiled = _of("inner", "spoiled")
    failure_text = _of("inner", "failure_text")


class DelayedHostReward(AbstractHostWrapper):
    """`DelayedReward` for a task outside JAX."""

    def __check_init__(self):
        if not isinstance(self.env, AbstractHostEnvironment):
            raise ValueError(f"{type(self.env).__name__} is no host task: use delayed(env)")

    def around(self, inner: AbstractCopies) -> "DelayedCopies":
        return DelayedCopies(inner, self.reward_shapes)


class DelayedCopies(AbstractWrappedCopies):
    """Copies whose rewards are paid at the last step of each episode."""

    def __init__(self, inner: AbstractCopies, shapes: dict[str, tuple[int, ...]]):
        self.inner, self.n = inner, inner.n
        self._earned = {name: np.zeros((inner.n, *shape)) for name, shape in shapes.items()}

    def reset(self, seeds: np.ndarray, active: np.ndarray) -> np.ndarray:
        for earned in self._earned.values():
            earned[active] = 0.0
        return self.inner.reset(seeds, active)

    def step(self, actions: np.ndarray, active: np.ndarray) -> HostStep:
        now = self.inner.step(actions, active)
        ended = now.terminated | now.truncated
        paid = {}
        for name, earned in self._earned.items():
            lanes = (-1,) + (1,) * (earned.ndim - 1)
            np.add(earned, now.rewards[name], out=earned, where=active.reshape(lanes))
            paid[name] = np.where((ended & active).reshape(lanes), earned, 0.0)
        return dataclasses.replace(now, rewards=paid)


class _Kept(threading.local):
    """Of each thread its own, as the copies inside are."""

    def __init__(self):
        self.copies: dict[tuple[AbstractHostWrapper, int], AbstractWrappedCopies] = {}


_KEPT = _Kept()
