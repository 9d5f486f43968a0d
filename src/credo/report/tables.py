"""Cells of tables in words, and one convention for independent runs wherever they are shown: their
mean (or another centre), a 95 % bootstrap interval of it, and every run."""

import math
from numbers import Integral, Real
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..analysis.statistics import Statistic, bootstrap_interval, interquartile_mean
from .sections import Cell, Summary, Table

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


class Shown(NamedTuple):
    """A cell in words: `small` stands below `text`, `title` in a tooltip. Of a summary: the centre
    with its interval, `0.53 [0.51, 0.55]`; every run, of many `0.40 … 0.60, n = 10`, of one
    nothing; and every run with its seed."""

    text: str
    small: str = ""
    title: str = ""


def centred(runs: ArrayLike, centre: str = "mean", resamples: int = 2000) -> Centre:
    """`centre` (a name of `CENTRES`) of `runs[runs, …]` with its 95 % percentile bootstrap
    interval, which is NaN for one run and where a run has no value."""
    runs = np.asarray(runs, np.float64)
    statistic = CENTRES[centre][0]
    low, high = bootstrap_interval(runs, statistic, resamples=resamples)
    return Centre(statistic(runs, axis=0), low, high)


def shown(cell: Cell) -> Shown:
    """A cell as a table shows it."""
    if isinstance(cell, Summary):
        return _summary(cell)
    if cell is None:
        return Shown("–")
    return Shown(number(cell) if _is_number(cell) else str(cell))  # type: ignore[arg-type]


def _summary(summary: Summary) -> Shown:
    """Runs without a value count for nothing, but `small` and `title` tell of them."""
    runs = [math.nan if x is None else summary.scale * float(x) for x in summary.values]
    found = [x for x in runs if math.isfinite(x)]
    places = decimals(runs, summary.digits)
    each = [number(x, places) for x in runs]
    seeds = summary.seeds or range(len(runs))
    title = ", ".join(f"seed {seed}: {x}" for seed, x in zip(seeds, each, strict=True))
    if not found:
        return Shown("–", "", title)
    value, low, high = (number(float(x), places) for x in centred(found, summary.centre))
    if len(found) == 1:
        return Shown(value, "", title)
    extremes = f"{number(min(found), places)} … {number(max(found), places)}, n = {len(found)}"
    small = ", ".join(each) if len(runs) <= FEW else extremes
    return Shown(f"{value} [{low}, {high}]", small, title)


def decimals(values: list[float], digits: int | None) -> int:
    """Digits behind the point: as given, or three in all of the largest finite value."""
    if digits is not None:
        return digits
    largest = max((abs(x) for x in values if math.isfinite(x)), default=0.0)
    return min(max(2 - math.floor(math.log10(largest)), 0), 6) if largest > 0 else 0


def number(value: Any, places: int | None = None) -> str:
    """A number with so many digits behind the point, a dash for NaN. None: whole numbers, and any
    of 10,000 or more, without a point; others with four digits in all."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else "∞" if value > 0 else "−∞"
    if places is not None:
        text = f"{value:,.{places}f}"
    elif isinstance(value, Integral) or 1e4 <= abs(value) < 1e15:
        text = f"{value:,.0f}"
    else:
        text = f"{value:.4g}"
    zero = not float(text.replace(",", ""))
    return text.removeprefix("-") if zero else text.replace("-", "−")


def numeric(table: Table) -> list[bool]:
    """Which columns hold numbers, and nothing else."""
    return [
        any(map(_is_number, column)) and all(cell is None or _is_number(cell) for cell in column)
        for column in zip(*table.rows, strict=True)
    ] or [False] * len(table.columns)


def _is_number(cell: object) -> bool:
    return isinstance(cell, Real | Summary) and not isinstance(cell, bool | np.bool_)


def hidden_runs(table: Table) -> list[tuple[str, str, str]]:
    """Row, column and every run of the summaries that show their extremes alone."""
    return [
        (shown(row[0]).text, column, shown(cell).title)
        for row in table.rows
        for column, cell in zip(table.columns, row, strict=True)
        if isinstance(cell, Summary) and len(cell.values) > FEW
    ]


def note(table: Table) -> str:
    """What brackets and small numbers of a table mean; "" if it has none."""
    cells = [cell for row in table.rows for cell in row if isinstance(cell, Summary)]
    if all(len(cell.values) <= 1 for cell in cells):
        return ""
    names = dict.fromkeys(CENTRES[cell.centre][1] for cell in cells)
    return NOTE.format(centre=" or ".join(names))
