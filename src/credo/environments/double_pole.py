"""Double pole balancing: two poles of different length on one cart, with or without velocities.

Source: Wieland (1991), "Evolving neural network controllers for unstable systems", for the physics;
Gruau, Whitley & Pyeatt (1996) for fitness and test; Stanley & Miikkulainen (2002), section 4.2, for
all constants. Forces are applied for 0.02 s, two steps of a fourth-order Runge-Kutta integration.

Departure: actions are in [-1, 1] and not in [0, 1], and 1 is the same 10 N to the right.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .. import require
from ..types import TimeStep
from .base import AbstractEnvironment

GRAVITY, FORCE, CART = 9.8, 10.0, 1.0  # m/s², N, kg
HALVES, MASSES = (0.5, 0.05), (0.1, 0.01)  # of both poles half the length in m, and kg
FRICTION = 2e-6  # of the poles' hinges, N·m·s; the cart has none
TAU, SUBSTEPS = 0.01, 2  # s of one integration step, and how many there are for an action
TRACK, FALLEN = 2.4, 0.628329  # m from the middle, and rad from upright: 36°
SCALES = (4.8, 2.0, 0.52, 2.0, 0.52, 2.0)  # what an observation is divided by
RANGES = (2.16, 1.35, 0.06283152, 0.15009752, 0.0, 0.0)  # of starts, ±
WINDOW = 100  # steps over which the fitness wants the cart and the long pole still

World = Float[Array, "6"]  # position, long pole's and short pole's angle, each with its velocity


class DoublePoleState(eqx.Module):
    world: World
    wobble: Float[Array, " window"]  # |x| + |ẋ| + |θ| + |θ̇| of the cart and the long pole, in turn
    step: Int[Array, ""]


class DoublePole(AbstractEnvironment):
    """Keep two poles, 1 m and 0.1 m long, upright on one cart, and the cart on its track.

    Observations are the cart's position in units of 4.8 m and both poles' angles in units of
    0.52 rad; with `velocities` each is followed by its velocity, in units of 2 m/s or 2 rad/s. The
    action is a force on the cart, up to 10 N in either direction. The episode is terminated where
    a pole leans by more than 36° or the cart is more than 2.4 m from the middle, and truncated
    after `max_steps`.

    Signals: `fitness`, at the last step, that of Gruau et al.: 0.1 t / 1000 + 0.9 f after t steps,
    where f is 0 before 100 steps and then 0.75 / Σ(|x| + |ẋ| + |θ| + |θ̇|) over the last 100, so
    that swinging to and fro, which needs no memory, is worth little; and `balanced`, 1 at each step
    after which all stands. Best `balanced` return: `max_steps`.
    """

    signals: ClassVar[tuple[str, ...]] = ("fitness", "balanced")
    action_size: ClassVar[int] = 1

    velocities: bool = eqx.field(static=True, default=False)
    """Whether velocities are observed. Without them they have to be made of what was seen
    before."""
    max_steps: int = eqx.field(static=True, default=1000)  # of 0.02 s, at least 1
    x: float = 0.0  # position of the cart at the start, m from the middle, at most 2.4
    v: float = 0.0  # its velocity, m/s
    angle: float = 0.07  # lean of the long pole, rad, at most 0.628; the paper's 4°
    spin: float = 0.0  # its velocity, rad/s; the short pole starts upright, at rest
    spread: float = 0.0
    """How far a start is drawn from these, uniformly: 0, not at all; 1, by up to 2.16 m, 1.35 m/s,
    3.6° and 8.6°/s, the ranges of the papers' test of generalisation; at least 0."""

    def __check_init__(self):
        require.at_least("max_steps", self.max_steps, 1)
        require.at_least("spread", self.spread, 0)
        require.within("x", self.x, -TRACK, TRACK)
        require.within("angle", self.angle, -FALLEN, FALLEN)

    @property
    def obs_size(self) -> int:
        return 6 if self.velocities else 3

    def reset(self, *, key: PRNGKeyArray) -> tuple[DoublePoleState, TimeStep]:
        start = (self.x, self.v, self.angle, self.spin, 0.0, 0.0)
        away = jax.random.uniform(key, (6,), minval=-1.0, maxval=1.0) * jnp.array(RANGES)
        world = jnp.stack([jnp.asarray(x, jnp.float32) for x in start]) + self.spread * away
        return self._at(DoublePoleState(world, jnp.zeros(WINDOW), jnp.int32(0)))

    def step(
        self, state: DoublePoleState, action: Float[Array, " one"], *, key: PRNGKeyArray
    ) -> tuple[DoublePoleState, TimeStep]:
        world, force = state.world, FORCE * action[0]
        for _ in range(SUBSTEPS):
            world = _integrated(world, force)
        wobble = state.wobble.at[state.step % WINDOW].set(jnp.sum(jnp.abs(world[:4])))
        return self._at(DoublePoleState(world, wobble, state.step + 1))

    def _at(self, state: DoublePoleState) -> tuple[DoublePoleState, TimeStep]:
        world, step = state.world, state.step
        down = jnp.abs(world[0]) > TRACK
        down = down | (jnp.abs(world[2]) > FALLEN) | (jnp.abs(world[4]) > FALLEN)
        over = step >= self.max_steps
        calm = jnp.where(step >= WINDOW, 0.75 / jnp.maximum(jnp.sum(state.wobble), 1e-6), 0.0)
        fitness = 0.1 * step.astype(jnp.float32) / 1000.0 + 0.9 * calm
        balanced = (step > 0) & ~down
        rewards = {
            "fitness": jnp.where((step > 0) & (down | over), fitness, 0.0),
            "balanced": balanced.astype(jnp.float32),
        }
        seen = world / jnp.array(SCALES)
        obs = seen if self.velocities else seen[::2]
        return state, TimeStep(obs, rewards, down & (step > 0), over & ~down)


def _change(world: World, force: Float[Array, ""]) -> World:
    """The derivative of a world with respect to time."""
    push, mass, falls = force, jnp.float32(CART), []
    for half, kg, angle, spin in zip(HALVES, MASSES, world[2::2], world[3::2], strict=True):
        sin, cos = jnp.sin(angle), jnp.cos(angle)
        fall = FRICTION * spin / (kg * half) - GRAVITY * sin
        push += kg * half * spin**2 * sin + 0.75 * kg * cos * fall
        mass += kg * (1.0 - 0.75 * cos**2)
        falls.append((half, cos, fall))
    faster = push / mass
    spins = (-0.75 * (faster * cos + fall) / half for half, cos, fall in falls)
    first, second = spins
    return jnp.stack([world[1], faster, world[3], first, world[5], second])


def _integrated(world: World, force: Float[Array, ""]) -> World:
    """One step of the fourth-order Runge-Kutta method."""
    a = _change(world, force)
    b = _change(world + 0.5 * TAU * a, force)
    c = _change(world + 0.5 * TAU * b, force)
    d = _change(world + TAU * c, force)
    return world + TAU / 6.0 * (a + 2.0 * b + 2.0 * c + d)
