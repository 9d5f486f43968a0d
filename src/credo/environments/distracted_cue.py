"""Distracted Cue: one number that counts, many of the same kind that do not, then the question.

The copying problem's distractors (Hochreiter & Schmidhuber 1997, section 5.1, task 2: noise between
a signal and its use) as a task of one answer. In the T-mazes nothing happens in the corridor; here
whoever lets in what comes later forgets what came first: it asks for a gate.
"""

import dataclasses
from typing import ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..types import Sequence
from .base import AbstractSequenceTask


class DistractedCue(AbstractSequenceTask):
    """Read a cue, then distractors that look like it, then say what the cue was.

    Inputs are [value, cue, question]. At the first step the value is the cue, 1 or -1, and `cue` is
    1; at each of the next `min_distractors` to `max_distractors` steps the value is 1 or -1 by
    chance; at the last one it is 0 and `question` is 1: that answer alone counts, and is to have
    the sign of the cue.

    The reward is the answer times the cue, in [-1, 1]. Without memory of the first step half of
    the answers are right.
    """

    obs_size: ClassVar[int] = 3
    obs_range: ClassVar[tuple[float, float]] = (-1.0, 1.0)
    inputs: ClassVar[tuple[str, ...]] = ("value", "it is the cue", "it is the question")

    min_distractors: int = eqx.field(static=True, default=10)  # at least 0
    max_distractors: int = eqx.field(static=True, default=20)
    """Distractors, at most, `min_distractors` or more."""

    def __check_init__(self):
        if not 0 <= self.min_distractors <= self.max_distractors:
            raise ValueError(
                f"{self.min_distractors}..{self.max_distractors} distractors: "
                "needs 0 <= min_distractors <= max_distractors"
            )

    @property
    def max_steps(self) -> int:
        return self.max_distractors + 2

    def longer(self, times: int) -> Self:
        low, high = times * self.min_distractors, times * self.max_distractors
        return dataclasses.replace(self, min_distractors=low, max_distractors=high)

    def sample(self, *, key: PRNGKeyArray) -> Sequence:
        value_key, number_key = jax.random.split(key)
        values = jax.random.rademacher(value_key, (self.max_steps,), jnp.float32)
        number = jax.random.randint(number_key, (), self.min_distractors, self.max_distractors + 1)
        return self.lay_out(values, number)

    def lay_out(self, values: Float[Array, " time"], number: Int[Array, ""]) -> Sequence:
        """The sequence with these values ±1, of which the first is the cue, and so many
        distractors, at most `max_distractors`."""
        step = jnp.arange(self.max_steps)
        asked = step == number + 1
        shown = jnp.where(step <= number, values, 0.0)
        flags = [(step == 0).astype(jnp.float32), asked.astype(jnp.float32)]
        inputs = jnp.stack([shown, *flags], axis=1)
        targets = jnp.where(asked, values[0], 0.0)
        return Sequence(inputs, targets, asked, jnp.int32(number + 2))

    def reward(self, answer, target, scored, perfect):
        return jnp.where(scored, answer * target, 0.0)
