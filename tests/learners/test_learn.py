"""Many updates in one program, and the parts that learners share."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations

from credo.learners.base import act, adam, adam_state, learn, polyak
from credo.learners.sac import SAC
from credo.learners.td3 import TD3
from credo.networks.base import AbstractPolicy
from credo.networks.mlp import MLP, Critic
from credo.networks.values import Histogram, Quantiles
from credo.replay import Replay, Sampling
from credo.types import NOTHING, Batch, Transition

NETWORK = MLP(hidden=(3,))
LEARNER = TD3(critic=Critic(hidden=(3,)), actor_lr=0.01, critic_lr=0.01, batch_size=4)
ROWS, KEY = 12, jax.random.key(3)


def transitions():
    """Rows of two rewards, `b` the square of `a`."""
    draw = np.random.default_rng(0).uniform(-1, 1, (4, ROWS, 2)).astype(np.float32)
    a = draw[2, :, 0]
    return Transition(
        draw[0], draw[1, :, :1], {"a": a, "b": a**2}, draw[3], draw[2, :, 1] > 0, draw[2, :, 1] > 9
    )


@pytest.fixture(scope="module")
def replay():
    return Replay(jax.tree.map(jnp.asarray, transitions()), jnp.int32(ROWS))


@pytest.fixture(scope="module")
def start():
    return LEARNER.init(NETWORK, 2, 1, key=jax.random.key(0))


def same(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in pairs)


def test_it_is_one_update_after_the_other_each_on_rows_of_its_own(replay, start):
    learned, metrics = learn(LEARNER, start, replay, jnp.int32(3), signal="a", key=KEY)
    state, reports, drawn = start, [], []
    update = eqx.filter_jit(lambda state, batch, key: LEARNER.update(state, batch, key=key))
    for i in range(3):
        sample_key, update_key = jax.random.split(jax.random.fold_in(KEY, i))
        rows = replay.sample(4, key=sample_key)[0]
        drawn.append(np.asarray(rows.obs).tobytes())
        batch = Batch(
            rows.obs, rows.action, rows.rewards["a"], rows.next_obs, rows.terminated, rows.truncated
        )
        state, report = update(state, batch, update_key)
        reports.append(report)
    assert len(set(drawn)) == 3
    for x, y in zip(jax.tree.leaves(learned), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-5)
    assert set(metrics) == {"critic_loss", "q"}
    for name, value in metrics.items():
        assert float(value) == pytest.approx(np.mean([float(r[name]) for r in reports]), rel=1e-3)


def test_without_an_update_everything_stays_as_it_is(replay, start):
    state, metrics = learn(LEARNER, start, replay, jnp.int32(0), signal="a", key=KEY)
    assert state is start
    assert all(value == NOTHING for value in metrics.values())
    inside, metrics = jax.jit(
        lambda updates: learn(LEARNER, start, replay, updates, signal="a", key=KEY)
    )(jnp.int32(0))
    assert same(inside, start)
    assert set(metrics) == set(LEARNER.metrics)
    assert all(value == NOTHING for value in metrics.values())


def test_counts_discounts_and_rates_are_data(replay, start):
    learn(LEARNER, start, replay, jnp.int32(1), signal="a", key=KEY)
    others = [dataclasses.replace(LEARNER, gamma=γ, tau=0.1) for γ in (0.0, 0.5)]
    others.append(dataclasses.replace(LEARNER, actor_lr=0.3))
    with compilations() as events:
        learned = [
            learn(learner, start, replay, jnp.int32(updates), signal="a", key=KEY)[0]
            for learner in others
            for updates in (4, 5)
        ]
        jax.block_until_ready(learned)
    assert events == []
    for i in range(6):
        assert not any(same(learned[i].actor, learned[j].actor) for j in range(i))


def test_a_learner_that_names_a_reward_gets_that_one(replay, start):
    own = dataclasses.replace(LEARNER, signal="b")
    states = [
        learn(learner, start, replay, jnp.int32(2), signal=signal, key=KEY)[0]
        for learner, signal in ((LEARNER, "a"), (LEARNER, "b"), (own, "a"))
    ]
    assert not same(states[0], states[1])
    assert same(states[1], states[2])


def test_adam_steps_down_the_gradient_and_clips_it():
    weights = {"x": jnp.array([1.0, -2.0]), "y": jnp.array([0.5])}
    gradient = {"x": jnp.array([3.0, 0.0]), "y": jnp.array([-4.0])}  # norm 5
    state = adam_state(weights)
    moved, after = adam(weights, gradient, state, 0.1)
    np.testing.assert_allclose(moved["x"], [0.9, -2.0], rtol=1e-5)
    np.testing.assert_allclose(moved["y"], [0.6], rtol=1e-5)
    np.testing.assert_allclose(after[0].mu["x"], [0.3, 0.0], rtol=1e-5)
    _, clipped = adam(weights, gradient, state, 0.1, max_norm=1.0)
    np.testing.assert_allclose(clipped[0].mu["x"], [0.06, 0.0], rtol=1e-5)
    np.testing.assert_allclose(clipped[0].mu["y"], [-0.08], rtol=1e-5)
    _, short = adam(weights, gradient, state, 0.1, max_norm=6.0)
    np.testing.assert_allclose(short[0].mu["y"], [-0.4], rtol=1e-5)


def test_targets_follow_by_a_share():
    target = polyak({"w": jnp.array([1.0, 0.0])}, {"w": jnp.array([2.0, -4.0])}, 0.25)
    np.testing.assert_allclose(target["w"], [1.25, -1.0])
    network = NETWORK.init(2, 1, key=jax.random.key(0))
    other = NETWORK.init(2, 1, key=jax.random.key(1))
    assert same(polyak(network, other, 1.0), other)
    assert same(polyak(network, other, 0.0), network)


class Affine(AbstractPolicy):
    """A policy without the promise to take a batch at once."""

    w: jax.Array

    def start(self, *, key):
        return ()

    def __call__(self, obs, carry):
        return jnp.tanh(self.w @ obs), carry


def test_a_batch_of_actions_is_one_action_after_the_other():
    obs = jnp.asarray(transitions().obs)
    for policy in (NETWORK.init(2, 1, key=jax.random.key(0)), Affine(jnp.array([[1.0, -2.0]]))):
        actions = act(policy, obs)
        assert actions.shape == (ROWS, 1)
        one_by_one = [np.asarray(policy(x, policy.start(key=None))[0]) for x in obs]
        np.testing.assert_allclose(actions, one_by_one, atol=1e-6)
        assert len(np.unique(actions)) == ROWS


def test_transitions_of_several_steps_bootstrap_with_their_own_discount(replay, start):
    """And rewards are scaled so that the usual one, paid at every step, makes a return of 1."""
    sampling = Sampling(3, half_life=5.0)
    learner = dataclasses.replace(LEARNER, reward_scale=None, gamma=0.9)
    given = {"signal": "a", "sampling": sampling, "key": KEY}
    learned, _ = learn(learner, start, replay, jnp.int32(1), **given)

    sample_key, update_key = jax.random.split(jax.random.fold_in(KEY, 0))
    rows, discount = replay.sample(4, sampling, 0.9, key=sample_key)
    usual = np.sqrt(np.mean(np.asarray(replay.data.rewards["a"]) ** 2))
    by_hand = dataclasses.replace(learner, reward_scale=0.1 / usual)
    ends = (rows.terminated, rows.truncated)
    batch = Batch(rows.obs, rows.action, rows.rewards["a"], rows.next_obs, *ends, None, discount)
    target = by_hand.bellman_target(start, batch, key=update_key)
    after = by_hand.bellman_target(
        start, dataclasses.replace(batch, reward=jnp.zeros(4), discount=jnp.ones(4)), key=update_key
    )
    expected = 0.1 / usual * np.asarray(batch.reward) + np.asarray(discount) * np.asarray(after[0])
    np.testing.assert_allclose(target[0], expected, rtol=1e-5)
    state, _ = by_hand.update(start, batch, key=update_key)
    for x, y in zip(jax.tree.leaves(learned), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-5)


@pytest.mark.parametrize("values", [Quantiles(5), Histogram(31, limit=3.0)])
@pytest.mark.parametrize("kind", [TD3, SAC])
def test_critics_of_distributions_learn_the_value_of_an_end(kind, values, replay):
    """Of rows that all end the episode a value is the reward."""
    data = dataclasses.replace(replay.data, terminated=jnp.ones(ROWS, bool))
    ended = Replay(data, jnp.int32(ROWS))
    critic = Critic(hidden=(32,), values=values)
    learner = kind(critic=critic, actor_lr=0.0, critic_lr=0.01, batch_size=64)
    state = learner.init(NETWORK, 2, 1, key=jax.random.key(0))
    state, _ = learn(learner, state, ended, jnp.int32(1500), signal="a", key=KEY)
    found = state.critics[0](data.obs.T, data.action.T)
    np.testing.assert_allclose(found, data.rewards["a"], atol=0.15)
