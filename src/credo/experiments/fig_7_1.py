"""Figure 7.1: two rovers, two POIs, and a local reward that misleads."""

from typing import Any

import numpy as np

from ..environments.rover import Rover
from ..evolution.mutation import MatrixMutation
from ..networks.team import Team
from ..report.sections import Table
from ..runs.store import Run
from . import chapter7
from .base import Cell
from .chapter7 import Plan

TITLE = "motivating example"
PUBLISHED = (
    "Figure 7.1 of the dissertation: one rover can reach both POIs and is closer to the only one "
    "that the other can reach. Only MERL finds both; TD3-mixed and EA find one, TD3-global none. "
    "The author's logs, POIs found in five runs: MERL 2, 2, 2, 2, 1, EA 1 in all, TD3-mixed 1, 1, "
    "0, 0, 2."
)
BUDGETS = chapter7.BUDGETS
PLANS = {
    "smoke": Plan(1_000, 2),
    "quick": Plan(100_000, 2),
    "full": Plan(400_000, 5),
    "published": Plan(2_000_000, 5),
}
# What sets one rover apart from the other must be able to change alone: with a shared trunk and
# mutation of all matrices at once 6 of 17 runs of MERL found both POIs.
TEAM = Team(sharing="nothing")
MUTATION = MatrixMutation(
    gate="matrix",
    probability=0.2,
    fraction=0.3,
    super_probability=0.2,
    reset_probability=0.05,
    vectors=False,
)
SETTINGS = {"population_size": 50, "episodes": 5, "workers": 10, "mutation": MUTATION}
FRESH = 200  # chosen by looking at others
METHODS = ("merl", "ea", "td3 mixed", "td3 global", "td3 local")
WHERE = "motivating example"
PUBLISHED_SHARE = {"merl": "1.00 (4 of 5)", "ea": "0.50", "td3 mixed": "0.50", "td3 global": "0"}


def cells(budget: str) -> list[Cell]:
    plan = PLANS[budget]
    return [
        chapter7.cell(method, task(method), WHERE, budget, plan, FRESH, TEAM, **SETTINGS)
        for method in METHODS
    ]


def task(method: str) -> Rover:
    """With the local reward of fig-7.4."""
    return Rover.motivating(local="progress", rewards=chapter7.task(method).rewards)


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    found = chapter7.measure(runs, budget)
    for name, cell in runs.items():
        found[name]["both after"] = [_after(run) for run in cell]
    return found


def _after(run: Run) -> int | None:
    """Frames until a champion's test first found both POIs in nine of ten worlds."""
    reached = np.flatnonzero(run.metrics["champion_score"] >= 0.95)
    return int(run.metrics["frames"][reached[0]]) if reached.size else None


def sections(measured: dict[str, Any]) -> list[Any]:
    both = Table(
        "Frames until a test found both POIs in at least nine of ten worlds, each run",
        ["method", "runs that did", "after frames"],
        [
            [
                cell["method"],
                f"{sum(n is not None for n in cell['both after'])} of {len(cell['both after'])}",
                ", ".join("never" if n is None else f"{n:,}" for n in cell["both after"]),
            ]
            for cell in measured.values()
        ],
    )
    published = {f"{method}, {WHERE}": text for method, text in PUBLISHED_SHARE.items()}
    return [
        both,
        chapter7.scores(measured, published),
        *chapter7.curves(measured),
        chapter7.about(
            "0.5 is one POI of two. Rovers start at fixed places, with any heading. Every rover "
            "has a network of its own, and evolution changes matrices one by one; with a shared "
            "trunk and ERL's operators 6 of 17 runs of MERL on other seeds found both. These "
            "settings were searched for MERL alone, the learners' are those of fig-7.4. The local "
            "reward is progress towards the closest POI that is left.",
        ),
    ]
