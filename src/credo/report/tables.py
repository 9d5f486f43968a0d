"""Cells of tables in words, and one convention for independent runs wherever they are shown: their
mean, its 95 % bootstrap interval, and every run."""

import math
from numbers import Integral, Real
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..analysis.statistics import bootstrap_interval
from .sections import Cell, Summary, Table

Floats = NDArray[np.float64]

FEW = 5  # runs of which all values are shown
NOTE = (
    "In brackets: 95 % bootstrap interval of the mean over runs. Small: each run; of more than "
    f"{FEW}, the least and the largest."
)


class Mean(NamedTuple):
    """A mean over runs and its interval, each of the shape of one run."""

    value: Floats
    low: Floats
    high: Floats


class Shown(NamedTuple):
    """A cell in words: `small` stands below `text`, `title` in a tooltip. Of a summary: the mean
    with its interval, `0.53 [0.51, 0.55]`; every run, of many `0.40 … 0.60, n = 10`, of one
    nothing; and every run with its seed."""

    text: str
    small: str = ""
    title: str = ""


def mean(runs: ArrayLike, resamples: int = 2000) -> Mean:
    """The mean over `runs[runs, …]` with its 95 % percentile bootstrap interval, which is NaN for
    one run and where a run has no value."""
    runs = np.asarray(runs, np.float64)
    return Mean(runs.mean(axis=0), *bootstrap_interval(runs, resamples=resamples))


def shown(cell: Cell) -> Shown:
    """A cell as a table shows it: text as given, numbers as of `number`, None as a dash."""
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
    value, low, high = (number(float(x), places) for x in mean(found))
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
    """Which columns hold numbers and summaries, and nothing else but None: they stand right."""
    return [
        any(map(_is_number, column)) and all(cell is None or _is_number(cell) for cell in column)
        for column in zip(*table.rows, strict=True)
    ] or [False] * len(table.columns)


def _is_number(cell: object) -> bool:
    """Whether a cell is a number or a summary of some; a truth value is text."""
    return isinstance(cell, Real | Summary) and not isinstance(cell, bool | np.bool_)


def hidden_runs(table: Table) -> list[tuple[str, str, str]]:
    """Row, column and every run of the summaries that show their extremes alone. A page of HTML has
    them in tooltips; Markdown has none, and lists them below the table."""
    return [
        (shown(row[0]).text, column, shown(cell).title)
        for row in table.rows
        for column, cell in zip(table.columns, row, strict=True)
        if isinstance(cell, Summary) and len(cell.values) > FEW
    ]


def note(table: Table) -> str:
    """What brackets and small numbers of a table mean; "" if it has none."""
    cells = [cell for row in table.rows for cell in row]
    several = any(isinstance(cell, Summary) and len(cell.values) > 1 for cell in cells)
    return NOTE if several else ""
