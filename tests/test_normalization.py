"""Observations by what was seen: the moments are NumPy's, belong to everybody, and are frozen in
the champion."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import rollout, tree
from credo.algorithms.ccea import CCEA
from credo.algorithms.erl import ERL
from credo.algorithms.merl import MERL
from credo.algorithms.neuroevolution import Neuroevolution
from credo.algorithms.off_policy import OffPolicy
from credo.algorithms.ppo import PPO
from credo.environments.probes import Copy, Meet
from credo.learners.td3 import TD3
from credo.networks.dmmu import DMMU
from credo.networks.mlp import MLP, Critic
from credo.networks.normalized import LIMIT, Normalized, scaled
from credo.networks.team import Team
from credo.normalization import TRUSTED, Moments, behind, seen
from credo.rollout import Experience
from credo.types import Transition

KEY = jax.random.key(0)
NETWORK, CRITIC = MLP(hidden=(2,)), Critic(hidden=(2,))
TINY = {"critic": CRITIC, "batch_size": 2}
EVOLUTION = {"population_size": 4, "elite_fraction": 0.25, "episodes": 1, "test_episodes": 1}
LEARN = {"replay_capacity": 64, "updates_per_frame": 0.1, "test_episodes": 1}
HYBRID = EVOLUTION | LEARN | {"warmup_frames": 5, "workers": 1}
ON = {"normalize_observations": True}


class Raw(Copy):
    """`Copy` in units of a sensor: observations about 5000 ± 577."""

    obs_range = (4000.0, 6000.0)

    def reset(self, *, key):
        state, first = super().reset(key=key)
        return state, self._raw(first)

    def step(self, state, action, *, key):
        state, step = super().step(state, action, key=key)
        return state, self._raw(step)

    def _raw(self, step):
        return dataclasses.replace(step, obs=5000.0 + 1000.0 * step.obs)


MAKE = {
    "neuroevolution": lambda **on: Neuroevolution.as_written(Raw(), NETWORK, **EVOLUTION, **on),
    "ccea": lambda **on: CCEA.ccea(Meet(), NETWORK, teams=1, **EVOLUTION, **on),
    "ea": lambda **on: ERL.ea(Raw(), NETWORK, **HYBRID, **on),
    "erl": lambda **on: ERL.erl(Raw(), NETWORK, learners=(TD3(**TINY),), **HYBRID, **on),
    "merl": lambda **on: MERL.merl(
        Meet(), Team(trunk=(2,)), learners=(TD3(signal="local", **TINY),), **HYBRID, **on
    ),
    "td3": lambda **on: OffPolicy.td3(
        Raw(), NETWORK, learner=TD3(**TINY), start_frames=5, **LEARN, **on
    ),
    "ppo": lambda **on: PPO.ppo(
        Raw(), NETWORK, critic=CRITIC, horizon=8, copies=2, batch_size=4, epochs=1, **on
    ),
}


def same(a, b) -> bool:
    arrays = [jax.tree.leaves(eqx.filter(x, eqx.is_array)) for x in (a, b)]
    return all(np.array_equal(x, y) for x, y in zip(*arrays, strict=True))


def experience(obs, valid, active=None) -> Experience:
    rest = jnp.zeros(len(obs))
    return Experience(Transition(obs, rest, {}, obs, rest, rest, active), valid)


@pytest.mark.parametrize("host", [False, True])
def test_moments_are_those_of_all_that_was_seen(host):
    """Five rollouts of different length, with an offset that costs float32 its digits."""
    rng = np.random.default_rng(0)
    moments, every = Moments.first(Copy(size=3)), []
    for n in (3, 1500, 1, 40, 2000):
        obs = (rng.normal(size=(n, 3)) * [1, 0.1, 50] + [1e3, 5, 0]).astype(np.float32)
        valid = rng.random(n) < 0.7
        every.append(obs[valid])
        obs[~valid] = np.nan  # lost, or padding
        met = experience(obs[valid], None) if host else experience(jnp.array(obs), valid)
        moments = moments.after(met)
    every = np.concatenate(every).astype(np.float64)
    assert int(moments.count) == len(every)
    np.testing.assert_allclose(moments.mean, every.mean(axis=0), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(moments.variance, every.var(axis=0), rtol=1e-4)
    np.testing.assert_allclose(moments.std, every.std(axis=0), rtol=1e-3)


def test_they_hold_still_after_a_billion_frames():
    """Sums of float32 would not: 1e9 + 1 = 1e9."""
    moments = Moments(jnp.int32(10**9), jnp.full(1, 3.0), jnp.full(1, 4.0))
    obs = np.full((10**6, 1), 13.0, np.float32)
    after = moments.after(experience(jnp.array(obs), np.ones(len(obs), bool)))
    assert int(after.count) == 10**9 + 10**6
    np.testing.assert_allclose(after.mean, 3 + 10 / 1001, rtol=1e-6)
    np.testing.assert_allclose(after.variance, 4 * 1000 / 1001 + 100 * 1000 / 1001**2, rtol=1e-6)


@pytest.mark.parametrize("host", [False, True])
def test_an_agent_that_does_not_act_is_not_counted(host):
    obs = np.arange(12, dtype=np.float32).reshape(3, 2, 2)
    active = np.array([[True, False], [True, True], [True, False]])
    moments = Moments.first(Meet()).after(
        experience(obs, None if host else np.ones(3, bool), active)
    )
    assert moments.count.tolist() == [3, 1]
    np.testing.assert_allclose(moments.mean, [obs[:, 0].mean(0), obs[1, 1]], rtol=1e-6)
    np.testing.assert_allclose(moments.variance[1], 0.0, atol=1e-12)


def test_what_never_changes_is_0_and_what_is_far_off_is_clipped():
    obs = np.tile(np.float32([1e6, 2.0]), (7, 1))
    moments = Moments.first(Copy(size=2)).after(experience(obs, None))
    np.testing.assert_allclose(scaled(jnp.array(obs[0]), moments.mean, moments.std), 0.0, atol=0.1)
    far = scaled(jnp.array([2e6, 1.0]), moments.mean, moments.std)
    np.testing.assert_array_equal(far, [LIMIT, -LIMIT])


def test_a_batch_stands_in_front_or_behind():
    moments = Moments(jnp.int32(1), jnp.array([1.0, 2.0]), jnp.array([4.0, 9.0]))
    obs = jnp.array([[1.0, 2.0], [3.0, 5.0], [-1.0, 2.0]])
    expected = [[0.0, 0.0], [1.0, 1.0], [-1.0, 0.0]]
    np.testing.assert_allclose(seen(moments, obs), expected, atol=1e-5)
    np.testing.assert_allclose(scaled(obs.T, moments.mean, moments.std).T, expected, atol=1e-5)


@pytest.fixture(scope="module", params=MAKE)
def runs(request):
    """An algorithm, and its states through three generations."""
    algorithm = MAKE[request.param](**ON)
    states, step = [algorithm.init(key=KEY)], eqx.filter_jit(algorithm.generation)
    for g in range(3):
        states.append(step(states[-1], key=jax.random.key(g))[0])
    return algorithm, states, step


def test_the_champion_is_frozen_and_the_state_goes_on(runs):
    algorithm, states, _ = runs
    counts = [int(np.max(state.moments.count)) for state in states]
    assert counts[0] == 0
    assert np.all(np.diff(counts) > 0)
    champion = states[2].champion
    assert isinstance(champion, Normalized)
    used = states[2 if isinstance(algorithm, OffPolicy) else 1].moments
    np.testing.assert_array_equal(champion.mean, used.mean)
    np.testing.assert_array_equal(champion.std, used.std)
    before = jax.tree.map(np.asarray, eqx.filter(champion, eqx.is_array))
    rollout.evaluate(algorithm.env, tree.stack(champion), 2, key=KEY)
    assert same(before, champion)
    assert algorithm.env.agents or abs(float(states[3].moments.mean[0]) - 5000) < 500


def test_a_generation_has_at_most_the_frames_that_it_says(runs):
    """In `Copy` every episode lasts until the clock ends it."""
    algorithm, states, _ = runs
    if not hasattr(algorithm, "replay_capacity"):
        pytest.skip("has no buffer that the budget could fill")
    if algorithm.env.agents is None:
        assert int(states[1].frames) == algorithm.most_frames
    else:
        assert 0 < int(states[1].frames) <= algorithm.most_frames


def test_a_state_read_back_goes_on_to_the_same_bits(runs, tmp_path):
    algorithm, states, step = runs
    eqx.tree_serialise_leaves(tmp_path / "state", states[2])
    again = eqx.tree_deserialise_leaves(tmp_path / "state", algorithm.init(key=jax.random.key(9)))
    assert same(step(again, key=jax.random.key(2))[0], states[3])


def test_a_saved_champion_brings_its_statistics_with_it(runs):
    algorithm, states, step = runs
    if not hasattr(algorithm, "warm"):
        pytest.skip("starts from no policy")
    champion = states[2].champion
    state = algorithm.warm(algorithm.init(key=jax.random.key(5)), champion)
    np.testing.assert_array_equal(state.moments.mean, champion.mean)
    np.testing.assert_allclose(state.moments.std, champion.std, rtol=1e-5)
    assert int(np.max(state.moments.count)) == TRUSTED
    assert same(state.champion.policy, champion.policy)
    assert int(np.max(step(state, key=KEY)[0].moments.count)) > TRUSTED


def test_without_the_field_nothing_is_kept():
    for make in MAKE.values():
        state = jax.eval_shape(lambda make=make: eqx.filter(make().init(key=KEY), eqx.is_array))
        assert state.moments is None


def test_the_population_shares_one():
    population = tree.stack(*(NETWORK.init(1, 1, key=jax.random.key(i)) for i in range(3)))
    moments = Moments(jnp.int32(1), jnp.array([2.0]), jnp.array([9.0]))
    members = behind(moments, population)
    np.testing.assert_array_equal(members.mean, np.full((3, 1), 2.0))
    obs = jnp.array([5.0])
    for i in range(3):
        direct = tree.take(population, i)(scaled(obs, moments.mean, moments.std), ())[0]
        np.testing.assert_allclose(tree.take(members, i)(obs, ())[0], direct)


@pytest.mark.parametrize("on", [False, True])
def test_raw_units_are_learned_with_it_and_not_without(on):
    """The best return is 0; who cannot see acts 0 and has -3.3 on average."""
    evolution = Neuroevolution(
        Raw(),
        MLP(hidden=()),
        population_size=30,
        episodes=3,
        test_episodes=20,
        normalize_observations=on,
    )
    state = evolution.init(key=KEY)
    step = jax.jit(lambda state, key: evolution.generation(state, key=key))
    for g in range(25):
        state, metrics = step(state, jax.random.key(g))
    assert (float(metrics["champion_score"]) > -2.5) == on


def test_a_network_that_reads_its_observations_last_number_is_refused():
    with pytest.raises(ValueError, match="who takes part"):
        Moments.first(Meet(), DMMU(hidden=3))
    assert Moments.first(Meet(), DMMU(hidden=3, access="everyone")).mean.shape == (2, 2)


def test_counts_do_not_overflow():
    moments = Moments(jnp.int32(2**31 - 1000), jnp.full(1, 3.0), jnp.full(1, 4.0))
    after = moments.after(experience(jnp.full((5000, 1), 3.5), np.ones(5000, bool)))
    assert 0 < int(after.count) < 2**31
    np.testing.assert_allclose(after.mean, 3.0, atol=1e-4)
    np.testing.assert_allclose(after.variance, 4.0, rtol=1e-4)
