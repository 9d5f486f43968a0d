"""Statistics over independent runs: seeded, and vectorised over everything but the runs.

`x` always has the runs on axis 0. A NaN is a missing score: it makes means, quantiles and
intervals of its column NaN.

Source of the interquartile mean and of intervals by the bootstrap: Agarwal et al. 2021, "Deep
Reinforcement Learning at the Edge of the Statistical Precipice".
"""

from typing import Protocol

import numpy as np
import scipy.stats
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

LARGEST_SAMPLE = 4_000_000  # numbers held at once while resampling whole runs: 32 MB


class Statistic(Protocol):
    """`np.mean`, `np.median`, `interquartile_mean`: anything that reduces the axis it is given."""

    def __call__(self, x: Floats, /, *, axis: int) -> Floats: ...


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


def interquartile_mean(x: ArrayLike, *, axis: int = 0) -> Floats:
    """Mean of the middle half along `axis`: ⌊n/4⌋ of the n scores are dropped at either end."""
    scores = np.sort(np.moveaxis(np.asarray(x, dtype=np.float64), axis, -1), axis=-1)
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
) -> tuple[Floats, Floats]:
    """Percentile bootstrap interval (low, high) of `statistic` over the runs of `x[runs, ...]`, by
    `scipy.stats.bootstrap`.

    Whole runs are drawn with replacement and every column has an interval of its own: low and high
    have shape `x.shape[1:]`. There is no interval, but NaN, of one run and of columns with a value
    that is not finite.

    **Raises:** `ValueError` if `confidence` is not in (0, 1) or `resamples` is less than 1.
    """
    x = over_runs(x)
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence is {confidence}: it must lie in (0, 1)")
    if resamples < 1:
        raise ValueError(f"resamples is {resamples}: it must be at least 1")
    columns = x.reshape(len(x), -1)
    there = np.isfinite(columns).all(axis=0)
    bounds = np.full((2, *there.shape), np.nan)
    if len(x) > 1 and there.any():
        sample = columns[:, there]
        bounds[:, there] = scipy.stats.bootstrap(
            (sample,),
            statistic,
            n_resamples=resamples,
            batch=max(1, LARGEST_SAMPLE // sample.size),
            vectorized=True,
            confidence_level=confidence,
            method="percentile",
            rng=np.random.default_rng(seed),
        ).confidence_interval
    low, high = bounds.reshape(2, *x.shape[1:])
    return low, high


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
