"""Figure 7.1: two rovers, two POIs, and a local reward that misleads."""

from typing import Any

import numpy as np

from ..environments.rover import Rover
from ..runs.loop import Run
from ..runs.page import Table
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
    "full": Plan(600_000, 5),
    "published": Plan(2_000_000, 5),
}
# With MERL's own settings and minus the distance as the local reward, four of five runs of 200,000
# frames (seeds 0 to 4) found one POI; with these, seeds 1 to 4 found both.
SETTINGS = {"population_size": 50, "episodes": 2, "workers": 10}
FRESH = 100
METHODS = ("merl", "ea", "td3 mixed", "td3 global", "td3 local")
WHERE = "motivating example"
PUBLISHED_SHARE = {"merl": "1.00 (4 of 5)", "ea": "0.50", "td3 mixed": "0.50", "td3 global": "0"}


def cells(budget: str) -> list[Cell]:
    plan = PLANS[budget]
    return [
        chapter7.cell(method, task(method), WHERE, budget, plan, FRESH, **SETTINGS)
        for method in METHODS
    ]


def task(method: str) -> Rover:
    """With the author's local reward."""
    return Rover.motivating(local="closeness", rewards=chapter7.task(method).rewards)


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
            "0.5 is one POI of two. Rovers start at fixed places, with any heading. The local "
            "reward is the author's, min(1, d_a / distance).",
        ),
    ]
