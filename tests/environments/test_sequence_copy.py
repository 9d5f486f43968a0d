"""Copy and Repeat Copy against sequences written by hand, and their two ways to be played."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import rollout
from credo.algorithms.bptt import BPTT, loss_of
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.base import CERTAIN, cross_entropy
from credo.environments.checks import check_environment
from credo.environments.sequence_copy import RepeatCopy, SequenceCopy
from credo.environments.wrappers import Shortened
from credo.networks.mlp import MLP
from credo.networks.recurrent import Recurrent

COPY = SequenceCopy(bits=2, max_length=3)
REPEAT = RepeatCopy(bits=2, max_length=3, max_repeats=2)
TASKS = {"copy": COPY, "repeat": REPEAT, "one bit": SequenceCopy(bits=1, max_length=2)}
VECTORS = jnp.array([[1.0, 0.0], [1.0, 1.0], [0.0, 0.0]])


def test_a_copy_step_by_step():
    drawn = jax.tree.map(np.asarray, COPY.lay_out(VECTORS, jnp.int32(2)))
    #                        bits     delimiter, silence          padding
    assert drawn.inputs[:, 0].tolist() == [1, 1, 0, 0, 0, 0, 0]
    assert drawn.inputs[:, 1].tolist() == [0, 1, 0, 0, 0, 0, 0]
    assert drawn.inputs[:, 2].tolist() == [0, 0, 1, 0, 0, 0, 0]
    assert drawn.scored.tolist() == [False] * 3 + [True] * 2 + [False] * 2
    assert drawn.targets.tolist() == [[0, 0]] * 3 + [[1, -1], [1, 1]] + [[0, 0]] * 2
    assert drawn.length == 5


def test_repeats_step_by_step():
    drawn = jax.tree.map(np.asarray, REPEAT.lay_out(VECTORS, jnp.int32(2), jnp.int32(2)))
    assert REPEAT.max_steps == 11
    # Two vectors, delimiter with the number 2 of 1..2 (+1 normalised), two copies, end marker.
    assert drawn.inputs[:, :2].tolist() == [[1, 0], [1, 1], *[[0, 0]] * 9]
    assert drawn.inputs[:, 2].tolist() == [0, 0, 1, *[0] * 8]
    assert drawn.inputs[:, 3].tolist() == [0, 0, 1, *[0] * 8]
    once = [[1, -1, -1], [1, 1, -1]]
    assert drawn.targets[3:].tolist() == [*once, *once, [-1, -1, 1], *[[0, 0, 0]] * 3]
    assert drawn.scored.tolist() == [False] * 3 + [True] * 5 + [False] * 3
    assert drawn.length == 8


def test_numbers_of_repeats_have_mean_0_and_variance_1():
    task = RepeatCopy(bits=1, max_length=1, min_repeats=2, max_repeats=6)
    lay_out = jax.vmap(lambda r: task.lay_out(jnp.ones((1, 1)), jnp.int32(1), r))
    told = np.asarray(lay_out(jnp.arange(2, 7)).inputs[:, 1, 2])
    assert told.mean() == pytest.approx(0.0, abs=1e-6)
    assert told.var() == pytest.approx(1.0, rel=1e-5)
    assert task.obs_range == (pytest.approx(told[0]), pytest.approx(told[-1]))
    alone = RepeatCopy(bits=1, max_length=1, min_repeats=3, max_repeats=3)
    assert alone.obs_range == (0.0, 1.0)


@pytest.mark.parametrize("name", TASKS)
def test_the_checker_finds_nothing_wrong(name):
    assert check_environment(TASKS[name]) == []


def test_lengths_repeats_and_bits_are_drawn_evenly():
    sample = jax.jit(jax.vmap(lambda key: REPEAT.sample(key=key)))
    drawn = jax.tree.map(np.asarray, sample(jax.random.split(jax.random.key(0), 600)))
    n = drawn.inputs[:, :, 2].argmax(axis=1)
    r = (drawn.length - n - 2) // n
    pairs = {(i, j): np.mean((n == i) & (r == j)) for i in (1, 2, 3) for j in (1, 2)}
    assert sum(pairs.values()) == pytest.approx(1.0)
    assert all(share == pytest.approx(1 / 6, abs=0.06) for share in pairs.values())
    bits = np.concatenate([x[:k, :2].ravel() for x, k in zip(drawn.inputs, n, strict=True)])
    assert bits.mean() == pytest.approx(0.5, abs=4 * 0.5 / math.sqrt(bits.size))


def test_cross_entropy_is_that_of_probabilities_and_finite():
    answer, target = np.meshgrid(np.linspace(-0.9, 0.9, 7), np.linspace(-1.0, 1.0, 5))
    p, q = (answer + 1) / 2, (target + 1) / 2
    by_hand = -q * np.log(p) - (1 - q) * np.log(1 - p)
    found = cross_entropy(jnp.float32(answer), jnp.float32(target))
    np.testing.assert_allclose(found, by_hand, rtol=1e-4)
    wrong = jnp.array([-1.0, 1.0])
    worst = jax.vmap(jax.value_and_grad(cross_entropy))(wrong, -wrong)
    np.testing.assert_allclose(worst[0], -math.log(CERTAIN), rtol=0.01)
    assert np.isfinite(worst[1]).all()


def walk(task, key, answers):
    """Sums of all rewards of an episode."""
    state, time_step = task.reset(key=key)
    step, sums = eqx.filter_jit(task.step), dict.fromkeys(task.signals, 0.0)
    while not time_step.terminated:
        state, time_step = step(state, answers[int(state.step)], key=key)
        sums = {name: sums[name] + float(r) for name, r in time_step.rewards.items()}
    return sums


@pytest.mark.parametrize("name", TASKS)
def test_returns_are_minus_bits(name):
    task, key = TASKS[name], jax.random.key(5)
    drawn = task.sample(key=key)
    asked = int(drawn.scored.sum()) * task.action_size
    targets = np.asarray(drawn.targets)
    best = walk(task, key, targets)
    assert best["fitness"] == pytest.approx(0.0, abs=1e-3)
    assert (best["accuracy"], best["success"]) == (pytest.approx(1.0), 1.0)
    nothing = walk(task, key, 0 * targets)
    assert nothing["fitness"] == pytest.approx(-asked, rel=1e-5)
    assert nothing["accuracy"] == pytest.approx(float((targets > 0).sum()) / asked)
    flipped = targets.copy()
    flipped[int(drawn.scored.argmax()), 0] *= -1
    one_wrong = walk(task, key, flipped)
    assert one_wrong["accuracy"] == pytest.approx(1 - 1 / asked)
    assert one_wrong["fitness"] == pytest.approx(math.log2(CERTAIN), rel=0.01)
    assert one_wrong["success"] == 0


@pytest.mark.parametrize("name", TASKS)
def test_answered_together_is_played_step_by_step(name):
    """The fast path of features-first networks, and episodes of a network that is not known as
    one."""
    task = TASKS[name]
    network = Recurrent("lstm", 3, initializer="normal")
    keys = jax.random.split(jax.random.key(1), 3)
    population = eqx.filter_vmap(lambda key: network.init(*task.sizes, key=key))(keys)
    together = rollout.evaluate(task, population, 4, key=jax.random.key(2))
    played, _ = rollout.collect(task, population, 4, key=jax.random.key(2))
    assert set(together.returns) == set(task.signals)
    for signal in task.signals:
        np.testing.assert_allclose(together.returns[signal], played.returns[signal], rtol=1e-4)
    np.testing.assert_array_equal(together.steps, played.steps)
    assert np.std(together.returns["fitness"]) > 0.1


def test_a_cut_copy_has_as_many_answers():
    cut = Shortened(COPY, 1)
    drawn = cut.sample(key=jax.random.key(3))
    assert (cut.action_size, int(drawn.scored.sum())) == (2, 1)
    targets, asked = cut.lesson(drawn)
    assert targets.shape == asked.shape == (7, 2)
    assert int(asked.sum()) == 2


@pytest.mark.parametrize("preset", [Neuroevolution.as_written, Neuroevolution.ours])
def test_it_can_be_evolved(preset):
    algorithm = preset(COPY, Recurrent("gru", 2), population_size=10, episodes=2, test_episodes=2)
    state = algorithm.init(key=jax.random.key(0))
    _, metrics = algorithm.generation(state, key=jax.random.key(1))
    assert np.isfinite(float(metrics["champion_score"]))


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_the_loss_of_undecided_answers_is_a_bit_each(reduction):
    bptt = BPTT(COPY, loss="cross_entropy", reduction=reduction, batch_size=8, test_episodes=2)
    bptt = eqx.tree_at(lambda b: b.learning_rate, bptt, 0.0)
    batch = bptt.batch(jax.random.key(0), key=jax.random.key(1))
    policy = MLP((2,)).init(*COPY.sizes, key=jax.random.key(0))
    zero = jax.tree.map(jnp.zeros_like, policy)
    bits = 2 * int(batch.scored.sum())
    scale = 1 if reduction == "mean" else bits
    assert float(loss_of(zero, bptt, batch)) == pytest.approx(scale * math.log(2), rel=1e-5)
    state = bptt.init(key=jax.random.key(0))
    state = eqx.tree_at(lambda s: s.champion, state, jax.tree.map(jnp.zeros_like, state.champion))
    _, metrics = bptt.generation(state, key=jax.random.key(1))
    assert 2 <= float(metrics["bits"]) <= 6
    asked = 8 * float(metrics["bits"])
    assert asked == pytest.approx(round(asked), abs=1e-3)


def test_it_learns_one_vector_by_gradient():
    task = SequenceCopy(bits=2, max_length=1)
    bptt = BPTT.ours(task, Recurrent("lstm", 8), loss="cross_entropy", test_episodes=20)
    state = bptt.init(key=jax.random.key(0))
    bits = []
    for g in range(6):
        state, metrics = bptt.generation(state, key=jax.random.key(g))
        bits.append(float(metrics["bits"]))
    assert bits[0] > 0.5
    assert bits[-1] < 0.1
    assert float(metrics["champion_score"]) == 1.0


@pytest.mark.parametrize(
    ("build", "told"),
    [
        (lambda: SequenceCopy(bits=0), "bits is 0"),
        (lambda: SequenceCopy(min_length=0), "min_length is 0"),
        (lambda: SequenceCopy(min_length=3, max_length=2), "min_length is 3 and max_length is 2"),
        (lambda: RepeatCopy(bits=0), "bits is 0"),
        (lambda: RepeatCopy(min_repeats=0), "min_repeats is 0"),
        (lambda: RepeatCopy(min_repeats=3, max_repeats=2), "min_repeats is 3 and max_repeats is 2"),
        (lambda: BPTT(COPY, loss="l2"), "loss is 'l2'.*cross_entropy, smooth_l1"),
    ],
)
def test_impossible_tasks_are_refused(build, told):
    with pytest.raises(ValueError, match=told):
        build()
