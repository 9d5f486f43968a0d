"""Tasks of Brax: the numbers of its own steps, ends told apart, no mistakes that our own check
finds."""

import importlib.util
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

if importlib.util.find_spec("brax") is None:  # one that cannot be imported is no reason to skip
    pytest.skip("an extra: pip install credo[brax]", allow_module_level=True)

from credo import rollout
from credo.environments import checks
from credo.environments.brax import Brax, envs
from credo.environments.others import making, permissive
from credo.networks.mlp import MLP

KEY = jax.random.key(0)
TASKS = [
    ("inverted_pendulum", "generalized"),
    pytest.param("inverted_pendulum", "mjx", marks=pytest.mark.slow),
    ("hopper", "spring"),
    pytest.param("reacher", "positional", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("id", "backend"), TASKS)
def test_steps_are_those_of_brax(id, backend):
    """50 steps from the same start, with the same actions."""
    ours = Brax(id, backend=backend)
    with making():
        theirs = envs.get_environment(id, backend=backend)
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (50, ours.action_size))
    step = jax.jit(lambda state, action: ours.step(state, action, key=KEY))
    state, first = ours.reset(key=KEY)
    with permissive():
        their_step, expected = jax.jit(theirs.step), jax.jit(theirs.reset)(KEY)
    np.testing.assert_allclose(first.obs, expected.obs, atol=1e-4)
    for action in jnp.asarray(actions, jnp.float32):
        state, now = step(state, action)
        with permissive():
            expected = their_step(expected, action)
        np.testing.assert_allclose(now.obs, expected.obs, atol=1e-4)
        assert float(now.rewards["reward"]) == pytest.approx(float(expected.reward), abs=1e-4)
        assert bool(now.terminated) == (float(expected.done) == 1.0)
        assert not bool(now.truncated)


def test_sizes_and_the_clock():
    env = Brax("halfcheetah")
    assert (env.sizes, env.discrete, env.max_steps) == ((17, 6), False, 1000)
    assert Brax("hopper", backend="spring").sizes == (11, 3)


@pytest.mark.parametrize("backend", ["generalized", "spring"])
def test_our_check_finds_nothing(backend):
    env = Brax("inverted_pendulum", backend=backend, max_episode_steps=50)
    assert checks.check_environment(env) == []


def test_a_fall_terminates_and_the_clock_truncates():
    """A pendulum that is pushed to one side falls; one that is let go at the top still stands after
    five steps."""
    pushed, let_go = (jnp.full(1, push) for push in (1.0, 0.0))
    env = Brax("inverted_pendulum", max_episode_steps=5)
    for push, steps in ((pushed, None), (let_go, 5)):
        limited = env if steps else Brax("inverted_pendulum")
        state, now = limited.reset(key=KEY)
        step = jax.jit(lambda state, push=push, env=limited: env.step(state, push, key=KEY))
        taken = 0
        while not (bool(now.terminated) or bool(now.truncated)):
            state, now = step(state)
            taken += 1
        assert taken == steps or (steps is None and taken < 100)
        assert (bool(now.terminated), bool(now.truncated)) == (steps is None, steps is not None)
        assert (abs(float(now.obs[1])) > 0.2) == (steps is None)  # the last state, not a new one


def test_a_population_plays_it():
    env = Brax("inverted_pendulum", max_episode_steps=10)
    policies = jax.vmap(lambda key: MLP((4,)).init(4, 1, key=key))(jax.random.split(KEY, 3))
    played = rollout.evaluate(env, policies, 2, key=KEY)
    assert played.returns["reward"].shape == (3, 2)
    np.testing.assert_array_equal(played.returns["reward"], played.steps)  # 1 for every step


def test_what_brax_does_not_have_is_refused():
    with pytest.raises(ValueError, match="id is 'halfchetah'"):
        Brax("halfchetah")
    with pytest.raises(ValueError, match="backend is 'warp'"):
        Brax("halfcheetah", backend="warp")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"hopper was not made: .*'gravty'"):
        Brax("hopper", kwargs={"gravty": 1.0})


def test_a_task_that_brax_itself_cannot_play_is_refused():
    """The swimmer of Brax 0.14 calls a function of JAX in a way that is gone."""
    with pytest.raises(ValueError, match="swimmer was not made"):
        Brax("swimmer")


def test_nothing_is_warned_of():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert Brax("reacher", backend="spring").action_size == 2
