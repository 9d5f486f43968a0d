"""Figure 6.2: CERL with two learners that fail alone."""

from typing import Any

from ..report.sections import Reference
from . import chapter5, chapter6
from .base import Cell

TITLE = "two learners that fail alone"
PUBLISHED = (
    "Figure 6.2 of the dissertation: on Hopper, in 5 million frames, CERL with TD3 at γ = 0 and "
    "γ = 1 reaches 2136 ± 512; each of the two alone, and evolution, stay at 1,000 or below."
)
BUDGETS = chapter6.BUDGETS
GAMMAS = (0.0, 1.0)


def cells(budget: str) -> list[Cell]:
    (task,) = chapter6.tasks(budget, ("Hopper-v5",))
    learners = chapter6.portfolio(GAMMAS)
    return [
        chapter6.cerl("cerl gamma 0 1", task, budget, learners=learners),
        *chapter6.parts(task, budget, GAMMAS),
    ]


measure = chapter6.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    given = {
        "cerl gamma 0 1 Hopper-v5": "2136 ± 512",
        **dict.fromkeys(
            ("td3 gamma 0 Hopper-v5", "td3 gamma 1 Hopper-v5", "ea of cerl Hopper-v5"), "≤ 1,000"
        ),
    }
    levels = [Reference("published CERL, 5M", 2136.0)]
    hopper = "Hopper-v5" in chapter5.tasks_in(measured)
    return [
        *chapter5.by_task(measured, *(levels if hopper else [])),
        chapter5.scores(measured, given, interval=True),
        *chapter6.attributions(measured),
        chapter5.about(measured),
    ]
