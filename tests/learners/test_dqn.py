"""DQN: targets and errors as in plain NumPy, exploration counted, and refusals."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.compilation import jit
from credo.learners.dqn import DQN, error
from credo.networks.choosing import Choosing
from credo.networks.exploration import EpsilonGreedy
from credo.networks.graph import Graph
from credo.networks.mlp import MLP
from credo.types import Batch

OBS, ACT, N = 3, 4, 6
NETWORK = Choosing(MLP(hidden=(5,), initializer="fan_in"), (ACT,))
LEARNER = DQN(gamma=0.9, learning_rate=0.01, tau=0.25, batch_size=N)


def weights(policy):
    return {name: np.asarray(x, np.float64) for name, x in policy.weights.items()}


def said(policy, obs):
    """Q(s, ·) `[rows, act]` of an MLP, by hand."""
    w = weights(policy.policy)
    hidden = np.tanh(obs @ w["W_0"].T + w["b_0"])
    return hidden, hidden @ w["W_1"].T + w["b_1"]


def values(of, obs):
    """The same with the dueling head, if there is one."""
    hidden, q = said(of.policy, obs)
    if of.head is None:
        return q
    head = {name: np.asarray(x, np.float64) for name, x in of.head.items()}
    return hidden @ head["W_0"].T + head["b_0"] + q - q.mean(axis=1, keepdims=True)


def batch(seed, **more):
    rng = np.random.default_rng(seed)
    obs, after = rng.normal(size=(2, N, OBS)).astype(np.float32)
    action = rng.uniform(-1, 1, (N, ACT)).astype(np.float32)
    reward, ended = rng.normal(size=N).astype(np.float32) * 3, np.arange(N) % 3 == 0
    return Batch(*map(jnp.asarray, (obs, action, reward, after, ended, np.arange(N) == 1)), **more)


@pytest.fixture(scope="module", params=[{}, {"double": False}, {"dueling": True}])
def learned(request):
    """A learner and its state after two updates, so that target and network differ."""
    learner = dataclasses.replace(LEARNER, **request.param)
    state = learner.init(NETWORK, OBS, ACT, key=jax.random.key(1))
    update = jit(lambda state, rows: learner.update(state, rows, key=None)[0])
    for seed in (5, 6):
        state = update(state, batch(seed))
    return learner, state


def test_targets_are_those_of_the_paper(learned):
    learner, state = learned
    rows = batch(0)
    after = values(state.target, np.asarray(rows.next_obs))
    chooses = values(state.values, np.asarray(rows.next_obs)) if learner.double else after
    best = after[np.arange(N), chooses.argmax(axis=1)]
    expected = rows.reward + 0.9 * np.where(rows.terminated, 0.0, best)  # time limits bootstrap
    np.testing.assert_allclose(learner.target(state, rows)[0], expected, atol=1e-5)


@pytest.mark.parametrize("double", [True, False])
def test_who_chooses_the_next_action(double):
    """The network or its target, which here want different ones."""
    learner = dataclasses.replace(LEARNER, double=double)
    state, other = (learner.init(NETWORK, OBS, ACT, key=jax.random.key(n)) for n in (1, 2))
    state = dataclasses.replace(state, target=other.values)
    rows = batch(0)
    after, mine = (values(x, np.asarray(rows.next_obs)) for x in (state.target, state.values))
    assert (after.argmax(axis=1) != mine.argmax(axis=1)).sum() >= 2
    best = after[np.arange(N), (mine if double else after).argmax(axis=1)]
    expected = rows.reward + 0.9 * np.where(rows.terminated, 0.0, best)
    np.testing.assert_allclose(learner.target(state, rows)[0], expected, atol=1e-5)


def test_a_warm_start_explores_no_more_than_in_the_end():
    learner = dataclasses.replace(LEARNER, epsilon=0.1)
    state = learner.init(NETWORK, OBS, ACT, key=jax.random.key(1))
    given = NETWORK.init(OBS, ACT, key=jax.random.key(3))
    warm = learner.warm(state, given)
    assert float(learner.explorer(warm, jnp.bool_(False)).epsilon) == pytest.approx(0.1)
    for a, b in zip(jax.tree.leaves(learner.actor(warm)), jax.tree.leaves(given), strict=True):
        assert (a == b).all()


def test_returns_of_n_steps_have_their_discount(learned):
    learner, state = learned
    rows = batch(0, discount=jnp.linspace(0.1, 0.9, N))
    one = dataclasses.replace(learner, gamma=1.0)
    after = one.target(state, dataclasses.replace(rows, discount=None))[0] - rows.reward
    found = learner.target(state, rows)[0] - rows.reward
    np.testing.assert_allclose(found, rows.discount * after, atol=1e-5)


def test_the_error_is_hubers_of_what_was_done(learned):
    _, state = learned
    rows, target = batch(3), jnp.linspace(-3, 3, N)[None]
    q = values(state.values, np.asarray(rows.obs))[np.arange(N), rows.action.argmax(axis=1)]
    off = np.abs(q - target[0])
    huber = np.where(off <= 1, 0.5 * off**2, off - 0.5).mean()
    loss, mean = error(state.values, rows, target)
    assert float(loss) == pytest.approx(huber, rel=1e-5)
    assert float(mean) == pytest.approx(q.mean(), rel=1e-4)


def test_rows_that_do_not_count_change_nothing(learned):
    _, state = learned
    rows = batch(3, active=jnp.arange(N) < 4)
    loss, _ = error(state.values, rows, jnp.zeros((1, N)))
    less = Batch(*(x[:4] for x in (rows.obs, rows.action, rows.reward, rows.next_obs)), None, None)
    assert float(loss) == pytest.approx(float(error(state.values, less, jnp.zeros((1, 4)))[0]))


def test_the_target_follows_and_the_actor_takes_the_largest(learned):
    learner, state = learned
    after = learner.update(state, batch(9), key=None)[0]
    for new, target, old in zip(
        *map(jax.tree.leaves, (after.values, after.target, state.target)), strict=True
    ):
        np.testing.assert_allclose(target, 0.25 * new + 0.75 * old, atol=1e-6)
    obs = np.asarray(batch(9).obs)
    actor = learner.actor(state)
    acts = np.array([actor(jnp.asarray(x), ())[0] for x in obs])
    assert (acts.argmax(axis=1) == said(actor, obs)[1].argmax(axis=1)).all()
    judged = learner.value(state, actor, batch(9))
    np.testing.assert_allclose(
        judged,
        values(state.values, obs)[np.arange(N), said(actor, obs)[1].argmax(axis=1)],
        atol=1e-5,
    )


def test_the_largest_is_found_among_large_values():
    """Behind tanh, 300 and 301 are both 1."""
    policy = NETWORK.init(OBS, ACT, key=jax.random.key(0))
    w = {name: jnp.zeros_like(x) for name, x in policy.policy.weights.items()}
    w["b_1"] = jnp.array([300.0, 299.5, 301.0, -500.0])
    inner = dataclasses.replace(policy.policy, weights=w)
    action, _ = dataclasses.replace(policy, policy=inner)(jnp.zeros(OBS), ())
    assert int(action.argmax()) == 2
    assert float(action.max()) == 0.0
    assert (np.abs(action) <= 1).all()
    assert float(action[0]) > float(action[1])


def test_exploration_falls_with_updates():
    learner = dataclasses.replace(LEARNER, epsilon=0.1, exploration=4)
    state = learner.init(NETWORK, OBS, ACT, key=jax.random.key(1))
    update = jit(lambda state: learner.update(state, batch(0), key=None)[0])
    seen = []
    for _ in range(6):
        seen.append(float(learner.explorer(state, jnp.bool_(False)).epsilon))
        state = update(state)
    np.testing.assert_allclose(seen, [1.0, 0.775, 0.55, 0.325, 0.1, 0.1], atol=1e-6)


@pytest.mark.parametrize(("random", "share"), [(False, 0.3), (True, 1.0)])
def test_every_action_has_an_equal_chance_in_that_share_of_the_steps(random, share):
    policy = NETWORK.init(OBS, ACT, key=jax.random.key(0))
    explorer = EpsilonGreedy(policy, jnp.float32(0.3), jnp.bool_(random))

    def step(carry, _):
        action, carry = explorer(jnp.ones(OBS), carry)
        return carry, jnp.argmax(action)

    n = 20_000
    _, taken = jax.lax.scan(step, explorer.start(key=jax.random.key(2)), length=n)
    counts = np.bincount(np.asarray(taken), minlength=ACT) / n
    best = int(policy(jnp.ones(OBS), ())[0].argmax())
    expected = np.full(ACT, share / ACT)
    expected[best] += 1 - share
    np.testing.assert_allclose(counts, expected, atol=0.015)


def test_networks_that_do_not_tell_their_output_layer_apart_are_refused():
    with pytest.raises(TypeError, match="DQN needs what a network's output layer says before"):
        LEARNER.init(Graph(hidden=2), OBS, ACT, key=jax.random.key(0))


@pytest.mark.parametrize(
    ("field", "value"),
    [("gamma", 1.1), ("epsilon", -0.1), ("tau", 2), ("exploration", 0), ("batch_size", 0)],
)
def test_impossible_settings_are_refused(field, value):
    with pytest.raises(ValueError, match=field):
        DQN(**{field: value})
