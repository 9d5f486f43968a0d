"""What every experiment shares: cells of runs, budgets, the folder of results."""

import importlib
import json
import pathlib
from typing import Any, Protocol

import equinox as eqx

from ..runs import config, executor
from ..runs.loop import Run
from ..runs.page import Page, write

MODULES = {
    "fig-3.4a": "fig_3_4a",
    "fig-3.5a": "fig_3_5a",
    "fig-3.5b": "fig_3_5b",
    "table-3.1": "table_3_1",
    "table-3.2": "table_3_2",
    "fig-3.6": "fig_3_6",
    "fig-3.7": "fig_3_7",
    "alg-3.3": "alg_3_3",
    "fig-3.9a": "fig_3_9a",
    "fig-3.10": "fig_3_10",
    "ablation-3.4a": "ablation_3_4a",
}


class Cell(eqx.Module):
    """Independent runs of one algorithm that differ in their seed alone."""

    name: str  # also the folder of its runs: experiments that share a cell share its runs
    algorithm: Any
    generations: int
    runs: int
    first_seed: int = 0  # settings chosen by looking at some seeds are reported on others


class Experiment(Protocol):
    """What a module of this folder defines."""

    TITLE: str
    PUBLISHED: str  # where the dissertation has it

    def cells(self, budget: str) -> list[Cell]:
        """The runs it needs. `budget`: smoke (seconds), quick (minutes) or full."""
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
    jobs: int | None = None,
    output: pathlib.Path = pathlib.Path("reproduced"),
    work: pathlib.Path = pathlib.Path("runs/reproduce"),
) -> pathlib.Path:
    """Run what is missing, measure, and write `results.json` and `report.html`.

    **Returns:** the path of the page.
    """
    module: Any = importlib.import_module(f".{MODULES[name]}", __package__)
    cells = [
        cell if runs is None else eqx.tree_at(lambda c: c.runs, cell, runs)
        for cell in module.cells(budget)
    ]
    folder = {
        cell.name: [work / budget / cell.name / str(s) for s in seeds(cell)] for cell in cells
    }
    executor.run(
        [
            executor.Job(path, cell.algorithm, cell.generations, seed)
            for cell in cells
            for seed, path in zip(seeds(cell), folder[cell.name], strict=True)
        ],
        jobs,
        title=f"{name} {budget}",
    )
    finished = {name: [Run(path) for path in paths] for name, paths in folder.items()}
    results = {
        "experiment": name,
        "budget": budget,
        "command": f"credo reproduce {name} --budget {budget}"
        + (f" --runs {runs}" if runs is not None else ""),
        "cells": {
            cell.name: {
                "runs": cell.runs,
                "first seed": cell.first_seed,
                "generations": cell.generations,
                "algorithm": config.to_tree(cell.algorithm),
            }
            for cell in cells
        },
        "machine": config.machine(),
        "measured": module.measure(finished, budget),
    }
    target = output / name / budget
    target.mkdir(parents=True, exist_ok=True)
    (target / "results.json").write_text(_compact(results))
    return page(target / "results.json")


def seeds(cell: Cell) -> range:
    return range(cell.first_seed, cell.first_seed + cell.runs)


def page(results: pathlib.Path) -> pathlib.Path:
    """Write `report.html` beside a `results.json`, from its numbers alone."""
    record = json.loads(results.read_text())
    module: Any = importlib.import_module(f".{MODULES[record['experiment']]}", __package__)
    machine = record["machine"]
    facts = {
        "budget": record["budget"],
        "runs": ", ".join(
            f"{name}: {cell['runs']} × {cell['generations']} generations"
            for name, cell in record["cells"].items()
        ),
        "machine": f"{machine['processor']}, {machine['device']}, {machine['system']}",
        "versions": ", ".join(f"{k} {v}" for k, v in machine["versions"].items()),
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
