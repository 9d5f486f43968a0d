"""How late returns are paid: in equal parts, or as a model says; always the whole return."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from walk import HostWalk, Walk

from credo import rollout, tree
from credo.algorithms.erl import ERL
from credo.algorithms.merl import MERL
from credo.algorithms.off_policy import OffPolicy
from credo.cli.line import Line
from credo.environments.probes import Copy, Meet
from credo.environments.wrappers import delayed
from credo.learners.credit import Even
from credo.learners.decomposed import Decomposed
from credo.learners.differences import Differences, _pieces
from credo.learners.predicted import Episodes, Part
from credo.learners.td3 import TD3
from credo.networks.base import AbstractPolicy
from credo.networks.mlp import MLP, Critic
from credo.networks.recurrent import Recurrent
from credo.networks.team import JointCritic, Team
from credo.normalization import Moments
from credo.replay import Replay
from credo.rollout import Experience
from credo.runs import config, loop
from credo.types import Evaluation, Transition

LEARNER = TD3(critic=Critic(hidden=(4,)), batch_size=4)
NETWORK = MLP((4,))
SMALL_MODEL = Decomposed(Critic((4,)), steps=4, memory=8, refresh=1)
SMALL_READER = Differences(Recurrent("gru", 3, "tanh"), pieces=4, memory=8, updates_per_frame=0.1)
SLOW = [SMALL_MODEL, pytest.param(SMALL_READER, marks=pytest.mark.slow)]


def rows(rewards, obs=None):
    """Transitions of one agent with these rewards."""
    n = len(rewards)
    obs = np.zeros((n, 1), np.float32) if obs is None else np.asarray(obs, np.float32).reshape(n, 1)
    flags = np.zeros(n, bool)
    rewards = {"r": np.asarray(rewards, np.float32)}
    return Transition(obs, np.zeros((n, 1), np.float32), rewards, obs, flags, flags)


def two(host):
    """Two episodes: one of three steps that pays early, one of two that pays at its end."""
    played = Evaluation({"r": jnp.asarray([[6.0], [4.0]])}, jnp.asarray([[3], [2]]))
    if host:
        return played, Experience(rows([1, 2, 3, 0, 4]), None)
    padded = jax.tree.map(jnp.asarray, rows([1, 2, 3, 0, 4, 9]))
    return played, Experience(padded, jnp.asarray([True] * 5 + [False]))


@pytest.mark.parametrize("host", [True, False])
def test_equal_parts_may_be_of_late_episodes_alone(host):
    played, experience = two(host)
    assert list(experience.late(played, "r")) == [False, True]
    for late_only, paid in ((True, [1, 2, 3, 2, 2]), (False, [2, 2, 2, 2, 2])):
        stored = Even(late_only).stored(experience, played)
        np.testing.assert_array_equal(stored.transitions.rewards["r"][:5], paid)


@pytest.mark.parametrize("env", [Walk(), HostWalk()], ids=["jax", "host"])
def test_a_dense_task_keeps_its_rewards_and_a_late_one_does_not(env):
    population = tree.stack(*(Acting(jnp.array([a])) for a in (0.5, jnp.nan, 0.9, -0.2)))
    key = jax.random.key(1)
    played, experience = rollout.collect(env, population, 2, key=key)
    kept = Even(late_only=True).stored(experience, played)
    late_played, late = rollout.collect(delayed(env), population, 2, key=key)
    valid = slice(None) if kept.valid is None else np.asarray(kept.valid)
    for name in env.signals:
        before, after = (x.transitions.rewards[name][valid] for x in (experience, kept))
        np.testing.assert_array_equal(before, after)
        spread = (Even(x).stored(late, late_played) for x in (True, False))
        np.testing.assert_array_equal(*(x.transitions.rewards[name][valid] for x in spread))
    assert list(experience.lived(played)) == list(late.lived(late_played))


class Acting(AbstractPolicy):
    """The same action for ever."""

    action: jax.Array

    def start(self, *, key):
        return ()

    def __call__(self, obs, carry):
        return self.action, carry


def test_episodes_of_a_buffer_are_found_until_they_are_overwritten():
    ring = Episodes.none(3)
    ints = jnp.asarray([2, 0, 3], jnp.int32)  # the second one is lost
    values, late = jnp.asarray([1.0, jnp.nan, 2.0]), jnp.asarray([True, True, False])
    ring = ring.after(jnp.int32(5), ints, values, late)
    assert ring.start.tolist()[:2] == [0, 2]
    assert ring.length.tolist() == [2, 3, 0]
    assert (int(ring.written), int(ring.fresh)) == (2, 2)
    ring = ring.after(jnp.int32(13), jnp.asarray([4, 4]), jnp.asarray([3.0, 4.0]), late[:2])
    assert ring.start.tolist() == [9, 2, 5]  # the newest took the place of the oldest
    assert ring.value.tolist() == [4.0, 2.0, 3.0]
    replay = Replay(rows(np.zeros(8)), jnp.int32(13))
    assert ring.whole(replay).tolist() == [True, False, True]  # the second is not late
    assert ring.whole(dataclasses.replace(replay, written=jnp.int32(14))).tolist()[2] is False
    # A buffer that was lost begins anew: what is remembered of it is forgotten.
    anew = ring.after(jnp.int32(4), jnp.asarray([4]), jnp.asarray([5.0]), late[:1])
    assert anew.length.tolist() == [0, 4, 0]


class Told(Decomposed):
    """Knows the reward: it is the observation."""

    def rewards(self, model, part):
        return part.every()[0][..., 0]


def paid_by(how, replay, episodes, steps):
    """What each row is paid, once `how` has looked at these episodes."""
    env = Copy(max_steps=steps)
    known = how.init(env, len(episodes), replay.capacity, key=jax.random.key(0))
    lengths, values, late = map(jnp.asarray, zip(*episodes, strict=True))
    ring = known.episodes.after(replay.written, lengths, values, late)
    known = dataclasses.replace(known, episodes=ring, signal="r")
    paid = dataclasses.replace(known.paid.data, rewards={"r": jnp.zeros(replay.capacity)})
    known = dataclasses.replace(known, paid=Replay(paid, jnp.int32(0)))
    frames = jnp.int32(0)
    known, seen, metrics = how.taught(known, replay, None, frames, key=jax.random.key(1))
    return known, np.asarray(seen.data.rewards["r"]), metrics


def test_what_a_model_leaves_of_a_return_is_paid_in_equal_parts():
    """Around the end of a ring; an episode that is not late keeps its rewards."""
    true, said = [0, 8, 1, 1, 0, 0, 30], [2, 3, 9, 9, 1, 3, 5]
    # Rows 3 to 9 of all that were written, in a ring of eight: row 9 lies in slot 1.
    ring = jax.tree.map(
        lambda x: jnp.asarray(np.roll(np.resize(x, (8, *x.shape[1:])), 3, axis=0)), rows(true, said)
    )
    replay = Replay(ring, jnp.int32(10))
    episodes = [(2, 8.0, True), (2, 2.0, False), (3, 30.0, True)]
    known, paid, metrics = paid_by(Told(Critic((4,))), replay, episodes, 3)
    # Returns per frame are 4, 4, 10, 10, 10: standard deviation √8.64, by which `said` counts.
    unit = np.sqrt(8.64)
    first = unit * np.array([2, 3]) + (8 - 5 * unit) / 2
    last = unit * np.array([1, 3, 5]) + (30 - 9 * unit) / 3
    np.testing.assert_allclose(np.roll(paid, -3)[:7], [*first, 1, 1, *last], rtol=1e-5)
    assert known.episodes.fresh == 0
    assert metrics["redistribution_loss"] < 0  # nothing: there was no update
    np.testing.assert_array_equal(replay.data.rewards["r"], ring.rewards["r"])


def episodes_of(n=60, steps=20):
    """A buffer of episodes of a reward that is linear in the observation, paid at their ends."""
    draw = np.random.default_rng(0)
    lengths = draw.integers(steps // 2, steps + 1, n)
    level = np.repeat(draw.normal(size=n), lengths)
    obs = draw.normal(size=lengths.sum()) + level
    true, ends = 1.0 + 2.0 * obs, np.cumsum(lengths)
    values = np.add.reduceat(true, ends - lengths)
    late = np.zeros_like(true)
    late[ends - 1] = values
    replay = Replay(jax.tree.map(jnp.asarray, rows(late, obs)), jnp.int32(lengths.sum()))
    told = [(int(length), float(v), True) for length, v in zip(lengths, values, strict=True)]
    return replay, told, true, ends - lengths


@pytest.mark.parametrize(
    ("how", "frames", "least"),
    [
        (Decomposed(Critic((32,)), learning_rate=3e-3, updates_per_frame=1.0), 600, 0.95),
        (Differences(learning_rate=1e-2, updates_per_frame=1.0), 300, 0.3),
    ],
    ids=["decomposed", "differences"],
)
def test_a_model_finds_out_what_each_step_was_worth(how, frames, least):
    replay, episodes, true, starts = episodes_of()
    lengths, values, late = map(jnp.asarray, zip(*episodes, strict=True))
    known = how.init(Copy(max_steps=20), len(episodes), replay.capacity, key=jax.random.key(0))
    known = dataclasses.replace(known, signal="r")
    ring = known.episodes.after(replay.written, lengths, values, late)
    data = dataclasses.replace(known.paid.data, rewards={"r": known.paid.data.rewards["reward"]})
    known = dataclasses.replace(known, episodes=ring, paid=Replay(data, jnp.int32(0)))
    given = (replay, None, jnp.int32(frames))
    known, seen, metrics = how.taught(known, *given, key=jax.random.key(1))
    paid = np.asarray(seen.data.rewards["r"])
    assert metrics["redistribution_loss"] < 1.0
    even = np.repeat(np.asarray(values) / np.asarray(lengths), np.asarray(lengths))
    inside = np.corrcoef(paid - even, true - even)[0, 1]  # equal parts would have no correlation
    assert inside > least
    np.testing.assert_allclose(np.add.reduceat(paid, starts), values, rtol=1e-4, atol=1e-3)


class Sum(AbstractPolicy):
    """Says the sum of the first number that it has read, in its own unit."""

    def start(self, *, key):
        return jnp.float32(0.0)

    def __call__(self, obs, carry):
        carry = carry + obs[0]
        return carry[None] / 4.0, carry


def test_differences_of_what_is_said_are_paid_piece_by_piece():
    obs = np.arange(1.0, 8.0)
    replay = Replay(jax.tree.map(jnp.asarray, rows(np.zeros(7), obs)), jnp.int32(7))
    part = Part(replay, None, jnp.asarray([0, 5]), jnp.asarray([5, 2]), 5)
    whose, read = _pieces(part, 2)
    assert read.tolist() == [2, 2]
    assert jnp.argmax(whose, axis=2).tolist()[0] == [0, 0, 0, 1, 1]
    paid = Differences(pieces=2).rewards(Sum(), part)
    # Means of the pieces 1, 2, 3 and 4, 5 are 2 and 4.5, in equal parts over their steps.
    np.testing.assert_allclose(paid[0], [2 / 3] * 3 + [2.25] * 2, rtol=1e-6)
    np.testing.assert_allclose(paid[1], [6, 7, 0, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(Differences(pieces=9).rewards(Sum(), part)[0], obs[:5], rtol=1e-6)


def test_models_see_observations_as_learners_do():
    replay = Replay(jax.tree.map(jnp.asarray, rows(np.zeros(4), [1, 2, 3, 4])), jnp.int32(4))
    moments = Moments(jnp.int32(1), jnp.asarray([2.0]), jnp.asarray([4.0]))
    part = Part(replay, moments, jnp.asarray([1]), jnp.asarray([2]), 2)
    obs, action, after = part.every()
    np.testing.assert_allclose(obs[0, :, 0], [0.0, 0.5], atol=1e-6)
    np.testing.assert_array_equal(obs, after)
    assert action.shape == (1, 2, 1)


# In algorithms.


def alone(env, how, **more):
    settings = {"episodes": 2, "start_frames": 0, "replay_capacity": 60, "test_episodes": 2}
    return OffPolicy(env, NETWORK, LEARNER, redistribute=how, **settings | more)


@pytest.mark.parametrize("how", [None, Even(), *SLOW], ids=lambda x: type(x).__name__)
def test_fitness_is_the_true_return_however_it_is_paid(how):
    settings = {"population_size": 4, "elite_fraction": 0.25, "warmup_frames": 0}
    erl = ERL.erl(delayed(Copy()), NETWORK, learners=(LEARNER,), redistribute=how, **settings)
    state, key = erl.init(key=jax.random.key(0)), jax.random.key(1)
    given = (erl.env, state.population, erl.episodes)
    true = rollout.evaluate(*given, key=jax.random.split(key, 6)[0]).of("reward")
    generation = jax.jit(erl.generation)
    state, metrics = generation(state, key=key)
    assert metrics["fitness_max"] == pytest.approx(float(jnp.max(jnp.mean(true, axis=1))), rel=1e-5)
    state, metrics = generation(state, key=jax.random.key(2))
    assert np.isfinite(metrics["critic_loss_0"])
    if state.known is not None:
        kept = np.asarray(state.replay.data.rewards["reward"])[: int(state.replay.written)]
        paid = np.asarray(state.known.paid.data.rewards["reward"])[: len(kept)]
        assert np.count_nonzero(kept) == len(kept) / 10  # the buffer keeps what was paid
        np.testing.assert_allclose(
            kept.reshape(-1, 10).sum(axis=1), paid.reshape(-1, 10).sum(axis=1), rtol=1e-4
        )
        assert np.count_nonzero(paid) == len(paid)


@pytest.mark.parametrize("how", SLOW, ids=lambda x: type(x).__name__)
def test_a_dense_task_is_paid_as_ever_and_no_model_learns(how):
    outcomes = []
    for one in (None, how):
        algorithm = alone(HostWalk(spread=0.5), one)
        state = algorithm.init(key=jax.random.key(0))
        for g in range(3):
            state, metrics = algorithm.generation(state, key=jax.random.key(g))
        outcomes.append(state)
        assert metrics.get("redistribution_loss", -1.0) < 0.0
    plain, more = outcomes
    leaves = (jax.tree.leaves(eqx.filter(x.learner, eqx.is_array)) for x in outcomes)
    assert all(np.array_equal(x, y) for x, y in zip(*leaves, strict=True))
    np.testing.assert_array_equal(
        plain.replay.data.rewards["reward"], more.known.paid.data.rewards["reward"]
    )


@pytest.mark.parametrize("how", SLOW, ids=lambda x: type(x).__name__)
def test_nothing_compiles_after_the_first_generations(how):
    algorithm = alone(delayed(HostWalk(spread=0.5)), how, normalize_observations=True)
    state = algorithm.init(key=jax.random.key(0))
    for g in range(12):
        with compilations() as events:
            state, metrics = algorithm.generation(state, key=jax.random.key(g))
        assert g < 3 or events == []
    assert int(state.replay.written) > 60  # around the ring
    assert np.isfinite(metrics["redistribution_loss"])
    assert metrics["redistribution_loss"] >= 0.0


@pytest.mark.parametrize("how", SLOW, ids=lambda x: type(x).__name__)
def test_a_run_goes_on_to_the_same_bits(how, tmp_path):
    algorithm = alone(delayed(Copy()), how, test_every=20)
    quiet = {"tensorboard": False, "progress": False, "checkpoint_every": 0.0}
    straight = loop.train(algorithm, generations=6, path=tmp_path / "straight", **quiet)
    loop.train(algorithm, generations=3, path=tmp_path / "halves", **quiet)
    halves = loop.resume(tmp_path / "halves", generations=6, tensorboard=False, progress=False)
    names = ["metrics.csv", "champion.safetensors"]
    for name in names:
        assert (straight.path / name).read_bytes() == (halves.path / name).read_bytes()
    ends = [max((run.path / "checkpoints").glob("[0-9]*")) for run in (straight, halves)]
    assert ends[0].name == ends[1].name
    files = [{f.name: f.read_bytes() for f in end.iterdir()} for end in ends]
    assert files[0].keys() == files[1].keys()
    assert all(files[0][n] == files[1][n] for n in files[0] if n.endswith("safetensors"))


def test_teams_are_redistributed_where_all_are_paid_one_reward():
    small = {"population_size": 5, "episodes": 2, "workers": 2, "warmup_frames": 0}
    env, network = delayed(Meet()), Team(head=MLP((4,)))
    learner = TD3(critic=Critic((4,)), batch_size=4, signal="global")
    merl = MERL(env, network, (learner,), redistribute=SMALL_MODEL, **small)
    state = merl.init(key=jax.random.key(0))
    state, metrics = jax.jit(merl.generation)(state, key=jax.random.key(1))
    assert state.known.signal == "global"
    assert metrics["redistribution_loss"] >= 0.0
    private = dataclasses.replace(SMALL_MODEL, signal="local")
    with pytest.raises(ValueError, match="'local' is paid to each agent apart"):
        dataclasses.replace(merl, redistribute=private).init(key=jax.random.key(0))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Decomposed(steps=0), "steps is 0"),
        (lambda: Decomposed(memory=0), "memory is 0"),
        (lambda: Decomposed(refresh=-1), "refresh is -1"),
        (lambda: Decomposed(JointCritic()), "JointCritic sees a team"),
        (lambda: Differences(pieces=0), "pieces is 0"),
        (lambda: Differences(Team()), "Team acts for a team"),
        (lambda: alone(Copy(), Decomposed(signal="x")).init(key=jax.random.key(0)), "signal 'x'"),
    ],
)
def test_bad_redistributions_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("even --redistribute.late-only", Even(late_only=True)),
        ("none", None),
        ("decomposed --redistribute.steps 16", Decomposed(steps=16)),
        ("differences --redistribute.pieces 7", Differences(pieces=7)),
    ],
)
def test_the_command_line_and_a_record_know_them(words, expected):
    taken = Line("train", ["--redistribute", *words.split()]).take(alone(Copy(), None))
    assert taken.redistribute == expected
    assert config.from_tree(json.loads(json.dumps(config.to_tree(taken)))) == taken


def test_records_of_before_are_read():
    for value, how in ((True, Even()), (False, None)):
        old = config.to_tree(alone(Copy(), None)) | {"redistribute": value}
        assert config.from_tree(old).redistribute == how
        assert config.changed(old, config.to_tree(alone(Copy(), how))) == []
