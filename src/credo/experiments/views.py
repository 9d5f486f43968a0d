"""Views of rows: what a table's columns and a figure's axes are made of.

A view is called with results and published values and gives sections of a page. Which labels make
the rows of a table, the panels and lines of a figure, is said once; nothing else knows the names of
cells. A view without rows gives no section.

The content of a table's cell is a function of the rows that belong to its row: `mean`, `plain`,
`each`, `count`, `known`, `published`, or one of the experiment's own.
"""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..report import sections as page
from ..report.rows import Label, Labels, Results
from .base import Value, named

Of = Callable[[Results, Sequence[Value]], page.Cell]  # what a table shows of some rows


# ----------------------------------------------------------------------- what a cell of a table has


def per_seed(results: Results, metric: str) -> dict[int, float]:
    """A metric's mean over all rows of each seed (episodes, agents, …); NaN where all are null. Of
    a series the last point."""
    found: dict[int, list[float]] = {}
    for seed, values in results.by_seed(metric).items():
        if seed is not None:
            found[seed] = [np.nan if value is None else float(value) for value in values]
    for curve in results.curves:
        if curve.metric == metric and curve.seed is not None:
            last = curve.values[-1]
            found.setdefault(curve.seed, []).append(np.nan if last is None else float(last))
    return {seed: float(np.mean(values)) for seed, values in found.items()}


def mean(metric: str, scale: float = 1.0, digits: int | None = None, **labels: Any) -> Of:
    """The mean over runs with its interval, and every run."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        found = per_seed(results.where(**labels), metric)
        if not any(np.isfinite(list(found.values()))):
            return None
        given = [value if np.isfinite(value) else None for value in found.values()]
        return page.Summary(given, list(found), scale, digits)

    return of


def plain(metric: str, scale: float = 1.0, of: Callable[[Any], Any] = np.mean, **labels: Any) -> Of:
    """The mean over runs alone, or their median (`of=np.median`), without interval and runs."""

    def content(results: Results, values: Sequence[Value]) -> page.Cell:
        found = list(per_seed(results.where(**labels), metric).values())
        return scale * float(of(found)) if found else None

    return content


def each(metric: str, none: str = "never", form: str = ",", **labels: Any) -> Of:
    """The value of every run, in order; `none`: what a run without one shows."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        found = results.where(**labels).by_seed(metric)
        told = [x for seed, several in found.items() if seed is not None for x in several]
        return ", ".join(none if x is None else f"{x:{form}}" for x in told) or None

    return of


def count(metric: str, test: Callable[[Any], bool], **labels: Any) -> Of:
    """How many runs pass a test of a metric: "2 of 3"."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        found = list(per_seed(results.where(**labels), metric).values())
        return f"{sum(map(test, found))} of {len(found)}" if found else None

    return of


def known(metric: str, scale: float = 1.0, **labels: Any) -> Of:
    """A number of the task rather than of a run: a baseline, an upper bound. Of several cells (a
    figure's level) the first one's: machines differ in the last digit."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        found = (row for row in results.where(**labels).rows if row.metric == metric)
        value = next((row.value for row in found), None)
        return value if value is None or isinstance(value, str) else scale * value

    return of


def published(metric: str, sourced: bool = False, number: bool = False, **labels: Any) -> Of:
    """What was published of these rows, the most particular first; None if nothing was.
    `sourced`: with its source. `number`: without its spread, for a figure's level."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        chosen = results.where(**labels)
        every = [cell["labels"] for cell in chosen.cells]
        every += [item.labels for item in [*chosen.rows, *chosen.curves]]
        found = [
            value
            for value in values
            if value.metric == metric
            and not (number and isinstance(value.value, str))
            and any(value.labels.items() <= told.items() for told in every)
        ]
        if not found:
            return None
        best = max(found, key=lambda value: len(value.labels))
        if number or not (best.spread or sourced):
            return best.value
        text = best.value if isinstance(best.value, str) else f"{best.value:,.6g}"
        return " ".join([text, best.spread][: 2 if best.spread else 1]) + (
            f" ({best.source})" if sourced else ""
        )

    return of


def computed(metric: str, function: Callable[[np.ndarray], page.Cell], **labels: Any) -> Of:
    """What a function makes of a metric's values `[seeds, values of each]`; of a series the last
    point counts."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        chosen = results.where(**labels)
        every = {seed: x for seed, x in chosen.by_seed(metric).items() if seed is not None}
        every = every or {seed: [x] for seed, x in per_seed(chosen, metric).items()}
        return function(np.array(list(every.values()), np.float64)) if every else None

    return of


def median(metric: str, scale: float = 1.0, **labels: Any) -> Of:
    """Median and range over runs; of one run just its value."""

    def told(x: np.ndarray) -> page.Cell:
        x = scale * np.mean(x, axis=1)
        x = x[np.isfinite(x)]
        if x.size < 2:
            return f"{x[0]:.1f}" if x.size else None
        return f"{np.median(x):.1f} ({x.min():.1f}…{x.max():.1f})"

    return computed(metric, told, **labels)


def best(metric: str, scale: float = 1.0) -> Of:
    """The best of all runs."""
    return computed(metric, lambda x: f"{scale * np.nanmax(np.mean(x, axis=1)):.1f}")


def at(x: float, content: Of) -> Of:
    """What a content is of series that end at `x`; None if no series has a point there."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        curves = [
            curve._replace(at=curve.at[: i + 1], values=curve.values[: i + 1])
            for curve in results.curves
            for i in [list(curve.at).index(x) if x in curve.at else None]
            if i is not None
        ]
        return content(replace(results, curves=curves), values)

    return of


def constant(value: float | str) -> Of:
    """The same for all: a published level, an upper bound."""
    return lambda results, values: value


# ----------------------------------------------------------------------------------------- views


@dataclass(frozen=True)
class Runs:
    """A row for each run, in order of the seeds; a table for each combination of `panel`, which
    `{panel}` in the title tells."""

    title: str
    columns: Mapping[str, Of]
    panel: Sequence[str] = ()
    where: Labels = field(default_factory=dict)
    caption: str = ""

    def __call__(self, results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
        chosen = results.where(**self.where)
        for key in combinations(chosen, self.panel):
            told = dict(zip(self.panel, key, strict=True))
            here = chosen.where(**told)
            body = [
                [str(seed), *(of(of_seed(here, seed), values) for of in self.columns.values())]
                for seed in dict.fromkeys(x.seed for x in [*here.rows, *here.curves])
                if seed is not None
            ]
            title = self.title.format(panel=named(present(told)))
            if body:
                yield page.Table(title, ["seed", *self.columns], body, caption=self.caption)


@dataclass(frozen=True)
class Table:
    """A row of cells for each combination of the labels `rows`; `columns` by their title. `where`:
    only what has these labels. `titles`: a heading for a label, where its name is not one."""

    title: str
    rows: Sequence[str]
    columns: Mapping[str, Of]
    where: Mapping[str, Any] = field(default_factory=dict)
    titles: Mapping[str, str] = field(default_factory=dict)
    caption: str = ""

    def __call__(self, results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
        chosen = results.where(**self.where)
        body = []
        for key in combinations(chosen, self.rows):
            here = chosen.where(**dict(zip(self.rows, key, strict=True)))
            contents = [of(here, values) for of in self.columns.values()]
            if any(content is not None for content in contents):
                body.append([*map(label_text, key), *contents])
        headings = [self.titles.get(name, name) for name in self.rows] + list(self.columns)
        # A column that says nothing anywhere, such as a label that no cell has, is left out.
        kept = [any(row[i] is not None for row in body) for i in range(len(headings))]
        body = [list(itertools.compress(row, kept)) for row in body]
        if body:
            columns = list(itertools.compress(headings, kept))
            yield page.Table(self.title, columns, body, caption=self.caption)


@dataclass(frozen=True)
class Curves:
    """Lines over an axis: a figure for each combination of the labels `panel`, a line for each of
    `line`.

    `y`: a metric. Of a series, `x` is its axis; of rows, `x` is a label with numbers. `levels`:
    horizontal lines, by their name. `title`: with the panel's labels in it as `{label}`, or all of
    them as `{panel}`. A line is named by those of its labels that not all lines of its panel share.
    """

    y: str
    x: str
    line: Sequence[str]
    panel: Sequence[str] = ()
    title: str = "{panel}"
    y_label: str = ""
    levels: Mapping[str, Of] = field(default_factory=dict)
    where: Mapping[str, Any] = field(default_factory=dict)
    scale: float = 1.0
    y_range: tuple[float, float] | None = None
    caption: str = ""

    def __call__(self, results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
        chosen = of_metric(results.where(**self.where), self.y)
        measured = [*chosen.rows, *chosen.curves]
        for key in combinations(chosen, self.panel) if measured else []:
            told = dict(zip(self.panel, key, strict=True))
            here, everything = chosen.where(**told), results.where(**{**self.where, **told})
            lines = [dict(zip(self.line, x, strict=True)) for x in combinations(here, self.line)]
            curves = [
                self.curve(here.where(**line), words or self.y)
                for line, words in zip(lines, differing(lines), strict=True)
            ]
            title = titled(self.title, told)
            levels = [(name, of(everything, values)) for name, of in self.levels.items()]
            yield page.Figure(
                title,
                self.x,
                self.y_label or self.y,
                curves,
                [page.Reference(name, x) for name, x in levels if isinstance(x, int | float)],
                self.caption,
                self.y_range,
                joined=bool(here.curves),
            )

    def curve(self, results: Results, label: str) -> page.Curve:
        """One line, of every seed."""
        if results.curves:
            return page.Curve(
                label,
                results.curves[0].at,
                [[number(y, self.scale) for y in curve.values] for curve in results.curves],
            )
        xs = sorted({row.labels[self.x] for row in results.rows})
        found = [per_seed(results.where(**{self.x: x}), self.y) for x in xs]
        seeds = dict.fromkeys(seed for place in found for seed in place)
        runs = [[place.get(seed, np.nan) for place in found] for seed in seeds]
        return page.Curve(label, xs, self.scale * np.array(runs, np.float64))


@dataclass(frozen=True)
class Notes:
    """What to know before comparing. A paragraph may be a function of the results, and may have
    nothing to say (None)."""

    paragraphs: Sequence[str | Callable[[Results], str | None]]
    title: str = "How to read it"

    def __call__(self, results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
        told = [text if isinstance(text, str) else text(results) for text in self.paragraphs]
        yield page.Text(self.title, [text for text in told if text is not None])


def where(text: str, **labels: Any) -> Callable[[Results], str | None]:
    """A paragraph that stands only on pages with such cells."""
    return lambda results: text if results.where(**labels).cells else None


# --------------------------------------------------------------------------------------- helpers


def combinations(results: Results, names: Sequence[str]) -> list[tuple[Any, ...]]:
    """What these labels are together, in order of appearance; None where a cell has none of the
    name. Without names, one combination of none if there is anything at all."""
    every: list[Labels] = [cell["labels"] for cell in results.cells]
    every = [item.labels for item in [*results.rows, *results.curves]] or every
    found = dict.fromkeys(tuple(labels.get(name) for name in names) for labels in every)
    return [key for key in found if not names or any(x is not None for x in key)]


def of_metric(results: Results, metric: str) -> Results:
    """Only the rows and series of a metric."""
    return only(results, lambda item: item.metric == metric)


def of_seed(results: Results, seed: int | None) -> Results:
    """Only the rows and series of one run, and those of the cell as a whole."""
    return only(results, lambda item: item.seed in (seed, None))


def only(results: Results, test: Callable[[Any], bool]) -> Results:
    """Only the rows and series that pass a test."""
    rows, curves = ([x for x in items if test(x)] for items in (results.rows, results.curves))
    return replace(results, rows=rows, curves=curves)


def titled(title: str, panel: Mapping[str, Any]) -> str:
    """A title with the labels of its panel."""
    return title.format(panel=named(present(panel)), **panel)


def differing(lines: Sequence[Mapping[str, Any]]) -> list[str]:
    """Of each line, in words, the labels that tell it from the others; all of them if there is
    nothing else to say."""
    told = [name for name in lines[0] if len({line[name] for line in lines}) > 1]
    return [
        named(present({name: line[name] for name in told})) or named(present(line))
        for line in lines
    ]


def present(labels: Mapping[str, Any]) -> dict[str, Label]:
    """Only the labels that are there."""
    return {name: value for name, value in labels.items() if value is not None}


def label_text(value: Any) -> page.Cell:
    """A label in a table or beside a heat map."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else value


def number(value: Any, scale: float = 1.0) -> float:
    """A value of a series; NaN for null."""
    return np.nan if value is None else scale * float(value)
