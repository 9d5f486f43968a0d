"""Teams of JaxMARL: the numbers of its own steps and of our simple spread, masks, deaths, ends."""

import dataclasses
import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

if importlib.util.find_spec("jaxmarl") is None:  # one that cannot be imported is no reason to skip
    pytest.skip("an extra: pip install credo[jaxmarl]", allow_module_level=True)

from credo import rollout
from credo.environments import checks
from credo.environments.jaxmarl import JaxMARL
from credo.environments.others import permissive
from credo.environments.simple_spread import SimpleSpread, SpreadState
from credo.networks.team import Team

KEY = jax.random.key(0)
SPREAD, SMAX = "MPE_simple_spread_v3", "HeuristicEnemySMAX"
CONTINUOUS = {"action_type": "Continuous"}


def played(env, steps, copies):
    """States and time steps `[copies, steps, ...]` of random actions, and the actions; an episode
    that is over starts anew."""

    def advance(carry, key):
        state, now = carry
        keys = jax.random.split(key, 3)
        action = jax.random.uniform(keys[0], (env.agents, env.action_size), minval=-1.0)
        over = now.terminated | now.truncated
        new = jax.lax.cond(
            over, lambda: env.reset(key=keys[1]), lambda: env.step(state, action, key=keys[2])
        )
        return new, (state, over, action, *new)

    def play(key):
        return jax.lax.scan(advance, env.reset(key=key), jax.random.split(key, steps))[1]

    return jax.jit(jax.vmap(play))(jax.random.split(KEY, copies))


def test_sizes_and_signals():
    env = JaxMARL(SPREAD, CONTINUOUS)
    assert (env.sizes, env.discrete, env.masked, env.max_steps) == ((18, 5, 3), False, False, 25)
    assert (env.signals, env.reported) == (("global", "local"), "global")
    env = JaxMARL(SPREAD)
    assert (env.sizes, env.choices, env.discrete, env.masked) == ((18, 5, 3), (5,), True, False)
    env = JaxMARL(SMAX, {"scenario": "3m"})
    assert (env.agents, env.choices, env.discrete, env.masked) == (3, (8,), True, True)
    env = JaxMARL("MPE_simple_speaker_listener_v4")
    assert (env.sizes, env.choices, env.masked) == ((11 + 5, 5, 2), (5,), True)
    _, first = env.reset(key=KEY)
    np.testing.assert_array_equal(first.obs[:, :5], [[1, 1, 1, 0, 0], [1, 1, 1, 1, 1]])
    assert (np.asarray(first.obs)[0, 5 + 3 :] == 0).all()  # the speaker observes three numbers


@pytest.mark.parametrize(("id", "settings"), [(SPREAD, CONTINUOUS), (SMAX, {"scenario": "3m"})])
def test_steps_are_those_of_jaxmarl(id, settings):
    """Up to 50 steps from the same start, with the same actions and keys."""
    ours = JaxMARL(id, settings)
    theirs = ours._made.env
    state, _ = ours.reset(key=KEY)
    step = jax.jit(lambda state, action, key: ours.step(state, action, key=key))
    inner, width = state.inner, ours.obs_size - ours.form.obs_size
    random = np.random.default_rng(0)
    for t in range(50):
        action = jnp.asarray(random.uniform(-1, 1, (ours.agents, ours.action_size)), jnp.float32)
        key = jax.random.fold_in(KEY, t)
        with permissive():
            own = (action + 1.0) / 2.0
            if ours.discrete:
                allowed = theirs.get_avail_actions(inner)
                allowed = jnp.stack([allowed[name] for name in theirs.agents])
                own = jnp.argmax(jnp.where(allowed > 0, action, -2.0), axis=1)
            actions = dict(zip(theirs.agents, own, strict=True))
            obs, inner, paid, dones, _ = theirs.step_env(key, inner, actions)
        state, now = step(state, action, key)
        for k, name in enumerate(theirs.agents):
            np.testing.assert_allclose(now.obs[k, width:], obs[name], atol=1e-4)
            assert float(now.rewards["local"][k]) == pytest.approx(float(paid[name]), abs=1e-4)
        if bool(dones["__all__"]):
            break
    assert t >= 10


def test_simple_spread_is_ours():
    """From the same states; of five numbers those for left, right, down and up push. JaxMARL alone
    lets 26 steps pass where its clock says 25."""
    theirs, ours = JaxMARL(SPREAD, CONTINUOUS), SimpleSpread()
    push = np.random.default_rng(0).uniform(-1, 1, (24, 3, 2)).astype(np.float32)
    state, _ = ours.reset(key=KEY)
    other, _ = theirs.reset(key=KEY)
    places = jnp.concatenate([state.position, state.landmarks])
    other = dataclasses.replace(other, inner=other.inner.replace(p_pos=places))
    steps = [jax.jit(lambda s, a, e=env: e.step(s, a, key=KEY)) for env in (ours, theirs)]
    for here in push:
        left, right = np.maximum(-here, 0), np.maximum(here, 0)
        five = np.stack([0 * left[:, 0], left[:, 0], right[:, 0], left[:, 1], right[:, 1]], axis=1)
        state, now = steps[0](state, jnp.asarray(here))
        other, told = steps[1](other, jnp.asarray(2 * five - 1, jnp.float32))
        np.testing.assert_allclose(told.obs, now.obs, atol=1e-4)
        np.testing.assert_allclose(told.rewards["local"], now.rewards["local"], atol=1e-4)
        np.testing.assert_allclose(told.rewards["global"], now.rewards["global"], atol=1e-4)
    assert isinstance(state, SpreadState)
    assert not bool(told.truncated)
    other, told = steps[1](other, jnp.zeros((3, 5)))
    assert (bool(told.terminated), bool(told.truncated)) == (False, True)
    still = dict.fromkeys(theirs._made.env.agents, jnp.zeros(5))
    for steps, over in ((24, False), (25, True)):  # that were taken before this one
        with permissive():
            before = other.inner.replace(step=jnp.int32(steps))
            *_, dones, _ = theirs._made.env.step_env(KEY, before, still)
        assert bool(dones["__all__"]) == over


@pytest.mark.parametrize("id", [SMAX, "MPE_simple_speaker_listener_v4"])
def test_no_action_is_played_that_is_not_allowed(id):
    """In 10,000 random steps; a mask is that of the state, and leads the observation."""
    env = JaxMARL(id, {"scenario": "3m"} if id == SMAX else {})
    states, over, actions, _, seen = played(env, 200, 50)

    def look(state, action):
        own = env._own(action, state.allowed)
        n = env.choices[0]
        return jnp.stack([own[name] < n for name in env._made.env.agents]), jnp.stack(
            [state.allowed[k, own[name]] for k, name in enumerate(env._made.env.agents)]
        )

    real, may = jax.jit(jax.vmap(jax.vmap(look)))(states, actions)
    assert np.asarray(real).all()
    assert np.asarray(may).all()
    told = jax.jit(jax.vmap(jax.vmap(lambda state: env._allowed(state.inner))))(states)
    np.testing.assert_array_equal(told, states.allowed)
    np.testing.assert_array_equal(seen.obs[:, :-1, :, : env.choices[0]], states.allowed[:, 1:])
    assert np.asarray(over).any()


def test_a_dead_unit_no_longer_acts_and_the_battle_ends():
    env = JaxMARL(SMAX, {"scenario": "3m"})
    states, over, _, _, seen = played(env, 200, 20)
    alive = np.asarray(states.inner.state.unit_alive)[..., :3]
    np.testing.assert_array_equal(np.asarray(states.active), alive)
    gone, active = np.asarray(seen.gone), np.asarray(seen.active)
    before = np.asarray(states.active) & ~np.asarray(over)[..., None]
    np.testing.assert_array_equal(gone, before & ~active)
    assert gone.any()
    assert np.asarray(seen.terminated).any()
    # What dead units are paid is the team's: one number for all.
    local = np.asarray(seen.rewards["local"])
    mean = np.asarray(seen.rewards["global"])[..., None]
    np.testing.assert_allclose(local, np.broadcast_to(mean, local.shape), atol=1e-6)


@pytest.mark.parametrize(
    ("id", "settings"),
    [(SPREAD, {}), (SPREAD, CONTINUOUS), (SMAX, {"scenario": "3m"}), ("switch_riddle", {})],
)
def test_our_check_finds_nothing(id, settings):
    assert checks.check_environment(JaxMARL(id, settings)) == []


def test_a_population_plays_it():
    env = JaxMARL(SPREAD, CONTINUOUS, max_episode_steps=7)
    team = Team(trunk=(4,))
    policies = jax.vmap(lambda key: team.init(*env.sizes, key=key))(jax.random.split(KEY, 3))
    scores = rollout.evaluate(env, policies, 2, key=KEY)
    assert scores.returns["global"].shape == (3, 2)
    assert np.asarray(scores.steps).tolist() == [[7, 7]] * 3


def test_what_jaxmarl_does_not_have_is_refused():
    with pytest.raises(
        ValueError, match=r"id is 'MPE_simple_spred_v3' .did you mean 'MPE_simple_spread_v3'"
    ):
        JaxMARL("MPE_simple_spred_v3")
    with pytest.raises(ValueError, match="was not made: TypeError"):
        JaxMARL(SMAX, {"gravty": 1.0})
    with pytest.raises(ValueError, match=r"scenario is '3n'.*3m"):
        JaxMARL(SMAX, {"scenario": "3n"})
    with pytest.raises(ValueError, match="storm does not tell observations by agent"):
        JaxMARL("storm")  # its observations are not by agent
