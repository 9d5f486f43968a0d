"""The double pole is that of the papers: its physics beside a NumPy loop, its fitness by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.environments.double_pole import DoublePole, DoublePoleState


def derivative(world, force):
    """Wieland's equations as one reads them in Stanley & Miikkulainen's appendix, float64."""
    g, x, y = -9.8, world[2:4], world[4:6]
    parts = []
    for (angle, spin), half, mass in ((x, 0.5, 0.1), (y, 0.05, 0.01)):
        hinge = 2e-6 * spin / (mass * half)
        pull = mass * half * spin**2 * np.sin(angle)
        pull += 0.75 * mass * np.cos(angle) * (hinge + g * np.sin(angle))
        inert = mass * (1 - 0.75 * np.cos(angle) ** 2)
        parts.append((angle, half, hinge, pull, inert))
    cart = (force + sum(p[3] for p in parts)) / (1.0 + sum(p[4] for p in parts))
    turns = [-0.75 / half * (cart * np.cos(a) + g * np.sin(a) + h) for a, half, h, _, _ in parts]
    return np.array([world[1], cart, world[3], turns[0], world[5], turns[1]])


def moved(world, force, tau=0.01):
    for _ in range(2):
        a = derivative(world, force)
        b = derivative(world + tau / 2 * a, force)
        c = derivative(world + tau / 2 * b, force)
        d = derivative(world + tau * c, force)
        world = world + tau / 6 * (a + 2 * b + 2 * c + d)
    return world


def played(env, actions):
    """All worlds and time steps under these actions."""
    key = jax.random.key(0)

    def step(state, action):
        state, seen = env.step(state, action[None], key=key)
        return state, (state.world, seen)

    state, first = env.reset(key=key)
    return first, jax.jit(lambda s, a: jax.lax.scan(step, s, a))(state, jnp.asarray(actions))[1]


def test_the_physics_is_that_of_the_equations():
    actions = np.random.default_rng(0).uniform(-1, 1, 25).astype(np.float32)
    env = DoublePole(velocities=True, x=0.3, v=-0.2, angle=0.05, spin=0.1)
    first, (worlds, seen) = played(env, actions)
    world = np.array([0.3, -0.2, 0.05, 0.1, 0.0, 0.0])
    scales = [4.8, 2.0, 0.52, 2.0, 0.52, 2.0]
    np.testing.assert_allclose(first.obs, world / scales, rtol=1e-6)
    for i, action in enumerate(actions):
        world = moved(world, 10.0 * action)
        np.testing.assert_allclose(worlds[i], world, rtol=2e-4, atol=2e-5)
        np.testing.assert_allclose(seen.obs[i], world / scales, rtol=2e-4, atol=2e-5)


def test_a_push_to_the_right_tips_the_poles_to_the_left():
    _, (worlds, _) = played(DoublePole(angle=0.0), np.ones(3, np.float32))
    assert (worlds[:, 0] > 0).all()
    assert (worlds[:, 2] < 0).all()
    assert (worlds[:, 4] < worlds[:, 2]).all()  # the short one sooner


def test_without_velocities_only_places_are_seen():
    both = (DoublePole(velocities=kind, angle=0.2, spin=0.1) for kind in (True, False))
    (all_, *_), (places, *_) = (played(env, np.zeros(1, np.float32)) for env in both)
    assert places.obs.tolist() == all_.obs[::2].tolist()
    assert (DoublePole().obs_size, DoublePole(velocities=True).obs_size) == (3, 6)


def test_an_idle_cart_loses_its_poles():
    _, (worlds, seen) = played(DoublePole(), np.zeros(200, np.float32))
    down = np.asarray(np.abs(worlds[:, 2:5:2]) > 0.628329).any(axis=1)
    fell = int(np.argmax(down))
    assert 0 < fell < 100
    assert seen.terminated[fell]
    assert not seen.terminated[:fell].any()
    assert not seen.truncated.any()
    assert (seen.rewards["balanced"][:fell] == 1).all()
    assert seen.rewards["balanced"][fell] == 0
    assert seen.rewards["fitness"][fell] == pytest.approx(0.1 * (fell + 1) / 1000)
    assert (seen.rewards["fitness"][:fell] == 0).all()


def at(env, **changes):
    """What follows of a world that is made by hand."""
    state, _ = env.reset(key=jax.random.key(0))
    world = jnp.zeros(6)
    for i, value in changes.items():
        world = world.at[["x", "v", "angle", "spin", "short", "turn"].index(i)].set(value)
    state = DoublePoleState(world, state.wobble, jnp.int32(7))
    return env.step(state, jnp.zeros(1), key=jax.random.key(0))[1]


@pytest.mark.parametrize(
    ("changes", "down"),
    [
        ({"x": 2.39}, False),
        ({"x": 2.41}, True),
        ({"x": -2.41}, True),
        ({"angle": 0.6}, False),
        ({"angle": -0.63}, True),
        ({"short": 0.63}, True),
        ({"short": -0.3}, False),
    ],
)
def test_the_limits(changes, down):
    seen = at(DoublePole(), **changes)
    assert bool(seen.terminated) == down
    assert float(seen.rewards["balanced"]) == float(not down)


def test_the_fitness_of_who_stands_to_the_end_counts_the_last_hundred_steps():
    env = DoublePole(max_steps=150, angle=0.0, x=0.5)
    _, (worlds, seen) = played(env, np.zeros(150, np.float32))
    assert seen.truncated[-1]
    assert not seen.terminated.any()
    assert not seen.truncated[:-1].any()
    wobble = np.abs(np.asarray(worlds)[50:, :4]).sum()
    assert wobble == pytest.approx(50.0)  # at rest, half a metre from the middle
    expected = 0.1 * 0.15 + 0.9 * 0.75 / wobble
    assert seen.rewards["fitness"][-1] == pytest.approx(expected, rel=1e-5)
    assert seen.rewards["balanced"].sum() == 150


def test_many_starts_are_one_program():
    """The test of generalisation is a batch of tasks."""
    xs = jnp.linspace(-2.0, 2.0, 5)
    many = eqx.filter_vmap(lambda x: DoublePole(x=x).reset(key=jax.random.key(0))[1].obs[0])(xs)
    np.testing.assert_allclose(many, xs / 4.8, rtol=1e-6)


def test_no_steps_are_refused():
    with pytest.raises(ValueError, match="max_steps is 0"):
        DoublePole(max_steps=0)


def test_starts_are_drawn_around_the_one_that_is_given():
    keys = jax.random.split(jax.random.key(0), 1000)
    env = DoublePole(velocities=True, spread=0.5, x=0.1)
    obs = np.asarray(jax.vmap(lambda key: env.reset(key=key)[1].obs)(keys))
    obs = obs * np.array([4.8, 2, 0.52, 2, 1, 1])
    low, high = obs.min(axis=0), obs.max(axis=0)
    middle, half = np.array([0.1, 0, 0.07, 0]), np.array([1.08, 0.675, 0.0314, 0.075])
    np.testing.assert_allclose(low[:4], middle - half, atol=0.02)
    np.testing.assert_allclose(high[:4], middle + half, atol=0.02)
    assert not obs[:, 4:].any()
