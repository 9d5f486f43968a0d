"""Rollouts: the fast path for sequences plays what `episode` plays, step by step."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import rollout, tree
from credo.environments.probes import Copy, Meet, Remember
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_recall import SequenceRecall
from credo.networks.base import AbstractPolicy
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent

POP, EPISODES = 3, 4
CLASSIFICATION = SequenceClassification(depth=3, min_gap=1, max_gap=3)
RECALL = SequenceRecall(depth=2, min_corridor=1, max_corridor=3)
NETWORKS = {
    "mmu": MMU(hidden=3),
    "general mmu": MMU(hidden=3, memory=2, alpha=0.3, encoder="learned", decoder="learned"),
    "rnn": Recurrent(cell="rnn", hidden=3),
    "gru": Recurrent(cell="gru", hidden=3),
    "lstm": Recurrent(cell="lstm", hidden=3),
    "mlp": MLP(hidden=(3,)),
}


def population_of(env, net):
    keys = jax.random.split(jax.random.key(0), POP)
    return eqx.filter_vmap(lambda key: net.init(env.obs_size, env.action_size, key=key))(keys)


class Slow(AbstractPolicy):
    """Any policy, without the promise that makes it fast."""

    inner: AbstractPolicy

    def start(self, *, key):
        return self.inner.start(key=key)

    def __call__(self, obs, carry):
        return self.inner(obs, carry)


def assert_same(a, b):
    """The same returns and steps."""
    np.testing.assert_array_equal(a.steps, b.steps)
    assert a.returns.keys() == b.returns.keys()
    for name in a.returns:
        np.testing.assert_allclose(a.returns[name], b.returns[name], atol=1e-4)


@pytest.mark.parametrize(
    ("env", "name", "common"),
    [
        *((CLASSIFICATION, name, True) for name in NETWORKS),
        (RECALL, "mmu", True),
        (RECALL, "mmu", False),
        (Remember(delay=2), "gru", False),
    ],
    ids=lambda x: str(x) if isinstance(x, str | bool) else type(x).__name__,
)
def test_the_fast_path_equals_episode_by_episode(env, name, common):
    population = population_of(env, NETWORKS[name])
    key = jax.random.key(7)
    fast = rollout.evaluate(env, population, EPISODES, common=common, key=key)
    slow = rollout.evaluate(env, Slow(population), EPISODES, common=common, key=key)
    assert fast.returns["fitness"].shape == fast.steps.shape == (POP, EPISODES)
    assert fast.returns["fitness"].std() > 0
    assert_same(fast, slow)


@pytest.fixture(scope="module")
def sequences():
    """Sequences of different lengths, `[1, episodes, ...]`."""
    keys = jax.random.split(jax.random.key(2), EPISODES)
    drawn = jax.vmap(lambda key: CLASSIFICATION.sample(key=key))(keys)
    return jax.tree.map(lambda x: x[None], drawn)


@pytest.fixture(scope="module")
def answered(sequences):
    """One compiled way to answer them."""
    population = population_of(CLASSIFICATION, NETWORKS["mmu"])
    play = eqx.filter_jit(lambda s: rollout.play_sequences(CLASSIFICATION, population, s))
    return play, play(sequences)


def test_padding_never_counts(sequences, answered):
    play, expected = answered
    assert len(set(sequences.length[0].tolist())) > 1
    time = jnp.broadcast_to(jnp.arange(CLASSIFICATION.max_steps), sequences.targets.shape)
    padding = time >= sequences.length[..., None]
    assert padding.any()
    dirty = eqx.tree_at(
        lambda s: (s.inputs, s.targets),
        sequences,
        (
            jnp.where(padding[..., None], 5.0, sequences.inputs),
            jnp.where(padding, -3.0, sequences.targets),
        ),
    )
    result = play(dirty)
    assert_same(result, expected)
    np.testing.assert_array_equal(result.returns["fitness"], expected.returns["fitness"])
    np.testing.assert_array_equal(
        result.steps, np.broadcast_to(sequences.length[0], (POP, EPISODES))
    )


def test_more_padding_changes_nothing(sequences, answered):
    _, expected = answered
    longer = jax.tree.map(
        lambda x: (
            jnp.pad(x, [(0, 0)] * 2 + [(0, 6)] + [(0, 0)] * (x.ndim - 3)) if x.ndim > 2 else x
        ),
        sequences,
    )
    population = population_of(CLASSIFICATION, NETWORKS["mmu"])
    assert_same(rollout.play_sequences(CLASSIFICATION, population, longer), expected)


class Constant(AbstractPolicy):
    """Always the same action: what it earns tells the world it was in."""

    action: jax.Array

    def start(self, *, key):
        return ()

    def __call__(self, obs, carry):
        return self.action, carry


def constants(*values):
    return tree.stack(*(Constant(jnp.array([value])) for value in values))


def test_common_worlds_and_worlds_of_ones_own():
    env, key = Copy(max_steps=3), jax.random.key(0)
    twins = constants(0.3, 0.3)
    same = rollout.evaluate(env, twins, EPISODES, key=key).returns["reward"]
    own = rollout.evaluate(env, twins, EPISODES, common=False, key=key).returns["reward"]
    np.testing.assert_array_equal(same[0], same[1])
    assert len(np.unique(same)) == EPISODES
    assert len(np.unique(own)) == 2 * EPISODES


def test_the_fast_path_too_gives_each_member_its_own_worlds():
    population = tree.stack(*[MLP(hidden=(2,)).init(1, 1, key=jax.random.key(0))] * 2)
    own = rollout.evaluate(CLASSIFICATION, population, 16, common=False, key=jax.random.key(1))
    common = rollout.evaluate(CLASSIFICATION, population, 16, key=jax.random.key(1))
    assert not np.array_equal(own.steps[0], own.steps[1])
    np.testing.assert_array_equal(common.steps[0], common.steps[1])


def test_the_key_decides():
    population = constants(0.0, 0.5)
    env = Copy(max_steps=3)
    once, again, other = (
        rollout.evaluate(env, population, 2, key=jax.random.key(seed)).returns["reward"]
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(once, again)
    assert not np.isclose(once, other).any()


class Countdown(Copy):
    """Terminates once the action was above 0, else runs into the clock; pays 1 a step."""

    signals: ClassVar[tuple[str, ...]] = ("reward",)

    def step(self, state, action, *, key):
        state, time_step = super().step(state, action, key=key)
        return state, eqx.tree_at(
            lambda t: (t.terminated, t.rewards["reward"]),
            time_step,
            (action[0] > 0, jnp.float32(1.0)),
        )


def test_steps_and_returns_count_up_to_the_end():
    result = rollout.evaluate(
        Countdown(max_steps=5), constants(-1.0, 1.0), 2, key=jax.random.key(0)
    )
    assert result.steps.tolist() == [[5, 5], [1, 1]]
    assert result.returns["reward"].tolist() == [[5.0, 5.0], [1.0, 1.0]]


class Endless(Countdown):
    def step(self, state, action, *, key):
        state, time_step = super().step(state, action, key=key)
        return state, eqx.tree_at(lambda t: t.truncated, time_step, jnp.bool_(False))


def test_no_episode_is_longer_than_max_steps():
    result = rollout.evaluate(Endless(max_steps=5), constants(-1.0), 1, key=jax.random.key(0))
    assert result.steps.tolist() == [[5]]


class Towards(AbstractPolicy):
    """A team as one policy: each agent walks the way it sees, at its own speed."""

    speed: jax.Array

    def start(self, *, key):
        return ()

    def __call__(self, obs, carry):
        return self.speed[:, None] * jnp.sign(obs[:, 1:]), carry


def test_a_team_earns_shared_and_private_rewards():
    teams = tree.stack(Towards(jnp.array([1.0, 1.0])), Towards(jnp.array([1.0, 0.0])))
    result = rollout.evaluate(Meet(), teams, 2, key=jax.random.key(0))
    assert result.returns["global"].tolist() == [[1.0, 1.0], [0.0, 0.0]]
    local = np.asarray(result.returns["local"])
    assert local.shape == (2, 2, 2)
    np.testing.assert_allclose(local[0], 0.2 * np.asarray(result.steps[0])[:, None] * [1, 1])
    np.testing.assert_allclose(local[1], [[1.0, 0.0]] * 2, rtol=1e-5)


class Counter(AbstractPolicy):
    """Acts the number of steps so far, over ten."""

    def start(self, *, key):
        return jnp.float32(0.0)

    def __call__(self, obs, carry):
        return obs * 0.0 + carry / 10.0, carry + 1.0


def test_the_carry_lives_for_one_episode():
    env = Copy(max_steps=3)
    returns, steps = rollout.episode(
        env, Counter(), world_key=jax.random.key(0), policy_key=jax.random.key(1)
    )
    actions, carries = rollout.trace(Counter(), jnp.ones((3, 1)))
    assert actions[:, 0].tolist() == pytest.approx([0.0, 0.1, 0.2])
    assert carries.tolist() == [1.0, 2.0, 3.0]
    assert int(steps) == 3
    again, _ = rollout.episode(
        env, Counter(), world_key=jax.random.key(0), policy_key=jax.random.key(2)
    )
    assert float(returns["reward"]) == float(again["reward"]) < 0.0
