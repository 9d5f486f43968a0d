"""Table 6.1: which learners CERL gave its workers to."""

from typing import Any

from . import chapter5, chapter6
from .base import Cell

TITLE = "workers of each learner"
PUBLISHED = (
    "Table 6.1 of the dissertation: cumulative share of workers of learners L1 to L4, γ = 0.9, "
    "0.99, 0.997 and 0.9995. L2, it says, is preferred in general; its numbers say so on two of "
    "five tasks."
)
BUDGETS = chapter6.BUDGETS
GIVEN = {
    "Humanoid": (0.24, 0.35, 0.20, 0.20),
    "Hopper": (0.14, 0.27, 0.32, 0.27),
    "Swimmer": (0.17, 0.20, 0.36, 0.27),
    "HalfCheetah": (0.29, 0.32, 0.24, 0.15),
    "Walker2d": (0.14, 0.28, 0.33, 0.25),
}


def cells(budget: str) -> list[Cell]:
    chosen = chapter6.tasks(budget, (*chapter6.TASKS, chapter6.HUMANOID))
    return [chapter6.cerl("cerl", task, budget) for task in chosen]


measure = chapter6.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    return [
        chapter6.allocation(measured, GIVEN),
        *chapter6.attributions(measured),
        *chapter5.by_task(measured),
        chapter5.scores(measured, interval=True),
        chapter5.about(measured),
    ]
