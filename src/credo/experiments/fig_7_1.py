"""Figure 7.1: two rovers, two POIs, and a local reward that misleads."""

from typing import Any

from ..environments.rover import Rover
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
    "quick": Plan(60_000, 2, 0.1),
    "full": Plan(200_000, 5, 0.1),
    "published": Plan(1_000_000, 5, 0.1),
}
METHODS = ("merl", "ea", "td3 mixed", "td3 global", "td3 local")
WHERE = "motivating example"
PUBLISHED_SHARE = {"merl": "1.00 (4 of 5)", "ea": "0.50", "td3 mixed": "0.50", "td3 global": "0"}


def cells(budget: str) -> list[Cell]:
    plan = PLANS[budget]
    return [chapter7.cell(method, task(method), WHERE, budget, plan) for method in METHODS]


def task(method: str) -> Rover:
    return Rover.motivating(rewards=chapter7.task(method).rewards)


measure = chapter7.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    published = {f"{method}, {WHERE}": text for method, text in PUBLISHED_SHARE.items()}
    return [
        chapter7.scores(measured, published),
        *chapter7.curves(measured),
        chapter7.about("0.5 is one POI of two. Rovers start at fixed places, with any heading."),
    ]
