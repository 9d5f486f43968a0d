"""Passive T-maze: a sign at the start says which way to turn at the end of a corridor.

Source: Ni et al. (2023), "When do transformers shine in RL? Decoupling memory from credit
assignment", section 4.1, after Bakker (2001). What separates sign and junction is the length of
the corridor: memory across `length` steps is all that a policy needs, for the way there is
rewarded step by step.

Departures:

- Actions are two numbers, walk and turn, where the paper has four directions.
- There is no way back: a policy that does not walk stays where it is.
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


class PassiveTMazeState(eqx.Module):
    side: Float[Array, ""]  # where the goal is, 1 or -1
    place: Int[Array, ""]  # steps walked
    step: Int[Array, ""]
    right: Bool[Array, ""]  # the goal has been reached


class PassiveTMaze(AbstractEnvironment):
    """Walk along a corridor of `length` steps, then turn to the side that was shown at the start.

    Observations are [sign, junction]: the sign is 1 or -1 at the first step and 0 later, junction
    is 1 where the corridor ends. Of an action the first number walks on if it is above 0, the
    second turns at the junction, to the side of its sign; 0 is none of them. The turn ends the
    episode (terminated), and so does the clock after `length` + 1 steps (truncated): whoever once
    stood still does not arrive.

    Signals: `reward`, minus 1 / `length` at each step that does not walk on, and 1 for the right
    turn; `success`, 1 for the right turn. Best 1 and 1. Without memory no policy has more than ½ of
    either on average: at the junction both sides look alike.
    """

    signals: ClassVar[tuple[str, ...]] = ("reward", "success")
    obs_range: ClassVar[tuple[float, float]] = (-1.0, 1.0)

    obs_size: ClassVar[int] = 2
    action_size: ClassVar[int] = 2

    length: int = eqx.field(static=True, default=100)  # steps from the sign to the junction, ≥ 1

    def __check_init__(self):
        require.at_least("length", self.length, 1)

    @property
    def max_steps(self) -> int:
        return self.length + 1

    def longer(self, times: int) -> Self:
        return dataclasses.replace(self, length=times * self.length)

    def reset(self, *, key: PRNGKeyArray) -> tuple[PassiveTMazeState, TimeStep]:
        side = jax.random.rademacher(key, (), jnp.float32)
        state = PassiveTMazeState(side, jnp.int32(0), jnp.int32(0), jnp.bool_(False))
        return state, self._seen(state, jnp.float32(0.0), jnp.bool_(False))

    def step(
        self, state: PassiveTMazeState, action: Float[Array, " two"], *, key: PRNGKeyArray
    ) -> tuple[PassiveTMazeState, TimeStep]:
        at_junction, walks = state.place >= self.length, action[0] > 0.0
        turned = at_junction & (action[1] != 0.0)
        right = turned & ((action[1] > 0.0) == (state.side > 0.0))
        place = state.place + (walks & ~at_junction).astype(jnp.int32)
        stood = ~at_junction & ~walks
        paid = right.astype(jnp.float32) - stood.astype(jnp.float32) / self.length
        state = PassiveTMazeState(state.side, place, state.step + 1, right)
        return state, self._seen(state, paid, turned)

    def _seen(
        self, state: PassiveTMazeState, paid: Float[Array, ""], turned: Bool[Array, ""]
    ) -> TimeStep:
        sign = jnp.where(state.step == 0, state.side, 0.0)
        junction = (state.place >= self.length).astype(jnp.float32)
        rewards = {"reward": paid, "success": state.right.astype(jnp.float32)}
        over = state.step >= self.max_steps
        return TimeStep(jnp.stack([sign, junction]), rewards, turned, over & ~turned)
