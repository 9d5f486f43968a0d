"""What every experiment shares: cells of runs, budgets, the folder of results."""

import dataclasses
import importlib
import json
import pathlib
import re
import shlex
import sys
from collections.abc import Iterable
from typing import Any, Protocol

import equinox as eqx

from ..executors import local
from ..report.pages import write
from ..report.sections import Page
from ..runs import config, files
from ..runs.options import RunOptions
from ..runs.record import RunError
from ..runs.store import Run

MODULES = {
    "fig-3.4a": "fig_3_4a",
    "fig-3.4b": "fig_3_4b",
    "fig-3.5a": "fig_3_5a",
    "fig-3.5b": "fig_3_5b",
    "table-3.1": "table_3_1",
    "table-3.2": "table_3_2",
    "fig-3.6": "fig_3_6",
    "fig-3.7": "fig_3_7",
    "alg-3.3": "alg_3_3",
    "fig-3.9a": "fig_3_9a",
    "fig-3.9b": "fig_3_9b",
    "fig-3.10": "fig_3_10",
    "fig-3.11": "fig_3_11",
    "fig-3.12": "fig_3_12",
    "fig-3.13": "fig_3_13",
    "beyond-3": "beyond_3",
    "ablation-3.4a": "ablation_3_4a",
    "fig-4.2": "fig_4_2",
    "fig-4.3": "fig_4_3",
    "fig-4.4": "fig_4_4",
    "fig-4.7": "fig_4_7",
    "fig-4.8": "fig_4_8",
    "table-4.1": "table_4_1",
    "beyond-4": "beyond_4",
    "check-td3": "check_td3",
    "check-learners": "check_learners",
    "fig-5.2": "fig_5_2",
    "fig-5.3": "fig_5_3",
    "fig-5.4": "fig_5_4",
    "table-5.2": "table_5_2",
    "note-5.5": "note_5_5",
    "beyond-5": "beyond_5",
    "fig-6.2": "fig_6_2",
    "fig-6.3": "fig_6_3",
    "fig-6.4": "fig_6_4",
    "fig-6.5": "fig_6_5",
    "table-6.1": "table_6_1",
    "beyond-6": "beyond_6",
    "fig-7.1": "fig_7_1",
    "fig-7.4": "fig_7_4",
    "fig-7.5": "fig_7_5",
    "beyond-7": "beyond_7",
    "check-spread": "check_spread",
}
BUDGETS = ("smoke", "quick", "full")  # a module may define more, as a name of the same


class Cell(eqx.Module):
    """Independent runs of one algorithm that differ in their seed alone."""

    name: str  # also the folder of its runs: experiments that share a cell share its runs
    algorithm: Any
    generations: int | None  # budget of each run; None: frames alone limit it
    runs: int
    first_seed: int = 0  # settings chosen by looking at some seeds are reported on others
    frames: int | None = None  # budget of each run, in environment steps
    stop_at: float | None = None  # a run ends early once its champion's score reaches this


class Experiment(Protocol):
    """What a module of this folder defines."""

    TITLE: str
    PUBLISHED: str  # where the dissertation has it

    def cells(self, budget: str) -> list[Cell]:
        """The runs it needs. `budget`: smoke (seconds), quick (minutes), full, or one of its own
        `BUDGETS`."""
        ...

    def measure(self, runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
        """Plain numbers, per seed, from the runs of every cell."""
        ...

    def sections(self, results: dict[str, Any]) -> list[Any]:
        """Figures and tables of the page, from `measure`'s numbers alone."""
        ...


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
    whose name this regular expression is not found, in whatever case: "(erl|ddpg) Hopper". What
    earlier commands measured of the others stays, where its settings are today's.

    **Returns:** the path of the page. **Raises:** `RunError` if there is no such budget or cell.
    """
    module: Any = importlib.import_module(f".{MODULES[name]}", __package__)
    if budget not in (known := budgets(name)):
        raise RunError(f"{name} has no budget {budget!r}: it has {', '.join(known)}")
    every = module.cells(budget)
    cells = every if only is None else named(every, only, f"{name} at budget {budget}")
    if runs is not None:
        cells = [dataclasses.replace(cell, runs=runs) for cell in cells]
    target = output / name / budget / "results.json"
    earlier = None if only is None else kept(target, every, cells)
    folder = {
        cell.name: [work / budget / cell.name / str(s) for s in seeds(cell)] for cell in cells
    }
    local.run(
        [
            local.Job(path, cell.algorithm, seed, RunOptions(tensorboard=False, **limits(cell)))
            for cell in cells
            for seed, path in zip(seeds(cell), folder[cell.name], strict=True)
        ],
        jobs,
        title=f"{name} {budget}",
    )
    print(f"{name} {budget}: runs are done; measuring", file=sys.stderr)
    finished = {name: [Run(path) for path in paths] for name, paths in folder.items()}
    results = {
        "experiment": name,
        "budget": budget,
        "command": f"credo reproduce {name} --budget {budget}"
        + (f" --runs {runs}" if runs is not None else "")
        + (f" --only {shlex.quote(only)}" if only is not None else ""),
        "cells": {
            cell.name: {
                "runs": cell.runs,
                "first seed": cell.first_seed,
                **{name: limit for name, limit in limits(cell).items() if limit is not None},
                "algorithm": config.to_tree(cell.algorithm),
            }
            for cell in cells
        },
        "machine": config.machine(),
        "measured": module.measure(finished, budget),
    }
    if earlier is not None:
        results = merged(earlier, results, every)
    files.write_text(target, _compact(results))
    return page(target)


def named(cells: list[Cell], only: str, where: str) -> list[Cell]:
    """Those in whose name the regular expression is found; RunError if there are none."""
    try:
        pattern = re.compile(only, re.IGNORECASE)
    except re.error as error:
        raise RunError(f"only is {only!r}, no regular expression: {error}") from error
    found = [cell for cell in cells if pattern.search(cell.name)]
    if not found:
        names = "; ".join(cell.name for cell in cells)
        raise RunError(f"no cell of {where} has {only!r} in its name: there are {names}")
    return found


def kept(path: pathlib.Path, cells: list[Cell], chosen: list[Cell]) -> dict[str, Any] | None:
    """What was measured earlier of cells that are not `chosen` now, if today's runs of them would
    be the same (their number may differ; versions of Credo may too). Says what stays and what does
    not, and why."""
    if not path.exists():
        return None
    try:
        record = json.loads(files.read_text(path))
        measured, recorded, machine, _ = (
            record[name] for name in ("measured", "cells", "machine", "command")
        )
    except (ValueError, KeyError) as error:
        raise RunError(
            f"{path} is no record of results ({error!r}): move it away, or choose another --output"
        ) from error
    others = [name for name in recorded if name not in {cell.name for cell in chosen}]
    known = {cell.name: cell for cell in cells}
    stay = []
    for name in others:
        why = _other_runs(recorded[name], known.get(name))
        if measured.keys() != recorded.keys():
            why = ["numbers of this experiment are of all its cells together"]
        if why:
            print(f"not kept of {path}: {name} ({'; '.join(why)})", file=sys.stderr)
        else:
            stay.append(name)
    if not stay:
        return None
    print(f"kept of {path}: {'; '.join(stay)}", file=sys.stderr)
    found = {name: {"machine": machine} | recorded[name] for name in stay}
    return record | {"cells": found, "measured": {name: measured[name] for name in stay}}


def merged(earlier: dict[str, Any], results: dict[str, Any], cells: list[Cell]) -> dict[str, Any]:
    """Results of two commands, in the order of `cells`. A cell names its machine if that is not
    the last command's."""
    here = results["machine"]
    old = {
        name: {key: value for key, value in cell.items() if (key, value) != ("machine", here)}
        for name, cell in earlier["cells"].items()
    }
    both = {"cells": old | results["cells"], "measured": earlier["measured"] | results["measured"]}
    order = [cell.name for cell in cells if cell.name in both["cells"]]
    now = results["command"]
    before = [command for command in earlier["command"].split(" && ") if command != now]
    return (
        results
        | {"command": " && ".join([*before, now])}
        | {key: {name: value[name] for name in order} for key, value in both.items()}
    )


def _other_runs(record: dict[str, Any], cell: Cell | None) -> list[str]:
    """How the runs of a recorded cell differ from today's."""
    if cell is None:
        return ["there is no such cell today"]
    today = json.loads(json.dumps(config.to_tree(cell.algorithm)))
    try:
        lines = config.changed(record["algorithm"], today)
    except (KeyError, TypeError, ValueError) as error:
        return [f"its record cannot be read: {error}"]
    given = {name: limit for name, limit in limits(cell).items() if limit is not None}
    given |= {"first seed": cell.first_seed}
    known = {k: v for k, v in record.items() if k not in ("runs", "algorithm", "machine")}
    return config.differences(known, given) + lines


def budgets(name: str) -> tuple[str, ...]:
    """The budgets that an experiment can be run at."""
    module: Any = importlib.import_module(f".{MODULES[name]}", __package__)
    return getattr(module, "BUDGETS", BUDGETS)


def limits(cell: Cell) -> dict[str, Any]:
    """What ends a run of this cell, by the names of `RunOptions`."""
    return {"generations": cell.generations, "frames": cell.frames, "stop_at": cell.stop_at}


def seeds(cell: Cell) -> range:
    return range(cell.first_seed, cell.first_seed + cell.runs)


def page(results: pathlib.Path) -> pathlib.Path:
    """Write `report.html` beside a `results.json`, from its numbers alone."""
    record = json.loads(files.read_text(results))
    module: Any = importlib.import_module(f".{MODULES[record['experiment']]}", __package__)
    cells = record["cells"]
    machines = [
        record["machine"],
        *(cell["machine"] for cell in cells.values() if "machine" in cell),
    ]
    facts = {
        "budget": record["budget"],
        "runs": ", ".join(
            f"{name}: {cell['runs']} × {extent(cell)}" for name, cell in cells.items()
        ),
        "machine": _once(f"{m['processor']}, {m['device']}, {m['system']}" for m in machines),
        "versions": _once(
            ", ".join(f"{k} {v}" for k, v in m["versions"].items()) for m in machines
        ),
    }
    target = results.with_name("report.html")
    write(
        Page(
            title=f"{record['experiment']}: {module.TITLE}",
            lead=module.PUBLISHED,
            command=record["command"],
            sections=module.sections(record["measured"]),
            facts=facts,
        ),
        target,
    )
    return target


def _once(texts: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(texts))


def extent(cell: dict[str, Any]) -> str:
    """The budget of a run, in words; `cell` as recorded in a `results.json`."""
    words = [
        f"{cell[name]:,} {name}" if name == "frames" else f"{cell[name]} {name}"
        for name in ("frames", "generations")
        if cell.get(name) is not None
    ]
    early = [f"a score of {cell['stop_at']:,.0f}"] if cell.get("stop_at") is not None else []
    return " or ".join(words + early)


def _compact(results: dict[str, Any]) -> str:
    """JSON with one line per list of numbers: small, and readable in a diff."""
    encoder = json.JSONEncoder(ensure_ascii=False)

    def render(value: Any, indent: int) -> str:
        pad = " " * indent
        if isinstance(value, dict) and value:
            inner = ",\n".join(
                f"{pad} {encoder.encode(str(k))}: {render(v, indent + 1)}" for k, v in value.items()
            )
            return f"{{\n{inner}\n{pad}}}"
        if isinstance(value, list) and any(isinstance(v, dict | list) for v in value):
            inner = ",\n".join(f"{pad} {render(v, indent + 1)}" for v in value)
            return f"[\n{inner}\n{pad}]"
        return encoder.encode(value)

    return render(results, 0) + "\n"
