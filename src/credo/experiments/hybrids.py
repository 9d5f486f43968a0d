"""When does a hybrid win? One preset (`ERL.hybrid`), its learner alone and its evolution alone, at
equal frames and updates.

hybrid-dense: four tasks of MuJoCo as they are. hybrid-late: the same, where the whole return is
paid at the last step; beside the learner that sees returns as they are paid stands that of the
preset, which sees them spread. Shared rewards are beyond-7-decoys.

The preset was chosen on seeds from 1,000 on, with up to 300,000 frames of the four tasks; reported
runs have seeds from 0 on.
"""

from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np

from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from ..analysis import statistics
from ..report import sections as page
from ..report.rows import Results
from .base import Cell, Experiment, Value
from .mujoco import MEASURES, STAND_IN, TABLE, cell, curves
from .plans import Plan

TASKS = ("Swimmer-v5", "HalfCheetah-v5", "Hopper-v5", "Walker2d-v5")
HYBRID, LEARNER, EVOLUTION = "hybrid", "its learner alone", "its evolution alone"
SPREAD = "its learner alone, returns spread"
METHODS = {
    HYBRID: ERL.hybrid,
    LEARNER: partial(OffPolicy.hybrid, redistribute=None),
    EVOLUTION: partial(ERL.hybrid, learners=()),
}
DENSE = {
    "smoke": Plan(600, 2),
    "quick": Plan(50_000, 2, 0.25),
    "full": Plan(300_000, 3),
    "million": Plan(1_000_000, 3),
}
LATE = DENSE | {"full": Plan(500_000, 3)}


def tasks(budget: str) -> Sequence[str]:
    """The tasks at a budget."""
    return {"smoke": (STAND_IN,), "quick": TASKS[:1]}.get(budget, TASKS)


def dense(budget: str) -> list[Cell]:
    """Every method on every task."""
    runs = DENSE[budget]
    return [cell(x, METHODS[x], task, budget, runs=runs) for task in tasks(budget) for x in METHODS]


def late(budget: str) -> list[Cell]:
    """The same with returns at the last step, and the learner that sees them spread."""
    methods = METHODS | {SPREAD: OffPolicy.hybrid}
    return [
        cell(name, build, task, budget, delayed=True, runs=LATE[budget])
        for task in tasks(budget)
        for name, build in methods.items()
    ]


IMPROVEMENT = ("task", "beside", "ratio of means", "P(hybrid is better)", "95 % interval")


def improvement(results: Results, values: Sequence[Value]) -> Iterable[page.Table]:
    """The hybrid against each of the others: the ratio of mean returns, and the probability that a
    run of it is better than a run of the other, with an interval."""
    body = []
    for task in results.levels("task"):
        here = results.where(task=task)
        scores = {x: _of_runs(here, x) for x in here.levels("method")}
        for other in scores:
            if other != HYBRID and HYBRID in scores:
                body.append([task, other, *_against(scores[HYBRID], scores[other])])
    if body:
        caption = (
            "Final champions, means over 10 fresh episodes of each run. The probability is that a "
            "run of the hybrid is better than one of the other (Agarwal et al. 2021); its interval "
            "is from 10,000 bootstrap samples of the runs of both, and wide with few runs."
        )
        yield page.Table("Is the hybrid better than its parts?", [*IMPROVEMENT], body, caption)


def _of_runs(results: Results, method: str) -> np.ndarray:
    """The mean return of the final champion of each run."""
    found = results.where(method=method).by_seed("return")
    return np.array([np.mean(x) for seed, x in found.items() if seed is not None], np.float64)


def _against(ours: np.ndarray, theirs: np.ndarray) -> list[page.Cell]:
    ratio = f"{ours.mean() / theirs.mean():.2f}" if theirs.mean() > 0 else None
    low, high = statistics.improvement_interval(ours, theirs)
    chance = statistics.probability_of_improvement(ours, theirs)
    return [ratio, f"{chance:.2f}", f"{low:.2f} to {high:.2f}" if np.isfinite(low) else None]


CURVES = curves()
VIEWS = (CURVES, improvement, TABLE)
EXPERIMENTS = {
    "hybrid-dense": Experiment(dense, MEASURES, VIEWS, DENSE),
    "hybrid-late": Experiment(late, MEASURES, VIEWS, LATE),
}
