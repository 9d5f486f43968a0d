"""Simple spread of the multi-agent particle environments: a public task for team learners.

Source: R. Lowe et al., "Multi-agent actor-critic for mixed cooperative-competitive environments",
2017; numbers and order of operations are those of the package mpe2 (1.1), `simple_spread_v3` with
continuous actions, whose steps a test compares with these.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .. import require
from ..types import TimeStep
from .base import AbstractEnvironment

TIME = 0.1  # seconds of one step
DAMPING = 0.25  # share of the velocity that is lost in a step
FORCE = 5.0  # of a full action; every agent has mass 1
REACH = 0.3  # two radii of 0.15: agents closer than this collide
STIFFNESS = 100.0
MARGIN = 1e-3  # over which the contact force sets in


class SpreadState(eqx.Module):
    position: Float[Array, "agents 2"]
    velocity: Float[Array, "agents 2"]
    landmarks: Float[Array, "agents 2"]
    step: Int[Array, ""]


class SimpleSpread(AbstractEnvironment):
    """N agents cover N landmarks in the plane without bumping into each other.

    An action is the force in x and y as a share of the full one. mpe2 takes five numbers in [0, 1],
    `[none, left, right, down, up]`, and pushes by right - left and up - down: our (x, y) is its
    `[0, max(-x, 0), max(x, 0), max(-y, 0), max(y, 0)]`.

    An agent observes `6 N` numbers: its velocity (2), its position (2), the way to every landmark
    (2 N) and to every other agent in order (2 N - 2), and 2 N - 2 zeros, the others' silence.
    Agents and landmarks start anywhere in [-1, 1]², at rest. The clock ends an episode.

    Signals: `local` `[agents]`, mpe2's reward: `local_ratio` times minus the number of agents one
    collides with, and the rest times minus the sum over landmarks of the distance to the closest
    agent. `global`: their mean, which is reported.
    """

    signals: ClassVar[tuple[str, ...]] = ("global", "local")
    reported: ClassVar[str] = "global"
    action_size: ClassVar[int] = 2

    agents: int = eqx.field(static=True, default=3)  # agents and landmarks, at least 2 of each
    local_ratio: float = 0.5  # share of an agent's own collisions in its reward, in [0, 1]
    max_steps: int = eqx.field(static=True, default=25)
    """Length of every episode in steps, at least 1."""

    def __check_init__(self):
        require.at_least("agents", self.agents, 2)
        require.at_least("max_steps", self.max_steps, 1)
        require.within("local_ratio", self.local_ratio, 0.0, 1.0)

    @property
    def obs_size(self) -> int:
        return 6 * self.agents

    def reset(self, *, key: PRNGKeyArray) -> tuple[SpreadState, TimeStep]:
        shape = (2, self.agents, 2)
        agents, landmarks = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
        state = SpreadState(agents, jnp.zeros_like(agents), landmarks, jnp.int32(0))
        return state, self._time_step(state, jnp.zeros(self.agents))

    def step(
        self, state: SpreadState, action: Float[Array, "agents 2"], *, key: PRNGKeyArray
    ) -> tuple[SpreadState, TimeStep]:
        push = self._contact(state.position)
        velocity = (1.0 - DAMPING) * state.velocity + TIME * (FORCE * action + push)
        # A position moves by the velocity of before the push, as in mpe2.
        position = state.position + TIME * state.velocity
        state = SpreadState(position, velocity, state.landmarks, state.step + 1)
        return state, self._time_step(state, self._earned(state))

    def _contact(self, position: Float[Array, "agents 2"]) -> Float[Array, "agents 2"]:
        """What pushes every agent away from the others: a softplus of how far they overlap."""
        way, distance = self._apart(position)
        overlap = MARGIN * jax.nn.softplus((REACH - distance) / MARGIN)
        # Two agents at one point push nowhere; mpe2 would say NaN.
        share = jnp.where(distance > 0.0, STIFFNESS * overlap / jnp.maximum(distance, 1e-12), 0.0)
        return jnp.sum(share[..., None] * way, axis=1)

    def _apart(self, position: Float[Array, "agents 2"]):
        """From each other agent to each, itself included: ways and distances."""
        way = position[:, None] - position[None]
        return way, jnp.sqrt(jnp.sum(way**2, axis=-1))

    def _earned(self, state: SpreadState) -> Float[Array, " agents"]:
        """mpe2's reward of each agent: collisions and uncovered landmarks."""
        _, distance = self._apart(state.position)
        hits = jnp.sum((distance < REACH).astype(jnp.float32), axis=1) - 1.0  # not with itself
        way = state.landmarks[:, None] - state.position[None]
        closest = jnp.min(jnp.sum(way**2, axis=-1), axis=1)
        uncovered = jnp.sum(jnp.sqrt(closest))
        return -self.local_ratio * hits - (1.0 - self.local_ratio) * uncovered

    def _time_step(self, state: SpreadState, local: Float[Array, " agents"]) -> TimeStep:
        rewards = {"global": jnp.mean(local), "local": local}
        everyone: Bool[Array, " agents"] = jnp.ones(self.agents, bool)
        truncated = state.step >= self.max_steps
        return TimeStep(self._observe(state), rewards, jnp.bool_(False), truncated, everyone)

    def _observe(self, state: SpreadState) -> Float[Array, "agents obs"]:
        """Velocity, position, and the ways to landmarks and other agents, one row an agent."""
        n, here = self.agents, state.position
        others = np.array([[k for k in range(n) if k != i] for i in range(n)])
        parts = [
            state.velocity,
            here,
            (state.landmarks[None] - here[:, None]).reshape(n, -1),
            (here[others] - here[:, None]).reshape(n, -1),
            jnp.zeros((n, 2 * n - 2)),
        ]
        return jnp.concatenate(parts, axis=1)
