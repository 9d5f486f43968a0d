"""One page about runs: what `credo report` writes.

It reads what runs have recorded: no environment but Credo's own in JAX is played, and no code that
a record names is imported but Credo's own. So a page about a stranger's run needs no trust in them.
"""

import functools
import json
import pathlib
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ..algorithms.lineage import MAKERS
from ..analysis import attribution, bounds
from ..learners.base import AbstractLearner
from ..runs import config
from ..runs.names import algorithm_word
from ..runs.record import RunError
from ..runs.store import Run
from . import champions
from .figures import shortened
from .pages import write as write_page
from .sections import Cell, Curve, Figure, Page, Reference, Section, Summary, Table, Text

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
    given = names if labels is None else labels
    if len(set(given)) != len(names) or len(given) != len(names):
        raise RunError(
            f"{len(set(given))} different labels are given for {len(names)} curves: give one "
            f"for each of {'; '.join(names)}"
        )
    return write_page(describe(dict(zip(given, groups.values(), strict=True)), paths), target)


def describe(runs: Groups, paths: Sequence[pathlib.Path]) -> Page:
    """The page about runs `paths`: scores, what each algorithm improves, attribution, settings, and
    where they were made. `runs`: those that differ in their seed alone, by label."""
    every = [run.config for group in runs.values() for run in group]
    machines = [config["machine"] for config in every]
    versions = (", ".join(f"{k} {v}" for k, v in m["versions"].items()) for m in machines)
    return Page(
        title=f"Credo: {paths[0].name if len(paths) == 1 else f'{len(paths)} runs'}",
        lead=f"Task: {'; '.join(sorted({_task(c['algorithm']['env']) for c in every}))}.",
        command="credo report " + shlex.join(map(str, paths)),
        sections=[
            _figure(runs, "champion_score", "Champion on fresh episodes, as last tested"),
            *_improved(runs),
            _table(runs),
            *_attributions(runs),
            *_pictures(runs),
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
            "versions": _once(versions),
        },
    )


def _once(texts: Iterable[str]) -> list[str]:
    """Texts without repetitions, in order of appearance."""
    return list(dict.fromkeys(texts))


def _task(tree: Tree) -> str:
    """The id of a task of Gymnasium or PettingZoo; of ours its class and fields; of a wrapper that
    of the task inside, and what the wrapper is."""
    if isinstance(inner := tree.get("env"), Mapping):
        around = {name: value for name, value in tree.items() if name != "env"}
        return f"{_task(inner)} in {config.brief(around)}"
    return str(tree["id"]) if "id" in tree else config.brief(dict(tree))


# ------------------------------------------------------------------------------------------- labels


def word(tree: Tree) -> str:
    """What the command line calls the algorithm of a record: `td3`, `cerl`, `ea`; of one's own the
    name of its class."""
    name = _class(tree)
    if name == "ERL":
        return algorithm_word(tree)
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
    """The class of a record without its module."""
    return tree["class"].partition(":")[2]


def group_labels(trees: Sequence[Tree]) -> list[str]:
    """What tells algorithms apart: the word of each and, where two share it, at most three fields
    in which these differ."""
    words = [word(tree) for tree in trees]
    flat = [config.flatten(_indexed(tree)) for tree in trees]
    labels = []
    for name, tree in zip(words, flat, strict=True):
        fields = telling([x for x, other in zip(flat, words, strict=True) if other == name])
        told = ", ".join(f"{_short(key, fields)} {_text(tree.get(key))}" for key in fields)
        labels.append(f"{name}: {told}" if told else name)
    return numbered(labels)


def telling(flat: Sequence[Mapping[str, Any]]) -> list[str]:
    """At most three fields by which settings can be told apart, or nearly so: again and again the
    field that tells most of them apart, given those that were chosen before."""

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


def _text(value: Any) -> str:
    """A setting in words, at most 24 characters."""
    return "none" if value is None else shortened(value)


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
    """What each algorithm improves: fitness, or a loss, where all of its runs have recorded it. One
    figure for each of the two that any algorithm has."""
    titles = {"fitness_max": "Best fitness of each generation", "loss": "Loss of each generation"}
    improves = {
        label: next((x for x in titles if all(x in run.metrics for run in group)), None)
        for label, group in runs.items()
    }
    return [
        _figure({x: runs[x] for x in runs if improves[x] == metric}, metric, title)
        for metric, title in titles.items()
        if metric in improves.values()
    ]


def _figure(runs: Groups, metric: str, title: str) -> Figure:
    """A metric of every algorithm over frames, or over generations where no run counts frames."""
    budgets = [run.config.get("budget", {}) for group in runs.values() for run in group]
    unit = "frames" if all(budget.get("frames") for budget in budgets) else "generation"
    curves = [_curve(label, group, metric, unit) for label, group in runs.items()]
    scores = metric == "champion_score"
    levels = dict.fromkeys(x for group in runs.values() if scores for x in _bounds(group) or ())
    names = {"champion_score": "success" if levels else "return", "fitness_max": "fitness"}
    return Figure(title, unit, names.get(metric, metric), curves, tuple(levels))


def _curve(label: str, group: list[Run], metric: str, unit: str) -> Curve:
    """One metric of runs that differ in their seed, as far as all of them are.

    Over frames, runs have rows at places of their own: each keeps its value until its next row, and
    the curve has points at up to 240 places that they share, from where all have begun.
    """
    columns = [run.metrics for run in group]
    if unit == "generation":
        length = min(len(c[unit]) for c in columns)
        values = np.stack([c[metric][:length] for c in columns])
        return Curve(label, columns[0][unit][:length], values)
    grid = attribution.axis([min((c[unit] for c in columns), key=lambda x: x[-1])], 240)
    grid = np.union1d(grid, [max(float(c[unit][0]) for c in columns)])  # where all have begun
    return Curve(label, grid, [attribution.on_grid(c[unit], c[metric], grid) for c in columns])


def _bounds(group: list[Run]) -> tuple[Reference, Reference] | None:
    """The best baseline and the upper bound of a run's task, where they are known exactly. No
    other task is made: that might run code of others."""
    task = group[0].part("env")
    return _limits(task) if bounds.exact(task) else None


@functools.cache  # every figure and the table ask for them; a T-maze takes seconds
def _limits(task: Any) -> tuple[Reference, Reference]:
    """`_bounds` of a task of which they are known."""
    name, value = bounds.best_baseline(task)
    highest = bounds.upper_bound(task).value
    return Reference(f"baseline: {name}", value), Reference("upper bound", highest)


def _table(runs: Groups) -> Table:
    """The last test of every algorithm, beside baseline and upper bound where one has them."""
    columns = ["algorithm", "champion", "baseline", "upper bound", "seeds", "generations"]
    rows = [_row(label, group) for label, group in runs.items()]
    each = sorted({group[0].config["algorithm"]["test_episodes"] for group in runs.values()})
    episodes = " or ".join(map(str, each))
    caption = f"On {episodes} fresh episodes; `credo evaluate` plays more."
    if not any(row[2] for row in rows):
        columns, rows = columns[:2] + columns[4:], [row[:2] + row[4:] for row in rows]
        caption += " No baseline and no upper bound of this task are known."
    return Table("Score of the champion, as last tested", columns, rows, caption)


def _row(label: str, group: list[Run]) -> list[Cell]:
    """An algorithm in the table: the last score of each seed, the bounds of its task (None where
    they are not known), seeds, and the generations that all runs have."""
    scores = [float(run.metrics["champion_score"][-1]) for run in group]
    told: list[Cell] = [None, None]
    if limits := _bounds(group):
        low, high = limits
        told = [f"{low.value:.3f} ({low.label.partition(': ')[2]})", high.value]
    last = min(int(run.metrics["generation"][-1]) for run in group)
    summary = Summary(scores, [run.config["seed"] for run in group])
    return [label, summary, *told, len(group), last]


# -------------------------------------------------------------------------------------- attribution


def _attributions(runs: Groups) -> Iterator[Section]:
    """Of algorithms that recorded it, who changed the champion last; with learners also where
    its weights come from, who had the workers, and what became of the learners' actors."""
    for label, group in runs.items():
        metrics = [run.metrics for run in group]
        if not all(map(attribution.known, metrics)):
            continue
        found = attribution.summary(metrics)
        learners = learner_names(group[0].config["algorithm"].get("learners", ()))
        title = f"{label}: " if len(runs) > 1 else ""
        share = "share of champions, mean of a tenth of the run"
        last = f"{title}Who was the last to change the champion"
        yield _shares(last, share, found, "makers", MAKERS)
        if learners:
            ancestors = [*learners, "first draw"]  # a learner has one colour in both figures
            origin = f"{title}Where the champion's weights come from"
            yield _shares(origin, "expected share", found, "ancestry", ancestors)
        if len(learners) > 1:
            workers = f"{title}Workers of each learner so far"
            yield _shares(workers, "share of all workers", found, "allocation", learners)
        if learners:
            yield _fates(found, learners, title)


def _shares(
    title: str, unit: str, found: Mapping[str, Any], key: str, labels: Sequence[str]
) -> Figure:
    """Shares `[runs, labels, points]` of `attribution.summary` over frames. Who never made a best
    policy has no curve."""
    values = np.array(found[key], np.float64)
    curves = [
        Curve(label, found["frames"], values[:, i])
        for i, label in enumerate(labels)
        if key != "makers" or np.nanmax(values[:, i], initial=0.0) > 0
    ]
    return Figure(title, "frames", unit, curves, y_range=(0.0, 1.0))


def _fates(found: Mapping[str, Any], learners: list[str], title: str) -> Table:
    """Allocation, and the fate of injected actors, in percent."""
    shares = np.array(found["fates"], np.float64)  # [runs, q, 3]
    shares = np.concatenate([np.array(found["allocated"], np.float64)[..., None], shares], axis=2)
    injected = np.sum(found["injected"], axis=0)
    rows: list[list[Cell]] = []
    for i, name in enumerate(learners):
        workers, *fates = (Summary(list(x), scale=100.0, digits=1) for x in shares[:, i].T)
        rows.append([name, workers, int(injected[i]), *fates])
    return Table(
        f"{title}Learners: their workers, and the fate of their actors in the population",
        ["learner", "workers, %", "injected", *(f"{fate}, %" for fate in attribution.FATES)],
        rows,
        caption="Injected: actors that were judged, in all runs together; the last ones may not "
        "have been. Selected: a parent, but no elite.",
    )


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


def _pictures(runs: Groups) -> list[Section]:
    """The champion of a page's only run, drawn."""
    every = [run for group in runs.values() for run in group]
    if len(every) != 1:
        return []
    try:
        return champions.pictures(every[0])
    except Exception as error:  # whatever a stranger's file holds, the numbers of its log are shown
        return [Text("Champion", [f"Not drawn: {str(error).rstrip('.; ')}."])]


# ----------------------------------------------------------------------------------------- settings


def _settings(runs: Groups) -> list[Table]:
    """Settings that several algorithms have and that differ; and all, where those are marked."""
    flat = [config.flatten(_indexed(group[0].config["algorithm"])) for group in runs.values()]
    unlike = [key for key in differing(flat) if sum(key in tree for tree in flat) > 1]
    columns = ["setting", *runs]
    rows = {
        key: [key, *(_text(tree[key]) if key in tree else "" for tree in flat)]
        for key in dict.fromkeys(key for tree in flat for key in tree)
    }
    every = Table(
        "All settings",
        columns,
        list(rows.values()),
        caption="Marked: settings that differ." if unlike else "",
        marked=[i for i, key in enumerate(rows) if key in unlike],
        folded=True,
    )
    few = Table("Settings that differ", columns, [rows[key] for key in unlike])
    return [few, every] if unlike else [every]
