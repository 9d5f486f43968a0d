"""Tasks made of other tasks."""

import dataclasses
import threading

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


class Shortened(AbstractSequenceTask):
    """A sequence task that ends after its first `questions` scored steps.

    `questions` is data: a curriculum that changes it compiles nothing. `max_steps` stays that of
    the whole task, but what is cut off is not played.
    """

    task: AbstractSequenceTask  # the task that is cut short
    questions: Int[Array, ""] | int  # scored steps that are left, at least 1

    @property
    def obs_size(self) -> int:
        return self.task.obs_size

    @property
    def max_steps(self) -> int:
        return self.task.max_steps

    def sample(self, *, key: PRNGKeyArray) -> Sequence:
        sequence = self.task.sample(key=key)
        asked = jnp.cumsum(sequence.scored.astype(jnp.int32))
        last = jnp.argmax(asked >= self.questions)  # 0 if there are fewer
        length = jnp.where(asked[-1] >= self.questions, last + 1, sequence.length)
        length = jnp.minimum(length, sequence.length)
        scored = sequence.scored & (jnp.arange(self.max_steps) < length)
        return Sequence(sequence.inputs, sequence.targets, scored, length)

    @property
    def unwrapped(self) -> AbstractEnvironment:
        return self.task.unwrapped

    def lesson(self, sequence):
        return self.task.lesson(sequence)

    def reward(self, answer, target, scored, perfect):
        return self.task.reward(answer, target, scored, perfect)


class Given(AbstractSequenceTask):
    """A sequence task of which the sequences are given: in `rollout.evaluate` every features-first
    policy answers each of them once. An episode alone draws one of them."""

    task: AbstractSequenceTask  # that says what an answer earns
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

    @property
    def unwrapped(self) -> AbstractEnvironment:
        return self.task.unwrapped

    def sample(self, *, key: PRNGKeyArray) -> Sequence:
        i = jax.random.randint(key, (), 0, self.n)
        return jax.tree.map(lambda x: x[i], self.sequences)

    def lesson(self, sequence):
        return self.task.lesson(sequence)

    def reward(self, answer, target, scored, perfect):
        return self.task.reward(answer, target, scored, perfect)


class AbstractWrapper(AbstractEnvironment):
    """A JAX task with the sizes and the signals of another one."""

    env: AbstractEnvironment  # the wrapped task

    @property
    def obs_size(self) -> int:
        return self.env.obs_size

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def max_steps(self) -> int:
        return self.env.max_steps

    @property
    def signals(self) -> tuple[str, ...]:
        return self.env.signals

    @property
    def agents(self) -> int | None:
        return self.env.agents

    @property
    def reported(self) -> str:
        return self.env.reported

    @property
    def unwrapped(self) -> AbstractEnvironment:
        return self.env.unwrapped

    def bare(self, state: PyTree) -> PyTree:
        return self.env.bare(state)

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
    readable: `NoisyObservations(ServerFleet(), 0.5, spared=1)`.
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
        noisy = jnp.arange(self.obs_size) < self.obs_size - self.spared
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

    @property
    def obs_range(self) -> tuple[float, float]:
        return self.env.obs_range

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


class DelayedHostReward(AbstractHostEnvironment):
    """The same for a task outside JAX. Its copies are those of `env`: play one at a time."""

    env: AbstractHostEnvironment  # the task whose reward comes late

    def __check_init__(self):
        if not isinstance(self.env, AbstractHostEnvironment):
            raise ValueError(f"{type(self.env).__name__} is no host task: use delayed(env)")

    @property
    def obs_size(self) -> int:
        return self.env.obs_size

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def max_steps(self) -> int:
        return self.env.max_steps

    @property
    def signals(self) -> tuple[str, ...]:
        return self.env.signals

    @property
    def agents(self) -> int | None:
        return self.env.agents

    @property
    def discrete(self) -> bool:
        return self.env.discrete

    @property
    def reported(self) -> str:
        return self.env.reported

    @property
    def unwrapped(self) -> AbstractHostEnvironment:
        return self.env.unwrapped

    @property
    def reward_shapes(self) -> dict[str, tuple[int, ...]]:
        return self.env.reward_shapes

    @property
    def obs_dtype(self) -> str:
        return self.env.obs_dtype

    @property
    def at_once(self) -> int | None:
        return self.env.at_once

    @property
    def obs_range(self):
        return self.env.obs_range

    @property
    def warnings(self) -> tuple[str, ...]:
        return self.env.warnings

    def task_record(self):
        return self.env.task_record()

    def copies(self, n: int) -> "DelayedCopies":
        inner = self.env.copies(n)
        kept = _DELAYED.copies
        if (self, n) not in kept or kept[self, n].inner is not inner:
            kept[self, n] = DelayedCopies(inner, self.reward_shapes)
        return kept[self, n]


class DelayedCopies(AbstractCopies):
    def __init__(self, inner: AbstractCopies, shapes: dict[str, tuple[int, ...]]):
        self.inner, self.n = inner, inner.n
        self._earned = {name: np.zeros((inner.n, *shape)) for name, shape in shapes.items()}

    @property
    def failed(self) -> np.ndarray | None:
        return self.inner.failed

    def failure_text(self, i: int) -> str:
        return self.inner.failure_text(i)

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
        self.copies: dict[tuple[DelayedHostReward, int], DelayedCopies] = {}


_DELAYED = _Kept()
