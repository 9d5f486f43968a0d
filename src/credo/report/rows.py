"""Results as tidy rows: labels, a seed, a metric and a value; and curves by labels and seed.

`results.json` is this table and nothing else. Whoever wants another figure reads `rows` and
`curves` and needs no code of Credo's:

    columns  ["task", "method", "episode", "seed", "metric", "value"]
    rows     [["Swimmer-v5", "ea", 3, 0, "return", 351.2], …]
    curves   [{"labels": {"task": …, "method": …}, "metric": "champion return", "x": "frames",
               "at": [10000, 20000, …], "seeds": {"0": [31.0, 44.2, …], "1": […]}}, …]

A label that does not apply to a row is null there. A row with no seed (null) tells of the cell as a
whole: a baseline, a bound, which seed's champion was chosen. Tidy data: Wickham (2014), Journal of
Statistical Software 59(10).
"""

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..runs import files

Label = str | int | float | bool
Labels = Mapping[str, Label]


class Row(NamedTuple):
    """One number (or text, or truth value) that was measured."""

    labels: Labels
    seed: int | None
    metric: str
    value: Any


class Series(NamedTuple):
    """One run's values `[points]` of a metric at `at[points]`, which is called `x`."""

    labels: Labels
    seed: int | None
    metric: str
    x: str
    at: Sequence[float]
    values: Sequence[Any]


def rows(metric: str, values: ArrayLike, labels: Labels | None = None, **axes: Any) -> list[Row]:
    """An array as rows. `axes` names its dimensions in order and gives the label of each entry, or
    None for 0, 1, 2, …; the axis `seed` is the run.

    `rows("return", returns, seed=[0, 1, 2], episode=None)` of `returns[3, 10]` is 30 rows.
    """
    array = np.asarray(values, object)
    return [Row(x, seed, metric, value) for x, seed, value in _entries(metric, array, labels, axes)]


def series(
    metric: str, x: str, at: ArrayLike, values: ArrayLike, labels: Labels | None = None, **axes: Any
) -> list[Series]:
    """An array `[…, points]` as one series for each entry of its other dimensions, which `axes`
    names as in `rows`."""
    array, places = np.asarray(values, object), plain(at)
    entries = _entries(metric, array, labels, axes, points=1)
    return [Series(found, seed, metric, x, places, values) for found, seed, values in entries]


def _entries(
    metric: str, array: np.ndarray, labels: Labels | None, axes: Mapping[str, Any], points: int = 0
) -> Iterator[tuple[dict[str, Label], int | None, Any]]:
    """Labels, seed and value of each entry of an array; the last `points` dimensions are no axes.
    Raises `ValueError` if `axes` do not fit the others."""
    shape = array.shape[: array.ndim - points]
    names = [
        list(range(size)) if given is None else list(given)
        for size, given in zip(shape, axes.values(), strict=False)
    ]
    if tuple(map(len, names)) != shape or len(axes) != len(shape):
        raise ValueError(
            f"{metric!r} has shape {shape} and axes "
            f"{ {name: len(given) for name, given in zip(axes, names, strict=False)} }: name every "
            "dimension, with one label for each entry"
        )
    for index, found in zip(np.ndindex(shape), product(*names), strict=True):
        told = {**(labels or {}), **dict(zip(axes, found, strict=True))}
        seed = told.pop("seed", None)
        yield told, seed, plain(array[index])


def plain(value: Any) -> Any:
    """NumPy and JAX numbers, and lists and mappings of them, as Python's, so that JSON can hold
    them; what is not finite is None. Text stays text."""
    if isinstance(value, Mapping):
        return {str(key): plain(x) for key, x in value.items()}
    if isinstance(value, str) or value is None:
        return value
    if np.ndim(value) > 0:
        return [plain(x) for x in value]
    number = value.item() if hasattr(value, "item") else value
    return None if isinstance(number, float) and not np.isfinite(number) else number


@dataclass(frozen=True)
class Results:
    """What an experiment measured at a budget, as its `results.json` has it.

    `cells`: a record for each group of runs that differ in their seed alone — labels, algorithm,
    seeds, budget, machine.
    """

    experiment: str
    budget: str
    command: str
    cells: Sequence[Mapping[str, Any]]
    rows: Sequence[Row]
    curves: Sequence[Series]

    def where(self, **labels: Any) -> "Results":
        """Only what has these labels; of a tuple, list or set any. A row without the label stays
        out; `name=None` asks for rows that do not have it."""

        def fits(found: Labels) -> bool:
            """Whether these labels are the wanted ones."""
            return all(
                found.get(name) in wanted
                if isinstance(wanted, tuple | list | set | frozenset)
                else found.get(name) == wanted
                for name, wanted in labels.items()
            )

        return replace(
            self,
            cells=[cell for cell in self.cells if fits(cell["labels"])],
            rows=[row for row in self.rows if fits(row.labels)],
            curves=[curve for curve in self.curves if fits(curve.labels)],
        )

    def levels(self, *labels: str) -> list[Any]:
        """The values of a label among rows and curves, in order of appearance; of several labels
        tuples of values. What lacks one of them does not count."""
        found = [
            tuple(item.labels.get(name) for name in labels) for item in [*self.rows, *self.curves]
        ]
        there = dict.fromkeys(values for values in found if None not in values)
        return [values[0] for values in there] if len(labels) == 1 else list(there)

    def by_seed(self, metric: str, **labels: Any) -> dict[int | None, list[Any]]:
        """Values of a metric by seed, in the order of the rows."""
        found: dict[int | None, list[Any]] = {}
        for row in self.where(**labels).rows:
            if row.metric == metric:
                found.setdefault(row.seed, []).append(row.value)
        return found

    def value(self, metric: str, default: Any = None, **labels: Any) -> Any:
        """The only value of a metric; `default` if there is none. Raises `ValueError` if several
        rows have it with unlike values."""
        found = [row.value for row in self.where(**labels).rows if row.metric == metric]
        if any(value != found[0] for value in found):
            raise ValueError(f"{metric!r} has {len(found)} values here: ask for more labels")
        return found[0] if found else default

    def array(self, metric: str, *dims: str, **labels: Any) -> np.ndarray:
        """Values of a metric as an array whose dimensions are these labels (`seed` among them),
        in order of appearance; None where there is no such row. For series, the last dimension is
        their points and need not be named. Raises `ValueError` if series differ in length."""
        chosen = self.where(**labels)
        found = [(x, x.value) for x in chosen.rows] + [(x, x.values) for x in chosen.curves]
        values = {
            tuple({**x.labels, "seed": x.seed}.get(name) for name in dims): value
            for x, value in found
            if x.metric == metric
        }
        levels = [list(dict.fromkeys(places)) for places in zip(*values, strict=True)]
        points = {len(value) for value in values.values() if np.ndim(value)}
        if len(points) > 1:
            raise ValueError(f"{metric!r} has series of {sorted(points)} points: ask for fewer")
        array = np.full([*map(len, levels), *points], None, object)
        for place, value in values.items():
            array[tuple(level.index(x) for level, x in zip(levels, place, strict=True))] = value
        return array


# -------------------------------------------------------------------------------------- the file


def write(results: Results, path: str | os.PathLike[str]) -> None:
    """Write `results.json`, one line per row and curve, so that a diff can be read.

    Runs of one curve (the same labels, metric and places) are one line, by seed. The columns of the
    rows are all labels that any row has, in order of appearance. A reader never sees half a file.
    """
    names = list(dict.fromkeys(name for row in results.rows for name in row.labels))
    curves: dict[str, dict[str, Any]] = {}
    for curve in results.curves:
        head = {"labels": dict(curve.labels), "metric": curve.metric, "x": curve.x}
        head["at"] = list(curve.at)
        group = curves.setdefault(json.dumps(head), head | {"seeds": {}})
        group["seeds"][str(curve.seed)] = list(curve.values)
    encode = json.JSONEncoder(ensure_ascii=False, allow_nan=False).encode
    lines = {
        "cells": [encode(cell) for cell in results.cells],
        "columns": encode([*names, "seed", "metric", "value"]),
        "rows": [
            encode([*(row.labels.get(name) for name in names), *row[1:]]) for row in results.rows
        ],
        "curves": [encode(curve) for curve in curves.values()],
    }
    head = {name: encode(getattr(results, name)) for name in ("experiment", "budget", "command")}
    text = ",\n".join(f'"{name}": {_block(value)}' for name, value in (head | lines).items())
    files.write_text(Path(path), f"{{\n{text}\n}}\n")


def _block(value: str | list[str]) -> str:
    """JSON of a field, of a list one line per entry."""
    return value if isinstance(value, str) else "[\n" + ",\n".join(value) + "\n]"


def read(path: str | os.PathLike[str]) -> Results:
    """Read a `results.json`. Raises `ValueError` if it is none."""
    try:
        record = json.loads(files.read_text(Path(path)))
        names = record["columns"][:-3]
        found = [
            Row({k: v for k, v in zip(names, row, strict=False) if v is not None}, *row[-3:])
            for row in record["rows"]
        ]
        curves = [
            Series(seed=None if seed == "None" else int(seed), values=values, **curve)
            for curve in record["curves"]
            for seed, values in curve.pop("seeds").items()
        ]
        head = {name: record[name] for name in ("experiment", "budget", "command", "cells")}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is no record of results ({error!r})") from error
    return Results(**head, rows=found, curves=curves)


def concat(parts: Iterable[Iterable[Row | Series]]) -> tuple[list[Row], list[Series]]:
    """Rows and series of several measurements, each kind together and in order: what a measure of
    an experiment yields mixes both."""
    every = [item for part in parts for item in part]
    found = [item for item in every if isinstance(item, Row)]
    return found, [item for item in every if isinstance(item, Series)]
