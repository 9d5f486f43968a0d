"""Sequence Classification: has the stream shown more +1 than -1 so far?

Source: Khadka (2019), section 3.2 and Figure 3.3; after Rawal & Miikkulainen (2016).
A scalar stream of `depth` signals ±1 (p = ½), with `min_gap`..`max_gap` zeros between two signals
and none after the last. The answer counts at every signal; one wrong answer fails the sequence.

Departures from the dissertation:

- A running sum of 0 is class +1, as its Figure 3.3 shows, for evolution and gradient alike. The
  author's evolved version accepted any answer there, which makes the task easier
  (`ties="free"`); 82 % of 21-deep sequences contain a tie.
- With that rule the reward uses S + ½ in place of the running sum S, since a reward that is 0 at
  S = 0 cannot teach the answer there.
- Length is depth + (depth-1)·[10..20], 221..421 at depth 21; the text's {221, 441} counts a gap
  after the last signal.
"""

import dataclasses
from typing import ClassVar, Literal, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .. import require
from ..types import Sequence
from .base import AbstractSequenceTask


class SequenceClassification(AbstractSequenceTask):
    """Signals ±1 between zeros; the class is the sign of their running sum.

    The reward is the author's: at every step clip(y·S, -1, 1), and 1 more at a signal where that
    product reaches 1, with S the running sum (plus ½ where a tie is class +1).
    """

    obs_size: ClassVar[int] = 1
    obs_range: ClassVar[tuple[float, float]] = (-1.0, 1.0)
    inputs: ClassVar[tuple[str, ...]] = ("signal",)

    depth: int = eqx.field(static=True, default=21)  # signals per sequence, at least 1
    min_gap: int = eqx.field(static=True, default=10)
    """Zeros between two signals, at least, 0 or more."""
    max_gap: int = eqx.field(static=True, default=20)
    """Zeros between two signals, at most, `min_gap` or more."""
    ties: Literal["positive", "free"] = eqx.field(static=True, default="positive")
    """The right answer at a running sum of 0: +1, or anything."""

    persistence: float = eqx.field(static=True, default=0.5)
    """Chance that a signal repeats the one before; ½: independent, as in the dissertation. More
    makes running sums larger, for training."""

    def __check_init__(self):
        require.at_least("depth", self.depth, 1)
        if not 0 <= self.min_gap <= self.max_gap:
            raise ValueError(
                f"gaps of {self.min_gap}..{self.max_gap} zeros: needs 0 <= min_gap <= max_gap"
            )
        require.within("persistence", self.persistence, 0, 1)
        require.literals(self)

    @property
    def max_steps(self) -> int:
        return self.depth + (self.depth - 1) * self.max_gap

    def longer(self, times: int) -> Self:
        """More signals, with gaps as they are."""
        return dataclasses.replace(self, depth=times * self.depth)

    def sample(self, *, key: PRNGKeyArray) -> Sequence:
        signal_key, gap_key = jax.random.split(key)
        if self.persistence == 0.5:
            signals = jax.random.rademacher(signal_key, (self.depth,), jnp.float32)
        else:
            repeats = jax.random.bernoulli(signal_key, self.persistence, (self.depth,))
            first = jax.random.rademacher(jax.random.fold_in(signal_key, 1), (), jnp.float32)
            flips = jnp.where(repeats, 1.0, -1.0).at[0].set(first)
            signals = jnp.cumprod(flips)
        gaps = jax.random.randint(gap_key, (self.depth,), self.min_gap, self.max_gap + 1)
        return self.lay_out(signals, gaps)

    def lay_out(
        self, signals: Float[Array, " depth"], gaps: Int[Array, " depth"], total: float | Array = 0
    ) -> Sequence:
        """The sequence with these signals, each but the first after its gap: `gaps[0]` is not
        used. `total` is the running sum before the first signal, for a stream cut in pieces."""
        position = jnp.arange(self.depth) + jnp.cumsum(gaps.at[0].set(0))
        scored = jnp.zeros(self.max_steps, bool).at[position].set(True)
        inputs = jnp.zeros(self.max_steps).at[position].set(signals)
        running = jnp.cumsum(inputs) + total
        targets = running + 0.5 if self.ties == "positive" else running
        return Sequence(inputs[:, None], targets, scored, position[-1] + 1)

    def reward(self, answer, target, scored, perfect):
        product = jnp.clip(answer * target, -1.0, 1.0)
        return product + (scored & (product >= 1.0)).astype(jnp.float32)
