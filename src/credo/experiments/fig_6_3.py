"""Figure 6.3: CERL and its parts on Humanoid."""

from typing import Any

from ..report.sections import Reference
from . import chapter5, chapter6
from .base import Cell

TITLE = "CERL and its parts on Humanoid"
PUBLISHED = (
    "Figure 6.3 of the dissertation: in 1 million frames CERL reaches 4702 ± 356.5; evolution, "
    "each of the four TD3 learners alone, and ERL with one learner fail."
)
BUDGETS = chapter6.BUDGETS
CLIPPING = (
    "The published failure of TD3 alone looks like a slip: its code clipped actions in [0, 1] to "
    "±0.4 before the task scaled them, so that a learner's rollouts could hardly push in one of "
    "the two directions (by reading the code, not by running it). Here actions lie in [-1, 1] and "
    "all of the range is used by everybody."
)


def cells(budget: str) -> list[Cell]:
    (task,) = chapter6.tasks(budget, (chapter6.HUMANOID,))
    best = chapter6.portfolio((chapter6.BEST,))
    return [
        chapter6.cerl("cerl", task, budget),
        chapter6.cerl("erl td3", task, budget, learners=best),
        *chapter6.parts(task, budget),
    ]


measure = chapter6.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    humanoid = chapter6.HUMANOID in chapter5.tasks_in(measured)
    levels = [Reference("published CERL, 1M", 4702.0)] if humanoid else []
    given = {f"cerl {chapter6.HUMANOID}": "4702 ± 356.5"}
    others = {name: "fails" for name in measured if name not in given and humanoid}
    return [
        *chapter5.by_task(measured, *levels),
        chapter5.scores(measured, given | others),
        *chapter6.attributions(measured),
        chapter5.about(measured, CLIPPING),
    ]
