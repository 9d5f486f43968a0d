"""Figure 6.4: how much the resource manager explores."""

from typing import Any

from ..learners.manager import UCB
from . import chapter5, chapter6
from .base import Cell

TITLE = "exploration of the resource manager"
PUBLISHED = (
    "Figure 6.4 of the dissertation (curves without numbers), on Humanoid: c = 0.9 is best; 0 and "
    "5 learn too, with more frames; 10 needs more still."
)
BUDGETS = chapter6.BUDGETS
COEFFICIENTS = (0.0, 0.9, 5.0, 10.0)
PUBLISHED_C = 0.9


def cells(budget: str) -> list[Cell]:
    (task,) = chapter6.tasks(budget, (chapter6.HUMANOID,))
    return [
        chapter6.cerl("cerl", task, budget)
        if c == PUBLISHED_C
        else chapter6.cerl(f"cerl c {c:g}", task, budget, manager=UCB(exploration=c))
        for c in COEFFICIENTS
    ]


measure = chapter6.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    return [
        *chapter5.by_task(measured),
        chapter5.scores(measured, interval=True),
        chapter6.allocation(measured, {}),
        *chapter6.attributions(measured),
        chapter5.about(measured, f"The cell without a number has c = {PUBLISHED_C}."),
    ]
