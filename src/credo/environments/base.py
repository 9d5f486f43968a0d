"""The contract every environment keeps, and the one for labelled sequences."""

import abc
import math
from typing import TYPE_CHECKING, Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from ..types import Sequence, TimeStep, Trace
from .viewer import Mark, Viewer


class AbstractTask(eqx.Module):
    """What every task says of itself, in JAX or outside. The attributes below are class variables,
    fields with a default, or properties."""

    if TYPE_CHECKING:  # a type checker would take an AbstractVar for a field
        obs_size: ClassVar[int]
        action_size: ClassVar[int]
        max_steps: ClassVar[int]
        signals: ClassVar[tuple[str, ...]]
    else:
        obs_size: eqx.AbstractVar[int]
        action_size: eqx.AbstractVar[int]
        max_steps: eqx.AbstractVar[int]  # no episode is longer
        signals: eqx.AbstractVar[tuple[str, ...]]
        """Names of the rewards. The first is what training maximises, unless an algorithm says
        otherwise; the last is what is reported, unless the task does."""
    agents: ClassVar[int | None] = None
    choices: ClassVar[tuple[int, ...]] = ()
    """Options of each choice that an action makes. Its first entries are one for every option, of
    which the largest of each choice is taken; behind them are numbers in [-1, 1]."""
    masked: ClassVar[bool] = False
    """Whether an observation begins with a number for each option: 1 if it is allowed now, else 0.
    Of those that are not the task takes none."""
    obs_range: ClassVar[tuple[Any, Any]] = (-math.inf, math.inf)
    """The least and the largest number in an observation."""

    image: ClassVar[tuple[int, int, int, int] | None] = None
    """Where the image in an observation begins, its height, its width and its channels; None: there
    is none."""

    @property
    def groups(self) -> tuple[int, ...] | None:
        """Of a team the group of each agent, counted from 0: those of one group see and do the same
        kind of things. By default all are alike."""
        return None if self.agents is None else (0,) * self.agents

    def __init_subclass__(cls, **kwargs):
        super().__init_subclass__(**kwargs)
        if isinstance(cls.__dict__.get("discrete"), bool):
            raise TypeError(
                f"{cls.__name__} sets discrete, which follows from choices: give choices = (3,) to "
                "a task whose action is one of three"
            )

    @property
    def reported(self) -> str:
        """The reward signal by which a champion is judged."""
        return self.signals[-1]

    @property
    def unwrapped(self) -> Any:
        """The task itself, within whatever delays its rewards, adds noise or cuts it short."""
        return self

    def longer(self, times: int) -> Self | None:
        """This task where something has to be remembered `times` as long, at least 1; None: it
        has no setting for that."""
        return None

    def viewer(self) -> Viewer | None:
        """How a page draws its episodes; None: it does not. A task that draws its state in
        `render(state) -> [height, width, 3]` can be filmed as well."""
        return None

    @property
    def discrete(self) -> bool:
        """Whether an action is choices alone."""
        return bool(self.choices) and sum(self.choices) == self.action_size

    @property
    def barrable(self) -> int:
        """Numbers at the start of an observation that say what is allowed; 0 if all always is."""
        return sum(self.choices) if self.masked else 0

    @property
    def sizes(self) -> tuple[int, ...]:
        """Numbers in an observation and in an action, and of a team how many agents: what networks
        and learners are made for."""
        team = () if self.agents is None else (self.agents,)
        return self.obs_size, self.action_size, *team


class AbstractEnvironment(AbstractTask):
    """One episode of one task as two pure functions.

    No automatic reset and no batch axis: rollouts decide when to stop, `jax.vmap` decides how
    many. Observations are finite float32; actions lie in [-1, 1]. For a team both have a leading
    agent axis and `agents` says how many.
    """

    def bare(self, state: PyTree) -> PyTree:
        """Of a state of this task that of `unwrapped`."""
        return state

    @abc.abstractmethod
    def reset(self, *, key: PRNGKeyArray) -> tuple[PyTree, TimeStep]:
        """A fresh episode. The rewards of this first time step are 0."""

    @abc.abstractmethod
    def step(
        self, state: PyTree, action: Float[Array, "*agents act"], *, key: PRNGKeyArray
    ) -> tuple[PyTree, TimeStep]:
        """One transition. After the end (terminated or truncated) its result is ignored."""


SEQUENCE_MARKS = (
    Mark("square", "c0", "an input: up is positive, down negative; faint: to be read"),
    Mark("line", "ink", "the answer, from −1 to 1"),
    Mark("square", "good", "pale: the side on which an answer is right; stronger where it counts"),
    Mark("dot", "good", "an answer that counts and is right"),
    Mark("dot", "bad", "an answer that counts and is wrong"),
    Mark("tick", "good", "the same in the whole sequence: right"),
    Mark("cross", "bad", "and wrong"),
    Mark("line", "muted", "now; in the whole sequence also what is shown above"),
)


class SequenceState(eqx.Module):
    """A sequence between two steps."""

    sequence: Sequence
    step: Int[Array, ""]
    perfect: Bool[Array, ""]  # every scored answer so far was right


class AbstractSequenceTask(AbstractEnvironment):
    """Read a sequence, answer at each step with one number in [-1, 1], or with several.

    A task says how to `sample` a labelled sequence and what an answer is worth; the environment
    below and the fast path of `rollout.evaluate` both follow from that.
    Signals: `fitness`, the sum of `reward` over all steps before the padding; `accuracy`, the
    share of the scored answers that were right; and `success`, 1 at the last step if all were.

    A task of several numbers at a step says so by `action_size`, and by targets `[time, act]`;
    answers then have that axis too, before any batch.
    """

    action_size: ClassVar[int] = 1
    signals: ClassVar[tuple[str, ...]] = ("fitness", "accuracy", "success")
    inputs: ClassVar[tuple[str, ...]] = ()
    """Names of the entries of an observation, for viewers; (): they have none."""

    @abc.abstractmethod
    def sample(self, *, key: PRNGKeyArray) -> Sequence:
        """One sequence, padded to `max_steps`."""

    @abc.abstractmethod
    def reward(
        self,
        answer: Float[Array, "*act_and_batch"],
        target: Float[Array, "*act_and_batch"],
        scored: Bool[Array, "*batch"],
        perfect: Bool[Array, "*batch"],
    ) -> Float[Array, "*batch"]:
        """What the answer of one step is worth: elementwise, and of several numbers their sum over
        the first axis. `perfect`: every scored answer of this sequence was right, this one
        included."""

    def lesson(
        self, sequence: Sequence
    ) -> tuple[Float[Array, "time *act"], Float[Array, "time *act"]]:
        """What training by gradient asks for: at each step the right answer in [-1, 1], and the
        weight of a mistake, 0 for none. By default ±1 where the answer is scored."""
        scored = sequence.scored[:, None] if several(sequence) else sequence.scored
        asked = scored & (sequence.targets != 0)
        return jnp.sign(sequence.targets), asked.astype(jnp.float32)

    def reset(self, *, key: PRNGKeyArray) -> tuple[SequenceState, TimeStep]:
        sequence = self.sample(key=key)
        state = SequenceState(sequence, jnp.int32(0), jnp.bool_(True))
        return state, _time_step(state, {name: jnp.float32(0.0) for name in self.signals})

    def viewer(self) -> Viewer | None:
        """Inputs, answers, and which of them were right; None if there are several at a step."""
        if several(jax.eval_shape(lambda: self.sample(key=jax.random.key(0)))):
            return None
        return Viewer(
            "sequence",
            f"{type(self.unwrapped).__name__}: read a sequence and answer at each step; some "
            "answers count.",
            self._shown,
            {"inputs": self.inputs or [f"input {i + 1}" for i in range(self.obs_size)]},
            SEQUENCE_MARKS,
            speed=10.0,
        )

    def _shown(self, trace: Trace) -> dict[str, Any]:
        """In every step: what is read, the answer, the side that is right, whether it is `scored`
        and whether it was `right`."""
        sequence, n = trace.states.sequence, int(trace.length)
        target, answer = sequence.targets[0, :n], trace.actions[:, 0]
        return {
            "inputs": trace.observations[:n],
            "answer": answer,
            "target": np.sign(target).astype(int),
            "scored": sequence.scored[0, :n],
            "right": np.asarray(correct(answer, target)),
        }

    def step(
        self, state: SequenceState, action: Float[Array, " act"], *, key: PRNGKeyArray
    ) -> tuple[SequenceState, TimeStep]:
        sequence, step = state.sequence, state.step
        target, scored = sequence.targets[step], sequence.scored[step]
        answer = action if several(sequence) else action[0]
        right = correct(answer, target)
        perfect = state.perfect & (~scored | jnp.all(right))
        asked = jnp.sum(sequence.scored.astype(jnp.float32))
        ends = step + 1 >= sequence.length
        rewards = {
            "fitness": self.reward(answer, target, scored, perfect),
            "accuracy": jnp.mean((scored & right).astype(jnp.float32)) / asked,
            "success": (ends & perfect).astype(jnp.float32),
        }
        state = SequenceState(sequence, step + 1, perfect)
        return state, _time_step(state, rewards)


def correct(answer: Float[Array, "*b"], target: Float[Array, "*b"]) -> Bool[Array, "*b"]:
    """An answer of 0 or more means class +1. A target of 0 accepts anything; NaN is no answer."""
    return (target == 0) | jnp.where(target > 0, answer >= 0, answer < 0)


def several(sequence: Sequence) -> bool:
    """Whether there are several answers at a step. Leaves may have further axes in front."""
    return sequence.targets.ndim > sequence.scored.ndim


CERTAIN = 1e-6  # the least probability of an answer: a wrong one costs at most 20 bits


def cross_entropy(answer: Float[Array, "*b"], target: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Cross-entropy of answers to targets, both in [-1, 1], in nats, elementwise. (1 + answer) / 2
    is read as the probability of class +1; at least `CERTAIN`, so that the cost is finite."""
    shrink = 1.0 - 2.0 * CERTAIN
    p, q = 0.5 + 0.5 * shrink * answer, 0.5 + 0.5 * target
    r = 0.5 - 0.5 * shrink * answer  # 1 - p, without its rounding
    return -q * jnp.log(p) - (1.0 - q) * jnp.log(r)


def _time_step(state: SequenceState, rewards: dict[str, Array]) -> TimeStep:
    ended = state.step >= state.sequence.length
    obs = state.sequence.inputs[jnp.minimum(state.step, state.sequence.length - 1)]
    return TimeStep(obs, rewards, ended, jnp.bool_(False))
