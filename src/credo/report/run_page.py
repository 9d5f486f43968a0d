"""One page about runs: what `credo report` writes.

It reads what runs have recorded: no environment is opened, and no code that a record names is
imported but Credo's own. So a page about a stranger's run needs no trust in them.
"""

import json
import pathlib
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..algorithms.lineage import MAKERS
from ..analysis import attribution, bounds
from ..learners.base import AbstractLearner
from ..runs import config
from ..runs.record import RunError
from ..runs.store import Run
from .pages import write as write_page
from .sections import Cell, Curve, Figure, Page, Reference, Section, Summary, Table

Tree = Mapping[str, Any]  # of a record: an object as `config.to_tree` makes it
Groups = Mapping[str, list[Run]]  # runs that differ in their seed alone, by label

MOST_FIELDS = 3  # in a label


def write(
    paths: Sequence[pathlib.Path],
    target: pathlib.Path,
    *,
    labels: Sequence[str] | None = None,
) -> pathlib.Path:
    """Write a page about runs to `target` and return it. Runs that differ in their seed alone are
    one curve; `labels`: what to call those curves, in order of the first run of each.

    **Raises:** `RunError` if a path is no run, a run has no generation yet, or there are not as
    many labels as curves.
    """
    groups: dict[str, list[Run]] = {}
    for path in paths:
        run = Run(path)
        if not run.metrics:
            raise RunError(f"{path} has no generation yet: wait for its first, or resume it")
        groups.setdefault(json.dumps(run.config["algorithm"]), []).append(run)
    names = group_labels([json.loads(key) for key in groups])
    if labels is not None:
        if len(set(labels)) != len(labels) or len(labels) != len(names):
            raise RunError(
                f"{len(set(labels))} different labels are given for {len(names)} curves: give one "
                f"for each of {'; '.join(names)}"
            )
        names = list(labels)
    runs = dict(zip(names, groups.values(), strict=True))
    target.parent.mkdir(parents=True, exist_ok=True)
    write_page(describe(runs, paths), target)
    return target


def describe(runs: Groups, paths: Sequence[pathlib.Path]) -> Page:
    """The page about runs."""
    first = paths[0].name if len(paths) == 1 else f"{len(paths)} runs"
    every = [run for group in runs.values() for run in group]
    machines = [run.config["machine"] for run in every]
    return Page(
        title=f"Credo: {first}",
        lead=_lead(every),
        command="credo report " + shlex.join(map(str, paths)),
        sections=[
            _figure(runs, "champion_score", "Best policy on fresh episodes, as last tested"),
            *_improved(runs),
            _table(runs),
            *_attributions(runs),
            *_settings(runs),
        ],
        facts={
            "seeds": [
                f"{label}: {', '.join(str(run.config['seed']) for run in group)}"
                for label, group in runs.items()
            ],
            "machine": _once(
                f"{m['processor']}, {m['cores']} cores, {m['system']}" for m in machines
            ),
            "versions": _once(
                ", ".join(f"{k} {v}" for k, v in m["versions"].items()) for m in machines
            ),
        },
    )


def _once(texts: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(texts))


def _lead(runs: Sequence[Run]) -> str:
    tasks = {
        str(tree["id"]) if "id" in tree else config.brief(tree)
        for tree in (run.config["algorithm"]["env"] for run in runs)
    }
    return f"Task: {'; '.join(sorted(tasks))}."


# ------------------------------------------------------------------------------------------- labels


def word(tree: Tree) -> str:
    """What the command line calls the algorithm of a record: `td3`, `cerl`, `ea`; of one's own the
    name of its class."""
    name = _class(tree)
    if name == "ERL":
        return ("ea", "erl", "cerl")[min(len(tree.get("learners", ())), 2)]
    if name == "OffPolicy":
        return _learner_word(tree["learner"])
    return name.lower() if tree["class"].startswith("credo.algorithms.") else name


def _learner_word(learner: Tree) -> str:
    """DDPG is TD3 less its three additions, and has one critic; the critics of MATD3 and MADDPG see
    the whole team."""
    name = _class(learner)
    if name != "TD3":
        return name.lower() if learner["class"].startswith("credo.learners.") else name
    single = learner.get("critics") == learner.get("policy_delay") == 1
    team = _class(learner.get("critic") or {"class": ""}) == "JointCritic"
    return ("ma" if team else "") + ("ddpg" if single else "td3")


def _class(tree: Tree) -> str:
    return tree["class"].partition(":")[2]


def group_labels(trees: Sequence[Tree]) -> list[str]:
    """What tells algorithms apart: the word of each and, where two share it, at most three fields
    in which these differ."""
    words = [word(tree) for tree in trees]
    flat = [config.flatten(_indexed(tree)) for tree in trees]
    labels = list(words)
    for name in dict.fromkeys(words):
        same = [i for i, other in enumerate(words) if other == name]
        if len(same) > 1:
            fields = telling([flat[i] for i in same])
            for i in same:
                told = [f"{_short(key, fields)} {_text(flat[i].get(key))}" for key in fields]
                labels[i] = f"{name}: {', '.join(told)}"
    return numbered(labels)


def telling(flat: Sequence[Mapping[str, Any]]) -> list[str]:
    """At most three fields by which settings can be told apart, or nearly so."""

    def kinds(fields: Sequence[str]) -> int:
        return len({tuple(str(tree.get(key)) for key in fields) for tree in flat})

    found: list[str] = []
    keys = differing(flat)
    while keys and len(found) < MOST_FIELDS and kinds(found) < len(flat):
        found.append(max(keys, key=lambda key: kinds([*found, key])))
    return found


def differing(flat: Sequence[Mapping[str, Any]]) -> list[str]:
    """Fields that are not the same everywhere."""
    keys = dict.fromkeys(key for tree in flat for key in tree)
    return [key for key in keys if len({str(tree.get(key)) for tree in flat}) > 1]


def numbered(names: Sequence[str]) -> list[str]:
    """Names that differ: a number behind one that is there several times."""
    return [
        f"{name} ({names[:i].count(name) + 1})" if names.count(name) > 1 else name
        for i, name in enumerate(names)
    ]


def _short(key: str, others: Sequence[str]) -> str:
    """The last part of a field's name, if no other field of a label has it."""
    last = key.rpartition(".")[2]
    alone = sum(other.rpartition(".")[2] == last for other in others) == 1
    return last if alone and not last.isdigit() else key


def _text(value: Any, most: int = 24) -> str:
    text = "none" if value is None else str(value)
    return text if len(text) <= most else f"{text[: most - 1]}…"


def _indexed(tree: Any) -> Any:
    """A config tree whose lists of objects are dicts of them, so that each field has a name:
    `learners.0.gamma`."""
    if isinstance(tree, dict):
        return {key: _indexed(value) for key, value in tree.items()}
    if isinstance(tree, list) and any(isinstance(value, dict) for value in tree):
        return {str(i): _indexed(value) for i, value in enumerate(tree)}
    return tree


# ------------------------------------------------------------------------------------------- scores


def _improved(runs: Groups) -> list[Figure]:
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


def _figure(runs: Groups, metric: str, title: str) -> Figure:
    budgets = [run.config.get("budget", {}) for group in runs.values() for run in group]
    unit = "frames" if all(budget.get("frames") for budget in budgets) else "generation"
    curves = [_curve(label, group, metric, unit) for label, group in runs.items()]
    known = [_bounds(group[0]) for group in runs.values()] if metric == "champion_score" else []
    levels = dict.fromkeys(level for pair in known if pair for level in pair)
    names = {"champion_score": "success" if levels else "return", "fitness_max": "fitness"}
    return Figure(title, unit, names.get(metric, metric), curves, tuple(levels))


def _curve(label: str, group: list[Run], metric: str, unit: str) -> Curve:
    """One metric of runs that differ in their seed, as far as all of them are. Over frames they
    have rows at places of their own: each keeps its value until its next row."""
    columns = [run.metrics for run in group]
    if unit == "generation":
        length = min(len(c[unit]) for c in columns)
        values = np.stack([c[metric][:length] for c in columns])
        return Curve(label, columns[0][unit][:length], values)
    grid = attribution.axis([min((c[unit] for c in columns), key=lambda x: x[-1])], 240)
    grid = np.union1d(grid, [max(float(c[unit][0]) for c in columns)])  # where all have begun
    return Curve(label, grid, [attribution.on_grid(c[unit], c[metric], grid) for c in columns])


def _bounds(run: Run) -> tuple[Reference, Reference] | None:
    """The best baseline and the upper bound of a run's task, where they are known exactly. No
    other task is made: that might run code of others."""
    recorded = run.config["algorithm"]["env"]
    if recorded["class"] not in map(config.class_name, bounds.EXACT):
        return None
    task = config.from_tree(recorded)
    if not bounds.exact(task):
        return None
    name, value = bounds.best_baseline(task)
    highest = bounds.upper_bound(task).value
    return Reference(f"baseline: {name}", value), Reference("upper bound", highest)


def _table(runs: Groups) -> Table:
    known = [_bounds(group[0]) for group in runs.values()]
    rows = []
    for (label, group), limits in zip(runs.items(), known, strict=True):
        scores = [float(run.metrics["champion_score"][-1]) for run in group]
        score = Summary(scores, [run.config["seed"] for run in group])
        last = min(int(run.metrics["generation"][-1]) for run in group)
        told: list[Cell] = [None, None]
        if limits is not None:
            low, high = limits
            told = [f"{low.value:.3f} ({low.label.partition(': ')[2]})", high.value]
        rows.append([label, score, *(told if any(known) else ()), len(group), last])
    beside = ["baseline", "upper bound"] if any(known) else []
    caption = f"On {_episodes(runs)} fresh episodes; `credo evaluate` plays more."
    return Table(
        "Score of the best policy, as last tested",
        ["algorithm", "best policy", *beside, "seeds", "generations"],
        rows,
        caption + ("" if beside else " No baseline and no upper bound of this task are known."),
    )


def _episodes(runs: Groups) -> str:
    each = [group[0].config["algorithm"]["test_episodes"] for group in runs.values()]
    return " or ".join(str(n) for n in sorted(set(each)))


# -------------------------------------------------------------------------------------- attribution


def _attributions(runs: Groups) -> list[Section]:
    sections: list[Section] = []
    for label, group in runs.items():
        metrics = [run.metrics for run in group]
        if all(map(attribution.known, metrics)):
            names = learner_names(group[0].config["algorithm"].get("learners", ()))
            title = f"{label}: " if len(runs) > 1 else ""
            sections += attributed(attribution.summary(metrics), names, title)
    return sections


def attributed(found: Mapping[str, Any], learners: list[str], title: str = "") -> list[Section]:
    """What `attribution.summary` found as figures and a table. `title`: put before each title."""
    made = np.array(found["makers"], np.float64)  # [runs, makers, points]
    present = [i for i in range(len(MAKERS)) if np.nanmax(made[:, i], initial=0.0) > 0]
    sections: list[Section] = [
        Figure(
            f"{title}Who was the last to change the best policy",
            "frames",
            "share of best policies, mean of a tenth of the run",
            [Curve(MAKERS[i], found["frames"], made[:, i]) for i in present],
            y_range=(0.0, 1.0),
        )
    ]
    if not learners:
        return sections
    ancestors = [*learners, "first draw"]  # a learner has one colour in both figures
    over_time = {
        "Where the best policy's weights come from": ("ancestry", ancestors, "expected share"),
        "Workers of each learner so far": ("allocation", learners, "share of all workers"),
    }
    for name, (key, labels, unit) in over_time.items():
        if len(labels) > 1:
            values = np.array(found[key], np.float64)  # [runs, labels, points]
            curves = [Curve(x, found["frames"], values[:, i]) for i, x in enumerate(labels)]
            sections.append(Figure(title + name, "frames", unit, curves, y_range=(0.0, 1.0)))
    return [*sections, fates(found, learners, title)]


def fates(found: Mapping[str, Any], learners: list[str], title: str = "") -> Table:
    """Allocation, and the fate of injected actors, in percent."""
    shares = np.array(found["fates"], np.float64)  # [runs, q, 3]
    allocated = np.array(found["allocated"], np.float64)
    injected = np.array(found["injected"])
    rows = [
        [
            name,
            percent(allocated[:, i]),
            int(injected[:, i].sum()),
            *(percent(shares[:, i, j]) for j in range(len(attribution.FATES))),
        ]
        for i, name in enumerate(learners)
    ]
    return Table(
        f"{title}Learners: their workers, and the fate of their actors in the population",
        ["learner", "workers, %", "injected", *(f"{fate}, %" for fate in attribution.FATES)],
        rows,
        caption="Injected: actors that were judged, in all runs together; the last ones may not "
        "have been. Selected: a parent, but no elite.",
    )


def percent(shares: np.ndarray) -> Summary:
    """Shares `[runs]` in percent."""
    values = [float(x) if np.isfinite(x) else None for x in shares]
    return Summary(values, scale=100.0, digits=1)


def learner_names(learners: Sequence[AbstractLearner | Tree]) -> list[str]:
    """What to call learners, or records of them: their kind and discount, and a number where that
    is not enough."""
    names = []
    for learner in map(config.to_tree, learners):
        gamma = learner.get("gamma")
        kind = _learner_word(learner)
        kind = kind.upper() if learner["class"].startswith("credo.") else kind
        names.append(kind if gamma is None else f"{kind} γ {gamma:g}")
    return numbered(names)


# ----------------------------------------------------------------------------------------- settings


def _settings(runs: Groups) -> list[Table]:
    """Settings that several algorithms have and that differ; and all, where those are marked."""
    flat = [config.flatten(_indexed(group[0].config["algorithm"])) for group in runs.values()]
    keys = list(dict.fromkeys(key for tree in flat for key in tree))
    unlike = {key for key in differing(flat) if sum(key in tree for tree in flat) > 1}
    rows = {key: [key, *(_text(tree[key]) if key in tree else "" for tree in flat)] for key in keys}
    columns = ["setting", *runs]
    every = Table(
        "All settings",
        columns,
        list(rows.values()),
        caption="Marked: settings that differ." if unlike else "",
        marked=[i for i, key in enumerate(keys) if key in unlike],
        folded=True,
    )
    few = Table("Settings that differ", columns, [rows[key] for key in keys if key in unlike])
    return [few, every] if unlike else [every]
