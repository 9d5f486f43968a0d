"""Sequence Classification against Figure 3.3 and numbers worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.environments.base import correct
from credo.environments.sequence_classification import SequenceClassification

DRAWS = 400


@pytest.fixture(scope="module")
def drawn():
    """Many 21-deep sequences, on the host."""
    task = SequenceClassification(depth=21)
    keys = jax.random.split(jax.random.key(0), DRAWS)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda key: task.sample(key=key)))(keys))


def laid_out(task, signals, gaps=None, **kwargs):
    gaps = [task.min_gap] * len(signals) if gaps is None else gaps
    return task.lay_out(jnp.array(signals, jnp.float32), jnp.array(gaps), **kwargs)


# The rows of Figure 3.3: signals, and the target output at each of them.
FIGURE = [
    ([-1, 1, -1], [-1, 1, -1]),
    ([-1, -1, 1], [-1, -1, -1]),
    ([-1, 1, 1], [-1, 1, 1]),
    ([1, 1, -1], [1, 1, 1]),
]


@pytest.mark.parametrize(("signals", "classes"), FIGURE)
def test_figure_3_3(signals, classes):
    task = SequenceClassification(depth=3, min_gap=1, max_gap=2)
    sequence = laid_out(task, signals, gaps=[1, 2, 1])
    assert sequence.inputs[:, 0].tolist() == [signals[0], 0, 0, signals[1], 0, signals[2], 0]
    assert sequence.scored.tolist() == [True, False, False, True, False, True, False]
    assert int(sequence.length) == 6
    assert np.sign(sequence.targets[sequence.scored]).tolist() == classes


def test_lengths_are_221_to_421_at_depth_21(drawn):
    task = SequenceClassification(depth=21)
    for gap, length in ((10, 221), (20, 421)):
        assert int(laid_out(task, [1] * 21, gaps=[gap] * 21).length) == length
    assert task.max_steps == 421 == drawn.inputs.shape[1]
    # 20 gaps of mean 15 and variance 10: length 321 ± 14.
    assert abs(drawn.length.mean() - 321) < 4 * 14.1 / np.sqrt(DRAWS)
    assert drawn.length.std() == pytest.approx(14.1, rel=0.15)


def test_gaps_as_seen_in_the_inputs_take_every_value_from_10_to_20(drawn):
    gaps = [np.diff(np.flatnonzero(row)) - 1 for row in drawn.inputs[:, :, 0]]
    assert all(len(row) == 20 for row in gaps)
    values, counts = np.unique(np.concatenate(gaps), return_counts=True)
    assert values.tolist() == list(range(10, 21))
    assert counts.min() > 0.8 * counts.mean()


def test_signals_are_fair_scored_and_followed_by_nothing(drawn):
    inputs = drawn.inputs[:, :, 0]
    assert set(np.unique(inputs)) == {-1.0, 0.0, 1.0}
    assert abs(inputs.sum() / (21 * DRAWS)) < 4 / np.sqrt(21 * DRAWS)
    np.testing.assert_array_equal(drawn.scored, inputs != 0)
    for row, end in zip(inputs, drawn.length, strict=True):
        assert abs(row[0]) == abs(row[end - 1]) == 1.0
        assert not row[end:].any()


def test_targets_are_running_sums_and_ties_are_class_1_or_free(drawn):
    sums = np.cumsum(drawn.inputs[:, :, 0], axis=1)
    np.testing.assert_array_equal(drawn.targets, sums + 0.5)
    tied = ((sums == 0) & drawn.scored).any(axis=1)
    # No tie before the end of a walk of 20 steps: C(20, 10)/2^20.
    assert tied.mean() == pytest.approx(1 - 184756 / 2**20, abs=0.08)

    def rights(ties):
        task = SequenceClassification(depth=2, min_gap=0, max_gap=0, ties=ties)
        target = laid_out(task, [1, -1]).targets[1]
        return [bool(correct(jnp.float32(answer), target)) for answer in (-1.0, -1e-6, 0.0, 1.0)]

    assert rights("positive") == [False, False, True, True]
    assert rights("free") == [True] * 4


def test_reward_by_hand():
    answer = jnp.array([0.5, 1.0, 1.0, -0.5, -1.0, 0.2, 0.4])
    target = jnp.array([0.5, 0.5, 1.5, 1.5, -2.5, -0.5, 2.5])
    scored = jnp.array([True, True, True, True, True, False, False])
    task = SequenceClassification()
    earned = task.reward(answer, target, scored, jnp.ones(7, bool))
    #         y·S ≥ 1 at a signal pays 1 more
    expected = [0.25, 0.5, 1.0 + 1.0, -0.75, 1.0 + 1.0, -0.1, 1.0]
    np.testing.assert_allclose(earned, expected, rtol=1e-6)


@pytest.mark.parametrize("ties", ["positive", "free"])
def test_a_stream_cut_in_pieces_continues_exactly(ties):
    task = SequenceClassification(depth=6, min_gap=1, max_gap=3, ties=ties)
    half = SequenceClassification(depth=3, min_gap=1, max_gap=3, ties=ties)
    signals, gaps = [-1, -1, 1, 1, 1, -1], [2, 1, 3, 2, 3, 1]
    whole = laid_out(task, signals, gaps)
    first = laid_out(half, signals[:3], gaps[:3])
    second = laid_out(half, signals[3:], gaps[3:], total=sum(signals[:3]))

    def at_signals(x):
        return x.targets[x.scored].tolist()

    assert at_signals(first) + at_signals(second) == at_signals(whole)
    assert at_signals(second) != at_signals(laid_out(half, signals[3:], gaps[3:]))


def test_negated_signals_negate_the_running_sum(drawn):
    task = SequenceClassification(depth=21)
    row = drawn.inputs[0, :, 0]
    signals, gaps = row[row != 0], np.append(0, np.diff(np.flatnonzero(row)) - 1)
    same, mirrored = (laid_out(task, sign * signals, gaps) for sign in (1, -1))
    np.testing.assert_array_equal(same.targets, drawn.targets[0])
    np.testing.assert_array_equal(mirrored.targets - 0.5, -(same.targets - 0.5))
    np.testing.assert_array_equal(mirrored.inputs, -same.inputs)
    np.testing.assert_array_equal(mirrored.scored, same.scored)


def test_depth_1_is_one_step():
    task = SequenceClassification(depth=1)
    assert task.max_steps == 1
    assert laid_out(task, [-1]).targets.tolist() == [-0.5]


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"depth": 0}, "depth is 0"),
        ({"min_gap": 5, "max_gap": 4}, "gaps of 5..4"),
        ({"min_gap": -1}, "gaps of -1..20"),
        ({"ties": "any"}, "ties is 'any'.*free, positive"),
    ],
)
def test_impossible_tasks_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        SequenceClassification(**fields)
