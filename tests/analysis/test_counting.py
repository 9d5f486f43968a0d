import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reading import read

from credo import tree
from credo.analysis import counting
from credo.analysis.memory import Masked, memory_of
from credo.environments.base import correct
from credo.environments.sequence_classification import SequenceClassification
from credo.networks.mmu import MMU

LIMIT = 7


class Given(eqx.Module):
    """Signals `[depth, streams]` or gaps `[depth]` from an array."""

    values: jax.Array

    def __call__(self, t):
        return self.values[t]


def saturating():
    """The exact counter, whose M1 closes its own write gate after 7 signals of +1."""
    exact = counting.exact_counter()
    # At +1 the gate's argument is +50 after 6 of them and -50 after 7; at 0 it stays shut.
    return dataclasses.replace(
        exact,
        K_w=exact.K_w.at[0, 0].set(1000.0),
        N_w=exact.N_w.at[0, 0].set(-100.0),
        b_w=exact.b_w.at[0].set(100.0 * (32 + LIMIT) - 1000.0 - 50.0),
    )


def clock():
    """The exact counter, whose M1 gains ½ at every step, signal or not."""
    exact = counting.exact_counter()
    return dataclasses.replace(exact, K_w=exact.K_w.at[0, 0].set(0.0), b_w=exact.b_w.at[0].set(0.0))


@pytest.fixture(scope="module")
def three():
    return tree.stack(counting.exact_counter(), saturating(), clock())


@pytest.fixture(scope="module")
def study(three):
    return counting.counting_study(three, 5_000, 5_100, key=jax.random.key(0))


def test_the_exact_counter_is_right_at_ten_thousand_signals(study):
    assert study.correct[0] == 10_100
    np.testing.assert_array_equal(study.counted[0], [[0, 5_000, 0], [5_100, 0, 0]])


def test_the_counting_rows_are_exact(study):
    assert study.negatives.tolist()[:5] == [1, 2, 5, 10, 20]
    assert study.negatives.tolist()[-13:] == [5_000] * 13
    assert study.positives.tolist()[-13:] == counting.logarithmic(5_100)
    np.testing.assert_array_equal(study.memory[:, 0, 0], 32 + study.positives)
    np.testing.assert_array_equal(study.memory[:, 0, 1], -32 - study.negatives)


def test_a_saturating_cell_is_caught_where_it_stops(study):
    assert study.counted[1, 1, 0] == LIMIT
    assert study.memory[-1, 1, 0] == 32 + LIMIT
    # Its sum stays negative: the first mistake is at the 5,000th +1, where the real sum is 0.
    assert study.correct[1] == 9_999
    assert study.counts(LIMIT).tolist() == [True, True, False]
    assert study.counts(LIMIT + 1).tolist() == [True, False, False]


def test_a_clock_is_no_counter(study):
    assert study.memory[5, 2, 0] > 100
    np.testing.assert_array_equal(study.counted[2, :, 0], 0)


def test_a_cell_that_turns_round_is_no_counter():
    exact = counting.exact_counter()
    # M1 starts at ½ and is written -sign(M1) at each +1: -½, ½, -½, …
    flipping = dataclasses.replace(
        exact,
        config=MMU(hidden=3, block_activation="identity"),
        K_p=jnp.zeros((3, 1)),
        N_p=jnp.diag(jnp.array([-100.0, 0.0, 0.0])),
        b_p=jnp.zeros(3),
        b_r=jnp.full(3, -100.0),
        m_0=jnp.array([0.5, -32.0, 0.0]),
    )
    signals, gaps = Given(jnp.ones((6, 1))), Given(jnp.ones(6, jnp.int32))
    kept = counting.stream(tree.stack(flipping), signals, gaps, jnp.array([1, 2, 6]))
    assert kept.memory[:, 0, 0, 0].tolist() == [-0.5, 0.5, 0.5]
    assert kept.counted[0, 0, :, 0].tolist() == [0, 1]


def test_longest_correct_finds_the_first_mistake(three):
    key = jax.random.key(1)
    found = counting.longest_correct(three, 300, 4, key=key)
    signals = jax.vmap(counting.RandomSignals(jax.random.split(key)[0], 4))(jnp.arange(300))
    assert set(np.unique(signals)) == {-1.0, 1.0}
    signals = np.asarray(signals)
    plus, minus = (np.cumsum(signals == sign, axis=0) for sign in (1, -1))
    # The present signal goes to the output past the memory, which is what stops at 7.
    remembered = np.minimum(plus - (signals > 0), LIMIT) + (signals > 0)
    wrong = (remembered >= minus) != (plus >= minus)
    assert wrong.any(axis=0).sum() >= 2
    expected = np.where(wrong.any(axis=0), wrong.argmax(axis=0), 300)
    assert found[0].tolist() == [300] * 4
    assert found[1].tolist() == expected.tolist()


@pytest.mark.parametrize("ties", ["positive", "free"])
def test_a_stream_equals_the_trace_of_the_laid_out_sequence(ties):
    depth, streams = 24, 2
    population = eqx.filter_vmap(lambda key: MMU(hidden=4).init(1, 1, key=key))(
        jax.random.split(jax.random.key(2), 3)
    )
    signals = jax.random.rademacher(jax.random.key(3), (depth, streams), jnp.float32)
    gaps = jax.random.randint(jax.random.key(4), (depth,), 0, 4)
    checkpoints = jnp.array([1, 5, depth], jnp.int32)
    kept = counting.stream(population, Given(signals), Given(gaps), checkpoints, ties=ties)

    task = SequenceClassification(depth=depth, min_gap=0, max_gap=3, ties=ties)
    assert kept.signals.tolist() == [1, 5, depth]
    for k in range(streams):
        np.testing.assert_array_equal(
            kept.sums[:, 0, k], jnp.cumsum(signals[:, k])[checkpoints - 1]
        )
        sequence = task.lay_out(signals[:, k], jnp.roll(gaps, 1))
        at = np.flatnonzero(sequence.scored)
        for p in range(3):
            answers, carry = read(tree.take(population, p), sequence.inputs)
            memory = memory_of(carry)[at][checkpoints - 1]
            np.testing.assert_allclose(kept.memory[:, p, k], memory, rtol=1e-3, atol=1e-3)
            right = np.asarray(correct(answers[:, 0], sequence.targets))[at]
            assert kept.correct[p, k] == (depth if right.all() else right.argmin())


def test_gaps_are_uniform_and_include_both_ends():
    gaps = jax.vmap(counting.RandomGaps(jax.random.key(0), 2, 4))(jnp.arange(3_000))
    counts = np.bincount(gaps, minlength=6)
    assert counts[[0, 1, 5]].tolist() == [0, 0, 0]
    np.testing.assert_allclose(counts[2:5], 1_000, atol=130)  # 5 standard deviations


def test_logarithmic_checkpoints():
    assert counting.logarithmic(1) == [1]
    assert counting.logarithmic(10) == [1, 2, 5, 10]
    assert counting.logarithmic(120) == [1, 2, 5, 10, 20, 50, 100, 120]


def test_errors_name_what_is_allowed(three):
    masked = Masked(three, jnp.ones((3, 3), bool), jnp.zeros((3, 3)))
    with pytest.raises(ValueError, match="features first"):
        counting.longest_correct(masked, key=jax.random.key(0))
    with pytest.raises(ValueError, match="depth is 0"):
        counting.longest_correct(three, 0, key=jax.random.key(0))
    with pytest.raises(ValueError, match="at least 1"):
        counting.counting_study(three, 0, key=jax.random.key(0))
    with pytest.raises(ValueError, match=r"gaps of 3\.\.2"):
        counting.RandomGaps(jax.random.key(0), 3, 2)
