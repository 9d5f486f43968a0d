"""Sequence Recall, also called deep T-maze: hear `depth` directions, then take them in order.

Source: Khadka (2019), section 3.3 and Figure 3.8.
Inputs are [signal, distance to the next junction]. The first `depth` steps show the directions ±1
while the distance holds the first corridor's length; then each corridor of length L counts the
distance down from L-1 to 0 with a signal of 0. The answer at distance 0 is the turn; all turns
right, in order, is success.

Departures from the dissertation:

- Distances are divided by `max_corridor`, so that they lie in [0, 1] (`unit=1` gives the
  author's raw integers).
- One encoding for evolution and gradient; the author's gradient version used another.
"""

import dataclasses
from typing import ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .. import require
from ..types import Sequence
from .base import AbstractSequenceTask


class SequenceRecall(AbstractSequenceTask):
    """Directions first, then corridors; the turns count.

    The reward is the author's: at a junction [½·t·y + ½·(every turn so far was right)] / depth,
    with t the direction ±1 and y the answer in [-1, 1]. So returns lie in -½..1.
    """

    obs_size: ClassVar[int] = 2
    inputs: ClassVar[tuple[str, ...]] = ("direction", "distance to the junction")

    depth: int = eqx.field(static=True, default=6)  # directions and junctions, at least 1
    min_corridor: int = eqx.field(static=True, default=10)  # steps per corridor, at least 1
    max_corridor: int = eqx.field(static=True, default=20)
    """Steps per corridor, at most, `min_corridor` or more."""
    unit: int | None = eqx.field(static=True, default=None)
    """Steps per unit of distance; None: `max_corridor`, so that distances lie in [0, 1]."""

    def __check_init__(self):
        require.at_least("depth", self.depth, 1)
        if not 1 <= self.min_corridor <= self.max_corridor:
            raise ValueError(
                f"corridors of {self.min_corridor}..{self.max_corridor} steps: "
                "needs 1 <= min_corridor <= max_corridor"
            )

        if self.unit is not None:
            require.at_least("unit", self.unit, 1)

    @property
    def obs_range(self) -> tuple[float, float]:
        return -1.0, self.max_corridor / (self.unit or self.max_corridor)

    @property
    def max_steps(self) -> int:
        return self.depth + self.depth * self.max_corridor

    def longer(self, times: int) -> Self:
        """Longer corridors. Distances keep their unit, or a longer corridor would look like a
        shorter one."""
        low, high = times * self.min_corridor, times * self.max_corridor
        unit = self.unit or self.max_corridor
        return dataclasses.replace(self, min_corridor=low, max_corridor=high, unit=unit)

    def sample(self, *, key: PRNGKeyArray) -> Sequence:
        direction_key, corridor_key = jax.random.split(key)
        directions = jax.random.rademacher(direction_key, (self.depth,), jnp.float32)
        corridors = jax.random.randint(
            corridor_key, (self.depth,), self.min_corridor, self.max_corridor + 1
        )
        return self.lay_out(directions, corridors)

    def lay_out(
        self, directions: Float[Array, " depth"], corridors: Int[Array, " depth"]
    ) -> Sequence:
        """The maze with these directions ±1 and corridor lengths, each at most `max_corridor`."""
        step = jnp.arange(self.max_steps)
        junction = self.depth - 1 + jnp.cumsum(corridors)  # the step at distance 0
        corridor = jnp.minimum(jnp.searchsorted(junction, step), self.depth - 1)
        instructing = step < self.depth
        distance = jnp.where(instructing, corridors[0], jnp.maximum(junction[corridor] - step, 0))
        signal = jnp.where(instructing, directions[jnp.minimum(step, self.depth - 1)], 0.0)
        scored = jnp.zeros(self.max_steps, bool).at[junction].set(True)
        distance = distance.astype(jnp.float32) / (self.unit or self.max_corridor)
        # The target holds along the corridor (`lesson` asks at every step of it), but only the
        # junction is scored.
        targets = jnp.where(instructing, 0.0, directions[corridor])
        return Sequence(jnp.stack([signal, distance], axis=1), targets, scored, junction[-1] + 1)

    def lesson(self, sequence: Sequence) -> tuple[Float[Array, " time"], Float[Array, " time"]]:
        """The next turn at every step of a corridor; undecided while directions are shown."""
        played = jnp.arange(self.max_steps) < sequence.length
        return sequence.targets, played.astype(jnp.float32)

    def reward(self, answer, target, scored, perfect):
        earned = 0.5 * target * answer + 0.5 * perfect.astype(jnp.float32)
        return jnp.where(scored, earned, 0.0) / self.depth
