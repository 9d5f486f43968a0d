"""PPO: advantages and objective by hand, and a task with a known answer."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from walk import HostWalk

from credo.algorithms.ppo import (
    PPO,
    Actor,
    Choice,
    Sample,
    advantages,
    earned,
    improve,
    prepare,
    surrogate,
)
from credo.compilation import jit
from credo.environments.passive_tmaze import PassiveTMaze
from credo.environments.probes import Copy, Meet
from credo.learners.base import act
from credo.networks.choosing import Choosing
from credo.networks.exploration import Categorical
from credo.networks.mlp import MLP, Critic
from credo.networks.recurrent import Recurrent
from credo.networks.team import Team
from credo.normalization import Moments
from credo.replay import Replay

SMALL = {
    "network": MLP(hidden=(8,), initializer="fan_in", output_scale=0.01),
    "critic": Critic(hidden=(8,), activation="tanh", initializer="fan_in"),
    "batch_size": 16,
    "test_episodes": 5,
}


@pytest.fixture(scope="module")
def trained():
    """Copy, learned, with its first and last generation."""
    ppo = PPO(Copy(), horizon=160, copies=16, learning_rate=3e-3, test_every=100, **SMALL)
    state, generation = jit(ppo.init)(key=jax.random.key(0)), jit(ppo.generation)
    history = []
    for i in range(40):
        state, metrics = generation(state, key=jax.random.fold_in(jax.random.key(1), i))
        history.append(metrics)
    return ppo, state, history


def test_advantages_by_hand():
    delta = jnp.array([1.0, 2.0, 4.0, 8.0])
    goes_on = jnp.array([True, False, True, False])
    expected = [1.0 + 0.5 * 2.0, 2.0, 4.0 + 0.5 * 8.0, 8.0]
    np.testing.assert_allclose(advantages(delta, goes_on, 0.5), expected)


def test_rewards_are_divided_by_the_deviation_of_discounted_returns(trained):
    """Against a plain loop over the frames of a generation, and the same whatever their unit."""
    ppo, state, _ = trained
    rows, n = state.replay.data, int(state.replay.size)
    reward = np.asarray(rows.rewards["reward"][:n], np.float64)
    over = np.asarray(rows.terminated | rows.truncated)[:n]
    returns, so_far = [], 0.0
    for paid, ends in zip(reward, over, strict=True):
        so_far = paid + float(ppo.gamma) * so_far
        returns.append(so_far)
        so_far = 0.0 if ends else so_far
    seen = earned(ppo, Moments.of_returns(ppo.env), state.replay)
    assert seen is not None
    assert int(seen.count) == n
    np.testing.assert_allclose(seen.std[0], np.std(returns), rtol=1e-3)
    networks = (state.actor, state.critic)
    sample = prepare(ppo, networks, state.replay, None, seen)
    large = dataclasses.replace(rows, rewards={"reward": 1000.0 * rows.rewards["reward"]})
    replay = dataclasses.replace(state.replay, data=large)
    other = prepare(ppo, networks, replay, None, earned(ppo, Moments.of_returns(ppo.env), replay))
    np.testing.assert_allclose(other.value[:n], sample.value[:n], rtol=1e-2, atol=1e-3)
    plain = prepare(ppo, networks, state.replay)
    assert not np.allclose(plain.value[:n], sample.value[:n], rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize(("env", "network"), [(Copy(), SMALL["network"]), (Meet(), None)])
def test_it_learns_from_normalised_rewards_alone_and_in_a_team(env, network):
    given = SMALL | {"network": network}
    ppo = PPO.ppo(
        env, horizon=160, copies=16, learning_rate=3e-3, test_every=1, normalize_rewards=True,
        **{name: x for name, x in given.items() if x is not None},
    )  # fmt: skip
    state, generation = jit(ppo.init)(key=jax.random.key(0)), jit(ppo.generation)
    scores = []
    for i in range(25):
        state, metrics = generation(state, key=jax.random.fold_in(jax.random.key(1), i))
        scores.append(float(metrics["champion_score"]))
    assert np.mean(scores[-3:]) > scores[0]
    assert np.isfinite(state.paid.std).all()


def test_the_objective_is_clipped_where_that_makes_it_worse(trained):
    ppo, state, _ = trained
    obs, action = jnp.zeros((4, 1)), jnp.array([[0.1], [0.2], [0.3], [0.4]])
    now = state.actor.log_density(act(state.actor.mean, obs), action)
    ratio = jnp.array([1.5, 0.5, 1.5, 0.5])
    advantage = jnp.array([1.0, 1.0, -1.0, -1.0])
    value = state.critic(obs.T, jnp.zeros((0, 4)))
    rows = Sample(obs, action, now - jnp.log(ratio), advantage, value)
    loss, metrics = surrogate(ppo, (state.actor, state.critic), rows)
    # min(r·A, clip(r)·A): 1.2, 0.5, -1.5, -0.8
    assert float(metrics["policy_loss"]) == pytest.approx(-(1.2 + 0.5 - 1.5 - 0.8) / 4, abs=1e-5)
    assert float(metrics["critic_loss"]) == pytest.approx(0.0, abs=1e-8)
    assert float(loss) == pytest.approx(float(metrics["policy_loss"]), abs=1e-6)
    assert float(metrics["clipped"]) == 1.0


def test_the_density_is_that_of_a_gaussian(trained):
    _, state, _ = trained
    actor = eqx.tree_at(lambda a: a.log_std, state.actor, jnp.log(jnp.array([0.5])))
    obs = jnp.array([[0.3]])
    mean = float(actor.mean(obs[0], ())[0][0])
    expected = -0.5 * ((0.7 - mean) / 0.5) ** 2 - np.log(0.5) - 0.5 * np.log(2 * np.pi)
    density = Actor.log_density(actor, act(actor.mean, obs), jnp.array([[0.7]]))
    assert float(density[0]) == pytest.approx(expected, rel=1e-4)


def test_advantages_stop_at_the_end_of_an_episode_and_bootstrap_at_a_time_limit(trained):
    ppo, state, _ = trained
    replay = state.replay
    n, length = int(replay.size), ppo.env.max_steps
    assert n == 160
    sample = jit(prepare)(ppo, (state.actor, state.critic), replay)
    rows = jax.tree.map(lambda x: np.asarray(x)[:n], replay.data)
    assert not rows.terminated.any()  # Copy ends by its clock

    def value(obs):
        return np.asarray(state.critic(jnp.asarray(obs.T), jnp.zeros((0, n))))

    delta = rows.rewards["reward"] + 0.99 * value(rows.next_obs) - value(rows.obs)
    expected = np.zeros(n)
    for i in reversed(range(n)):
        last = i % length == length - 1
        expected[i] = delta[i] + (0.0 if last else 0.99 * 0.95 * expected[i + 1])
    np.testing.assert_allclose(sample.value[:n], expected + value(rows.obs), rtol=1e-3, atol=1e-3)
    normal = (expected - expected.mean()) / expected.std()
    np.testing.assert_allclose(sample.advantage[:n], normal, rtol=1e-3, atol=2e-3)


def test_copy_is_learned(trained):
    _, _, history = trained
    first, last = (float(metrics["champion_score"]) for metrics in (history[0], history[-1]))
    assert first < -2.0  # doing nothing earns -3.3
    assert last > -0.6


@pytest.fixture(scope="module")
def team():
    """PPO of a team, two agents that meet, after three generations."""
    ppo = PPO.ppo(Meet(), horizon=64, copies=16, batch_size=16, signal="local")
    state, generation = ppo.init(key=jax.random.key(0)), jit(ppo.generation)
    for i in range(3):
        state, _ = generation(state, key=jax.random.key(i))
    return ppo, state


def test_each_agent_of_a_team_has_its_own_advantages(team):
    """Those of an agent alone with its own rewards; of one that ended or does not act, none."""
    ppo, state = team
    n = int(state.replay.size)
    rows = state.replay.data
    gone = jnp.arange(len(rows.obs)) % 5 == 2
    active = jnp.ones((len(rows.obs), 2), bool).at[:, 1].set(~(jnp.arange(len(rows.obs)) % 5 == 3))
    ended = jnp.stack([rows.terminated, rows.terminated | gone], axis=1)
    replay = Replay(dataclasses.replace(rows, terminated=ended, active=active), state.replay.size)
    sample = prepare(ppo, (state.actor, state.critic), replay)
    np.testing.assert_array_equal(sample.counts[:n], active[:n])
    seen = np.zeros((n, 2))
    for agent in (0, 1):
        value = lambda x: np.asarray(state.critic(x[:n, agent].T, jnp.zeros((0, n))))  # noqa: E731, B023
        now, after = value(rows.obs), value(rows.next_obs)
        end, over = np.asarray(ended[:n, agent]), np.asarray(ended[:n, agent] | rows.truncated[:n])
        delta = np.asarray(rows.rewards["local"][:n, agent]) + 0.99 * np.where(end, 0, after) - now
        for i in reversed(range(n)):
            on = i + 1 < n and not over[i] and bool(active[i + 1, agent])
            seen[i, agent] = delta[i] + (0.99 * 0.95 * seen[i + 1, agent] if on else 0.0)
        expected = seen[:, agent] + now
        np.testing.assert_allclose(sample.value[:n, agent], expected, rtol=1e-3, atol=1e-4)
    counted = seen[np.asarray(active[:n])]
    normal = (seen - counted.mean()) / counted.std()
    np.testing.assert_allclose(sample.advantage[:n], normal, rtol=1e-3, atol=2e-3)


def test_what_an_agent_that_does_not_act_said_changes_nothing(team):
    ppo, state = team
    rows = state.replay.data
    active = jnp.ones((len(rows.obs), 2), bool).at[::3, 0].set(False)
    losses = []
    for noise in (0.0, 5.0):
        action = jnp.where(active[..., None], rows.action, rows.action + noise)
        replay = Replay(dataclasses.replace(rows, action=action, active=active), state.replay.size)
        sample = prepare(ppo, (state.actor, state.critic), replay)
        losses.append(surrogate(ppo, (state.actor, state.critic), sample)[0])
    assert float(losses[0]) == pytest.approx(float(losses[1]), abs=1e-6)


def test_a_team_learns_to_meet(team):
    ppo, state = team
    ppo = dataclasses.replace(ppo, learning_rate=3e-3, test_every=200)
    generation = jit(ppo.generation)
    for i in range(30):
        state, metrics = generation(state, key=jax.random.key(100 + i))
    assert float(metrics["champion_score"]) == 1.0


def test_a_team_with_memory_is_refused():
    with pytest.raises(ValueError, match="acts for a team and has memory: PPO learns for teams wi"):
        PPO.ppo(Meet(), Team(head=Recurrent("gru", 4)))


def test_no_update_leaves_the_networks_alone(trained):
    ppo, state, _ = trained
    still = dataclasses.replace(ppo, learning_rate=0.0)
    networks = (state.actor, state.critic)
    actor, *_ = improve(still, networks, state.optimizer, state.replay, key=jax.random.key(0))
    for a, b in zip(jax.tree.leaves(actor), jax.tree.leaves(state.actor), strict=True):
        np.testing.assert_array_equal(a, b)


def test_on_a_host_task_nothing_compiles_after_the_first_generation():
    ppo = PPO(HostWalk(spread=0.5), horizon=40, copies=10, test_every=1, **SMALL)
    state, frames = ppo.init(key=jax.random.key(0)), set()
    for i in range(5):
        with compilations() as events:
            state, metrics = ppo.generation(state, key=jax.random.fold_in(jax.random.key(1), i))
            frames.add(int(metrics["frames"]))
        assert i < 2 or events == []
    assert len(frames) > 1


@pytest.mark.parametrize("length", [1, 10])
def test_windows_of_short_episodes_are_learned_from(length):
    """A round of frames that fills no minibatch once ended in an error, and had no update."""
    network = Recurrent("gru", 4, "tanh", "fan_in")
    for fields in ({}, {"window": 8, "batch_size": 64}):
        ppo = PPO.ppo(PassiveTMaze(length), network, copies=4, epochs=1, **fields)
        state = jit(ppo.init)(key=jax.random.key(0))
        after, metrics = jit(ppo.generation)(state, key=jax.random.key(1))
        assert np.isfinite(metrics["policy_loss"])
        assert metrics["critic_loss"] > 0
        before = jax.tree.leaves(state.actor)
        assert any(
            (a != b).any() for a, b in zip(before, jax.tree.leaves(after.actor), strict=True)
        )


def test_a_round_that_fills_no_minibatch_is_learned_from_all_the_same():
    """It once had no update, and did not say so. Rows that are no frames change nothing."""
    ppo = PPO(Copy(max_steps=1), copies=8, horizon=8, batch_size=64, epochs=1, network=MLP((4,)))
    state = jit(ppo.init)(key=jax.random.key(0))
    after, metrics = jit(ppo.generation)(state, key=jax.random.key(1))
    assert int(metrics["frames"]) == 8
    assert float(metrics["critic_loss"]) > 0
    junk = jax.tree.map(
        lambda x: x.at[8:].set(True if x.dtype == bool else 7) if x.ndim else x, after.replay
    )
    key, given = jax.random.key(2), (state.actor, state.critic)
    found = [improve(ppo, given, state.optimizer, x, key=key)[0] for x in (after.replay, junk)]
    for a, b in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_the_entropy_of_a_gaussian_and_of_a_choice():
    actor = Actor(MLP((2,)).init(1, 2, key=jax.random.key(0)), jnp.log(jnp.array([0.5, 2.0])))
    expected = np.log(0.5) + np.log(2.0) + np.log(2 * np.pi * np.e)
    np.testing.assert_allclose(actor.entropy(jnp.zeros((3, 2))), expected, rtol=1e-6)
    choice = Choice(Choosing(MLP((2,)), (3,)).init(1, 3, key=jax.random.key(0)))
    said = jnp.log(jnp.array([[0.5, 0.25, 0.25], [1 / 3, 1 / 3, 1 / 3]]))
    np.testing.assert_allclose(choice.entropy(said), [1.5 * np.log(2), np.log(3)], rtol=1e-6)
    taken = jnp.array([[-1.0, 1.0, -1.0], [1.0, -1.0, -1.0]])
    density = np.exp(choice.log_density(said + 7.0, taken))  # logits have no level
    np.testing.assert_allclose(density, [0.25, 1 / 3], rtol=1e-5)


def test_actions_are_drawn_with_the_probabilities_of_the_softmax():
    policy = Choosing(MLP(()), (3,)).init(1, 3, key=jax.random.key(0))
    said = np.asarray(policy.spoken(jnp.ones(1), ())[1])
    explorer = Categorical(policy)

    def step(carry, _):
        action, carry = explorer(jnp.ones(1), carry)
        return carry, action

    _, drawn = jax.lax.scan(step, explorer.start(key=jax.random.key(1)), length=20_000)
    assert set(np.unique(drawn)) == {-1.0, 1.0}
    expected = np.exp(said) / np.exp(said).sum()
    np.testing.assert_allclose((np.asarray(drawn) > 0).mean(axis=0), expected, atol=0.015)
