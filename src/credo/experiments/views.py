"""Views of rows: what a table's columns and a figure's axes are made of.

A view is called with results and published values and gives sections of a page. Which labels make
the rows of a table, the panels and lines of a figure, is said once; nothing else knows the names of
cells. A view without rows gives no section.

The content of a table's cell is a function of the rows that belong to its row: `mean`, `plain`,
`each`, `count`, `known`, `published`, or one of the experiment's own.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..analysis import statistics
from ..report import sections as page
from ..report.rows import Label, Labels, Results
from .base import Value, named

Of = Callable[[Results, Sequence[Value]], page.Cell]  # what a table shows of some rows
SEED = "seed"  # the label of a table that has a row for each run


# ----------------------------------------------------------------------- what a cell of a table has


def per_seed(results: Results, metric: str) -> dict[int, float]:
    """A metric's mean over all rows of each seed (episodes, agents, …); NaN where one of them is
    null. Of a series the last point."""
    every = results.by_seed(metric)
    for curve in results.curves:
        if curve.metric == metric:
            every.setdefault(curve.seed, []).append(curve.values[-1])
    return {
        seed: float(np.mean([number(value) for value in values]))
        for seed, values in every.items()
        if seed is not None
    }


def mean(metric: str, scale: float = 1.0, digits: int | None = None, **labels: Any) -> Of:
    """The mean over runs with its interval, and every run."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        found = per_seed(results.where(**labels), metric)
        given = [value if np.isfinite(value) else None for value in found.values()]
        there = any(value is not None for value in given)
        return page.Summary(given, list(found), scale, digits) if there else None

    return of


def of_runs(metric: str, function: Callable[[np.ndarray], page.Cell], **labels: Any) -> Of:
    """What a function makes of the mean of each run over its rows, `[runs]`."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        found = per_seed(results.where(**labels), metric)
        return function(np.array(list(found.values()))) if found else None

    return of


def plain(metric: str, scale: float = 1.0, of: Callable[[Any], Any] = np.mean, **labels: Any) -> Of:
    """The mean over runs alone, or their median (`of=np.median`), without interval and runs."""
    return of_runs(metric, lambda x: scale * float(of(x)), **labels)


def median(metric: str, scale: float = 1.0) -> Of:
    """Median and range over runs; of one run just its value."""

    def told(x: np.ndarray) -> page.Cell:
        x = scale * x[np.isfinite(x)]
        if x.size < 2:
            return f"{x[0]:.1f}" if x.size else None
        return f"{np.median(x):.1f} ({x.min():.1f}…{x.max():.1f})"

    return of_runs(metric, told)


def best(metric: str, scale: float = 1.0) -> Of:
    """The best of all runs."""
    return of_runs(metric, lambda x: f"{scale * np.nanmax(x):.1f}")


def count(metric: str, test: Callable[[Any], bool]) -> Of:
    """How many runs pass a test of a metric: "2 of 3"."""
    return of_runs(metric, lambda x: f"{sum(map(test, x))} of {len(x)}")


def each(metric: str, none: str = "never", form: str = ",", **labels: Any) -> Of:
    """The value of every run, in order; `none`: what a run without one shows."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        found = results.where(**labels).by_seed(metric)
        told = [x for seed, several in found.items() if seed is not None for x in several]
        return ", ".join(none if x is None else f"{x:{form}}" for x in told) or None

    return of


def known(metric: str, scale: float = 1.0, **labels: Any) -> Of:
    """A number of the task rather than of a run: a baseline, an upper bound. Of several cells (a
    figure's level) the first one's: machines differ in the last digit."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        found = (row for row in results.where(**labels).rows if row.metric == metric)
        value = next((row.value for row in found), None)
        return value if value is None or isinstance(value, str) else scale * value

    return of


def published(metric: str, number: bool = False, **labels: Any) -> Of:
    """What was published of these rows, the most particular first, with its spread; None if nothing
    was. `number`: the number alone, for a figure's level."""

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
        best = max(found, key=lambda value: len(value.labels), default=None)
        if best is None or number or not best.spread:
            return best and best.value
        return (
            f"{best.value if isinstance(best.value, str) else f'{best.value:,.6g}'} {best.spread}"
        )

    return of


def computed(metric: str, function: Callable[[np.ndarray], page.Cell]) -> Of:
    """What a function makes of a metric's values `[seeds, values of each]`."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        found = [x for seed, x in results.by_seed(metric).items() if seed is not None]
        return function(np.array(found, np.float64)) if found else None

    return of


def at(x: float, content: Of) -> Of:
    """What a content is of series that end at `x`; None if no series has a point there."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        ends = [(y, list(y.at).index(x) + 1) for y in results.curves if x in y.at]
        curves = [y._replace(at=y.at[:end], values=y.values[:end]) for y, end in ends]
        return content(replace(results, curves=curves), values)

    return of


def constant(value: float | str) -> Of:
    """The same for all: a published level, an upper bound."""
    return lambda results, values: value


# ----------------------------------------------------------------------------------------- views


@dataclass(frozen=True)
class Table:
    """A row of cells for each combination of the labels `rows`, or for each run (`rows=[SEED]`);
    `columns` by their title. `panel`: labels of which each combination has a table of its own; the
    title may have them in it as `{panel}`. `where`: only what has these labels. `titles`: a heading
    for a label, where its name is not one.

    A column that says nothing anywhere, such as a label that no cell has, is left out.
    """

    title: str
    rows: Sequence[str]
    columns: Mapping[str, Of]
    where: Mapping[str, Any] = field(default_factory=dict)
    panel: Sequence[str] = ()
    titles: Mapping[str, str] = field(default_factory=dict)
    caption: str = ""

    def __call__(self, results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
        headings = [self.titles.get(name, name) for name in self.rows] + list(self.columns)
        for told, chosen in panels(results.where(**self.where), self.panel):
            body = []
            for key, here in self.places(chosen):
                contents = [of(here, values) for of in self.columns.values()]
                if any(content is not None for content in contents):
                    body.append([*map(label_text, key), *contents])
            kept = [any(row[i] is not None for row in body) for i in range(len(headings))]
            body = [list(itertools.compress(row, kept)) for row in body]
            columns = list(itertools.compress(headings, kept))
            if body:
                yield page.Table(titled(self.title, told), columns, body, caption=self.caption)

    def places(self, results: Results) -> Iterator[tuple[Sequence[Any], Results]]:
        """What belongs to each row."""
        if list(self.rows) == [SEED]:
            seeds = dict.fromkeys(x.seed for x in [*results.rows, *results.curves])
            yield from (([str(x)], of_seed(results, x)) for x in seeds if x is not None)
        else:
            yield from ((tuple(x.values()), here) for x, here in panels(results, self.rows))


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
    y_range: tuple[float, float] | None = None
    caption: str = ""

    def __call__(self, results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
        every = results.where(**self.where)
        chosen = of_metric(every, self.y)
        for told, here in panels(chosen, self.panel) if chosen.rows or chosen.curves else ():
            lines = list(panels(here, self.line))
            names = differing([labels for labels, _ in lines])
            levels = {name: of(every.where(**told), values) for name, of in self.levels.items()}
            yield page.Figure(
                titled(self.title, told),
                self.x,
                self.y_label or self.y,
                [self.curve(x, name or self.y) for (_, x), name in zip(lines, names, strict=True)],
                [page.Reference(k, x) for k, x in levels.items() if isinstance(x, int | float)],
                self.caption,
                y_range=self.y_range,
                joined=bool(here.curves),
            )

    def curve(self, results: Results, label: str) -> page.Curve:
        """One line, of every seed."""
        if results.curves:
            runs = [[number(y) for y in curve.values] for curve in results.curves]
            return page.Curve(label, results.curves[0].at, runs)
        xs = sorted({row.labels[self.x] for row in results.rows})
        found = [per_seed(results.where(**{self.x: x}), self.y) for x in xs]
        seeds = dict.fromkeys(seed for place in found for seed in place)
        runs = [[place.get(seed, np.nan) for place in found] for seed in seeds]
        return page.Curve(label, xs, runs)


@dataclass(frozen=True)
class Improvement:
    """A method against each of the others, in a row for each combination of the labels `rows`: the
    ratio of the means of a metric over runs, and the probability that a run of it is better than
    one of the other (Agarwal et al. 2021, "Deep RL at the Edge of the Statistical Precipice"), with
    an interval."""

    method: str
    metric: str
    rows: Sequence[str]
    title: str
    caption: str = ""

    def __call__(self, results: Results, values: Sequence[Value]) -> Iterable[page.Table]:
        body = []
        for told, here in panels(results, self.rows):
            runs = {x: self.runs(here, x) for x in here.levels("method")}
            ours = runs.pop(self.method, np.array([]))
            places = [label_text(x) for x in told.values()]
            body += [
                [*places, x, *against(ours, y)] for x, y in runs.items() if len(ours) and len(y)
            ]
        if body:
            columns = [*self.rows, "beside", "ratio of means", f"P({self.method} is better)"]
            caption = (
                f"{self.caption} The probability is that a run of {self.method} is better than one "
                "of the other (Agarwal et al. 2021); its interval is from 10,000 bootstrap samples "
                "of the runs of both, and wide with few runs."
            )
            yield page.Table(self.title, [*columns, "95 % interval"], body, caption.strip())

    def runs(self, results: Results, method: str) -> np.ndarray:
        """The mean of each run."""
        found = np.array(list(per_seed(results.where(method=method), self.metric).values()))
        return found[np.isfinite(found)]


def against(ours: np.ndarray, theirs: np.ndarray) -> list[page.Cell]:
    """Ratio of means, if both have a sign that allows one, the probability of improvement, and its
    interval, of values of runs."""
    ratio = f"{ours.mean() / theirs.mean():.2f}" if theirs.mean() > 0 else None
    low, high = statistics.improvement_interval(ours, theirs)
    chance = statistics.probability_of_improvement(ours, theirs)
    return [ratio, f"{chance:.2f}", f"{low:.2f} to {high:.2f}" if np.isfinite(low) else None]


# --------------------------------------------------------------------------------------- helpers


def panels(results: Results, names: Sequence[str]) -> Iterator[tuple[dict[str, Any], Results]]:
    """What these labels are together, in order of appearance, and what has them; None where there
    is no label of the name. Without names, all results if there are any at all."""
    every: list[Labels] = [cell["labels"] for cell in results.cells]
    every = [item.labels for item in [*results.rows, *results.curves]] or every
    for key in dict.fromkeys(tuple(labels.get(name) for name in names) for labels in every):
        if not names or any(x is not None for x in key):
            told = dict(zip(names, key, strict=True))
            yield told, results.where(**told)


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


def number(value: Any) -> float:
    """A value of a series; NaN for null."""
    return np.nan if value is None else float(value)
