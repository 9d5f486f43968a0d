"""Chapter 6: the runs that its figures and tables share. Tasks, budgets and scores are those of
chapter 5."""

import dataclasses
from typing import Any

import numpy as np

from ..algorithms.erl import ERL
from ..environments.gymnasium import Gymnasium
from ..learners.td3 import TD3
from ..report import run_page as report
from ..report.sections import Section, Table
from ..runs.store import Run
from . import beyond_5, chapter5
from .base import Cell

BUDGETS = chapter5.BUDGETS
PORTFOLIO = (0.9, 0.99, 0.997, 0.9995)  # γ of learners L1 to L4
TASKS = ("Hopper-v5", "Swimmer-v5", "HalfCheetah-v5", "Walker2d-v5")
HUMANOID = "Humanoid-v5"
BEST = 0.99  # the discount that TD3's authors chose


def cerl(label: str, task: str, budget: str, **overrides: Any) -> Cell:
    """CERL with the published portfolio, unless `overrides` have another."""
    return chapter5.cell(label, ERL.cerl, task, budget, **overrides)


def portfolio(gammas: tuple[float, ...]) -> tuple[TD3, ...]:
    """TD3 as in `ERL.cerl`, at these discounts."""
    like = ERL.cerl(Gymnasium(chapter5.STAND_IN)).learners[0]
    assert isinstance(like, TD3)
    return tuple(dataclasses.replace(like, gamma=gamma) for gamma in gammas)


def ea(task: str, budget: str) -> Cell:
    """The evolution of CERL, alone."""
    return cerl("ea of cerl", task, budget, learners=(), manager=None)


def parts(task: str, budget: str, gammas: tuple[float, ...] = PORTFOLIO) -> list[Cell]:
    """What a portfolio is made of: evolution, and each of its learners, alone."""
    alone = [chapter5.td3_gamma(task, budget, gamma) for gamma in gammas]
    return [ea(task, budget), *alone]


def tasks(budget: str, of: tuple[str, ...] = TASKS) -> tuple[str, ...]:
    """Fewer at quick: a portfolio of four takes four times as long."""
    return chapter5.tasks(budget, of)[:1] if budget == "quick" else chapter5.tasks(budget, of)


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    """Scores, and the attribution of cells that have a portfolio."""
    return {
        name: beyond_5.lineage(name, cell)
        if len(getattr(cell[0].algorithm, "learners", ())) > 1
        else chapter5.outcome(name, cell)
        for name, cell in runs.items()
    }


def attributions(measured: dict[str, Any]) -> list[Section]:
    """Allocation, fates and ancestry of every portfolio."""
    sections: list[Section] = []
    for name, cell in measured.items():
        if "attribution" in cell:
            sections += report.attributed(cell["attribution"], cell["learners"], f"{name}: ")
    return sections


def allocation(measured: dict[str, Any], given: dict[str, tuple[float, ...]]) -> Table:
    """Share of all workers that each learner had, beside the published ones."""
    rows = []
    for cell in measured.values():
        shares = np.array(cell["attribution"]["allocated"], np.float64)  # [runs, q]
        even = 100 / shares.shape[1]
        published = given.get(cell["task"].partition("-")[0], ())
        for i, learner in enumerate(cell["learners"]):
            rows.append(
                [
                    cell["task"] if i == 0 else "",
                    cell["label"] if i == 0 else "",
                    f"{np.mean(cell['played']):,.0f}" if i == 0 else "",
                    learner,
                    f"{even:.0f}",
                    f"{100 * published[i]:.0f}" if published else "–",
                    report.percent(shares[:, i]),
                    ", ".join(f"{100 * x:.0f}" for x in shares[:, i]),
                ]
            )
    return Table(
        "Cumulative allocation, in percent of all rollout workers",
        ["task", "algorithm", "frames", "learner", "even", "published", "measured", "each run"],
        rows,
        caption="Mean ± standard error over runs.",
    )
