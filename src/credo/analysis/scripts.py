"""Scripted teams, and how they are played: all from the same starts, so that they are compared."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .. import require
from ..compilation import jit
from ..environments.base import AbstractEnvironment
from ..networks.base import AbstractPolicy

Start = tuple[Any, Any]
"""State and first time step of an episode."""


class RandomTeam(AbstractPolicy):
    """Every agent draws a uniform action in [-1, 1] at every step."""

    agents: int = eqx.field(static=True)
    size: int = eqx.field(static=True)  # of an action
    amplitude: float = 1.0  # the largest action, in [0, 1]; an array once it is one of a population

    def __check_init__(self):
        require.within("amplitude", self.amplitude, 0, 1)

    def start(self, *, key: PRNGKeyArray) -> PRNGKeyArray:
        return key

    def __call__(self, obs: Float[Array, "agents obs"], carry: PRNGKeyArray):
        carry, key = jax.random.split(carry)
        drawn = jax.random.uniform(key, (self.agents, self.size), minval=-1.0, maxval=1.0)
        return self.amplitude * drawn, carry


def random_team(env: Any) -> RandomTeam:
    """The baseline of random actions for the agents of `env`."""
    return RandomTeam(env.agents, env.action_size)


def starts(env: AbstractEnvironment, n: int, *, key: PRNGKeyArray) -> Start:
    """The starts of that many episodes; leaves `[n, ...]`."""
    return _starts(env, jax.random.split(key, n))


@jit
def _starts(env: AbstractEnvironment, keys: PRNGKeyArray) -> Start:
    return jax.vmap(lambda key: env.reset(key=key))(keys)


def simulate(
    env: AbstractEnvironment,
    start: Start,
    act: Callable[[Any, Array, PyTree], tuple[Array, PyTree]],
    carry: PyTree,
    key: PRNGKeyArray,
) -> Float[Array, ""]:
    """Return, in the task's reported reward, of one episode of `act(state, obs, carry) -> (action,
    carry)`, to which the whole state is known."""

    def ongoing(loop):
        _, now, *_ = loop
        return ~(now.terminated | now.truncated)

    def advance(loop):
        state, now, carry, step, total = loop
        action, carry = act(state, now.obs, carry)
        state, now = env.step(state, action, key=jax.random.fold_in(key, step))
        return state, now, carry, step + 1, total + now.rewards[env.reported]

    begun = (*start, carry, jnp.int32(0), jnp.float32(0.0))
    return jax.lax.while_loop(ongoing, advance, begun)[-1]
