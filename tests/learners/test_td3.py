"""TD3 and DDPG: updates as in a NumPy version of the published boxes."""

import copy
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from credo.compilation import jit
from credo.learners.td3 import TD3, ddpg
from credo.networks.base import AbstractPolicy
from credo.networks.exploration import GaussianNoise, OrnsteinUhlenbeck
from credo.networks.mlp import MLP, Critic
from credo.types import Batch

OBS, ACT, N = 2, 1, 6
NETWORK = MLP(hidden=(3,))
LEARNERS = {
    "td3": TD3(
        critic=Critic(hidden=(4,)),
        gamma=0.9,
        actor_lr=0.01,
        critic_lr=0.02,
        tau=0.1,
        target_noise=0.5,
        target_noise_clip=0.3,
        batch_size=N,
    ),
    "ddpg": ddpg(
        critic=Critic(
            hidden=(3,),
            branches=(2, 3),
            activation="elu",
            normalization="before",
            initializer="normal",
        ),
        gamma=0.8,
        actor_lr=0.01,
        critic_lr=0.02,
        tau=0.1,
        actor_max_norm=0.05,
        critic_max_norm=0.05,
        batch_size=N,
    ),
}


@jit
def update(learner, state, batch, key):
    return learner.update(state, batch, key=key)


@jit
def bellman_target(learner, state, batch, key):
    return learner.bellman_target(state, batch, key=key)[0]  # of means there is one sample


def batch_of(seed):
    obs, action, reward, next_obs, end = (
        np.random.default_rng(seed).uniform(-1, 1, (5, N, OBS)).astype(np.float32)
    )
    return Batch(obs, action[:, :ACT], 3 * reward[:, 0], next_obs, end[:, 0] > 0, end[:, 0] > 9)


def start(name, seed=0):
    return LEARNERS[name].init(NETWORK, OBS, ACT, key=jax.random.key(seed))


def same(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in pairs)


class ByHand:
    """The learner in NumPy, from the same start."""

    def __init__(self, learner, state, **how):
        self.learner, self.how, self.step = learner, how, 0
        self.actor = [reference.numpy_of(state.actor)]
        self.critics = [reference.numpy_of(critic) for critic in state.critics]
        self.target_actor = copy.deepcopy(self.actor)
        self.target_critics = copy.deepcopy(self.critics)
        max_norm = learner.actor_max_norm or np.inf
        self.actor_adam = reference.Adam(learner.actor_lr, max_norm)
        self.critic_adam = reference.Adam(learner.critic_lr, max_norm)

    def q(self, w, obs, action):
        return reference.critic(w, obs, action, **self.how)

    def target(self, batch, key):
        t = self.learner
        noise = t.target_noise * np.asarray(jax.random.normal(key, batch.action.shape))
        noise = np.clip(noise, -t.target_noise_clip, t.target_noise_clip)
        action = np.clip(reference.actor(self.target_actor[0], batch.next_obs) + noise, -1, 1)
        q = np.min([self.q(w, batch.next_obs, action) for w in self.target_critics], axis=0)
        return batch.reward + t.gamma * np.where(batch.terminated, 0.0, q)

    def update(self, batch, key):
        y = self.target(batch, key)

        def error(critics):
            return sum(np.mean((self.q(w, batch.obs, batch.action) - y) ** 2) for w in critics)

        def loss(actors):
            action = reference.actor(actors[0], batch.obs)
            return -np.mean(self.q(self.critics[0], batch.obs, action))

        critic_loss = error(self.critics)
        value = np.mean([self.q(w, batch.obs, batch.action) for w in self.critics])
        self.critic_adam(self.critics, reference.gradient(error, self.critics))
        if self.step % self.learner.policy_delay == 0:
            self.actor_adam(self.actor, reference.gradient(loss, self.actor))
            reference.follow(self.target_actor, self.actor, self.learner.tau)
            reference.follow(self.target_critics, self.critics, self.learner.tau)
        self.step += 1
        return critic_loss, value


@pytest.mark.parametrize("name", LEARNERS)
def test_updates_are_those_of_the_equations(name):
    learner, state = LEARNERS[name], start(name)
    how = {"φ": reference.elu, "normalized": True} if name == "ddpg" else {}
    by_hand = ByHand(learner, state, **how)
    assert len(by_hand.critics) == {"td3": 2, "ddpg": 1}[name]
    for step in range(4):
        batch, key = batch_of(step), jax.random.key(step)
        assert batch.terminated.any()
        assert not batch.terminated.all()
        state, metrics = update(learner, state, batch, key)
        critic_loss, value = by_hand.update(batch, key)
        assert float(metrics["critic_loss"]) == pytest.approx(critic_loss, rel=1e-3)
        assert float(metrics["q"]) == pytest.approx(value, rel=1e-3, abs=1e-5)
        assert set(metrics) == set(learner.metrics)
        reference.assert_weights([state.actor], by_hand.actor)
        reference.assert_weights(state.critics, by_hand.critics)
        reference.assert_weights([state.target_actor], by_hand.target_actor)
        reference.assert_weights(state.target_critics, by_hand.target_critics)


def test_the_first_step_of_adam_has_the_size_of_its_rate():
    """Down the gradient, whatever its size."""
    before = start("td3")
    after, _ = update(LEARNERS["td3"], before, batch_of(0), jax.random.key(0))
    for old, new, rate in (
        (before.actor, after.actor, 0.01),
        (before.critics, after.critics, 0.02),
    ):
        moves = [
            np.abs(b - a).ravel()
            for a, b in zip(jax.tree.leaves(old), jax.tree.leaves(new), strict=True)
        ]
        moves = np.concatenate(moves)
        moves = moves[moves > 0]  # a dead unit does not move
        assert len(moves) > 5
        np.testing.assert_allclose(moves, rate, rtol=0.02)


def test_the_policy_and_the_targets_wait_for_every_second_update():
    learner, state = LEARNERS["td3"], start("td3")
    for step in range(4):
        before = state
        state, _ = update(learner, state, batch_of(step), jax.random.key(step))
        assert not same(state.critics, before.critics)
        slow = ("actor", "actor_opt", "target_actor", "target_critics")
        for field in slow:
            assert same(getattr(state, field), getattr(before, field)) == (step % 2 == 1), field
    assert int(state.step) == 4


def test_a_terminated_row_is_worth_its_reward_and_a_truncated_one_is_not():
    learner, state, batch = LEARNERS["td3"], start("td3"), batch_of(0)
    y, rest = (
        np.asarray(bellman_target(learner, state, b, jax.random.key(0)))
        for b in (batch, eqx.tree_at(lambda b: b.terminated, batch, np.zeros(N, bool)))
    )
    np.testing.assert_array_equal(y[batch.terminated], batch.reward[batch.terminated])
    np.testing.assert_array_equal(y[~batch.terminated], rest[~batch.terminated])
    assert (np.abs(rest - batch.reward) > 1e-3).all()


def test_a_next_value_that_is_nan_does_not_matter_after_the_end():
    batch = batch_of(0)
    lost = np.where(batch.terminated[:, None], np.float32(np.nan), batch.next_obs)
    y = bellman_target(
        LEARNERS["td3"],
        start("td3"),
        eqx.tree_at(lambda b: b.next_obs, batch, lost),
        jax.random.key(0),
    )
    assert np.isfinite(y).all()


def test_smoothing_noise_is_clipped_and_actions_stay_in_range():
    """Large noise pushes each target action to the clip or to the border."""
    learner = LEARNERS["ddpg"]
    state, batch = start("ddpg"), batch_of(1)
    noisy = eqx.tree_at(
        lambda t: (t.target_noise, t.target_noise_clip, t.gamma), learner, (1e6, 0.4, 1.0)
    )
    y = np.asarray(bellman_target(noisy, state, batch, jax.random.key(3)))
    w = reference.numpy_of(state.target_critics[0])
    action = reference.actor(reference.numpy_of(state.target_actor), batch.next_obs)
    ends = [
        reference.critic(
            w, batch.next_obs, np.clip(action + side, -1, 1), reference.elu, normalized=True
        )
        for side in (-0.4, 0.4)
    ]
    at = [np.isclose(y - batch.reward, end, atol=1e-4) for end in ends]
    assert (at[0] | at[1] | batch.terminated).all()
    assert not np.allclose(*ends, atol=1e-3)


def test_both_gradients_are_clipped():
    learner = eqx.tree_at(
        lambda t: (t.actor_max_norm, t.critic_max_norm), LEARNERS["ddpg"], (1e-3, 1e-3)
    )
    state, _ = update(learner, start("ddpg"), batch_of(0), jax.random.key(0))
    for opt in (state.actor_opt, state.critic_opt):
        first_moment = np.concatenate([x.ravel() for x in jax.tree.leaves(opt[0].mu)])
        assert np.linalg.norm(first_moment) == pytest.approx(0.1 * 1e-3, rel=1e-3)


def test_a_start_has_equal_targets_and_different_critics():
    state = start("td3")
    assert same(state.actor, state.target_actor)
    assert same(state.critics, state.target_critics)
    assert not same(*state.critics)
    assert not same(state.actor, start("td3", seed=1).actor)
    assert int(state.step) == 0


def test_a_given_actor_is_where_it_goes_on():
    learner, state = LEARNERS["td3"], start("td3")
    given = NETWORK.init(OBS, ACT, key=jax.random.key(9))
    warm = learner.warm(state, given)
    assert same(learner.actor(warm), given)
    assert same(warm.target_actor, given)
    assert same((warm.critics, warm.target_critics), (state.critics, state.target_critics))
    update(learner, warm, batch_of(0), jax.random.key(0))


def test_the_explorer_adds_the_learners_noise():
    learner, state = LEARNERS["td3"], start("td3")
    still = eqx.tree_at(lambda t: t.noise.std, learner, 0.0).explorer(state, jnp.bool_(False))
    obs = jnp.array([0.3, -0.2])
    action, _ = still(obs, still.start(key=jax.random.key(0)))
    np.testing.assert_allclose(action, learner.actor(state)(obs, ())[0], atol=1e-6)
    noisy = learner.explorer(state, jnp.bool_(False))
    moved, _ = noisy(obs, noisy.start(key=jax.random.key(0)))
    assert not np.allclose(moved, action, atol=1e-4)
    assert isinstance(noisy, AbstractPolicy)


def test_ddpg_has_the_constants_of_section_5_4():
    learner = ddpg(gamma=0.9)
    assert (learner.critics, learner.policy_delay, learner.batch_size) == (1, 1, 128)
    assert (learner.actor_lr, learner.critic_lr, learner.tau) == (5e-5, 5e-4, 1e-3)
    assert (learner.target_noise, learner.critic_max_norm, learner.gamma) == (0.0, 10.0, 0.9)
    assert learner.noise == OrnsteinUhlenbeck(theta=0.15, sigma=0.2, scale=0.3)
    assert (learner.critic.branches, learner.critic.hidden) == ((200, 200), (300,))
    assert ddpg().gamma == TD3().gamma == 0.99
    assert TD3().noise == GaussianNoise(0.1)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"gamma": 1.01}, r"gamma is 1.01.*\[0, 1\]"),
        ({"tau": -0.1}, "tau is -0.1"),
        ({"policy_delay": 0}, "policy_delay is 0"),
        ({"critics": 0}, "critics is 0"),
        ({"batch_size": 0}, "batch_size is 0"),
        ({"actor_lr": -1.0}, "actor_lr is -1.0"),
        ({"target_noise": -1.0}, "target_noise is -1.0"),
    ],
)
def test_impossible_settings_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        TD3(**fields)


def test_a_time_limit_may_count_as_the_end():
    """As in the author's code; by default it is bootstrapped through."""
    batch = eqx.tree_at(lambda b: b.truncated, batch_of(0), np.ones(N, bool))
    state = start("ddpg")
    through = bellman_target(LEARNERS["ddpg"], state, batch, jax.random.key(0))
    ends = dataclasses.replace(LEARNERS["ddpg"], bootstrap_truncated=False)
    target = bellman_target(ends, state, batch, jax.random.key(0))
    np.testing.assert_array_equal(target, batch.reward)
    assert np.any(np.asarray(through) != batch.reward)


def test_a_reward_scale_is_that_of_the_rewards():
    batch, state = batch_of(0), start("td3")
    smaller = eqx.tree_at(lambda b: b.reward, batch, np.float32(0.5) * batch.reward)
    halving = dataclasses.replace(LEARNERS["td3"], reward_scale=0.5)
    target = bellman_target(halving, state, batch, jax.random.key(0))
    other = bellman_target(LEARNERS["td3"], state, smaller, jax.random.key(0))
    np.testing.assert_array_equal(target, other)
    assert np.any(
        np.asarray(target) != bellman_target(LEARNERS["td3"], state, batch, jax.random.key(0))
    )


def test_the_actor_of_a_learner_may_start_small():
    learner = dataclasses.replace(LEARNERS["ddpg"], actor_scale=0.1)
    full, small = (
        made.init(NETWORK, OBS, ACT, key=jax.random.key(0)).actor.weights
        for made in (dataclasses.replace(learner, actor_scale=1.0), learner)
    )
    last = len(NETWORK.hidden)
    for name in full:
        scale = 0.1 if name in (f"W_{last}", f"b_{last}") else 1.0
        np.testing.assert_allclose(small[name], scale * full[name], rtol=1e-6)
