"""Tasks of gymnax: the same numbers as Gymnasium's of the same name, ends told apart, no mistakes
that our own check finds."""

import importlib.util

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

if importlib.util.find_spec("gymnax") is None:  # one that cannot be imported is no reason to skip
    pytest.skip("it wants a Gymnasium below ours, 1.4", allow_module_level=True)

from credo import rollout, tree
from credo.environments import checks
from credo.environments.gymnax import Gymnax
from credo.networks.mlp import MLP

KEY = jax.random.key(0)


def walk(env, state, actions):
    """Observations, rewards and ends from a state on."""
    step = jax.jit(env.step)
    for action in actions:
        state, now = step(state, jnp.asarray(action), key=KEY)
        yield np.asarray(now.obs), float(now.rewards["reward"]), bool(now.terminated)


def test_cart_pole_is_that_of_gymnasium():
    ours, theirs = Gymnax("CartPole-v1"), gymnasium.make("CartPole-v1").unwrapped
    assert (ours.obs_size, ours.action_size, ours.discrete, ours.max_steps) == (4, 2, True, 500)
    theirs.reset(seed=0)
    start = np.array([0.01, -0.02, 0.03, 0.01])
    theirs.state = tuple(start)
    state, _ = ours.reset(key=KEY)
    x, v, θ, ω = jnp.asarray(start, jnp.float32)
    state = state.replace(x=x, x_dot=v, theta=θ, theta_dot=ω)
    pushes = np.random.default_rng(0).integers(0, 2, 50)
    actions = np.where(np.arange(2)[None] == pushes[:, None], 1.0, -1.0).astype(np.float32)
    ended = False
    for push, (obs, reward, terminated) in zip(pushes, walk(ours, state, actions), strict=True):
        expected, paid, over, _, _ = theirs.step(int(push))
        np.testing.assert_allclose(obs, expected, atol=1e-4)
        assert terminated == over
        ended = ended or over
        if ended:
            break  # behind the end Gymnasium pays no more
        assert reward == paid
    assert ended


def test_a_pendulum_is_that_of_gymnasium():
    ours, theirs = Gymnax("Pendulum-v1"), gymnasium.make("Pendulum-v1").unwrapped
    assert (ours.obs_size, ours.action_size, ours.discrete, ours.max_steps) == (3, 1, False, 200)
    theirs.reset(seed=0)
    theirs.state = np.array([1.0, 0.5])
    state, _ = ours.reset(key=KEY)
    state = state.replace(theta=jnp.float32(1.0), theta_dot=jnp.float32(0.5))
    actions = np.random.default_rng(0).uniform(-1, 1, (50, 1)).astype(np.float32)
    for action, (obs, reward, _) in zip(actions, walk(ours, state, actions), strict=True):
        expected, paid, *_ = theirs.step(2.0 * action)  # its torque is in [-2, 2]
        np.testing.assert_allclose(obs, expected, atol=1e-3)
        assert reward == pytest.approx(paid, abs=1e-3)


@pytest.mark.parametrize(
    "id", ["CartPole-v1", "Pendulum-v1", "Breakout-MinAtar", "Catch-bsuite", "FrozenLake-misc"]
)
def test_our_check_finds_nothing(id):
    assert checks.check_environment(Gymnax(id)) == []


def test_the_clock_truncates_and_no_episode_starts_by_itself():
    env = Gymnax("Pendulum-v1", {"max_steps_in_episode": 5})
    assert env.max_steps == 5
    policy = MLP((2,)).init(3, 1, key=KEY)
    played = rollout.record(env, policy, key=KEY)
    assert int(played.length) == 5
    returns = rollout.evaluate(env, tree.single(policy), 4, key=KEY)
    assert np.asarray(returns.steps).tolist() == [[5, 5, 5, 5]]


def test_a_discrete_observation_is_one_hot():
    env = Gymnax("FrozenLake-misc")
    _, first = env.reset(key=KEY)
    assert first.obs.shape == (env.obs_size,)
    assert sorted(np.unique(first.obs).tolist()) == [0.0, 1.0]
    assert float(first.obs.sum()) == 1.0


def test_what_gymnax_does_not_have_is_refused():
    with pytest.raises(ValueError, match="id is 'CartPol-v1'"):
        Gymnax("CartPol-v1")
    with pytest.raises(ValueError, match="setting is 'gravty'"):
        Gymnax("CartPole-v1", {"gravty": 1.0})
