"""Tasks made of other tasks."""

import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from ..types import Sequence
from .base import AbstractSequenceTask


class Shortened(AbstractSequenceTask):
    """A sequence task that ends after its first `questions` scored steps.

    `questions` is data: a curriculum that changes it compiles nothing. `max_steps` stays that of
    the whole task, but what is cut off is not played.
    """

    task: AbstractSequenceTask
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

    def reward(self, answer, target, scored, perfect):
        return self.task.reward(answer, target, scored, perfect)
