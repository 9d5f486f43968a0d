"""Figures 5.3 and 5.4, Table 5.2 and beyond chapter 5: ERL, its parts and its champions on tasks of
MuJoCo; and the check of TD3. Also what all experiments on MuJoCo share: tasks, budgets,
measurements and the table of scores.

Section 5.5 compares ERL with its parts, EA and DDPG, and with PPO (Figure 5.3), leaves out
selection (Figure 5.4) and counts what becomes of the learner's actors (Table 5.2). It has five
runs, gives their standard deviation, and tests a champion in 5 episodes. `check-td3` compares TD3,
which chapter 6 takes as given, with its authors' curves.

`full` has 300,000 frames and 2 runs unless `PLANS` says otherwise, `million` the frames at which
later papers report, `published` the author's. `quick` has the first two tasks and a quarter
of the updates, `smoke` another task (`STAND_IN`).
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from ..algorithms.ppo import PPO
from ..analysis import attribution
from ..analysis.attribution import FATES
from ..environments.gymnasium import Gymnasium
from ..environments.wrappers import delayed as with_delay
from ..evolution.selection import Uniform
from ..report import sections as page
from ..report.rows import Labels, Results, Row, rows
from . import measures
from .base import BUDGETS as THREE
from .base import Cell, Experiment, Trained, Value
from .plans import Plan, planned
from .views import Curves, Of, Table, each, known, mean, of_metric, plain, published

BUDGETS = (*THREE, "million", "published")
TASKS = ("HalfCheetah-v5", "Swimmer-v5", "Reacher-v5", "Ant-v5", "Hopper-v5", "Walker2d-v5")
STAND_IN = "InvertedPendulum-v5"  # for every task at smoke, with tiny networks
METHODS = {
    "erl": ERL.erl,
    "ea": ERL.ea,
    "ddpg": OffPolicy.ddpg,
    # As in OpenAI's Baselines, which the dissertation ran.
    "ppo": partial(PPO.ppo, normalize_observations=True, normalize_rewards=True),
}
WITH, WITHOUT = "erl", "erl without selection"
SELECTION = {WITH: ERL.erl, WITHOUT: partial(ERL.erl, selection=Uniform())}


PLANS: dict[Any, Plan] = {  # by budget; by budget and task where that has one of its own
    "smoke": Plan(600, 2),
    "quick": Plan(50_000, 2, 0.25),
    "full": Plan(300_000, 2),
    "million": Plan(1_000_000, 5),
    "published": Plan(2_000_000, 5),
    ("full", "Swimmer-v5"): Plan(500_000, 3, 0.1),
    ("full", "Humanoid-v5"): Plan(100_000, 2),
    # Hopper has 4M in chapter 5, and 5M and 1.5M in chapter 6: runs of 5M hold them all.
    ("published", "Hopper-v5"): Plan(5_000_000, 5),
    ("published", "Ant-v5"): Plan(6_000_000, 5),
    ("published", "Walker2d-v5"): Plan(8_000_000, 5),
    ("published", "Humanoid-v5"): Plan(1_000_000, 5),
}
"""Frames, runs and updates per frame of most cells of chapters 5 and 6. `published` has the
author's frames, 2 million where a task has none of its own, and the dissertation's five runs."""


def tasks(budget: str, of: Sequence[str] = TASKS) -> Sequence[str]:
    """The tasks of an experiment at a budget."""
    return {"smoke": (STAND_IN,), "quick": of[:2]}.get(budget, of)


def plan(budget: str, task: str) -> Plan:
    """The runs of most cells."""
    return PLANS.get((budget, task), PLANS[budget])


def cell(
    method: str,
    build: Callable[..., Any],
    task: str,
    budget: str,
    *,
    labels: Labels | None = None,
    delayed: bool | None = None,
    runs: Plan | None = None,
    first_seed: int = 0,
    ends: dict[str, Any] | None = None,
    **fields: Any,
) -> Cell:
    """Runs of what `build(env, **fields)` makes. `labels`: what tells it from others of the method.
    `delayed`: whether rewards are paid at the end of an episode, where cells differ in it. `ends`:
    other limits of a run than frames."""
    env: Any = with_delay(Gymnasium(task)) if delayed else Gymnasium(task)
    told = {"method": method, **(labels or {}), "task": task}
    told |= {} if delayed is None else {"delayed": delayed}
    runs = runs or plan(budget, task)
    return planned(told, build(env, **fields), runs, budget, first_seed, **(ends or {}))


def every(
    methods: dict[str, Callable[..., Any]], of: Sequence[str] = TASKS
) -> Callable[[str], list[Cell]]:
    """Cells of every method on every task, by budget."""
    return lambda budget: [
        cell(name, build, task, budget)
        for task in tasks(budget, of)
        for name, build in methods.items()
    ]


def td3(task: str, budget: str, gamma: float = 0.99) -> Cell:
    """TD3 with the constants of its authors, alone, or at another discount `gamma` in [0, 1], which
    is then a label. At their discount, 0.99, there are three runs at full."""
    if gamma == 0.99:
        runs = plan(budget, task)
        runs = runs._replace(runs=3) if budget == "full" else runs
        return cell("td3", OffPolicy.td3, task, budget, runs=runs)
    learner = dataclasses.replace(OffPolicy.td3(Gymnasium(task)).learner, gamma=gamma)
    return cell("td3", OffPolicy.td3, task, budget, labels={"gamma": gamma}, learner=learner)


def long_view(tasks: Sequence[str], budget: str) -> list[Cell]:
    """On Swimmer, TD3 with a longer view."""
    return [td3(task, budget, 0.9999) for task in tasks if task == "Swimmer-v5"]


def against_its_parts(budget: str) -> list[Cell]:
    """Every method on every task."""
    return every(METHODS)(budget) + long_view(tasks(budget), budget)


def check_of_td3(budget: str) -> list[Cell]:
    """TD3 on the tasks of which its authors show curves, at 300,000 frames."""
    return [td3(task, budget) for task in tasks(budget, ("HalfCheetah-v5", "Hopper-v5"))]


# ------------------------------------------------------------------------------- scores on a page


TESTS = (measures.last_tests, measures.effort, measures.of_task(measures.random_actions))
MEASURES = (measures.final(), measures.scores(), *TESTS)
VARIANTS = ("method", "gamma", "exploration", "manager")  # what lines and rows differ in


def curves(**levels: Of) -> Curves:
    """The champions' tests as they were logged, a figure for each task."""
    levels = {"random policy": known("random")} | levels
    label = "return of the champion"
    return Curves("test score", "frames", VARIANTS, ["task"], y_label=label, levels=levels)


OTHERS = ("TD3, 1M frames", "ERL rerun, 1M frames", "FlashSAC, 1M frames", "upper bound")
TABLE = Table(
    "Return",
    ["task", "delayed", *VARIANTS],
    {
        "random policy": known("random"),
        "published": published("return"),
        "final champion": mean("return"),
        "median": plain("return", of=np.median),
        "last test": mean("last test"),
        "last test, smoothed": plain("last test, smoothed"),
        "frames": plain("frames"),
        "updates per frame": plain("updates per frame"),
        **{title: published(title) for title in OTHERS},
    },
    caption="Final champion: 10 fresh episodes without noise. Last test: the published protocol, "
    f"as logged; smoothed over {measures.SMOOTHED} generations, as the author did (of a learner "
    "alone, a generation is an episode). Random policy: actions drawn uniformly, mean of 100 "
    "episodes.",
)
CURVES = curves()
AUTHORS = curves(
    **{
        "authors, 300k frames": published("return", number=True),
        "less 2 s.d.": published("less 2 s.d."),
    }
)


def ablation(results: Results, values: Sequence[Value]) -> Iterable[page.Table]:
    """Scores above a random policy, as a share of the best that full ERL had."""
    body = []
    for task in results.levels("task"):
        here = results.where(task=task)
        if {WITH, WITHOUT} <= set(here.levels("method")):
            scores = (here.array("test score", "seed", method=x) for x in (WITH, WITHOUT))
            best, last = (x.astype(np.float64).mean(axis=0) for x in scores)
            baseline = here.value("random", method=WITH)
            best, last = np.nanmax(best) - baseline, last[-1] - baseline
            change = f"{100 * (last / best - 1):+.0f} %" if best > 0 else "no better than random"
            body.append([task, best, last, "~ -80 %", change])
    columns = ["task", "best of ERL", "last without selection", "published change", "change"]
    if body:
        caption = "Means over runs, less the mean return of a random policy."
        yield page.Table("What is lost without selection", columns, body, caption)


# ------------------------------------------------------------ what learners contribute to champions


def fates(cell: Trained) -> list[Row]:
    """Shares of the learner's actors that were judged in the population, and what chance says.

    **Returns:** for each run "fate" in [0, 1] by `fate` (elite, selected, discarded), and
    "injected", how many were judged; for the cell "by chance" by `fate`, and "sync period", the
    generations from one copy of the learner's actor to the next.
    """
    metrics, algorithm = [run.metrics for run in cell.runs], cell.cell.algorithm
    counts = [int(attribution.injected(m)[0]) for m in metrics]
    return [
        *cell.rows("fate", [attribution.fates(m)[0] for m in metrics], 4, fate=FATES),
        *cell.rows("injected", counts),
        *rows("by chance", expected(algorithm), cell.labels, fate=FATES),
        cell.fact("sync period", algorithm.sync_period),
    ]


def expected(algorithm: Any) -> list[float]:
    """Shares of an actor that is no better or worse than the others: a random rank, and as many
    tournaments as there are offspring."""
    k, e = algorithm.population_size, algorithm.elites
    entrants = algorithm.breeder.selection.size
    ranks = np.arange(e, k)  # of those that are no elite, 0 the best
    wins = ((k - ranks) / k) ** entrants - ((k - ranks - 1) / k) ** entrants
    selected = np.sum(1.0 - (1.0 - wins) ** (k - e)) / k
    return [round(float(x), 4) for x in (e / k, selected, 1.0 - e / k - selected)]


INJECTED = Table(
    "What became of injected actors, in percent",
    ["task", "fate"],
    {
        "by chance": known("by chance", 100),
        "published": published("fate, %"),
        "measured": mean("fate", 100, digits=1),
    },
    where={"fate": FATES},
    caption="By chance: what an actor of random rank would meet, computed. Selected: the parent of "
    "an offspring, but no elite.",
)
JUDGED = Table("Actors that were judged", ["task"], {"each run": each("injected")})


def shares(metric: str, line: str, title: str, y_label: str) -> Curves:
    """Shares over frames, a figure for each cell."""
    told: dict[str, Any] = {"title": f"{{panel}}: {title}", "y_label": y_label}
    return Curves(metric, "frames", [line], (*VARIANTS, "task"), y_range=(0.0, 1.0), **told)


MADE = shares(
    "last changed by",
    "operator",
    "who was the last to change the champion",
    "share of champions, mean of a tenth of the run",
)
ANCESTRY = shares(
    "ancestry", "ancestor", "where the champion's weights come from", "expected share"
)
ALLOCATED = shares(
    "allocation so far", "learner", "workers of each learner so far", "share of all workers"
)


def makers(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """A line for each operator that was the last to change a champion."""
    found = of_metric(results, MADE.y).curves
    made = {curve.labels["operator"] for curve in found if any(curve.values)}
    return dataclasses.replace(MADE, where={"operator": tuple(made)})(results, values)


FATE = Table(
    "Learners: their workers, and the fate of their actors in the population",
    ["task", *VARIANTS, "learner"],
    {
        "workers, %": mean("allocation", 100, digits=1),
        "injected, each run": each("injected"),
        **{f"{fate}, %": mean("fate", 100, digits=1, fate=fate) for fate in FATES},
    },
    caption="Injected: actors that were judged; the last ones may not have been. Selected: a "
    "parent, but no elite.",
)
by_erl = every({"erl": ERL.erl})
EXPERIMENTS = {
    "check-td3": Experiment(check_of_td3, MEASURES, (AUTHORS, TABLE)),
    "fig-5.3": Experiment(against_its_parts, MEASURES, (CURVES, TABLE), BUDGETS),
    "fig-5.4": Experiment(
        every(SELECTION, ("HalfCheetah-v5", "Swimmer-v5")),
        MEASURES,
        (CURVES, ablation, TABLE),
        BUDGETS,
    ),
    "table-5.2": Experiment(by_erl, (fates, *MEASURES), (INJECTED, JUDGED, CURVES, TABLE), BUDGETS),
    "beyond-5": Experiment(
        by_erl, (*MEASURES, measures.lineage), (makers, ANCESTRY, FATE, CURVES, TABLE), BUDGETS
    ),
}
