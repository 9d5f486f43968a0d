"""Figure 6.5: CERL, its learners alone, and evolution on four tasks."""

from typing import Any

from . import chapter5, chapter6, fig_5_3
from .base import Cell

TITLE = "CERL against its parts on four tasks"
PUBLISHED = (
    "Figure 6.5 of the dissertation (curves without numbers): TD3 at γ 0.99 needs fewer frames "
    "than CERL on Hopper, HalfCheetah and Walker2d, CERL fewer than the other TD3s; of Swimmer "
    "only CERL and evolution are said to be capable."
)
BUDGETS = chapter6.BUDGETS


def cells(budget: str) -> list[Cell]:
    chosen = chapter6.tasks(budget)
    found = [
        cell
        for task in chosen
        for cell in (chapter6.cerl("cerl", task, budget), *chapter6.parts(task, budget))
    ]
    if "Swimmer-v5" in chosen:
        found.append(chapter5.td3_gamma("Swimmer-v5", budget, 0.9999))
    return found


measure = chapter6.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    swimmer = [fig_5_3.SWIMMER] if fig_5_3.LONG_VIEW in measured else []
    return [
        *chapter5.by_task(measured),
        chapter5.scores(measured, interval=True),
        *chapter6.attributions(measured),
        chapter5.about(measured, *swimmer),
    ]
