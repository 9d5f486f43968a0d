"""Rollouts: the fast path for sequences plays what `episode` plays, step by step, and so does
whoever collects transitions, inside JAX and outside."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from reading import read
from walk import START, HostWalk, Walk, Walkers

from credo import rollout, tree
from credo.environments.host import EnvironmentFailure, InTurn
from credo.environments.probes import Copy, Meet, Remember
from credo.environments.rover import Rover
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_recall import SequenceRecall
from credo.environments.server_fleet import ServerFleet
from credo.environments.wrappers import Given, NoisyObservations, Shortened, delayed
from credo.networks.base import AbstractPolicy
from credo.networks.dmmu import DMMU
from credo.networks.exploration import Explorer, GaussianNoise
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent
from credo.networks.team import Team

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
    """Sequences of different lengths, `[episodes, ...]`."""
    keys = jax.random.split(jax.random.key(2), EPISODES)
    return jax.vmap(lambda key: CLASSIFICATION.sample(key=key))(keys)


def answers(population, sequences):
    """What a population earns with these sequences."""
    env = Given(CLASSIFICATION, sequences)
    return rollout.evaluate(env, population, EPISODES, key=jax.random.key(0))


@pytest.fixture(scope="module")
def answered(sequences):
    """One compiled way to answer them."""
    population = population_of(CLASSIFICATION, NETWORKS["mmu"])
    play = eqx.filter_jit(lambda s: answers(population, s))
    return play, play(sequences)


def test_padding_never_counts(sequences, answered):
    play, expected = answered
    assert len(set(sequences.length.tolist())) > 1
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
    np.testing.assert_array_equal(result.steps, np.broadcast_to(sequences.length, (POP, EPISODES)))


def test_more_padding_changes_nothing(sequences, answered):
    _, expected = answered
    longer = jax.tree.map(
        lambda x: jnp.pad(x, [(0, 0)] + [(0, 6)] + [(0, 0)] * (x.ndim - 2)) if x.ndim > 1 else x,
        sequences,
    )
    population = population_of(CLASSIFICATION, NETWORKS["mmu"])
    assert_same(answers(population, longer), expected)


def test_given_sequences_are_played_once_each(sequences):
    population = population_of(CLASSIFICATION, NETWORKS["mmu"])
    env = Given(CLASSIFICATION, jax.tree.map(lambda x: x[:3], sequences))
    for wrong, members in ((2, population), (3, Slow(population))):
        with pytest.raises(ValueError, match="3 given sequences are played once each"):
            rollout.evaluate(env, members, wrong, key=jax.random.key(0))


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

    tenth: float = 0.1

    def start(self, *, key):
        return jnp.float32(0.0)

    def __call__(self, obs, carry):
        return obs * 0.0 + carry * self.tenth, carry + 1.0


def test_the_carry_lives_for_one_episode():
    env = Copy(max_steps=3)
    population = tree.stack(Counter(), Counter())
    played = rollout.evaluate(env, population, 2, key=jax.random.key(0))
    actions, carries = read(Counter(), jnp.ones((3, 1)))
    assert actions[:, 0].tolist() == pytest.approx([0.0, 0.1, 0.2])
    assert carries.tolist() == [1.0, 2.0, 3.0]
    assert played.steps.tolist() == [[3, 3], [3, 3]]
    returns = played.returns["reward"]
    assert returns[0].tolist() == returns[1].tolist()  # common worlds, and no carry left over
    assert float(returns.max()) < 0.0


# Transitions: the same episodes as `evaluate`, frame by frame.


@pytest.fixture(scope="module")
def walkers():
    """Members that end early, late, or never."""
    return tree.stack(*(leaning(bias) for bias in (0.9, 0.02, -0.3)))


def leaning(bias):
    """A small network that mostly walks one way."""
    policy = MLP(hidden=(3,), initializer="uniform", output_scale=0.1).init(
        2, 1, key=jax.random.key(0)
    )
    return eqx.tree_at(lambda p: p.weights["b_1"], policy, jnp.array([bias]))


def lanes(experience, pop=POP):
    """Rows, episode by episode: `[lane][step]`."""
    rows = jax.tree.map(np.asarray, experience.transitions)
    if experience.valid is None:
        return rows
    shape = (pop * EPISODES, -1)
    valid = np.asarray(experience.valid).reshape(shape)
    rows = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), rows)
    return [jax.tree.map(lambda x, i=i: x[i, valid[i]], rows) for i in range(len(valid))]


def rows_of(experience):
    if experience.valid is None:
        return len(experience.transitions.obs)
    return int(jnp.sum(experience.valid))


@pytest.mark.parametrize(
    ("env", "name", "common"),
    [
        (Walk(), "mlp", True),
        (Copy(max_steps=3), "rnn", False),
        (Remember(delay=2), "rnn", True),
    ],
    ids=lambda x: str(x) if isinstance(x, str | bool) else type(x).__name__,
)
def test_collecting_changes_neither_returns_nor_steps(env, name, common):
    population, key = population_of(env, NETWORKS[name]), jax.random.key(7)
    played = rollout.evaluate(env, population, EPISODES, common=common, key=key)
    collected, experience = rollout.collect(env, population, EPISODES, common=common, key=key)
    assert_same(played, collected)
    assert int(jnp.sum(experience.valid)) == int(jnp.sum(played.steps))
    for lane, steps in zip(lanes(experience), np.asarray(played.steps).ravel(), strict=True):
        assert len(lane.obs) == steps


def test_noise_too_is_the_same_when_it_is_collected(walkers):
    explorers = Explorer(walkers, GaussianNoise(0.3), jnp.zeros(POP, bool), 1)
    explorers = eqx.tree_at(lambda e: e.noise.std, explorers, jnp.full(POP, 0.3))
    key = jax.random.key(1)
    played = rollout.evaluate(Walk(), explorers, EPISODES, key=key)
    collected, _ = rollout.collect(Walk(), explorers, EPISODES, key=key)
    assert_same(played, collected)
    assert len(np.unique(played.returns["reward"])) == POP * EPISODES


def test_rows_are_the_episodes_frame_by_frame(walkers):
    played, experience = rollout.collect(Walk(), walkers, EPISODES, key=jax.random.key(0))
    steps = np.asarray(played.steps).ravel()
    ends = []
    for i, lane in enumerate(lanes(experience)):
        np.testing.assert_allclose(lane.obs[0], [START, 0.0])
        np.testing.assert_array_equal(lane.next_obs[:-1], lane.obs[1:])
        np.testing.assert_allclose(lane.next_obs[:, 1], 0.1 * np.arange(1, steps[i] + 1), rtol=1e-6)
        np.testing.assert_allclose(lane.next_obs[:, 0], lane.rewards["reward"])
        policy = tree.take(walkers, i // EPISODES)
        expected = policy(jnp.asarray(lane.obs.T), ())[0].T
        np.testing.assert_allclose(lane.action, expected, atol=1e-6)
        for name, rewards in lane.rewards.items():
            total = float(np.asarray(played.returns[name]).ravel()[i])
            assert rewards.sum() == pytest.approx(total, rel=1e-5)
        # After the clock alone, learners bootstrap.
        assert not lane.terminated[:-1].any()
        assert lane.terminated[-1] == (np.abs(lane.next_obs[-1, 0]) > 1.0)
        assert lane.terminated[-1] or steps[i] == Walk.max_steps
        ends.append(bool(lane.terminated[-1]))
    assert len(set(ends)) == 2  # both ways to end were seen


@pytest.mark.parametrize("env", [Walk(), HostWalk()], ids=["jax", "host"])
def test_the_episodes_wanted_are_data(walkers, env):
    key = jax.random.key(0)
    every, _ = rollout.collect(env, walkers, EPISODES, common=False, key=key)
    rollout.collect(env, walkers, EPISODES, wanted=jnp.int32(4), common=False, key=key)
    with compilations() as events:
        some = [
            rollout.collect(env, walkers, EPISODES, wanted=n, common=False, key=key)
            for n in map(jnp.int32, (0, 1, 3))
        ]
        jax.block_until_ready([evaluation for evaluation, _ in some])
    assert events == []
    for n, (played, experience) in zip((0, 1, 3), some, strict=True):
        np.testing.assert_array_equal(played.steps[:, :n], every.steps[:, :n])
        assert not np.any(played.steps[:, n:])
        for name, returns in played.returns.items():
            np.testing.assert_allclose(returns[:, :n], every.returns[name][:, :n], rtol=1e-5)
            assert not np.any(returns[:, n:])
        assert rows_of(experience) == int(jnp.sum(played.steps))


def test_a_team_is_collected_with_its_private_rewards():
    teams = tree.stack(Towards(jnp.array([1.0, 1.0])), Towards(jnp.array([1.0, 0.0])))
    key = jax.random.key(0)
    played = rollout.evaluate(Meet(), teams, 2, key=key)
    collected, experience = rollout.collect(Meet(), teams, 2, key=key)
    assert_same(played, collected)
    assert experience.transitions.rewards["local"].shape[1:] == (2,)
    assert experience.transitions.obs.shape[1:] == (2, 2)
    assert int(jnp.sum(experience.transitions.terminated & experience.valid)) == 2


def test_a_host_task_plays_as_the_same_task_in_jax(walkers):
    key = jax.random.key(0)
    inside, frames = rollout.collect(Walk(), walkers, EPISODES, key=key)
    outside, rows = rollout.collect(HostWalk(), walkers, EPISODES, key=key)
    assert_same(inside, outside)
    assert_same(inside, rollout.evaluate(HostWalk(), walkers, EPISODES, key=key))
    assert rows.valid is None
    valid = np.asarray(frames.valid)
    for x, y in zip(
        jax.tree.leaves(frames.transitions), jax.tree.leaves(rows.transitions), strict=True
    ):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(np.asarray(x)[valid], y, atol=1e-5)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), rollout.blank(HostWalk())) == jax.tree.map(
        lambda x: (x.shape, x.dtype), rollout.blank(Walk())
    )


@pytest.mark.parametrize("env", [Walk(), HostWalk()], ids=["jax", "host"])
def test_a_member_that_acts_nan_has_a_nan_return_and_spoils_nobody_else(env):
    population = tree.stack(*(Constant(jnp.array([a])) for a in (0.1, jnp.nan, -0.1)))
    played, experience = rollout.collect(env, population, 2, key=jax.random.key(0))
    for returns in played.returns.values():
        assert np.isnan(returns).tolist() == [[False] * 2, [True] * 2, [False] * 2]
    assert np.isfinite(np.asarray(played.steps)).all()
    rows = jax.tree.map(np.asarray, experience.transitions)
    for leaf in jax.tree.leaves(rows):
        kept = leaf if experience.valid is None else leaf[np.asarray(experience.valid)]
        assert np.isfinite(kept).all()  # learners would never recover


class Broken(Walk):
    """A walk whose world says NaN beyond 0.5, in `what`."""

    what: str = eqx.field(static=True, default="obs")

    def step(self, state, action, *, key):
        state, step = super().step(state, action, key=key)
        nan = jnp.where(step.obs[0] > 0.5, jnp.nan, 0.0)
        if self.what == "obs":
            return state, eqx.tree_at(lambda s: s.obs, step, step.obs + nan)
        rewards = {name: reward + nan for name, reward in step.rewards.items()}
        return state, eqx.tree_at(lambda s: s.rewards, step, rewards)


@pytest.mark.parametrize("what", ["obs", "rewards"])
def test_a_jax_task_that_says_nan_spoils_no_buffer(what):
    population = constants(0.9, -0.1)
    played, experience = rollout.collect(Broken(what=what), population, 2, key=jax.random.key(0))
    for returns in played.returns.values():
        assert np.isnan(returns).tolist() == [[True] * 2, [False] * 2]
    valid = np.asarray(experience.valid)
    assert 0 < valid.sum() < int(played.steps.sum())
    for leaf in jax.tree.leaves(experience.transitions):
        assert np.isfinite(np.asarray(leaf)[valid]).all()
    returns = rollout.evaluate(Broken(what=what), population, 2, key=jax.random.key(0)).returns
    for name in returns:
        np.testing.assert_array_equal(returns[name], played.returns[name])


class InTurnWalk(HostWalk):
    at_once: int | None = eqx.field(static=True, default=None)

    def copies(self, n):
        return InTurn(Walkers(self.at_once, self.spread), n)


@pytest.mark.parametrize("at_once", [1, 3, 5])
def test_copies_in_turn_play_what_they_play_together(at_once):
    """Bit for bit, although a policy remembers; with members that end early, or act NaN."""
    weights = jnp.array([0.9, jnp.nan, -0.2, 0.1])
    population = eqx.filter_vmap(lambda w: Growing(w))(weights)
    key = jax.random.key(5)
    for wanted in (0, 2, 3):
        together = rollout.collect(HostWalk(spread=0.5), population, 3, wanted=wanted, key=key)
        env = InTurnWalk(spread=0.5, at_once=at_once)
        apart = rollout.collect(env, population, 3, wanted=wanted, key=key)
        for x, y in zip(jax.tree.leaves(together), jax.tree.leaves(apart), strict=True):
            np.testing.assert_array_equal(x, y)
        assert (wanted == 0) == (rows_of(apart[1]) == 0)
        lasted = delayed(env)
        assert lasted.at_once == at_once
        late = rollout.evaluate(lasted, population, 3, key=key)
        assert_same(late, rollout.evaluate(HostWalk(spread=0.5), population, 3, key=key))


class Growing(AbstractPolicy):
    """Its action grows from step to step."""

    weight: jax.Array

    def start(self, *, key):
        return jnp.float32(0.0)

    def __call__(self, obs, carry):
        return (carry + obs[:1]) * self.weight, carry + 0.1


class FailingWalkers(Walkers):
    """Breaks at reset where the seed is even, and at a step beyond 0.5."""

    def reset(self, seeds, active):
        obs = super().reset(seeds, active)
        self.failed = active & (seeds % 2 == 0)
        return np.where(self.failed[:, None], np.float32(0.0), obs)

    def step(self, actions, active):
        step = super().step(actions, active)
        assert not (active & self.failed).any()
        step.failed = active & (self.x > 0.5)
        return step


class FailingWalk(HostWalk):
    def copies(self, n):
        return FailingWalkers(n, self.spread)


def test_a_failed_episode_has_a_nan_return_and_is_discarded():
    env, population = FailingWalk(), constants(0.2, -0.1)
    played, experience = rollout.collect(env, population, 8, key=jax.random.key(0))
    steps = np.asarray(played.steps)
    begun = steps[1] > 0
    assert 0 < begun.sum() < 8  # of the others the reset failed
    np.testing.assert_array_equal(steps[0], np.where(begun, 3, 0))  # 0.25 + 3 * 0.1
    np.testing.assert_array_equal(steps[1], np.where(begun, 6, 0))
    for returns in played.returns.values():
        assert np.isnan(returns[0]).all()
        np.testing.assert_array_equal(np.isfinite(returns[1]), begun)
    assert rows_of(experience) == 6 * begun.sum()
    assert np.asarray(experience.transitions.obs)[:, 0].max() <= np.float32(START)
    returns = rollout.evaluate(env, population, 8, key=jax.random.key(0)).returns
    for name, other in returns.items():
        np.testing.assert_array_equal(other, played.returns[name])


class ByteWalkers(Walkers):
    def _obs(self):
        return np.uint8(255 * np.clip(super()._obs(), 0, 1))


class ByteWalk(HostWalk):
    obs_dtype: ClassVar[str] = "uint8"

    def copies(self, n):
        return ByteWalkers(n, self.spread)


class Divided(AbstractPolicy):
    weight: jax.Array

    def start(self, *, key):
        return None

    def __call__(self, obs, carry):
        assert obs.dtype == jnp.float32
        return self.weight * obs[:1] / 255.0, carry


def test_bytes_are_recorded_as_bytes_and_seen_as_numbers():
    population = eqx.filter_vmap(Divided)(jnp.array([0.2, -0.5]))
    played, experience = rollout.collect(ByteWalk(), population, 1, key=jax.random.key(0))
    rows = experience.transitions
    assert rows.obs.dtype == rows.next_obs.dtype == np.uint8
    assert rollout.blank(ByteWalk()).obs.dtype == jnp.uint8
    assert rows_of(experience) == int(played.steps.sum())
    np.testing.assert_allclose(rows.action[0, 0], 0.2 * 63 / 255, rtol=1e-6)


def test_seeds_of_a_host_task_follow_the_key():
    env = HostWalk(spread=0.5)
    twins = constants(0.1, 0.1)

    def starts(seed, common):
        played, experience = rollout.collect(
            env, twins, EPISODES, common=common, key=jax.random.key(seed)
        )
        assert np.all(np.asarray(played.steps) == env.max_steps)
        return np.asarray(experience.transitions.obs).reshape(2, EPISODES, -1, 2)[:, :, 0, 0]

    same, own = starts(0, True), starts(0, False)
    np.testing.assert_array_equal(same[0], same[1])
    assert len(np.unique(same)) == EPISODES
    assert len(np.unique(own)) == 2 * EPISODES
    np.testing.assert_array_equal(own, starts(0, False))
    assert not np.isin(own, starts(1, False)).any()


@pytest.mark.parametrize("env", [Walk(), HostWalk()], ids=["jax", "host"])
def test_a_delayed_task_pays_in_the_last_row(walkers, env):
    key = jax.random.key(0)
    plain, frames = rollout.collect(env, walkers, EPISODES, key=key)
    late, experience = rollout.collect(delayed(env), walkers, EPISODES, key=key)
    assert_same(plain, late)
    valid = slice(None) if frames.valid is None else np.asarray(frames.valid)
    before, after = (
        jax.tree.map(lambda x: np.asarray(x)[valid], e.transitions) for e in (frames, experience)
    )
    assert len(after.obs) == int(jnp.sum(plain.steps))
    assert np.count_nonzero(after.rewards["reward"]) == POP * EPISODES
    np.testing.assert_array_equal(after.obs, before.obs)
    np.testing.assert_array_equal(after.terminated, before.terminated)


@pytest.mark.parametrize("env", [Walk(), HostWalk()], ids=["jax", "host"])
def test_spread_returns_are_equal_parts_of_what_was_paid(env):
    """A frame of an episode gets its return over its length; lost episodes leave no frame."""
    population = tree.stack(*(Constant(jnp.array([a])) for a in (0.5, jnp.nan, 0.9, -0.2)))
    played, experience = rollout.collect(delayed(env), population, 2, key=jax.random.key(1))
    spread = experience.spread(played)
    valid = slice(None) if spread.valid is None else np.asarray(spread.valid)
    before, reward = (
        np.asarray(x.transitions.rewards["reward"])[valid] for x in (experience, spread)
    )
    kept = [0, 1, 4, 5, 6, 7]
    steps = np.asarray(played.steps).ravel()[kept]
    returns = np.asarray(played.returns["reward"]).ravel()[kept]
    assert len(set(steps)) == 3
    np.testing.assert_allclose(reward, np.repeat(returns / steps, steps), rtol=1e-6)
    assert np.count_nonzero(before) == 6  # the task paid at the end of each
    np.testing.assert_array_equal(spread.transitions.obs, experience.transitions.obs)


class Started(Slow):
    """Acts by chance too: its start is drawn."""

    def start(self, *, key):
        return jax.random.normal(key), self.inner.start(key=key)

    def __call__(self, obs, carry):
        action, inner = self.inner(obs, carry[1])
        return action + carry[0], (carry[0], inner)


@pytest.mark.parametrize("common", [True, False])
def test_large_policies_play_in_turn_what_they_play_together(common, monkeypatch):
    population = eqx.filter_vmap(Started)(population_of(Copy(), MLP(hidden=(3,))))
    key, weights = jax.random.key(3), 3 * Copy().obs_size + 3 + 3 + 1
    together = rollout.evaluate(Copy(), population, EPISODES, common=common, key=key)
    monkeypatch.setattr(tree, "CACHED", 2 * weights)
    assert tree.batch(population) == 2  # of three
    apart = rollout.evaluate(Copy(), population, EPISODES, common=common, key=key)
    np.testing.assert_allclose(apart.returns["reward"], together.returns["reward"], atol=1e-5)
    assert np.unique(np.asarray(apart.returns["reward"])).size >= POP * EPISODES - 2  # some are cut


# Recording: the episode that `evaluate` plays, moment by moment.


RECORDED = {
    "rovers": (Rover(coupling=2, rovers=3, pois=2, size=8.0, max_steps=9), Team((4,))),
    "fleet": (ServerFleet.case_study(), DMMU(hidden=3, order="random")),
    "noise": (delayed(NoisyObservations(RECALL, 0.1)), MMU(hidden=3)),
    "shortened": (Shortened(CLASSIFICATION, 1), Recurrent("lstm", 3)),
    "outside": (delayed(HostWalk(spread=0.5)), Recurrent("gru", 3)),
}


@pytest.mark.parametrize("name", RECORDED)
def test_what_is_recorded_is_what_evaluation_plays(name):
    env, network = RECORDED[name]
    policy = network.init(*env.sizes, key=jax.random.key(1))
    for seed in range(3, 6):
        trace = rollout.record(env, policy, key=jax.random.key(seed))
        played = rollout.evaluate(env, tree.stack(policy), 1, key=jax.random.key(seed))
        steps = int(trace.length)
        assert played.steps.item() == steps == len(trace.actions)
        assert trace.terminated != trace.truncated
        seen = jax.tree.leaves((trace.observations, trace.states, trace.carries))
        assert {len(x) for x in seen} == {steps + 1}
        assert all(isinstance(x, np.ndarray | np.generic) for x in jax.tree.leaves(trace))
        assert np.abs(trace.actions).max() <= 1.0
        for reward, paid in trace.rewards.items():
            np.testing.assert_allclose(
                paid.sum(axis=0), played.returns[reward][0, 0], rtol=1e-5, atol=1e-6
            )


def test_a_carry_leads_from_each_observation_to_the_action():
    env, network = RECORDED["outside"]
    policy = network.init(*env.sizes, key=jax.random.key(1))
    for task in (env, delayed(Walk())):
        trace = rollout.record(task, policy, key=jax.random.key(0))
        actions, carries = read(policy, trace.observations[:-1])
        np.testing.assert_allclose(actions, trace.actions, atol=1e-6)
        np.testing.assert_allclose(carries, trace.carries[1:], atol=1e-6)


def test_a_padded_record_holds_the_same_under_vmap():
    env, network = RECORDED["rovers"]
    policy = network.init(*env.sizes, key=jax.random.key(1))
    keys = jax.random.split(jax.random.key(0), 3)
    padded = jax.vmap(lambda key: rollout.record(env, policy, key=key, padded=True))(keys)
    assert padded.actions.shape[:2] == (3, env.max_steps)
    for i, key in enumerate(keys):
        one = jax.tree.map(lambda x, i=i: x[i], padded).cut()
        alone = rollout.record(env, policy, key=key)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5)


def test_a_record_outside_jax_takes_a_seed_and_is_seen_at_every_moment():
    seen = []
    policy = MLP((3,)).init(2, 1, key=jax.random.key(0))
    trace = rollout.record(HostWalk(), policy, key=jax.random.key(0), seed=5, see=seen.append)
    assert seen == [False] * int(trace.length) + [True]
    with pytest.raises(EnvironmentFailure, match="the episode failed, or its policy said NaN"):
        rollout.record(HostWalk(), Constant(jnp.full(1, jnp.nan)), key=jax.random.key(0))


def test_the_task_within_is_one_property_away():
    assert delayed(NoisyObservations(RECALL, 0.1)).unwrapped is RECALL
    assert Shortened(CLASSIFICATION, 1).unwrapped is CLASSIFICATION
    host = HostWalk()
    assert delayed(delayed(host)).unwrapped is host
    assert host.unwrapped is host
