"""One page about runs: what `credo report` writes.

It reads what runs have recorded: no environment is opened, and no code that a record names is
imported but Credo's own. So a page about a stranger's run needs no trust in them.
"""

import json
import pathlib
import shlex
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..algorithms.lineage import MAKERS
from ..analysis import attribution, floors, statistics
from ..environments.base import AbstractSequenceTask
from ..environments.sequence_classification import SequenceClassification
from ..environments.sequence_recall import SequenceRecall
from ..learners.base import AbstractLearner
from ..runs import config
from ..runs.loop import Run, RunError
from .page import Curve, Figure, Page, Reference, Section, Table
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
        command="credo report " + shlex.join(map(str, paths)),
        sections=[
            _figure(runs, "champion_score", "Champion on fresh episodes, as last tested"),
            *_improved(runs),
            _table(runs),
            *_attributions(runs),
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


def _improved(runs: dict[str, list[Run]]) -> list[Figure]:
    """What each algorithm improves: fitness, or a loss."""
    titles = {"fitness_max": "Best fitness of each generation", "loss": "Loss of each generation"}
    found = []
    for metric, title in titles.items():
        known = {
            label: group
            for label, group in runs.items()
            if all(metric in run.metrics for run in group)
            and (metric == "fitness_max" or "fitness_max" not in group[0].metrics)
        }
        found += [_figure(known, metric, title)] if known else []
    return found


def _lead(runs: dict[str, list[Run]]) -> str:
    tasks = {config.brief(r.config["algorithm"]["env"]) for group in runs.values() for r in group}
    return f"Task: {'; '.join(sorted(tasks))}."


def _labels(trees: list[dict[str, Any]]) -> list[str]:
    """What tells groups of runs apart: the fields in which they differ."""
    names = [tree["class"].partition(":")[2] for tree in trees]
    if len(trees) == 1:
        return names
    flat = [config.flatten(_indexed(tree)) for tree in trees]
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
    budgets = [run.config.get("budget", {}) for group in runs.values() for run in group]
    unit = "frames" if all(budget.get("frames") for budget in budgets) else "generation"
    for label, group in runs.items():
        curves.append(_curve(label, group, metric, unit))
        task = _task(group[0])
        if metric == "champion_score" and task is not None and not references:
            known = floors.floor(task) if floors.known(task) else None
            if known is not None:
                references.append(Reference(f"floor: {known[0]}", known[1]))
            references.append(Reference("ceiling", 1.0))
    return Figure(title, unit, metric.replace("_", " "), curves, tuple(references))


def _curve(label: str, group: list[Run], metric: str, unit: str) -> Curve:
    """One metric of runs that differ in their seed, as far as all of them are. Over frames they
    have rows at places of their own: each keeps its value until its next row."""
    columns = [run.metrics for run in group]
    if unit == "generation":
        length = min(len(c[unit]) for c in columns)
        values = np.stack([c[metric][:length] for c in columns])
        return Curve(label, columns[0][unit][:length], values)
    grid = attribution.axis([min((c[unit] for c in columns), key=lambda x: x[-1])], 400)
    return Curve(label, grid, [attribution.on_grid(c[unit], c[metric], grid) for c in columns])


def _attributions(runs: dict[str, list[Run]]) -> list[Section]:
    sections: list[Section] = []
    for label, group in runs.items():
        metrics = [run.metrics for run in group]
        if all(map(attribution.known, metrics)):
            names = learner_names(group[0].config["algorithm"].get("learners", ()))
            title = f"{label}: " if len(runs) > 1 else ""
            sections += attributed(attribution.summary(metrics), names, title)
    return sections


def attributed(found: dict[str, Any], learners: list[str], title: str = "") -> list[Section]:
    """What `attribution.summary` found as figures and a table. `title`: put before each title."""
    made = np.array(found["makers"], np.float64)  # [runs, makers, points]
    present = [i for i in range(len(MAKERS)) if np.nanmax(made[:, i], initial=0.0) > 0]
    sections: list[Section] = [
        Figure(
            f"{title}Who was the last to change the champion",
            "frames",
            "share of champions, mean of a tenth of the run",
            [Curve(MAKERS[i], found["frames"], made[:, i]) for i in present],
            y_range=(0.0, 1.0),
        )
    ]
    if not learners:
        return sections
    ancestors = [*learners, "first draw"]  # a learner has one colour in both figures
    over_time = {
        "Where the champion's weights come from": ("ancestry", ancestors, "expected share"),
        "Workers of each learner so far": ("allocation", learners, "share of all workers"),
    }
    for name, (key, labels, unit) in over_time.items():
        if len(labels) > 1:
            values = np.array(found[key], np.float64)  # [runs, labels, points]
            curves = [Curve(x, found["frames"], values[:, i]) for i, x in enumerate(labels)]
            sections.append(Figure(title + name, "frames", unit, curves, y_range=(0.0, 1.0)))
    return [*sections, fates(found, learners, title)]


def fates(found: dict[str, Any], learners: list[str], title: str = "") -> Table:
    """Allocation, and the fate of injected actors, mean ± standard error over runs."""
    shares = np.array(found["fates"], np.float64)  # [runs, q, 3]
    allocated = np.array(found["allocated"], np.float64)
    counts = np.array(found["injected"])
    rows = [
        [
            name,
            percent(allocated[:, i]),
            str(int(counts[:, i].sum())),
            *(percent(shares[:, i, j]) for j in range(len(attribution.FATES))),
        ]
        for i, name in enumerate(learners)
    ]
    return Table(
        f"{title}Learners: their workers, and the fate of their actors in the population",
        ["learner", "workers, %", "injected", *(f"{fate}, %" for fate in attribution.FATES)],
        rows,
        caption="Mean ± standard error over runs. Injected: actors that were judged, in all runs "
        "together; the last ones may not have been. Selected: a parent, but no elite.",
    )


def percent(shares: np.ndarray) -> str:
    """Mean ± standard error over runs, in percent; runs without a value are left out."""
    shares = shares[np.isfinite(shares)]
    if not shares.size:
        return "–"
    mean, error = (100 * float(x) for x in statistics.mean_and_standard_error(shares))
    return f"{mean:.1f} ± {error:.1f}" if len(shares) > 1 else f"{mean:.1f}"


def learner_names(learners: Sequence[AbstractLearner | dict[str, Any]]) -> list[str]:
    """What to call learners, or records of them: their kind and discount, and a number where that
    is not enough."""
    names = [_learner_name(config.to_tree(learner)) for learner in learners]
    return [
        f"{name} ({names[:i].count(name) + 1})" if names.count(name) > 1 else name
        for i, name in enumerate(names)
    ]


def _learner_name(learner: dict[str, Any]) -> str:
    kind = learner["class"].partition(":")[2]
    if kind == "TD3" and learner.get("critics") == learner.get("policy_delay") == 1:
        kind = "DDPG"  # the same mathematics, less three additions
    gamma = learner.get("gamma")
    return kind if gamma is None else f"{kind} γ {gamma:g}"


def _task(run: Run) -> AbstractSequenceTask | None:
    """The task of a run, if it is one whose floor Credo may know. Any other is not made: that might
    run somebody's code."""
    recorded = run.config["algorithm"]["env"]
    ours = map(config.class_name, (SequenceClassification, SequenceRecall))
    return config.from_tree(recorded) if recorded["class"] in ours else None


def _table(runs: dict[str, list[Run]]) -> Table:
    rows = []
    for label, group in runs.items():
        scores = np.array([run.metrics["champion_score"][-1] for run in group])
        task = _task(group[0])
        known = None if task is None or not floors.known(task) else floors.floor(task)
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
        "Score of the champion that was tested last",
        ["runs", "seeds", "generations", "floor", "mean ± s.e.", "median", "ceiling"],
        rows,
        caption=f"On {episodes} fresh episodes; `credo evaluate` plays more.",
    )


def _settings(runs: dict[str, list[Run]]) -> Table:
    flat = {
        label: config.flatten(_indexed(group[0].config["algorithm"]))
        for label, group in runs.items()
    }
    keys = dict.fromkeys(key for tree in flat.values() for key in tree)
    return Table(
        "Settings",
        ["field", *flat],
        [[key, *(str(tree.get(key, "")) for tree in flat.values())] for key in keys],
    )


def _indexed(tree: Any) -> Any:
    """A config tree whose lists of objects are dicts of them, so that each field has a name:
    `learners.0.gamma`."""
    if isinstance(tree, dict):
        return {key: _indexed(value) for key, value in tree.items()}
    if isinstance(tree, list) and any(isinstance(value, dict) for value in tree):
        return {str(i): _indexed(value) for i, value in enumerate(tree)}
    return tree
