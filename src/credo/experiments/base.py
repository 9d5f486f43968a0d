"""An experiment is data: cells of runs, what is measured of them, and how rows are shown.

Figures and tables that share their cells are one module of this folder; its `EXPERIMENTS` are by
the ids that `catalogue` has. What the dissertation says of each, and what to know before comparing,
is in `dissertation.toml`. A cell has labels, an algorithm, a budget and seeds; its name and folder
are made of its labels, and nothing is ever read back from a name. What is measured are rows
(`credo.report.rows`), a figure is a view of rows (`views`). A whole module:

    '''Figure 9.1: TD3 and ERL on a pendulum, at two sizes of their networks.'''

    METHODS = {"td3": OffPolicy.td3, "erl": ERL.erl}
    FRAMES = {"smoke": 2_000, "quick": 20_000, "full": 200_000}


    def cells(budget: str) -> list[Cell]:
        return [
            Cell(x, METHODS[x["method"]](Gymnasium("Pendulum-v1"), MLP(hidden=(x["width"],))),
                 seeds=range(3), frames=FRAMES[budget])
            for x in grid(method=METHODS, width=(16, 64))
        ]


    EXPERIMENTS = {
        "fig-9.1": Experiment(
            cells,
            (measures.final(), measures.scores(), measures.of_task(measures.random_actions)),
            (
                Curves("test score", "frames", line=["method"], panel=["width"]),
                Table("Return", ["width", "method"], {"random": known("random"),
                      "published": published("return"), "final champion": mean("return")}),
            ),
        ),
    }
"""

import importlib
import itertools
import json
import pathlib
import re
import shlex
import sys
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from importlib import resources
from typing import Any

import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from .. import executors, tree
from ..executors import Job, Place
from ..report import pages
from ..report.rows import Label, Labels, Results, Row, Series, concat, read, rows, series, write
from ..report.sections import SMOKE, Page, Section, Text
from ..runs import config, log
from ..runs.options import RunOptions
from ..runs.record import RunError
from ..runs.store import Run
from . import catalogue

Axis = tuple[str, ArrayLike]  # "frames", and where on it
BUDGETS = ("smoke", "quick", "full")
"""How much to train: seconds, minutes or hours. `cells(budget)` turns the name into generations or
frames, runs and sometimes fewer tasks.

`smoke` shows that everything runs: tasks and networks are small, or runs end after a few
generations; its numbers mean nothing. `quick` is a first impression of at most three runs. `full`
is for results that are reported. Experiments whose full is shorter than the dissertation's may add
`published`, with its generations or frames and its number of runs; some on MuJoCo have `million`.
"""


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
        """The name, without what would be a folder of its own."""
        return self.name.replace("/", "-")

    @property
    def budget(self) -> dict[str, Any]:
        """What ends a run, by the names of `RunOptions`."""
        limits = {"generations": self.generations, "frames": self.frames, "stop_at": self.stop_at}
        return {name: limit for name, limit in limits.items() if limit is not None}

    def record(self) -> dict[str, Any]:
        """As `results.json` has it."""
        algorithm = json.loads(json.dumps(config.to_tree(self.algorithm)))
        told = {"labels": dict(self.labels), "seeds": list(self.seeds), "budget": self.budget}
        return told | {"algorithm": algorithm}


@dataclass(frozen=True)
class Trained:
    """A cell whose runs are done: what measurements look at."""

    cell: Cell
    runs: list[Run]
    budget: str

    @property
    def labels(self) -> Labels:
        """Of the cell, and so of every row that is measured of it."""
        return self.cell.labels

    @property
    def seeds(self) -> list[int]:
        """In the order of the runs."""
        return list(self.cell.seeds)

    @property
    def env(self) -> Any:
        """The task that was trained on."""
        return self.cell.algorithm.env

    @cached_property
    def champions(self) -> PyTree:
        """The final champions as one population `[runs, …]`."""
        return tree.stack(*(run.champion for run in self.runs))

    @property
    def scores(self) -> np.ndarray:
        """The champions' tests `[runs, generations]`. Raises `ValueError` if runs differ in length,
        as those that end by frames or a score may."""
        return np.stack([run.metrics["champion_score"] for run in self.runs])

    def part(self, seed: int | None = None, /, **labels: Label) -> "Trained":
        """The same with more labels; with a `seed`, of that run alone. A seed that the cell does
        not have leaves no runs."""
        chosen = [i for i, x in enumerate(self.seeds) if seed in (x, None)]
        seeds, runs = [self.seeds[i] for i in chosen], [self.runs[i] for i in chosen]
        cell = replace(self.cell, labels={**self.labels, **labels}, seeds=seeds)
        return replace(self, cell=cell, runs=runs)

    def rows(self, metric: str, values: Any, digits: int | None = None, **axes: Any) -> list[Row]:
        """Values `[runs, …]`, rounded to `digits`, as rows; `axes` name the other dimensions, as in
        `credo.report.rows.rows`."""
        return rows(metric, rounded(values, digits), self.labels, seed=self.seeds, **axes)

    def series(
        self, metric: str, at: Axis, values: Any, digits: int | None = None, **axes: Any
    ) -> list[Series]:
        """Values `[runs, …, points]` as series over `at`, the name and places of their axis."""
        found = rounded(values, digits)
        return series(metric, *at, found, self.labels, seed=self.seeds, **axes)

    def fact(self, metric: str, value: Any, **labels: Label) -> Row:
        """A row of the cell as a whole, without a seed: a baseline, a bound. `labels` are added to
        those of the cell."""
        return Row({**self.labels, **labels}, None, metric, value)

    def record(self) -> dict[str, Any]:
        """The cell as `results.json` has it, with the core-hours that its runs took."""
        clocks = [log.read(run.path / log.TIMING) for run in self.runs]
        hours = sum(float(clock["seconds"][-1]) for clock in clocks if clock) / 3600
        return self.cell.record() | {"machine": config.machine(), "hours": round(hours, 2)}


def rounded(values: Any, digits: int | None) -> Any:
    """Short enough for a text file; as given without `digits`."""
    return values if digits is None else np.round(np.asarray(values, np.float64), digits)


Measure = Callable[[Trained], Iterable[Row | Series]]


@dataclass(frozen=True)
class Value:
    """A published number (or its words: "> 80"), and where it stands. It belongs to every row
    that has these labels. `spread`: what stands behind the number: "± 512"."""

    value: float | str
    metric: str
    source: str
    labels: Labels = field(default_factory=dict)
    spread: str = ""


View = Callable[[Results, Sequence[Value]], Iterable[Section]]


@dataclass(frozen=True)
class Experiment:
    """A figure or table, as data.

    `cells(budget)`: the runs it needs. `measures`: rows of each cell. `views`: sections of the
    page, in order; a view without rows is left out. `published`: what the dissertation has, and
    where. `values`: published numbers. `notes`: paragraphs to read before comparing; one with
    labels stands only on pages with such cells. `find` adds these three.
    """

    cells: Callable[[str], list[Cell]]
    measures: Sequence[Measure]
    views: Sequence[View]
    budgets: Collection[str] = BUDGETS
    published: str = ""
    values: Sequence[Value] = ()
    notes: Sequence[tuple[str, Labels]] = ()


def named(labels: Labels) -> str:
    """Labels in words: words as they are, numbers behind the name of their label, of truths the
    name alone: "merl, coupling 4, delayed"."""

    def words(name: str, value: Label) -> str:
        if isinstance(value, str) or value is True:
            return name if value is True else value
        return f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"

    return ", ".join(words(name, x) for name, x in labels.items() if x is not False)


def grid(**axes: Iterable[Label]) -> list[dict[str, Label]]:
    """Labels of every combination, the first axis slowest."""
    return [dict(zip(axes, found, strict=True)) for found in itertools.product(*axes.values())]


def find(name: str) -> Experiment:
    """The experiment of an id of the catalogue, with its texts and published numbers.

    A value of `dissertation.toml` takes `metric` and `source` from its table where it has none of
    its own, a note the labels of its table. Raises `StopIteration` if no module has the id.
    """
    module = importlib.import_module(f".{catalogue.module(name)}", __package__)
    told = [_texts()[part] for part in _texts()[name].get("parts", [name])]
    values = [
        Value(**{k: part[k] for k in ("metric", "source") if k in part} | value)
        for part in told
        for value in part.get("values", ())
    ]
    notes = [
        (x, part.get("labels", {})) if isinstance(x, str) else (x["text"], x["labels"])
        for part in told
        for x in part.get("notes", ())
    ]
    published = _texts()[name]["published"]
    return replace(module.EXPERIMENTS[name], published=published, values=values, notes=notes)


@cache
def _texts() -> dict[str, Any]:
    path = resources.files("credo.experiments").joinpath("dissertation.toml")
    return tomllib.loads(path.read_text(encoding="utf-8"))


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
    on: str | Place = "local",
) -> pathlib.Path:
    """Run what is missing, measure, and write `results.json` and `report.html`.

    **Arguments:** `runs`: of each cell, instead of what the budget says. `only`: leave out cells in
    whose name this regular expression is not found, in whatever case: "(erl|ddpg), Hopper". What
    earlier commands measured of the others stays, where its settings are today's. `jobs`: runs at
    a time; None: as many as the place has room for. `on`: where runs are trained (see `Place`).

    **Returns:** the path of the page. **Raises:** `RunError` if there is no such budget or cell,
    and what `executors.run` raises.
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
    finished = trained(chosen, budget, work / budget, jobs, f"{name} {budget}", on)
    print(f"{name} {budget}: runs are done; measuring", file=sys.stderr)
    flags = {"--budget": budget, "--runs": runs, "--only": only}
    told = [f"{x} {shlex.quote(str(given))}" for x, given in flags.items() if given is not None]
    command = " ".join([f"credo reproduce {name}", *told])
    found, curves = concat(m(cell) for cell in finished for m in experiment.measures)
    records = [cell.record() for cell in finished]
    results = Results(name, budget, command, records, found, curves)
    write(results if earlier is None else merged(earlier, results, every), target)
    return page(target)


def trained(
    cells: list[Cell],
    budget: str,
    work: pathlib.Path,
    jobs: int | None,
    title: str,
    on: str | Place = "local",
) -> list[Trained]:
    """The cells with their runs, in folders of `work`; what is missing of them is trained.

    A run is in `work/<name of its cell>/<seed>`, whichever experiment asked for it first. `jobs`:
    runs at a time; None: as many as the place `on` has room for.
    """

    def path(cell: Cell, seed: int) -> pathlib.Path:
        return work / cell.folder / str(seed)

    wanted = [
        Job(path(c, seed), c.algorithm, seed, RunOptions(**c.budget, tensorboard=False))
        for c in cells
        for seed in c.seeds
    ]
    executors.run(wanted, jobs, on=on, title=title)
    return [Trained(c, [Run(path(c, seed)) for seed in c.seeds], budget) for c in cells]


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
        raise RunError(
            f"{error}: convert it by tools/convert_results.py if an older version of Credo wrote "
            "it; otherwise move it away, or choose another --output"
        ) from error
    now, known = {cell.name for cell in chosen}, {cell.name: cell for cell in every}
    others = {name: part for name, part in by_cell(earlier).items() if name not in now}
    why = {name: _other_runs(part.cells[0], known.get(name)) for name, part in others.items()}
    for name, lines in why.items():
        if lines:
            print(f"not kept of {path}: {name} ({'; '.join(lines)})", file=sys.stderr)
    stay = {name: part for name, part in others.items() if not why[name]}
    if not stay:
        return None
    print(f"kept of {path}: {'; '.join(stay)}", file=sys.stderr)
    return joined(earlier, stay.values())


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


def by_cell(results: Results) -> dict[str, Results]:
    """Results of each cell, by its name: rows and curves whose labels, as far as cells have them,
    are those of the cell."""
    names = {name for cell in results.cells for name in cell["labels"]}

    def own(labels: Labels) -> frozenset[tuple[str, Any]]:
        return frozenset((name, value) for name, value in labels.items() if name in names)

    return {
        named(cell["labels"]): replace(
            results,
            cells=[cell],
            rows=[row for row in results.rows if own(row.labels) == own(cell["labels"])],
            curves=[curve for curve in results.curves if own(curve.labels) == own(cell["labels"])],
        )
        for cell in results.cells
    }


def joined(results: Results, parts: Iterable[Results]) -> Results:
    """The same with cells, rows and curves of these parts, in their order."""
    parts = list(parts)
    return replace(
        results,
        cells=[cell for part in parts for cell in part.cells],
        rows=[row for part in parts for row in part.rows],
        curves=[curve for part in parts for curve in part.curves],
    )


def merged(earlier: Results, results: Results, every: list[Cell]) -> Results:
    """Results of two commands, in the order of the experiment's cells."""
    parts = by_cell(earlier) | by_cell(results)
    before = [part for part in earlier.command.split(" && ") if part != results.command]
    told = replace(results, command=" && ".join([*before, results.command]))
    return joined(told, [parts[cell.name] for cell in every if cell.name in parts])


# ------------------------------------------------------------------------------------- its page


def page(path: pathlib.Path) -> pathlib.Path:
    """Write `report.html` beside a `results.json`, and `README.md` with its figures as SVG files
    for a repository page, from rows alone."""
    described, target = describe(read(path)), path.with_name("report.html")
    pages.markdown(described, path.parent)
    pages.write(described, target)
    return target


def describe(results: Results) -> Page:
    """The page of results."""
    experiment = find(results.experiment)
    machines = [cell["machine"] for cell in results.cells]
    hosts = dict.fromkeys(map("{processor}, {device}, {system}".format_map, machines))
    used = dict.fromkeys(", ".join(f"{k} {v}" for k, v in m["versions"].items()) for m in machines)
    return Page(
        title=f"{results.experiment}: {catalogue.EXPERIMENTS[results.experiment]}",
        lead=experiment.published,
        command=results.command,
        sections=sections(experiment, results),
        facts={
            "budget": results.budget,
            "runs": [f"{named(c['labels'])}: {extent(c)}" for c in results.cells],
            "machine": list(hosts),
            "versions": list(used),
        },
        banner=SMOKE if results.budget == "smoke" else "",
    )


def sections(experiment: Experiment, results: Results) -> list[Section]:
    """What the views of an experiment make of results, in order, and how to read it."""
    found = [x for view in experiment.views for x in view(results, experiment.values)]
    told = [text for text, x in experiment.notes if not x or results.where(**x).cells]
    return [*found, Text("How to read it", told)] if told else found


def extent(cell: Mapping[str, Any]) -> str:
    """Runs and their budget, in words; `cell` as recorded."""
    budget = cell["budget"]
    words = [f"{budget[name]:,} {name}" for name in ("frames", "generations") if name in budget]
    words += [f"a score of {budget['stop_at']:,.0f}"] if "stop_at" in budget else []
    return f"{len(cell['seeds'])} × {' or '.join(words)}"
