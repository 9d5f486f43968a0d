"""Statistics over independent runs: seeded, and vectorised over everything but the runs.

`x` always has the runs on axis 0. A NaN is a missing score: it makes means, quantiles and
intervals of its column NaN, and it loses every comparison.

Source of the interquartile mean, the stratified bootstrap and the probability of improvement:
Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice".
"""

from typing import Protocol

import numpy as np
import scipy.stats
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Axes = int | tuple[int, ...]

LARGEST_SAMPLE = 4_000_000  # numbers held at once while resampling whole runs: 32 MB


class Statistic(Protocol):
    """`np.mean`, `np.median`, `interquartile_mean`: anything that reduces the axes it is given."""

    def __call__(self, x: Floats, /, *, axis: Axes) -> Floats: ...


def mean_and_standard_error(x: ArrayLike, ddof: int = 1) -> tuple[Floats, Floats]:
    """Mean over the runs of `x[runs, ...]`, and its standard error s/√runs.

    `ddof=1` divides the squared deviations by runs − 1 (unbiased variance); the dissertation's
    numbers were made with `ddof=0`. With no more than `ddof` runs the error is unknown: NaN.
    """
    x = over_runs(x)
    runs = x.shape[0]
    mean = x.mean(axis=0)
    if runs <= ddof:
        return mean, np.full_like(mean, np.nan)
    return mean, x.std(axis=0, ddof=ddof) / np.sqrt(runs)


def interquartile_mean(x: ArrayLike, *, axis: Axes = 0) -> Floats:
    """Mean of the middle half along `axis`: ⌊n/4⌋ of the n scores are dropped at either end.

    Over runs and tasks together, as Agarwal et al. report it: `axis=(0, 1)`.
    """
    x = np.asarray(x, dtype=np.float64)
    axes = (axis,) if isinstance(axis, int) else axis
    scores = np.moveaxis(x, axes, range(-len(axes), 0))
    scores = np.sort(scores.reshape(*scores.shape[: scores.ndim - len(axes)], -1), axis=-1)
    cut = scores.shape[-1] // 4
    middle = scores[..., cut : scores.shape[-1] - cut].mean(axis=-1)
    # Sorting puts NaN last, where the cut would hide it.
    return np.where(np.isnan(scores[..., -1]), np.nan, middle)


def bootstrap_interval(
    x: ArrayLike,
    statistic: Statistic = np.mean,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
    *,
    pooled: bool = False,
) -> tuple[Floats, Floats]:
    """Percentile bootstrap interval (low, high) of `statistic` over the runs of `x[runs, ...]`, by
    `scipy.stats.bootstrap`.

    By default whole runs are drawn with replacement and every column has an interval of its
    own: low and high have shape `x.shape[1:]`. With `pooled`, the columns of `x[runs, tasks]`
    are strata: each task draws its own runs, the statistic pools all of them, and low and high
    are scalars (the stratified bootstrap of Agarwal et al.). There is no interval, but NaN, of one
    run and of columns with a value that is not finite.

    **Raises:** `ValueError` if `confidence` is not in (0, 1), `resamples` is less than 1, or pooled
    columns are no matrix.
    """
    x = over_runs(x)
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence is {confidence}: it must lie in (0, 1)")
    if resamples < 1:
        raise ValueError(f"resamples is {resamples}: it must be at least 1")
    if pooled and x.ndim != 2:
        raise ValueError(f"x has shape {x.shape}: pooled resampling needs [runs, tasks]")
    if pooled:
        samples, shape = tuple(x.T), ()
        there = np.array(np.isfinite(x).all())
    else:
        columns, shape = x.reshape(len(x), -1), x.shape[1:]
        there = np.isfinite(columns).all(axis=0)
        samples = (columns[:, there],)
    bounds = np.full((2, *there.shape), np.nan)
    if len(x) > 1 and there.any():
        found = _percentiles(samples, statistic, confidence, resamples, seed)
        bounds[:, there] = np.reshape(found, (2, -1))
    low, high = bounds.reshape(2, *shape)
    return low, high


def _percentiles(
    samples: tuple[Floats, ...], statistic: Statistic, confidence: float, resamples: int, seed: int
) -> tuple[Floats, Floats]:
    """The interval over the runs of one sample `[runs, columns]`, or of tasks `[runs]` together."""

    def of_tasks(*drawn: Floats, axis: int) -> Floats:
        return statistic(np.stack(drawn, axis=-1), axis=(axis - 1, -1))

    tasks = samples[0].ndim == 1
    found = scipy.stats.bootstrap(
        samples,
        of_tasks if tasks else statistic,
        n_resamples=resamples,
        batch=None if tasks else max(1, LARGEST_SAMPLE // samples[0].size),
        vectorized=True,
        confidence_level=confidence,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    return found.confidence_interval


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> float:
    """P(X > Y) + ½ P(X = Y) for a run of `x[runs_x, ...]` against one of `y[runs_y, ...]`.

    It is the Mann–Whitney U statistic over runs_x·runs_y, averaged over the trailing axes
    (tasks), which must agree.
    """
    x, y = (np.nan_to_num(over_runs(z), nan=-np.inf, posinf=np.inf, neginf=-np.inf) for z in (x, y))
    if x.shape[1:] != y.shape[1:]:
        raise ValueError(
            f"x has shape {x.shape}, y has {y.shape}: all axes but the first, the runs, must agree"
        )
    wins = (x[:, None] > y[None]).mean()
    ties = (x[:, None] == y[None]).mean()
    return float(wins + 0.5 * ties)


def improvement_interval(
    x: ArrayLike, y: ArrayLike, confidence: float = 0.95, resamples: int = 10_000, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap interval (low, high) of `probability_of_improvement` on one task, over
    the runs of `x[runs_x]` and `y[runs_y]`, each drawn with replacement; NaN if either has one."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    if min(len(x), len(y)) < 2:
        return float("nan"), float("nan")
    rng, better = np.random.default_rng(seed), np.sign(x[:, None] - y[None]) / 2 + 0.5
    rows, columns = (rng.integers(n, size=(resamples, n)) for n in better.shape)
    drawn = better[rows[:, :, None], columns[:, None]].mean(axis=(1, 2))
    low, high = np.quantile(drawn, [0.5 - confidence / 2, 0.5 + confidence / 2])
    return float(low), float(high)


def success_rate(x: ArrayLike, threshold: float) -> Floats:
    """Share of the runs of `x[runs, ...]` that score `threshold` or more, in [0, 1]."""
    return (over_runs(x) >= threshold).mean(axis=0)


def moving_average(x: ArrayLike, window: int) -> Floats:
    """Mean of the last `window` values up to and including each, along the last axis.

    The first `window` − 1 entries average what there is, as the published code's trackers do.
    """
    x = np.asarray(x, dtype=np.float64)
    if window < 1:
        raise ValueError(f"window is {window}: it must be at least 1")
    if x.shape[-1] == 0:
        return x
    # Sums of windows, not differences of one running sum: a NaN or an infinity leaves again.
    padded = np.concatenate([np.zeros((*x.shape[:-1], window - 1)), x], axis=-1)
    sums = np.lib.stride_tricks.sliding_window_view(padded, window, axis=-1).sum(axis=-1)
    return sums / np.minimum(np.arange(1, x.shape[-1] + 1), window)


def over_runs(x: ArrayLike) -> Floats:
    """`x` as float64, with at least one run on axis 0."""
    x = np.asarray(x, dtype=np.float64)
    if x.ndim == 0 or x.shape[0] == 0:
        raise ValueError(f"x has shape {x.shape}: it needs the runs on axis 0, at least one")
    return x
