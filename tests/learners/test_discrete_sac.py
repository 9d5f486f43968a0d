"""Soft actor-critic of discrete actions: targets, losses and entropies as in plain NumPy, with and
without options that are not allowed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.learners.discrete_sac import DiscreteSAC, actor_loss, critic_error, lesser
from credo.networks.choosing import Choosing
from credo.networks.graph import Graph
from credo.networks.mlp import MLP
from credo.types import Batch

ACT, OBS, N, ALPHA = 4, 6, 7, 0.3
LEARNER = DiscreteSAC(gamma=0.9, tau=0.25, batch_size=N, temperature=ALPHA, target_entropy=0.4)


@pytest.fixture(params=[False, True], ids=["all", "masked"])
def learned(request):
    network = Choosing(MLP((5,), initializer="fan_in"), (ACT,), request.param)
    state = LEARNER.init(network, OBS, ACT, key=jax.random.key(1))
    return LEARNER.update(state, batch(5), key=None)[0], request.param


def batch(seed):
    rng = np.random.default_rng(seed)
    obs, after = rng.normal(size=(2, N, OBS)).astype(np.float32)
    for seen in (obs, after):
        seen[:, :ACT] = rng.random((N, ACT)) < 0.5
        seen[np.arange(N), rng.integers(0, ACT, N)] = 1.0
    action = np.where(obs[:, :ACT] > 0, rng.uniform(-1, 1, (N, ACT)), -1).astype(np.float32)
    reward = rng.normal(size=N).astype(np.float32)
    ends = (np.arange(N) == 2, np.zeros(N, bool))
    return Batch(*map(jnp.asarray, (obs, action, reward, after, *ends)))


def said(policy, obs):
    w = {name: np.asarray(x, np.float64) for name, x in policy.policy.weights.items()}
    return np.tanh(obs @ w["W_0"].T + w["b_0"]) @ w["W_1"].T + w["b_1"]


def by_hand(state, obs, masked, critics):
    """Probabilities and the lesser values, row by row, of what is allowed alone."""
    for row in np.asarray(obs, np.float64):
        options = np.flatnonzero(row[:ACT]) if masked else np.arange(ACT)
        u = said(state.actor, row)[options]
        p = np.exp(u) / np.exp(u).sum()
        yield options, p, np.min([said(q, row)[options] for q in critics], axis=0)


def test_targets_are_those_of_the_paper(learned):
    state, masked = learned
    rows, alpha = batch(0), jnp.exp(state.log_alpha)
    after = [
        (p * (q - float(alpha) * np.log(p))).sum()
        for _, p, q in by_hand(state, rows.next_obs, masked, state.targets)
    ]
    expected = rows.reward + 0.9 * np.where(rows.terminated, 0.0, after)
    found = LEARNER.soft_target(state, rows, alpha)[0]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_the_actor_descends_what_the_paper_says(learned):
    state, masked = learned
    rows = batch(3)
    made = list(by_hand(state, rows.obs, masked, state.critics))
    expected = np.mean([(p * (ALPHA * np.log(p) - q)).sum() for _, p, q in made])
    q = lesser(state.critics, rows)
    loss, (entropy, most) = actor_loss(state.actor, q, rows, jnp.float32(ALPHA))
    assert float(loss) == pytest.approx(expected, rel=1e-4)
    np.testing.assert_allclose(entropy, [-(p * np.log(p)).sum() for _, p, _ in made], atol=1e-5)
    np.testing.assert_allclose(most, [np.log(len(p)) for _, p, _ in made], rtol=1e-6)
    slopes = jax.grad(lambda actor: actor_loss(actor, q, rows, ALPHA)[0])(state.actor)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(slopes))


def test_critics_descend_the_squared_error_of_what_was_done(learned):
    state, _ = learned
    rows, target = batch(4), jnp.linspace(-1, 1, N)[None]
    taken = np.asarray(rows.action).argmax(axis=1)
    q = [said(one, np.asarray(rows.obs))[np.arange(N), taken] for one in state.critics]
    expected = 0.5 * sum(np.square(x - target[0]).mean() for x in q)
    assert float(critic_error(state.critics, rows, target)[0]) == pytest.approx(expected, rel=1e-4)


def test_the_temperature_rises_while_the_entropy_is_too_low(learned):
    state, masked = learned
    rows, network = batch(6), Choosing(MLP((5,)), (ACT,), masked)
    for share, rises in ((0.0, False), (1.0, True)):
        learner = DiscreteSAC(target_entropy=share)
        state = learner.init(network, OBS, ACT, key=jax.random.key(1))
        after = learner.update(state, rows, key=None)[0]
        assert (float(after.log_alpha) > float(state.log_alpha)) == rises


def test_the_explorer_draws_and_the_actor_takes_the_likeliest(learned):
    state, masked = learned
    obs = jnp.array([1.0, 0, 1, 1, 0.3, -0.2])
    ((options, p, _),) = by_hand(state, obs[None], masked, state.critics)
    explorer = LEARNER.explorer(state, jnp.bool_(False))

    def step(carry, _):
        action, carry = explorer(obs, carry)
        return carry, jnp.argmax(action)

    _, taken = jax.lax.scan(step, explorer.start(key=jax.random.key(2)), length=20_000)
    counts = np.bincount(np.asarray(taken), minlength=ACT) / 20_000
    expected = np.zeros(ACT)
    expected[options] = p
    np.testing.assert_allclose(counts, expected, atol=0.015)
    assert int(LEARNER.actor(state)(obs, ())[0].argmax()) == options[p.argmax()]


def test_networks_that_do_not_tell_their_output_layer_apart_are_refused():
    with pytest.raises(TypeError, match="DiscreteSAC needs what a network's output layer says"):
        LEARNER.init(Graph(hidden=2), OBS, ACT, key=jax.random.key(0))
