"""SAC: densities and updates as in a NumPy version of the published box."""

import copy
import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from credo.compilation import jit
from credo.learners.sac import LOG_STD_MAX, SAC, StochasticActor
from credo.networks.graph import Graph
from credo.networks.mlp import MLP, Critic, MLPPolicy
from credo.types import Batch

OBS, ACT, N = 2, 2, 5
NETWORK = MLP(hidden=(3,))
LEARNER = SAC(
    critic=Critic(hidden=(3,)),
    gamma=0.9,
    actor_lr=0.01,
    critic_lr=0.02,
    alpha_lr=0.03,
    tau=0.1,
    batch_size=N,
)


@jit
def update(learner, state, batch, key):
    return learner.update(state, batch, key=key)


@jit
def sample(actor, obs, key):
    """Of observations `[obs, batch]`."""
    batch = Batch(obs.T, *[None] * 5)  # pyright: ignore[reportArgumentType]
    return actor.sample(batch, key=key)


def batch_of(seed):
    obs, action, reward, next_obs, end = (
        np.random.default_rng(seed).uniform(-1, 1, (5, N, OBS)).astype(np.float32)
    )
    return Batch(obs, action, 3 * reward[:, 0], next_obs, end[:, 0] > 0, end[:, 0] > 9)


@pytest.fixture(scope="module")
def start():
    return LEARNER.init(NETWORK, OBS, ACT, key=jax.random.key(0))


def same(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in pairs)


def density(actor, obs, noise):
    """Action and log density of a squashed Gaussian; `actor` is [mean, head]."""
    mean_w, head = actor
    features = np.tanh(reference.layer(mean_w, 0, obs))
    mean = reference.layer(mean_w, 1, features)
    std = np.exp(np.clip(reference.layer(head, 0, features), -20, 2))
    u = mean + std * noise
    log_p = -0.5 * noise**2 - np.log(std * np.sqrt(2 * np.pi)) - np.log(1 - np.tanh(u) ** 2)
    return np.tanh(u), log_p.sum(axis=1)


class ByHand:
    def __init__(self, state):
        head = {name: np.asarray(w, np.float64) for name, w in state.actor.head.items()}
        self.actor = [reference.numpy_of(state.actor.mean), head]
        self.critics = [reference.numpy_of(critic) for critic in state.critics]
        self.targets = copy.deepcopy(self.critics)
        self.log_alpha = [{"": np.zeros(())}]
        rates = (LEARNER.actor_lr, LEARNER.critic_lr, LEARNER.alpha_lr)
        self.adams = [reference.Adam(rate) for rate in rates]

    def update(self, batch, key):
        noise, noise_2 = (
            np.asarray(jax.random.normal(k, (ACT, N)), np.float64).T for k in jax.random.split(key)
        )
        alpha = np.exp(self.log_alpha[0][""])
        action, log_p = density(self.actor, batch.next_obs, noise)
        q = np.min([reference.critic(w, batch.next_obs, action) for w in self.targets], axis=0)
        y = batch.reward + 0.9 * np.where(batch.terminated, 0.0, q - alpha * log_p)

        def error(critics):
            qs = [reference.critic(w, batch.obs, batch.action) for w in critics]
            return sum(0.5 * np.mean((q - y) ** 2) for q in qs)

        def loss(actor):
            action, log_p = density(actor, batch.obs, noise_2)
            qs = [reference.critic(w, batch.obs, action) for w in self.critics]
            return np.mean(alpha * log_p - np.min(qs, axis=0))

        losses = [error(self.critics)]
        self.adams[1](self.critics, reference.gradient(error, self.critics))
        losses.append(loss(self.actor))
        _, log_p = density(self.actor, batch.obs, noise_2)
        self.adams[0](self.actor, reference.gradient(loss, self.actor))
        # J(log α) = -log α (log π + H), as in the authors' code; H is -1 per dimension.
        self.adams[2](self.log_alpha, [{"": np.asarray(-np.mean(log_p - ACT))}])
        reference.follow(self.targets, self.critics, LEARNER.tau)
        return *losses, alpha


def test_updates_are_those_of_the_equations(start):
    state, by_hand = start, ByHand(start)
    for step in range(3):
        batch, key = batch_of(step), jax.random.key(step)
        assert 0 < batch.terminated.sum() < N
        state, metrics = update(LEARNER, state, batch, key)
        expected = by_hand.update(batch, key)
        reported = [float(metrics[name]) for name in LEARNER.metrics]
        np.testing.assert_allclose(reported, expected, rtol=1e-3, atol=1e-4)
        reference.assert_weights([state.actor.mean], by_hand.actor[:1])
        for name, w in by_hand.actor[1].items():
            np.testing.assert_allclose(state.actor.head[name], w, atol=2e-5)
        reference.assert_weights(state.critics, by_hand.critics)
        reference.assert_weights(state.target_critics, by_hand.targets)
        assert float(state.log_alpha) == pytest.approx(by_hand.log_alpha[0][""], abs=1e-5)


def test_a_delayed_actor_moves_with_every_second_update_of_the_critics(start):
    late, states, losses = dataclasses.replace(LEARNER, policy_delay=2), [start], []
    for step in range(4):
        state, metrics = update(late, states[-1], batch_of(step), jax.random.key(step))
        states.append(state)
        losses.append(float(metrics["actor_loss"]))
    moved = [not same(a.actor, b.actor) for a, b in itertools.pairwise(states)]
    warmed = [float(a.log_alpha) != float(b.log_alpha) for a, b in itertools.pairwise(states)]
    assert moved == warmed == [True, False, True, False]
    assert all(not same(a.critics, b.critics) for a, b in itertools.pairwise(states))
    # The loss of the first update counts for the second too.
    _, at_once = update(LEARNER, start, batch_of(0), jax.random.key(0))
    assert losses[:2] == [pytest.approx(2.0 * float(at_once["actor_loss"]), rel=1e-4), 0.0]


def fixed(mean, log_std):
    """A policy of one action that ignores what it sees."""
    zeros = {"W_0": jnp.zeros((1, 1)), "b_0": jnp.zeros(1), "W_1": jnp.zeros((1, 1))}
    weights = zeros | {"b_1": jnp.array([mean])}
    head = {"W_0": jnp.zeros((1, 1)), "b_0": jnp.array([log_std])}
    return StochasticActor(MLPPolicy(weights, MLP(hidden=(1,))), head)


def test_the_density_is_that_of_what_is_drawn():
    """Its mean over draws of 1 / density is the length of the interval they lie in."""
    n = 20_000
    action, log_p = sample(fixed(0.3, -0.5), jnp.zeros((1, n)), jax.random.key(0))
    action, log_p = np.asarray(action[0]), np.asarray(log_p)
    inside = np.abs(action - 0.1) < 0.4
    assert 0.2 < inside.mean() < 0.8
    assert np.sum(inside / np.exp(log_p)) / n == pytest.approx(0.8, rel=0.03)
    u = np.arctanh(action.astype(np.float64))
    assert np.mean(u) == pytest.approx(0.3, abs=0.02)
    assert np.std(u) == pytest.approx(np.exp(-0.5), rel=0.02)


def test_far_actions_have_a_finite_density_and_the_spread_has_a_limit():
    action, log_p = sample(fixed(30.0, 9.0), jnp.zeros((1, 500)), jax.random.key(0))
    assert np.isfinite(log_p).all()
    assert (np.abs(action) <= 1.0).all()
    near, _ = sample(fixed(0.0, 9.0), jnp.zeros((1, 500)), jax.random.key(0))
    limit, _ = sample(fixed(0.0, LOG_STD_MAX), jnp.zeros((1, 500)), jax.random.key(0))
    np.testing.assert_array_equal(near, limit)


@pytest.mark.parametrize(("log_std", "rises"), [(-4.0, True), (0.0, False)])
def test_the_temperature_rises_while_there_is_too_little_entropy(start, log_std, rises):
    head = {
        "W_0": jnp.zeros_like(start.actor.head["W_0"]),
        "b_0": jnp.full(ACT, log_std, jnp.float32),
    }
    state = eqx.tree_at(lambda s: s.actor.head, start, head)
    after, _ = update(LEARNER, state, batch_of(0), jax.random.key(0))
    assert float(after.log_alpha) == pytest.approx(0.03 if rises else -0.03, rel=1e-3)


def test_the_actor_is_the_squashed_mean_and_can_be_given(start):
    actor, obs = LEARNER.actor(start), jnp.array([0.4, -0.7])
    assert same(actor, start.actor.mean)
    np.testing.assert_allclose(
        actor(obs, ())[0],
        reference.actor(reference.numpy_of(actor), np.asarray(obs)[None])[0],
        atol=1e-6,
    )
    given = NETWORK.init(OBS, ACT, key=jax.random.key(9))
    warm = LEARNER.warm(start, given)
    assert same(LEARNER.actor(warm), given)
    assert same(warm.actor.head, start.actor.head)
    update(LEARNER, warm, batch_of(0), jax.random.key(0))


def test_the_explorer_draws_from_the_policy_or_uniformly(start):
    obs = jnp.array([0.4, -0.7])

    @jax.jit
    def draw(random, keys):
        explorer = LEARNER.explorer(start, random)
        return jax.vmap(lambda key: explorer(obs, explorer.start(key=key))[0])(keys)

    keys = jax.random.split(jax.random.key(0), 4000)
    drawn, anything = (np.asarray(draw(jnp.bool_(random), keys)) for random in (False, True))
    mean = reference.numpy_of(start.actor.mean)
    head = {name: np.asarray(w) for name, w in start.actor.head.items()}
    features = np.tanh(reference.layer(mean, 0, np.asarray(obs)[None]))
    u = np.arctanh(np.clip(drawn.astype(np.float64), -1 + 1e-7, 1 - 1e-7))
    np.testing.assert_allclose(
        np.median(u, axis=0), reference.layer(mean, 1, features)[0], atol=0.2
    )
    std = np.exp(reference.layer(head, 0, features)[0])
    np.testing.assert_allclose(u.std(axis=0), std, rtol=0.1)
    assert anything.mean() == pytest.approx(0.0, abs=0.03)
    assert anything.var() == pytest.approx(1 / 3, rel=0.05)
    assert abs(np.corrcoef(anything.T)[0, 1]) < 0.05


def test_each_step_draws_anew(start):
    explorer = LEARNER.explorer(start, jnp.bool_(False))
    carry, actions = explorer.start(key=jax.random.key(0)), []
    for _ in range(3):
        action, carry = explorer(jnp.zeros(OBS), carry)
        actions.append(tuple(np.asarray(action).tolist()))
    assert len(set(actions)) == 3


def test_networks_without_a_mean_to_squash_are_refused():
    with pytest.raises(TypeError, match=r"SAC draws actions around.*Graph.*give MLP.*TD3"):
        SAC().init(Graph(hidden=2), OBS, ACT, key=jax.random.key(0))


def test_a_sigmoid_is_half_as_steep_as_tanh():
    network = MLP(hidden=(2,), output_activation="sigmoid")
    actor = SAC().init(network, OBS, ACT, key=jax.random.key(0)).actor
    silent = eqx.tree_at(lambda a: a.head["b_0"], actor, jnp.full(ACT, -20.0))
    obs = jnp.ones((OBS, 1))
    action, _ = sample(silent, obs, jax.random.key(0))
    np.testing.assert_allclose(action[:, 0], actor.mean(obs[:, 0], ())[0], atol=1e-3)


def test_a_reward_scale_is_that_of_the_rewards(start):
    batch = batch_of(0)
    smaller = eqx.tree_at(lambda b: b.reward, batch, np.float32(0.5) * batch.reward)
    halving = dataclasses.replace(LEARNER, reward_scale=0.5)
    a, b = (
        update(learner, start, rows, jax.random.key(0))[0].critics
        for learner, rows in ((halving, batch), (LEARNER, smaller))
    )
    assert same(a, b)
    assert not same(a, update(LEARNER, start, batch, jax.random.key(0))[0].critics)


@pytest.mark.parametrize("field", ["gamma", "tau", "alpha_lr", "critics", "policy_delay"])
def test_impossible_settings_are_refused(field):
    with pytest.raises(ValueError, match=f"{field} is -1"):
        SAC(**{field: -1})


def test_the_value_of_another_policy_is_the_lesser_of_the_critics():
    @jax.jit
    def values():
        state = LEARNER.init(NETWORK, OBS, ACT, key=jax.random.key(0))
        policy = NETWORK.init(OBS, ACT, key=jax.random.key(1))
        obs, none = jnp.ones((N, OBS)), jnp.zeros(N)
        batch = Batch(obs, jnp.zeros((N, ACT)), none, obs, none > 0.0, none > 0.0)
        action = policy(obs[0], None)[0]
        each = jnp.stack([critic(obs[0], action) for critic in state.critics])
        return LEARNER.value(state, policy, batch), each

    value, each = values()
    np.testing.assert_allclose(value, np.full(N, each.min()), rtol=1e-5)
