"""One convention for independent runs, wherever they are shown: their mean (or another centre), a
95 % bootstrap interval of it, and every run."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..analysis.statistics import Statistic, bootstrap_interval, interquartile_mean
from .sections import Summary

Floats = NDArray[np.float64]

CENTRES: dict[str, tuple[Statistic, str]] = {
    "mean": (np.mean, "mean"),
    "median": (np.median, "median"),
    "iqm": (interquartile_mean, "interquartile mean"),
}
FEW = 5  # runs of which all values are shown
NOTE = (
    "In brackets: 95 % bootstrap interval of the {centre} over runs. Small: each run; of more than "
    f"{FEW}, the least and the largest."
)


class Centre(NamedTuple):
    """A centre over runs and its interval, each of the shape of one run."""

    value: Floats
    low: Floats
    high: Floats


def centred(runs: ArrayLike, centre: str = "mean", resamples: int = 2000) -> Centre:
    """`centre` (a name of `CENTRES`) of `runs[runs, …]` with its 95 % percentile bootstrap
    interval, which is NaN for one run and where a run has no value."""
    runs = np.asarray(runs, np.float64)
    statistic = CENTRES[centre][0]
    low, high = bootstrap_interval(runs, statistic, resamples=resamples)
    return Centre(statistic(runs, axis=0), low, high)


class Shown(NamedTuple):
    """A summary in words."""

    text: str  # 0.53 [0.51, 0.55]
    runs: str  # 0.51, 0.55; of many "0.40 … 0.60, n = 10"; "" of one
    every: str  # seed 0: 0.51, seed 1: 0.55


def shown(summary: Summary) -> Shown:
    """A cell of a table. Runs without a value count for nothing, and are told among `every`."""
    scaled = [np.nan if x is None else summary.scale * float(x) for x in summary.values]
    found = [x for x in scaled if math.isfinite(x)]
    every = ", ".join(
        f"seed {seed}: {number(x, decimals(scaled, summary.digits))}"
        for seed, x in zip(summary.seeds or range(len(scaled)), scaled, strict=True)
    )
    if not found:
        return Shown("–", "", every)
    places = decimals(found, summary.digits)
    value, low, high = (number(float(x), places) for x in centred(found, summary.centre))
    if len(found) == 1:
        return Shown(value, "", every)
    runs = ", ".join(number(x, places) for x in scaled)
    if len(scaled) > FEW:
        least, most = number(min(found), places), number(max(found), places)
        runs = f"{least} … {most}, n = {len(found)}"
    return Shown(f"{value} [{low}, {high}]", runs, every)


def decimals(values: list[float], digits: int | None) -> int:
    """Digits behind the point: as given, or three in all of the largest."""
    if digits is not None:
        return digits
    largest = max((abs(x) for x in values if math.isfinite(x)), default=0.0)
    return min(max(2 - math.floor(math.log10(largest)), 0), 6) if largest > 0 else 0


def number(value: float, places: int) -> str:
    """A number with so many digits behind the point; "–" for NaN."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else "∞" if value > 0 else "−∞"
    text = f"{value:,.{places}f}"
    return text.removeprefix("-") if not float(text.replace(",", "")) else text.replace("-", "−")
