"""Tasks of MuJoCo Playground: the numbers of its own steps, repeated actions, ends told apart."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

if importlib.util.find_spec("mujoco_playground") is None:
    pytest.skip("an extra: pip install credo[playground]", allow_module_level=True)

from credo import rollout
from credo.environments import bodies, checks
from credo.environments.others import making, permissive
from credo.environments.playground import Playground, registry
from credo.networks.mlp import MLP

KEY = jax.random.key(0)
TASKS = [
    ("CartpoleSwingup", {}),
    ("CartpoleBalance", {"action_repeat": 2}),
    pytest.param("CheetahRun", {}, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("id", "settings"), TASKS)
def test_steps_are_those_of_playground(id, settings):
    """50 steps from the same start, with the same actions; the sum of the rewards of an action that
    is repeated."""
    ours, repeat = Playground(id, kwargs=settings), settings.get("action_repeat", 1)
    with making():
        theirs = registry.load(id, config_overrides={"impl": "jax"})
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (50, ours.action_size))
    step = jax.jit(lambda state, action: ours.step(state, action, key=KEY))
    state, first = ours.reset(key=KEY)
    with permissive():
        their_step, expected = jax.jit(theirs.step), jax.jit(theirs.reset)(KEY)
    np.testing.assert_allclose(first.obs, expected.obs, atol=1e-4)
    for action in jnp.asarray(actions, jnp.float32):
        state, now = step(state, action)
        paid = 0.0
        for _ in range(repeat):
            with permissive():
                expected = their_step(expected, action)
            paid += float(expected.reward)
        np.testing.assert_allclose(now.obs, expected.obs, atol=1e-4)
        assert float(now.rewards["reward"]) == pytest.approx(paid, abs=1e-4)
        assert not bool(now.terminated)
        assert not bool(now.truncated)


def test_sizes_and_the_clock():
    env = Playground("CheetahRun")
    assert (env.sizes, env.discrete, env.max_steps) == ((17, 6), False, 1000)
    short = Playground("CartpoleBalance", kwargs={"episode_length": 11, "action_repeat": 2})
    assert short.max_steps == 6
    state, now = short.reset(key=KEY)
    step = jax.jit(lambda state: short.step(state, jnp.zeros(1), key=KEY))
    ends = []
    for _ in range(6):
        assert not bool(now.truncated)
        state, now = step(state)
        ends.append((bool(now.terminated), bool(now.truncated)))
    assert ends == [(False, False)] * 5 + [(False, True)]


def test_our_check_finds_nothing():
    assert checks.check_environment(Playground("CartpoleSwingup", max_episode_steps=50)) == []


def test_a_population_plays_it():
    env = Playground("CartpoleBalance", max_episode_steps=10)
    policies = jax.vmap(lambda key: MLP((4,)).init(5, 1, key=key))(jax.random.split(KEY, 3))
    played = rollout.evaluate(env, policies, 2, key=KEY)
    assert played.returns["reward"].shape == (3, 2)
    assert np.all(played.returns["reward"] > 0.0)


@pytest.mark.parametrize("number", [jnp.nan, jnp.inf])
def test_a_simulation_that_diverges_ends_its_episode_with_numbers(number):
    env = Playground("CartpoleBalance")
    state, _ = env.reset(key=KEY)
    data = state.inner.data
    broken = data.replace(qvel=jnp.full_like(data.qvel, number))
    state = bodies.BodiesState(state.inner.replace(data=broken), state.step)
    _, now = env.step(state, jnp.zeros(1), key=KEY)
    assert bool(now.terminated)
    assert np.isfinite(now.obs).all()
    assert abs(float(now.rewards["reward"])) < 10.0


def test_a_policy_sees_the_state_alone_of_several_observations():
    several = {"privileged_state": jnp.ones(3), "state": jnp.arange(2.0)}
    np.testing.assert_array_equal(bodies._seen(several), [0.0, 1.0])


def test_what_playground_does_not_have_is_refused():
    with pytest.raises(ValueError, match=r"id is 'CheetahRunn'.*CheetahRun"):
        Playground("CheetahRunn")
    with pytest.raises(ValueError, match=r"setting is 'sim_dtt': .*sim_dt"):
        Playground("CheetahRun", kwargs={"sim_dtt": 0.01})
    with pytest.raises(ValueError, match=r"CheetahRun was not made: .*int"):
        Playground("CheetahRun", kwargs={"episode_length": "long"})
    with pytest.raises(ValueError, match=r"setting is 'impl': it must|setting is 'impl' .did"):
        Playground("CartpoleBalance", kwargs={"impl": "warp"})  # a field of its own
    with pytest.raises(ValueError, match=r"action_repeat is 0: it must be at least 1"):
        Playground("CartpoleBalance", kwargs={"action_repeat": 0})
    with pytest.raises(ValueError, match=r"impl is 'cpp'"):
        Playground("CheetahRun", impl="cpp")  # pyright: ignore[reportArgumentType]
    if jax.default_backend() != "gpu":
        with pytest.raises(ValueError, match=r"'warp', and JAX runs on cpu: .*needs a GPU"):
            Playground("CheetahRun", impl="warp")
