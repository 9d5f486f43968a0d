"""Simple spread: numbers by hand, the contract, and mpe2's own steps from the same states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.environments.checks import check_environment
from credo.environments.simple_spread import SimpleSpread, SpreadState

STEPS = {}


def step(env, state, action):
    """One compiled step of each task of this file."""
    if env not in STEPS:
        STEPS[env] = jax.jit(lambda state, action: env.step(state, action, key=jax.random.key(0)))
    return STEPS[env](state, jnp.float32(action))


def at(position, velocity=None, landmarks=None, time=0):
    position = jnp.float32(position)
    still = jnp.zeros_like(position)
    velocity = still if velocity is None else jnp.float32(velocity)
    landmarks = still if landmarks is None else jnp.float32(landmarks)
    return SpreadState(position, velocity, landmarks, jnp.int32(time))


APART = [[-1.0, 0.0], [0.0, 1.0], [1.0, 0.0]]


def test_the_contract():
    env = SimpleSpread()
    assert check_environment(env) == []
    assert env.sizes == (18, 2, 3)
    assert (env.max_steps, env.signals, env.reported) == (25, ("global", "local"), "global")
    assert SimpleSpread(agents=5).sizes == (30, 2, 5)


def test_starts_are_uniform_and_at_rest():
    env = SimpleSpread()
    keys = jax.random.split(jax.random.key(0), 4000)
    state, first = jax.jit(jax.vmap(lambda key: env.reset(key=key)))(keys)
    for places in (np.asarray(state.position), np.asarray(state.landmarks)):
        assert np.abs(places).max() <= 1.0
        np.testing.assert_allclose(places.mean(axis=0), 0.0, atol=0.05)
        np.testing.assert_allclose((places**2).mean(axis=0), 1 / 3, atol=0.03)
    assert (np.asarray(state.velocity) == 0).all()
    assert not np.allclose(state.position, state.landmarks)
    assert (np.asarray(first.rewards["local"]) == 0).all()


def test_a_push_moves_at_the_step_after():
    env = SimpleSpread()
    state, now = step(
        env, at(APART, velocity=[[0, 0], [1, 0], [0, 0]]), [[1, -0.5], [0, 0], [0, 0]]
    )
    np.testing.assert_allclose(state.position, [[-1, 0], [0.1, 1], [1, 0]], atol=1e-6)
    np.testing.assert_allclose(state.velocity, [[0.5, -0.25], [0.75, 0], [0, 0]], atol=1e-6)
    assert int(state.step) == 1
    np.testing.assert_allclose(now.obs[0, :4], [0.5, -0.25, -1, 0], atol=1e-6)


def test_what_an_agent_observes():
    landmarks = [[0.5, 0.5], [-0.5, 0.5], [0.0, -0.5]]
    _, now = step(SimpleSpread(), at(APART, landmarks=landmarks), np.zeros((3, 2)))
    to_landmarks = [0.5, -0.5, -0.5, -0.5, 0.0, -1.5]
    to_others = [-1.0, -1.0, 1.0, -1.0]
    np.testing.assert_allclose(
        now.obs[1], [0, 0, 0, 1, *to_landmarks, *to_others, 0, 0, 0, 0], atol=1e-6
    )


def test_what_agents_earn():
    """Two agents 0.2 apart collide; the landmarks are 0, 0.5 and 2 from the closest agent."""
    position = [[0.0, 0.0], [0.2, 0.0], [1.0, 1.0]]
    landmarks = [[0.0, 0.0], [1.0, 0.5], [0.2, -2.0]]
    state = at(position, landmarks=landmarks)
    for ratio in (0.5, 0.1):
        _, now = step(SimpleSpread(local_ratio=ratio), state, np.zeros((3, 2)))
        shared = -2.5 * (1 - ratio)
        local = [shared - ratio, shared - ratio, shared]
        np.testing.assert_allclose(now.rewards["local"], local, rtol=1e-6)
        assert float(now.rewards["global"]) == pytest.approx(np.mean(local), rel=1e-6)


def test_agents_that_overlap_push_each_other_away():
    """0.1 of overlap is a force of 100 * 0.1 along the line between them, for 0.1 s."""
    position = [[0.0, 0.0], [0.12, 0.16], [1.0, 1.0]]
    state, _ = step(SimpleSpread(), at(position), np.zeros((3, 2)))
    np.testing.assert_allclose(state.velocity, [[-0.6, -0.8], [0.6, 0.8], [0, 0]], atol=1e-5)
    touching = [[0.0, 0.0], [0.3, 0.0], [1.0, 1.0]]  # the force is 100 * 0.001 * log 2 there
    state, _ = step(SimpleSpread(), at(touching), np.zeros((3, 2)))
    assert float(state.velocity[1, 0]) == pytest.approx(0.01 * np.log(2), rel=1e-3)


def test_two_agents_at_one_point_are_finite():
    state, now = step(SimpleSpread(), at([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]]), np.ones((3, 2)))
    np.testing.assert_allclose(state.velocity, 0.5, atol=1e-6)
    assert np.isfinite(np.asarray(now.obs)).all()
    assert float(now.rewards["local"][0] - now.rewards["local"][2]) == -0.5


def test_the_clock_ends_an_episode():
    env = SimpleSpread(max_steps=3)
    ends = [step(env, at(APART, time=time), np.zeros((3, 2)))[1] for time in range(3)]
    assert [bool(now.truncated) for now in ends] == [False, False, True]
    assert not any(now.terminated for now in ends)


def test_agents_are_interchangeable():
    """Renamed agents earn and move alike, wherever they stand."""
    env, random = SimpleSpread(), np.random.default_rng(0)
    position, velocity, landmarks, action = random.uniform(-0.4, 0.4, (4, 3, 2))
    order = np.array([2, 0, 1])
    once, now = step(env, at(position, velocity, landmarks), action)
    again, other = step(env, at(position[order], velocity[order], landmarks[::-1]), action[order])
    np.testing.assert_allclose(again.velocity, once.velocity[order], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(
        other.rewards["local"], now.rewards["local"][order], rtol=1e-5, atol=1e-5
    )


def test_wrong_fields_are_refused():
    with pytest.raises(ValueError, match="agents is 1: it must be at least 2"):
        SimpleSpread(agents=1)
    with pytest.raises(ValueError, match="max_steps is 0: it must be at least 1"):
        SimpleSpread(max_steps=0)
    with pytest.raises(ValueError, match=r"local_ratio is 1.5: it must lie in \[0, 1\]"):
        SimpleSpread(local_ratio=1.5)


def five(action):
    """Our action as mpe2's [none, left, right, down, up]."""
    x, y = action
    return np.float32([0, max(-x, 0), max(x, 0), max(-y, 0), max(y, 0)])


@pytest.mark.parametrize(("agents", "ratio"), [(3, 0.5), (5, 0.2)])
def test_every_step_is_that_of_mpe2(agents, ratio):
    """From mpe2's state before each step; crowded, so that many collide."""
    spread = pytest.importorskip("mpe2.simple_spread_v3")
    theirs = spread.parallel_env(N=agents, local_ratio=ratio, continuous_actions=True)
    ours, random, hits = SimpleSpread(agents, ratio), np.random.default_rng(0), 0
    for seed in range(3):
        theirs.reset(seed=seed)
        world = theirs.unwrapped.world
        for time in range(25):
            for entity in world.entities if time % 5 == 0 else ():
                entity.state.p_pos *= 0.4
            state = at(
                np.array([agent.state.p_pos for agent in world.agents]),
                np.array([agent.state.p_vel for agent in world.agents]),
                np.array([landmark.state.p_pos for landmark in world.landmarks]),
                time,
            )
            action = random.uniform(-1, 1, (agents, 2))
            given = dict(zip(theirs.agents, map(five, action), strict=True))
            obs, rewards, terminated, truncated, _ = theirs.step(given)
            _, now = step(ours, state, action)
            np.testing.assert_allclose(now.obs, [*obs.values()], rtol=1e-4, atol=1e-4)
            np.testing.assert_allclose(now.rewards["local"], [*rewards.values()], rtol=1e-5)
            assert set(truncated.values()) == {bool(now.truncated)}
            assert set(terminated.values()) == {bool(now.terminated)}
            way = state.position[:, None] - state.position[None]
            hits += int((np.linalg.norm(way, axis=2) < 0.3).sum()) > agents
    assert hits > 10


def test_an_episode_is_that_of_mpe2():
    """A whole episode from one start, where agents stay apart and errors do not grow."""
    spread = pytest.importorskip("mpe2.simple_spread_v3")
    theirs, ours = spread.parallel_env(continuous_actions=True), SimpleSpread()
    theirs.reset(seed=0)
    world = theirs.unwrapped.world
    for agent, place in zip(world.agents, APART, strict=True):
        agent.state.p_pos = np.array(place)
    state = at(APART, landmarks=np.array([mark.state.p_pos for mark in world.landmarks]))
    total, reported = 0.0, 0.0
    for time in range(25):
        action = 0.3 * np.array([[np.cos(time + k), np.sin(time + k)] for k in range(3)])
        given = dict(zip(theirs.agents, map(five, action), strict=True))
        obs, rewards, *_ = theirs.step(given)
        state, now = step(ours, state, action)
        total += np.mean([*rewards.values()])
        reported += float(now.rewards["global"])
    np.testing.assert_allclose(now.obs, [*obs.values()], atol=1e-4)
    assert reported == pytest.approx(total, rel=1e-5)
    assert bool(now.truncated)
    assert theirs.agents == []
