"""One page about runs: what `credo report` writes."""

import json
import pathlib
from typing import Any

import numpy as np

from ..analysis import floors, statistics
from ..environments.base import AbstractSequenceTask
from . import config
from .loop import Run, RunError
from .page import Curve, Figure, Page, Reference, Table
from .page import write as write_page


def write(paths: list[pathlib.Path], target: pathlib.Path) -> pathlib.Path:
    """Runs that differ in their seed alone are one curve. Returns the page's path."""
    groups: dict[str, list[Run]] = {}
    for path in paths:
        run = Run(path)
        if not run.metrics:
            raise RunError(f"{path} has no generation yet: wait for its first, or resume it")
        groups.setdefault(json.dumps(run.config["algorithm"]), []).append(run)
    labels = _labels([json.loads(key) for key in groups])
    runs = dict(zip(labels, groups.values(), strict=True))
    first = paths[0].name if len(paths) == 1 else f"{len(paths)} runs"
    machine = next(iter(runs.values()))[0].config["machine"]
    page = Page(
        title=f"Credo: {first}",
        lead=_lead(runs),
        command="credo report " + " ".join(map(str, paths)),
        sections=[
            _figure(runs, "champion_score", "Champion of each generation on fresh episodes"),
            _figure(runs, "fitness_max", "Best fitness of each generation"),
            _table(runs),
            _settings(runs),
        ],
        facts={
            "machine": f"{machine['processor']}, {machine['cores']} cores, {machine['system']}",
            "versions": ", ".join(f"{k} {v}" for k, v in machine["versions"].items()),
            "seeds": "; ".join(
                f"{label}: {', '.join(str(r.config['seed']) for r in group)}"
                for label, group in runs.items()
            ),
        },
    )
    target.parent.mkdir(parents=True, exist_ok=True)
    write_page(page, target)
    return target


def _lead(runs: dict[str, list[Run]]) -> str:
    tasks = {config.brief(r.config["algorithm"]["env"]) for group in runs.values() for r in group}
    return f"Task: {'; '.join(sorted(tasks))}."


def _labels(trees: list[dict[str, Any]]) -> list[str]:
    """What tells groups of runs apart: the fields in which they differ."""
    names = [tree["class"].partition(":")[2] for tree in trees]
    if len(trees) == 1:
        return names
    flat = [config.flatten(tree) for tree in trees]
    keys = dict.fromkeys(key for tree in flat for key in tree)
    differing = [key for key in keys if len({str(tree.get(key)) for tree in flat}) > 1]

    def named(keys: list[str]) -> list[str]:
        return [
            f"{name}: " + ", ".join(f"{key} {tree[key]}" for key in keys if key in tree)
            for name, tree in zip(names, flat, strict=True)
        ]

    short = named(differing[:3])
    return short if len(set(short)) == len(short) else named(differing)


def _figure(runs: dict[str, list[Run]], metric: str, title: str) -> Figure:
    curves, references = [], []
    for label, group in runs.items():
        columns = [run.metrics for run in group]
        length = min(len(c["generation"]) for c in columns)
        values = np.stack([c[metric][:length] for c in columns])
        curves.append(Curve(label, columns[0]["generation"][:length], values))
        task = group[0].algorithm.env
        if metric == "champion_score" and isinstance(task, AbstractSequenceTask) and not references:
            known = floors.floor(task) if floors.known(task) else None
            if known is not None:
                references.append(Reference(f"floor: {known[0]}", known[1]))
            references.append(Reference("ceiling", 1.0))
    return Figure(title, "generation", metric.replace("_", " "), curves, tuple(references))


def _table(runs: dict[str, list[Run]]) -> Table:
    rows = []
    for label, group in runs.items():
        scores = np.array([run.metrics["champion_score"][-1] for run in group])
        task = group[0].algorithm.env
        known = floors.floor(task) if floors.known(task) else None
        mean, error = statistics.mean_and_standard_error(scores)
        spread = (
            f"{float(mean):.3f} ± {float(error):.3f}" if len(scores) > 1 else f"{scores[0]:.3f}"
        )
        rows.append(
            [
                label,
                str(len(group)),
                str(int(min(run.metrics["generation"][-1] for run in group))),
                f"{known[1]:.3f} ({known[0]})" if known else "not known",
                spread,
                f"{np.median(scores):.3f}",
                "1" if known else "not known",
            ]
        )
    episodes = next(iter(runs.values()))[0].config["algorithm"]["test_episodes"]
    return Table(
        "Score of the last generation's champion",
        ["runs", "seeds", "generations", "floor", "mean ± s.e.", "median", "ceiling"],
        rows,
        caption=f"On {episodes} fresh episodes; `credo evaluate` plays more.",
    )


def _settings(runs: dict[str, list[Run]]) -> Table:
    flat = {label: config.flatten(group[0].config["algorithm"]) for label, group in runs.items()}
    keys = dict.fromkeys(key for tree in flat.values() for key in tree)
    return Table(
        "Settings",
        ["field", *flat],
        [[key, *(str(tree.get(key, "")) for tree in flat.values())] for key in keys],
    )
