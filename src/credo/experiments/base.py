"""An experiment is data: cells of runs, what is measured of them, and how rows are shown.

A module of this folder defines one figure or table as `EXPERIMENT`. A cell has labels, an
algorithm, a budget and seeds; its name and folder are made of its labels, and nothing is ever read
back from a name. What is measured are rows (`credo.report.rows`), a figure is a view of rows.
"""

import importlib
import itertools
import json
import pathlib
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from jaxtyping import PyTree

from .. import tree
from ..report.page import write as write_page
from ..report.rows import Label, Labels, Results, Row, Series, concat, read, write
from ..report.sections import Page, Section
from ..runs import config, executor
from ..runs.loop import Run
from ..runs.record import RunError
from . import catalogue

BUDGETS = ("smoke", "quick", "full")  # seconds, minutes, hours


@dataclass(frozen=True)
class Cell:
    """Independent runs of one algorithm that differ in their seed alone.

    `labels`: what sets it apart from the other cells: `{"method": "merl", "coupling": 4}`. Settings
    chosen by looking at some seeds are reported on others: `seeds`. A run ends at `generations`,
    `frames` (environment steps) or a champion's score of `stop_at`, whichever comes first.
    """

    labels: Labels
    algorithm: Any
    seeds: Sequence[int]
    generations: int | None = None
    frames: int | None = None
    stop_at: float | None = None

    @property
    def name(self) -> str:
        """What a reader sees, and `--only` looks at: "merl, coupling 4". Also the folder of its
        runs: experiments that share a cell share its runs."""
        return named(self.labels)

    @property
    def folder(self) -> str:
        return self.name.replace("/", "-")

    @property
    def budget(self) -> dict[str, Any]:
        """What ends a run, by the names of `RunOptions`."""
        limits = {"generations": self.generations, "frames": self.frames, "stop_at": self.stop_at}
        return {name: limit for name, limit in limits.items() if limit is not None}

    def record(self) -> dict[str, Any]:
        """As `results.json` has it."""
        algorithm = json.loads(json.dumps(config.to_tree(self.algorithm)))
        budget = {"seeds": list(self.seeds), "budget": self.budget}
        return {"labels": dict(self.labels), **budget, "algorithm": algorithm}


@dataclass(frozen=True)
class Trained:
    """A cell whose runs are done: what measurements look at."""

    cell: Cell
    runs: list[Run]
    budget: str

    @property
    def labels(self) -> Labels:
        return self.cell.labels

    @property
    def seeds(self) -> list[int]:
        return list(self.cell.seeds)

    @property
    def env(self) -> Any:
        return self.cell.algorithm.env

    @cached_property
    def champions(self) -> PyTree:
        """The final champions as one population `[runs, …]`."""
        return tree.stack(*(run.champion for run in self.runs))


Measure = Callable[[Trained], Iterable[Row | Series]]


@dataclass(frozen=True)
class Value:
    """A published number (or its words: "> 80"), and where it stands. It belongs to every row
    that has these labels."""

    value: float | str
    metric: str
    source: str
    labels: Labels = field(default_factory=dict)


View = Section | Callable[[Results, Sequence[Value]], Iterable[Section]]


@dataclass(frozen=True)
class Experiment:
    """A figure or table, as data.

    `published`: what the dissertation has, and where. `cells(budget)`: the runs it needs.
    `measures`: rows of each cell. `views`: sections of the page, in order; a view without rows is
    left out. `values`: published numbers.
    """

    published: str
    cells: Callable[[str], list[Cell]]
    measures: Sequence[Measure]
    views: Sequence[View]
    values: Sequence[Value] = ()
    budgets: Sequence[str] = BUDGETS


def named(labels: Labels) -> str:
    """Labels in words: words as they are, numbers behind the name of their label."""
    words = [
        value if isinstance(value, str) else name if value is True else f"{name} {value}"
        for name, value in labels.items()
        if value is not False
    ]
    return ", ".join(words)


def grid(**axes: Iterable[Label]) -> list[dict[str, Label]]:
    """Labels of every combination, the first axis slowest."""
    return [dict(zip(axes, found, strict=True)) for found in itertools.product(*axes.values())]


def find(name: str) -> Experiment:
    """The experiment of an id of the catalogue."""
    return importlib.import_module(f".{catalogue.module(name)}", __package__).EXPERIMENT


# ------------------------------------------------------------------------------------ reproduce


def reproduce(
    name: str,
    budget: str,
    *,
    runs: int | None = None,
    only: str | None = None,
    jobs: int | None = None,
    output: pathlib.Path = pathlib.Path("reproduced"),
    work: pathlib.Path = pathlib.Path("runs/reproduce"),
) -> pathlib.Path:
    """Run what is missing, measure, and write `results.json` and `report.html`.

    **Arguments:** `runs`: of each cell, instead of what the budget says. `only`: leave out cells in
    whose name this regular expression is not found, in whatever case: "(erl|ddpg), Hopper". What
    earlier commands measured of the others stays, where its settings are today's. `jobs`: runs at
    a time; None: one per core.

    **Returns:** the path of the page. **Raises:** `RunError` if there is no such budget or cell.
    """
    experiment = find(name)
    if budget not in experiment.budgets:
        raise RunError(f"{name} has no budget {budget!r}: it has {', '.join(experiment.budgets)}")
    every = experiment.cells(budget)
    chosen = every if only is None else matching(every, only, f"{name} at budget {budget}")
    if runs is not None:
        chosen = [replace(c, seeds=range(c.seeds[0], c.seeds[0] + runs)) for c in chosen]
    target = output / name / budget / "results.json"
    earlier = None if only is None else kept(target, every, chosen)
    finished = _trained(chosen, budget, work / budget, jobs, f"{name} {budget}")
    print(f"{name} {budget}: runs are done; measuring", file=sys.stderr)
    machine = config.machine()
    found, curves = concat(m(cell) for cell in finished for m in experiment.measures)
    command = f"credo reproduce {name} --budget {budget}"
    command += f" --runs {runs}" if runs is not None else ""
    command += f" --only {shlex.quote(only)}" if only is not None else ""
    cells = [cell.record() | {"machine": machine} for cell in chosen]
    results = Results(name, budget, command, cells, found, curves)
    write(results if earlier is None else merged(earlier, results, every), target)
    return page(target)


def _trained(
    cells: list[Cell], budget: str, work: pathlib.Path, jobs: int | None, title: str
) -> list[Trained]:
    """Train what is missing of the cells' runs."""
    paths = [[work / cell.folder / str(seed) for seed in cell.seeds] for cell in cells]
    wanted = [
        executor.Job(path, cell.algorithm, seed=seed, **({"generations": None} | cell.budget))
        for cell, folders in zip(cells, paths, strict=True)
        for seed, path in zip(cell.seeds, folders, strict=True)
    ]
    executor.run(wanted, jobs, title=title)
    return [
        Trained(cell, [Run(path) for path in folders], budget)
        for cell, folders in zip(cells, paths, strict=True)
    ]


def matching(cells: list[Cell], only: str, where: str) -> list[Cell]:
    """Those in whose name the regular expression is found; RunError if there are none."""
    try:
        pattern = re.compile(only, re.IGNORECASE)
    except re.error as error:
        raise RunError(f"--only {only!r} is no regular expression: {error}") from error
    found = [cell for cell in cells if pattern.search(cell.name)]
    if not found:
        names = "; ".join(cell.name for cell in cells)
        raise RunError(f"no cell of {where} has {only!r} in its name: there are {names}")
    return found


def kept(path: pathlib.Path, every: list[Cell], chosen: list[Cell]) -> Results | None:
    """What was measured earlier of cells that are not `chosen` now, if today's runs of them would
    be the same (their number may differ; versions of Credo may too). Says what stays and what does
    not, and why."""
    if not path.exists():
        return None
    try:
        earlier = read(path)
    except ValueError as error:
        raise RunError(f"{error}: move it away, or choose another --output") from error
    now = {named(cell.labels) for cell in chosen}
    known = {cell.name: cell for cell in every}
    stay = []
    for record in earlier.cells:
        name = named(record["labels"])
        if name in now:
            continue
        why = _other_runs(record, known.get(name))
        if why:
            print(f"not kept of {path}: {name} ({'; '.join(why)})", file=sys.stderr)
        else:
            stay.append(record)
    if not stay:
        return None
    print(f"kept of {path}: {'; '.join(named(r['labels']) for r in stay)}", file=sys.stderr)
    return _of_cells(earlier, stay)


def _other_runs(record: Mapping[str, Any], cell: Cell | None) -> list[str]:
    """How the runs of a recorded cell differ from today's."""
    if cell is None:
        return ["there is no such cell today"]
    today = cell.record()
    try:
        lines = config.changed(record["algorithm"], today["algorithm"])
    except (KeyError, TypeError, ValueError) as error:
        return [f"its record cannot be read: {error}"]
    if record["seeds"][0] != cell.seeds[0]:
        lines.append(f"first seed: {record['seeds'][0]} != {cell.seeds[0]}")
    return config.differences(record["budget"], today["budget"]) + lines


def _of_cells(results: Results, cells: Sequence[Mapping[str, Any]]) -> Results:
    """Only rows and curves of these cells: those whose labels, as far as cells have them, agree."""
    names = {name for cell in results.cells for name in cell["labels"]}

    def key(labels: Labels) -> frozenset[tuple[str, Any]]:
        return frozenset((name, value) for name, value in labels.items() if name in names)

    wanted = {key(cell["labels"]) for cell in cells}
    return replace(
        results,
        cells=list(cells),
        rows=[row for row in results.rows if key(row.labels) in wanted],
        curves=[curve for curve in results.curves if key(curve.labels) in wanted],
    )


def merged(earlier: Results, results: Results, every: list[Cell]) -> Results:
    """Results of two commands, in the order of the experiment's cells."""
    both = replace(
        results,
        cells=[*earlier.cells, *results.cells],
        rows=[*earlier.rows, *results.rows],
        curves=[*earlier.curves, *results.curves],
    )
    there = {named(cell["labels"]): cell for cell in both.cells}
    parts = [_of_cells(both, [there[cell.name]]) for cell in every if cell.name in there]
    before = [part for part in earlier.command.split(" && ") if part != results.command]
    return replace(
        both,
        command=" && ".join([*before, results.command]),
        cells=[cell for part in parts for cell in part.cells],
        rows=[row for part in parts for row in part.rows],
        curves=[curve for part in parts for curve in part.curves],
    )


# ------------------------------------------------------------------------------------- its page


def page(path: pathlib.Path) -> pathlib.Path:
    """Write `report.html` beside a `results.json`, from its rows alone."""
    target = path.with_name("report.html")
    write_page(describe(read(path)), target)
    return target


def describe(results: Results) -> Page:
    """The page of results."""
    experiment = find(results.experiment)
    machines = [cell["machine"] for cell in results.cells]
    return Page(
        title=f"{results.experiment}: {catalogue.EXPERIMENTS[results.experiment]}",
        lead=experiment.published,
        command=results.command,
        sections=sections(experiment, results),
        facts={
            "budget": results.budget,
            "runs": "; ".join(f"{named(c['labels'])}: {extent(c)}" for c in results.cells),
            "machine": _once(f"{m['processor']}, {m['device']}, {m['system']}" for m in machines),
            "versions": _once(
                ", ".join(f"{k} {v}" for k, v in m["versions"].items()) for m in machines
            ),
        },
    )


def sections(experiment: Experiment, results: Results) -> list[Section]:
    found: list[Section] = []
    for view in experiment.views:
        found += view(results, experiment.values) if callable(view) else [view]
    return found


def extent(cell: Mapping[str, Any]) -> str:
    """Runs and their budget, in words; `cell` as recorded."""
    budget = cell["budget"]
    words = [f"{budget[name]:,} {name}" for name in ("frames", "generations") if name in budget]
    words += [f"a score of {budget['stop_at']:,.0f}"] if "stop_at" in budget else []
    return f"{len(cell['seeds'])} × {' or '.join(words)}"


def _once(texts: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(texts))
