"""Selection by statistics, and NaN, which must never win."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.evolution.selection import Tournament, Truncation, rankable, ranking, repeated

DRAWS = 20_000
NAN = float("nan")


@pytest.mark.parametrize("size", [1, 2, 3])
def test_tournament_draws_the_best_of_size_with_replacement(size):
    ranks = jnp.arange(5.0)
    chosen = Tournament(size=size)(ranks, DRAWS, key=jax.random.key(0))
    # By enumeration of all equally likely sets of entrants.
    winners = [max(entrants) for entrants in itertools.product(range(5), repeat=size)]
    expected = np.bincount(winners, minlength=5) / len(winners)
    observed = np.bincount(chosen, minlength=5) / DRAWS
    np.testing.assert_allclose(observed, expected, atol=4 * 0.5 / np.sqrt(DRAWS))
    assert chosen.shape == (DRAWS,)


def test_tournament_returns_indices_not_ranks():
    chosen = Tournament(size=3)(jnp.array([3.0, 9.0, 1.0]), 1000, key=jax.random.key(0))
    counts = np.bincount(chosen, minlength=3) / 1000
    np.testing.assert_allclose(counts, [7 / 27, 19 / 27, 1 / 27], atol=0.06)


def test_truncation_draws_uniformly_from_the_best():
    fitness = jnp.array([0.0, 5.0, 3.0, -1.0, 4.0, NAN, 1.0, 2.0, -2.0, -3.0])
    chosen = Truncation(fraction=0.3)(fitness, DRAWS, key=jax.random.key(0))
    values, counts = np.unique(chosen, return_counts=True)
    assert values.tolist() == [1, 2, 4]
    np.testing.assert_allclose(counts / DRAWS, 1 / 3, atol=0.02)


def test_truncation_keeps_at_least_one():
    chosen = Truncation(fraction=0.01)(jnp.array([1.0, 2.0, 0.0]), 10, key=jax.random.key(0))
    assert chosen.tolist() == [1] * 10


@pytest.mark.parametrize("selection", [Tournament(size=8), Truncation(fraction=0.5)])
def test_nan_never_wins(selection):
    fitness = jnp.array([NAN, 1.0, NAN, -jnp.inf, 2.0, 1.0])
    chosen = selection(fitness, 500, key=jax.random.key(0))
    winners = set(np.asarray(chosen).tolist())
    assert winners <= {1, 4, 5}
    assert 4 in winners


def test_ranking_is_best_first_stable_and_puts_nan_last():
    fitness = jnp.array([1.0, NAN, 3.0, 1.0, 2.0])
    assert ranking(fitness).tolist() == [2, 4, 0, 3, 1]
    assert rankable(fitness).tolist() == [1.0, -np.inf, 3.0, 1.0, 2.0]


def test_repeated_marks_every_later_occurrence():
    index = jnp.array([3, 1, 3, 3, 0, 1])
    assert repeated(index).tolist() == [False, False, True, True, False, True]
    assert not repeated(jnp.arange(4)).any()


@pytest.mark.parametrize("selection", [Tournament(), Truncation()])
def test_a_key_is_a_draw(selection):
    fitness = jax.random.normal(jax.random.key(0), (20,))
    once, again, other = (selection(fitness, 30, key=jax.random.key(k)) for k in (1, 1, 2))
    np.testing.assert_array_equal(once, again)
    assert not np.array_equal(once, other)


@pytest.mark.parametrize(
    ("build", "told"),
    [
        (lambda: Tournament(size=0), "size is 0"),
        (lambda: Truncation(fraction=0.0), "fraction is 0.0"),
        (lambda: Truncation(fraction=1.5), "fraction is 1.5"),
    ],
)
def test_impossible_selections_are_refused(build, told):
    with pytest.raises(ValueError, match=told):
        build()
