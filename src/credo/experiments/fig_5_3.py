"""Figure 5.3: ERL, EA and DDPG on six tasks."""

from typing import Any

from . import chapter5
from .base import Cell

TITLE = "ERL against its parts on six tasks"
PUBLISHED = (
    "Figure 5.3 of the dissertation (curves without numbers): ERL beats DDPG on all six tasks, EA "
    "on all but Swimmer, where they are equal, and PPO on four of six."
)
BUDGETS = chapter5.BUDGETS
LONG_VIEW = "td3 gamma 0.9999 Swimmer-v5"
SWIMMER = (
    "That only evolution solves Swimmer is a matter of the discount: at 0.99 a stroke pays too "
    "late. The row with gamma 0.9999 shows what a learner alone does with a longer view (published "
    "elsewhere: 359 at 1M frames)."
)


def cells(budget: str) -> list[Cell]:
    found = [
        chapter5.cell(label, build, task, budget)
        for task in chapter5.tasks(budget)
        for label, build in chapter5.ALGORITHMS.items()
    ]
    if "Swimmer-v5" in chapter5.tasks(budget):
        found.append(chapter5.td3_gamma("Swimmer-v5", budget, 0.9999))
    return found


measure = chapter5.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    labels = {cell["label"] for cell in measured.values()}
    missing = [] if "ppo" in labels else ["PPO is missing here."]
    swimmer = [SWIMMER] if LONG_VIEW in measured else []
    return [
        *chapter5.by_task(measured),
        chapter5.scores(measured),
        chapter5.about(
            measured,
            "DDPG has the learner of ERL, alone, with the same networks, batch and updates per "
            "frame, after 1,000 frames of random actions; EA is the "
            "evolution of ERL, alone. The dissertation's DDPG and PPO were those "
            "of OpenAI Baselines. PPO here does not normalise observations and rewards, which "
            "theirs does: it is a lower line.",
            *missing,
            *swimmer,
        ),
    ]
