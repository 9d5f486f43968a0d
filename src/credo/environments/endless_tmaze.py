"""Endless T-maze: corridor after corridor, each with a sign of its own that says how to turn.

Source: the Endless T-maze of Shchendrigin et al. (2026), "Memory retention is not enough to master
memory tasks in reinforcement learning" (arXiv:2601.15086): what was remembered has to give way to
what is seen now. With one corridor it is the passive T-maze.

Departures:

- Actions are two numbers, walk and turn, where the paper has moves.
- An episode has `corridors` corridors and a clock.
- Every step costs 0.01, also one that stands still, so that nobody earns by waiting.
"""

import dataclasses
from typing import ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .. import require
from ..types import TimeStep
from .base import AbstractEnvironment

STEP_COST, MISTAKE_COST = 0.01, 1.0


class EndlessTMazeState(eqx.Module):
    sides: Float[Array, " corridors"]  # the right turn at the end of each, 1 or -1
    lengths: Int[Array, " corridors"]
    corridor: Int[Array, ""]  # corridors left behind
    place: Int[Array, ""]  # steps walked in this one
    stood: Bool[Array, ""]  # the last step was spent in place
    step: Int[Array, ""]


class EndlessTMaze(AbstractEnvironment):
    """Walk along a corridor, turn to the side that was shown where it began, and so on.

    Observations are [sign, junction]: the sign is 1 or -1 at the first step in a corridor and 0
    later, junction is 1 where the corridor ends. Of an action the first number walks on if it is
    above 0, the second turns at the junction, to the side of its sign; 0 is none of them. A right
    turn leads into the next corridor. The episode ends with the first wrong turn, with the last
    right one (both terminated), or by the clock after `corridors` · (`max_length` + 1) steps
    (truncated). Lengths are drawn anew for each corridor, all equally likely.

    Signals: `reward`, 1 for a right turn, minus 1 for a wrong one and minus 0.01 for every step;
    `turns`, 1 / `corridors` for a right turn; `success`, 1 for the last right turn. Without memory,
    success is at most ½ to the power of `corridors`. What was remembered of one corridor is wrong
    in half of the next ones.
    """

    signals: ClassVar[tuple[str, ...]] = ("reward", "turns", "success")
    obs_range: ClassVar[tuple[float, float]] = (-1.0, 1.0)
    obs_size: ClassVar[int] = 2
    action_size: ClassVar[int] = 2

    corridors: int = eqx.field(static=True, default=5)  # in an episode, at least 1
    min_length: int = eqx.field(static=True, default=5)  # steps from sign to junction, at least 1
    max_length: int = eqx.field(static=True, default=10)
    """Steps from sign to junction, at most, `min_length` or more."""

    def __check_init__(self):
        require.at_least("corridors", self.corridors, 1)
        if not 1 <= self.min_length <= self.max_length:
            raise ValueError(
                f"corridors of {self.min_length}..{self.max_length} steps: "
                "needs 1 <= min_length <= max_length"
            )

    @property
    def max_steps(self) -> int:
        return self.corridors * (self.max_length + 1)

    def longer(self, times: int) -> Self:
        low, high = times * self.min_length, times * self.max_length
        return dataclasses.replace(self, min_length=low, max_length=high)

    def reset(self, *, key: PRNGKeyArray) -> tuple[EndlessTMazeState, TimeStep]:
        side_key, length_key = jax.random.split(key)
        sides = jax.random.rademacher(side_key, (self.corridors,), jnp.float32)
        lengths = jax.random.randint(
            length_key, (self.corridors,), self.min_length, self.max_length + 1
        )
        zero, no = jnp.int32(0), jnp.bool_(False)
        state = EndlessTMazeState(sides, lengths, zero, zero, no, zero)
        nothing = {name: jnp.float32(0.0) for name in self.signals}
        return state, self._seen(state, nothing, no)

    def step(
        self, state: EndlessTMazeState, action: Float[Array, " two"], *, key: PRNGKeyArray
    ) -> tuple[EndlessTMazeState, TimeStep]:
        now = jnp.minimum(state.corridor, self.corridors - 1)
        at_junction, walks = state.place >= state.lengths[now], action[0] > 0.0
        turned = at_junction & (action[1] != 0.0)
        right = turned & ((action[1] > 0.0) == (state.sides[now] > 0.0))
        wrong = turned & ~right
        walked = walks & ~at_junction
        place = jnp.where(right, 0, state.place + walked.astype(jnp.int32))
        corridor = state.corridor + right.astype(jnp.int32)
        through = corridor >= self.corridors
        state = EndlessTMazeState(
            state.sides, state.lengths, corridor, place, ~walked & ~right, state.step + 1
        )
        earned = right.astype(jnp.float32)
        rewards = {
            "reward": earned - MISTAKE_COST * wrong.astype(jnp.float32) - STEP_COST,
            "turns": earned / self.corridors,
            "success": (right & through).astype(jnp.float32),
        }
        return state, self._seen(state, rewards, wrong | through)

    def _seen(
        self, state: EndlessTMazeState, rewards: dict[str, Array], ended: Bool[Array, ""]
    ) -> TimeStep:
        now = jnp.minimum(state.corridor, self.corridors - 1)
        first = (state.place == 0) & ~state.stood
        sign = jnp.where(first, state.sides[now], 0.0)
        junction = (state.place >= state.lengths[now]).astype(jnp.float32)
        over = state.step >= self.max_steps
        return TimeStep(jnp.stack([sign, junction]), rewards, ended, over & ~ended)
