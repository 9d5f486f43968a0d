import itertools

import numpy as np
import pytest
import scipy.stats

from credo.analysis.statistics import (
    bootstrap_interval,
    improvement_interval,
    interquartile_mean,
    mean_and_standard_error,
    moving_average,
    probability_of_improvement,
    success_rate,
)


def test_standard_error_by_hand():
    # Deviations from 5: 9 + 1 + 1 + 1 + 0 + 0 + 4 + 16 = 32, so std is 2 with ddof 0.
    x = np.array([2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0])
    mean, error = mean_and_standard_error(x, ddof=0)
    assert mean == 5.0
    assert error == pytest.approx(2.0 / np.sqrt(8.0), rel=1e-15)
    assert mean_and_standard_error(x)[1] == pytest.approx(np.sqrt(32 / 7 / 8), rel=1e-15)


def test_standard_error_keeps_trailing_axes_and_does_not_invent_one_from_a_single_run():
    mean, error = mean_and_standard_error([[1.0, 10.0], [3.0, 10.0]])
    assert mean.tolist() == [2.0, 10.0]
    assert error.tolist() == [1.0, 0.0]
    mean, error = mean_and_standard_error([[1.0, 10.0]])
    assert mean.tolist() == [1.0, 10.0]
    assert np.isnan(error).all()


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ([5.0], 5.0),
        ([0.0, 1.0, 2.0, 100.0], 1.5),
        # ⌊10/4⌋ = 2 leave at either end: 3..8 remain.
        ([10.0, 1.0, 9.0, 2.0, 8.0, 3.0, 7.0, 4.0, 6.0, 1000.0], (3 + 4 + 6 + 7 + 8 + 9) / 6),
        ([-np.inf, 1.0, 3.0, np.inf], 2.0),
    ],
)
def test_interquartile_mean_by_hand(scores, expected):
    assert interquartile_mean(scores) == pytest.approx(expected, rel=1e-15)


def test_interquartile_mean_pools_runs_and_tasks():
    # As rliable: a 25 % trimmed mean over all 3 × 4 scores, 0..11 without 0,1,2 and 9,10,11.
    x = np.arange(12.0)[::-1].reshape(3, 4)
    assert interquartile_mean(x, axis=(0, 1)) == 5.5
    assert interquartile_mean(x).tolist() == [7.0, 6.0, 5.0, 4.0]


def test_a_missing_score_is_not_trimmed_away():
    x = np.array([[0.0, 1.0], [1.0, 1.0], [2.0, 1.0], [np.nan, 1.0]])
    assert np.isnan(interquartile_mean(x)).tolist() == [True, False]


def test_bootstrap_of_two_runs_has_the_exact_distribution():
    # Means of two draws from {0, 1}: 0, ½, 1 with ¼, ½, ¼.
    low, high = bootstrap_interval([0.0, 1.0], confidence=0.4, resamples=4000)
    assert (low, high) == (0.5, 0.5)
    low, high = bootstrap_interval([0.0, 1.0], confidence=0.6, resamples=4000)
    assert (low, high) == (0.0, 1.0)


def test_bootstrap_of_the_mean_matches_all_resamples_counted_out():
    x = np.array([0.1, 0.4, 0.5, 0.9, 1.7])
    every = np.array([np.mean(draw) for draw in itertools.product(x, repeat=5)])
    interval = bootstrap_interval(x, np.mean, resamples=50_000)
    np.testing.assert_allclose(interval, np.quantile(every, [0.025, 0.975]), atol=0.02)


def test_bootstrap_is_seeded_and_columns_do_not_depend_on_their_neighbours():
    x = np.random.default_rng(1).normal(size=(8, 30))
    low, high = bootstrap_interval(x, np.median)
    assert low.shape == high.shape == (30,)
    assert np.all(low <= np.median(x, axis=0))
    assert np.all(np.median(x, axis=0) <= high)
    np.testing.assert_array_equal(bootstrap_interval(x[:, 7], np.median), (low[7], high[7]))
    assert not np.array_equal(bootstrap_interval(x, np.median, seed=1)[0], low)


def test_bootstrap_in_blocks_is_the_bootstrap_in_one_piece(monkeypatch):
    x = np.random.default_rng(2).normal(size=(5, 3, 4))
    whole = bootstrap_interval(x, resamples=100)
    whole_pooled = bootstrap_interval(x[:, 0], resamples=100, pooled=True)
    monkeypatch.setattr("credo.analysis.statistics.LARGEST_SAMPLE", 1000)
    np.testing.assert_array_equal(bootstrap_interval(x, resamples=100), whole)
    np.testing.assert_array_equal(
        bootstrap_interval(x[:, 0], resamples=100, pooled=True), whole_pooled
    )


def test_pooled_bootstrap_draws_each_task_on_its_own():
    # Runs that are high on one task are low on the other: whole runs would always average ½.
    x = np.array([[0.0, 1.0], [1.0, 0.0]])
    low, high = bootstrap_interval(x, np.mean, confidence=0.9, pooled=True)
    assert (low, high) == (0.0, 1.0)
    low, high = bootstrap_interval(x.mean(axis=1), np.mean, confidence=0.9)
    assert (low, high) == (0.5, 0.5)


def test_pooled_bootstrap_covers_the_interquartile_mean():
    # 95 % intervals of the IQM of 10 runs × 5 normal tasks; the true IQM is 0.
    rng = np.random.default_rng(3)
    covered = 0
    for seed in range(100):
        x = rng.normal(size=(10, 5))
        low, high = bootstrap_interval(x, interquartile_mean, resamples=300, seed=seed, pooled=True)
        covered += low <= 0.0 <= high
    assert 85 <= covered <= 100


def test_one_run_has_no_interval():
    assert np.isnan(bootstrap_interval([1.0])).all()
    assert np.isnan(bootstrap_interval([[1.0, 2.0]])).tolist() == [[True, True], [True, True]]


def test_bootstrap_is_that_of_scipy():
    x = np.random.default_rng(4).normal(size=(6, 3))
    rng = np.random.default_rng(0)
    known = scipy.stats.bootstrap((x,), np.mean, n_resamples=2000, method="percentile", rng=rng)
    np.testing.assert_array_equal(bootstrap_interval(x), known.confidence_interval)


def test_probability_of_improvement_by_hand():
    # 9 pairs: 4 > 1,2,3; 2 > 1; 0 beats none: 4 wins, 1 tie (2 = 2).
    assert probability_of_improvement([4.0, 2.0, 0.0], [1.0, 2.0, 3.0]) == pytest.approx(4.5 / 9)
    assert probability_of_improvement([1.0, 1.0], [1.0]) == 0.5
    assert probability_of_improvement([np.nan, 1.0], [0.0]) == 0.5


def test_probability_of_improvement_averages_over_tasks():
    # Agarwal et al., section 4.3: the mean over tasks of P(X_m > Y_m), ties counted half.
    rng = np.random.default_rng(4)
    x, y = rng.integers(5, size=(6, 3)), rng.integers(5, size=(9, 3))
    per_task = []
    for task in range(3):
        total = 0.0
        for a, b in itertools.product(x[:, task], y[:, task]):
            total += 1.0 if a > b else 0.5 if a == b else 0.0
        per_task.append(total / (6 * 9))
    assert probability_of_improvement(x, y) == pytest.approx(np.mean(per_task), rel=1e-12)
    assert probability_of_improvement(y, x) == pytest.approx(1 - np.mean(per_task), rel=1e-12)


def test_success_rate_counts_the_threshold_and_not_the_missing():
    x = np.array([[1.0, 0.2], [0.9, np.nan], [0.5, 0.9], [0.95, 0.1]])
    assert success_rate(x, 0.9).tolist() == [0.75, 0.25]


def test_moving_average_is_shorter_at_the_start():
    x = [[1.0, 2.0, 6.0, 0.0, 3.0], [0.0, 0.0, 3.0, 3.0, 3.0]]
    assert moving_average(x, 3).tolist() == [[1.0, 1.5, 3.0, 8 / 3, 3.0], [0.0, 0.0, 1.0, 2.0, 3.0]]
    assert moving_average(x, 1).tolist() == x
    assert moving_average([2.0, 4.0], 100).tolist() == [2.0, 3.0]
    assert moving_average(np.zeros((2, 0)), 3).shape == (2, 0)


def test_moving_average_forgets_a_missing_value():
    averages = moving_average([1.0, np.nan, 3.0, 5.0], 2)
    assert np.isnan(averages).tolist() == [False, True, True, False]
    assert averages[3] == 4.0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mean_and_standard_error(3.0), "runs on axis 0"),
        (lambda: success_rate(np.zeros((0, 4)), 0.5), "at least one"),
        (lambda: bootstrap_interval([1.0], confidence=95.0), "confidence is 95"),
        (lambda: bootstrap_interval([1.0], resamples=0), "resamples is 0"),
        (lambda: bootstrap_interval([1.0, 2.0], pooled=True), r"\[runs, tasks\]"),
        (lambda: probability_of_improvement(np.zeros((2, 3)), np.zeros((2, 4))), "must agree"),
        (lambda: moving_average([1.0], 0), "window is 0"),
    ],
)
def test_errors_say_what_is_allowed(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_the_interval_of_an_improvement_holds_the_probability():
    assert improvement_interval([4.0, 5.0], [1.0, 2.0]) == (1.0, 1.0)
    assert improvement_interval([1.0, 1.0], [1.0, 1.0]) == (0.5, 0.5)
    assert np.isnan(improvement_interval([4.0], [1.0, 2.0])).all()
    rng = np.random.default_rng(0)
    x, y = rng.normal(0.5, 1.0, 40), rng.normal(0.0, 1.0, 40)
    low, high = improvement_interval(x, y)
    assert low < probability_of_improvement(x, y) < high
    assert low == pytest.approx(probability_of_improvement(x, y) - 1.96 * 0.062, abs=0.03)
