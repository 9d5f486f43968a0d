"""Tasks with a known answer: an algorithm that fails one has the defect that its name says.

They are for tests and for debugging one's own algorithm or network: each is learned in seconds,
and the best possible return is written beside it.

| probe | needs | best | without it |
|---|---|---|---|
| `Copy` | the observation reaches the action | 0 | -size·max_steps/3 (action 0) |
| `Locked` | exploration by whole policies, then gradients | `max_steps` - `hold` | 0 |
| `Remember` | memory across `delay` steps | 1 | success ½ |
| `Xor` | a hidden unit | 16, success 1 | success 0 |
| `Meet` | both agents of a team act | 1 (global) | 0 |
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .. import require
from ..types import Sequence, TimeStep
from .base import AbstractEnvironment, AbstractSequenceTask


class CopyState(eqx.Module):
    obs: Float[Array, " size"]
    step: Int[Array, ""]


class AbstractAnswer(AbstractEnvironment):
    """Answer each observation with as many numbers. Each is drawn anew, independent of all before
    it and of the actions. The clock ends the episode (truncated)."""

    signals: ClassVar[tuple[str, ...]] = ("reward",)

    size: eqx.AbstractVar[int]  # numbers in an observation and in an action

    @property
    def obs_size(self) -> int:
        return self.size

    @property
    def action_size(self) -> int:
        return self.size

    @abc.abstractmethod
    def drawn(self, key: PRNGKeyArray) -> Float[Array, " size"]:
        """An observation."""

    @abc.abstractmethod
    def paid(self, obs: Float[Array, " size"], action: Float[Array, " size"]) -> Float[Array, ""]:
        """The reward of an answer."""

    def reset(self, *, key: PRNGKeyArray) -> tuple[CopyState, TimeStep]:
        return self._at(jnp.int32(0), jnp.float32(0.0), key)

    def step(
        self, state: CopyState, action: Float[Array, " size"], *, key: PRNGKeyArray
    ) -> tuple[CopyState, TimeStep]:
        return self._at(state.step + 1, self.paid(state.obs, action), key)

    def _at(self, step, reward, key):
        obs, truncated = self.drawn(key), step >= self.max_steps
        return CopyState(obs, step), TimeStep(obs, {"reward": reward}, jnp.bool_(False), truncated)


class Copy(AbstractAnswer):
    """Act as you see: the reward is minus the squared distance of action and observation, whose
    numbers are uniform in [-1, 1]. Best return 0; the action 0 has -size·max_steps/3 on average.
    """

    obs_range: ClassVar[tuple[float, float]] = (-1.0, 1.0)

    size: int = eqx.field(static=True, default=1)  # numbers to copy, at least 1
    max_steps: int = eqx.field(static=True, default=10)  # length of every episode, at least 1

    def __check_init__(self):
        require.at_least("size", self.size, 1)
        require.at_least("max_steps", self.max_steps, 1)

    def drawn(self, key):
        return jax.random.uniform(key, (self.size,), minval=-1.0, maxval=1.0)

    def paid(self, obs, action):
        return -jnp.sum((action - obs) ** 2)


class Choose(AbstractAnswer):
    """Choose what you see: the reward is 1 if the largest entry of the action is where the
    observation has its 1. Best return `max_steps`; by chance one `size`-th of it."""

    obs_range: ClassVar[tuple[float, float]] = (0.0, 1.0)
    size: int = eqx.field(static=True, default=3)  # actions, at least 2
    max_steps: int = eqx.field(static=True, default=10)  # length of every episode, at least 1

    def __check_init__(self):
        require.at_least("size", self.size, 2)
        require.at_least("max_steps", self.max_steps, 1)

    @property
    def choices(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return (self.size,)

    def drawn(self, key):
        return jax.nn.one_hot(jax.random.randint(key, (), 0, self.size), self.size)

    def paid(self, obs, action):
        return (jnp.argmax(action) == jnp.argmax(obs)).astype(jnp.float32)


class LockedState(eqx.Module):
    shown: Float[Array, " size"]  # what is to be copied
    lever: Float[Array, ""]  # its mean over the steps of the first part so far
    step: Int[Array, ""]


class Locked(AbstractEnvironment):
    """Copy behind a lock: for the first `hold` steps the last action moves a lever, and only if its
    mean was beyond ±`threshold` is copying paid in the steps that follow, 1 less the mean distance.

    Each step costs `effort` times the size of the lever's action, so that gradients lead away from
    the lever, and noise that is new in each step averages out: a learner alone ends near 0. Members
    of a population differ for whole episodes: evolution finds the lever, and comes to copy slowly.
    Observations are [what to copy, new in every step and uniform in [-1, 1]; the lever; the time in
    [0, 1]]. The clock ends the episode (truncated). Best return `max_steps` - `hold`, less the
    effort; action 0 has 0, the lever alone half of the best.
    """

    signals: ClassVar[tuple[str, ...]] = ("reward",)
    obs_range: ClassVar[tuple[float, float]] = (-1.0, 1.0)

    size: int = eqx.field(static=True, default=8)  # numbers to copy, at least 1
    threshold: float = 0.3  # of the lever's mean, in [0, 1]
    hold: int = eqx.field(static=True, default=16)  # steps with the lever, in [1, max_steps - 1]
    effort: float = 0.1  # what a full pull costs in a step, at least 0
    max_steps: int = eqx.field(static=True, default=32)  # length of every episode, at least 2

    def __check_init__(self):
        require.at_least("size", self.size, 1)
        require.at_least("max_steps", self.max_steps, 2)
        require.within("threshold", self.threshold, 0, 1)
        require.within("hold", self.hold, 1, self.max_steps - 1)
        require.at_least("effort", self.effort, 0)

    @property
    def obs_size(self) -> int:
        return self.size + 2

    @property
    def action_size(self) -> int:
        return self.size + 1

    def reset(self, *, key: PRNGKeyArray) -> tuple[LockedState, TimeStep]:
        return self._at(jnp.int32(0), jnp.float32(0.0), jnp.float32(0.0), key)

    def step(
        self, state: LockedState, action: Float[Array, " size+1"], *, key: PRNGKeyArray
    ) -> tuple[LockedState, TimeStep]:
        copied = 1.0 - jnp.mean(jnp.abs(action[:-1] - state.shown))
        paid = (state.step >= self.hold) & (jnp.abs(state.lever) > self.threshold)
        reward = jnp.where(paid, copied, 0.0) - self.effort * jnp.abs(action[-1])
        pulled = jnp.where(state.step < self.hold, action[-1] / self.hold, 0.0)
        return self._at(state.step + 1, state.lever + pulled, reward, key)

    def _at(self, step, lever, reward, key):
        shown = jax.random.uniform(key, (self.size,), minval=-1.0, maxval=1.0)
        time = step.astype(jnp.float32) / self.max_steps
        obs = jnp.concatenate([shown, jnp.stack([lever, time])])
        told = TimeStep(obs, {"reward": reward}, jnp.bool_(False), step >= self.max_steps)
        return LockedState(shown, lever, step), told


class Remember(AbstractSequenceTask):
    """See one signal ±1, then `delay` zeros, and repeat the signal at the last of them.

    The reward is answer·signal at that step and 0 before. Best return 1, success 1. The answer
    of a policy without memory cannot depend on the signal: fitness 0, success ½ on average.
    """

    obs_range: ClassVar[tuple[float, float]] = (-1.0, 1.0)

    obs_size: ClassVar[int] = 1

    delay: int = eqx.field(static=True, default=5)  # steps the signal must be kept, at least 1

    def __check_init__(self):
        require.at_least("delay", self.delay, 1)

    @property
    def max_steps(self) -> int:
        return self.delay + 1

    def sample(self, *, key: PRNGKeyArray) -> Sequence:
        signal = jax.random.rademacher(key, (), jnp.float32)
        last = jnp.arange(self.max_steps) == self.delay
        inputs = jnp.zeros((self.max_steps, 1)).at[0, 0].set(signal)
        return Sequence(inputs, jnp.where(last, signal, 0.0), last, jnp.int32(self.max_steps))

    def reward(self, answer, target, scored, perfect):
        return jnp.where(scored, answer * target, 0.0)


class XorState(eqx.Module):
    bits: Float[Array, "steps 2"]
    error: Float[Array, ""]  # so far
    right: Bool[Array, ""]  # all answers so far
    step: Int[Array, ""]


class Xor(AbstractEnvironment):
    """Say whether two bits differ, for each of the four pairs once, in random order.

    Observations are two bits of 0 or 1; of an action in [-1, 1] the upper half means that they
    differ. The clock ends the episode (truncated). Signals, both at the last step: `fitness`, 4
    less the sum of distances between answer and truth on a scale from 0 to 1, squared, as in
    Stanley & Miikkulainen (2002), section 4.1; `success`, 1 if all four answers are on the right
    side. Best 16 and 1. No feed-forward network without hidden units is right four times.
    """

    signals: ClassVar[tuple[str, ...]] = ("fitness", "success")
    reported: ClassVar[str] = "success"
    obs_range: ClassVar[tuple[float, float]] = (0.0, 1.0)

    obs_size: ClassVar[int] = 2
    action_size: ClassVar[int] = 1
    max_steps: ClassVar[int] = 4

    def reset(self, *, key: PRNGKeyArray) -> tuple[XorState, TimeStep]:
        pairs = jnp.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
        bits = pairs[jax.random.permutation(key, 4)]
        return self._at(XorState(bits, jnp.float32(0.0), jnp.bool_(True), jnp.int32(0)))

    def step(
        self, state: XorState, action: Float[Array, " one"], *, key: PRNGKeyArray
    ) -> tuple[XorState, TimeStep]:
        answer, (x, y) = 0.5 * (1.0 + action[0]), state.bits[state.step]
        right = state.right & ((answer > 0.5) == (x != y)) & (answer != 0.5)
        error = state.error + jnp.abs(answer - jnp.abs(x - y))
        return self._at(XorState(state.bits, error, right, state.step + 1))

    def _at(self, state: XorState) -> tuple[XorState, TimeStep]:
        last = state.step >= self.max_steps
        worth = {"fitness": (4.0 - state.error) ** 2, "success": state.right.astype(jnp.float32)}
        rewards = {name: jnp.where(last, x, 0.0) for name, x in worth.items()}
        obs = state.bits[jnp.minimum(state.step, 3)]
        return state, TimeStep(obs, rewards, jnp.bool_(False), last)


class MeetState(eqx.Module):
    position: Float[Array, " agents"]
    step: Int[Array, ""]


class Meet(AbstractEnvironment):
    """Two agents on a line walk towards each other; neither can cover the way alone.

    Agent 0 starts at -1..-0.7 and agent 1 at 0.7..1; a full action moves an agent by 0.2. At a
    distance of 0.2 or less they have met and the episode is terminated; after 5 steps it is
    truncated. Each agent sees [its position, the way to the other] in the same units.

    Signals: `global`, shared: 1 on meeting; `local` `[2]`: how far each agent's own move led
    towards the other, at most 0.2 a step. Two agents at full speed meet in 4 or 5 steps: the best
    `global` return is 1 from every start. If one of them stands still it is 0 from every start.
    """

    agents: ClassVar[int | None] = 2
    obs_size: ClassVar[int] = 2
    action_size: ClassVar[int] = 1
    max_steps: ClassVar[int] = 5
    signals: ClassVar[tuple[str, ...]] = ("global", "local")
    reported: ClassVar[str] = "global"
    obs_range: ClassVar[tuple[float, float]] = (-4.0, 4.0)

    def reset(self, *, key: PRNGKeyArray) -> tuple[MeetState, TimeStep]:
        start = jax.random.uniform(key, (2,), minval=0.7, maxval=1.0)
        state = MeetState(start * jnp.array([-1.0, 1.0]), jnp.int32(0))
        return state, self._time_step(state, jnp.zeros(2), jnp.bool_(False))

    def step(
        self, state: MeetState, action: Float[Array, "agents act"], *, key: PRNGKeyArray
    ) -> tuple[MeetState, TimeStep]:
        move = 0.2 * jnp.clip(action[:, 0], -1.0, 1.0)
        local = move * jnp.sign(state.position[::-1] - state.position)
        state = MeetState(state.position + move, state.step + 1)
        met = jnp.abs(state.position[0] - state.position[1]) <= 0.2
        return state, self._time_step(state, local, met)

    def _time_step(
        self, state: MeetState, local: Float[Array, " agents"], met: Bool[Array, ""]
    ) -> TimeStep:
        obs = jnp.stack([state.position, state.position[::-1] - state.position], axis=1)
        rewards = {"global": met.astype(jnp.float32), "local": local}
        truncated = ~met & (state.step >= self.max_steps)
        return TimeStep(obs, rewards, met, truncated, jnp.ones(2, bool))
