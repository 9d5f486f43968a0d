"""Beyond chapter 7: difference rewards, D++, recurrent heads, and what teams share."""

import dataclasses
from typing import Any

from ..algorithms.merl import LOCAL, MERL
from ..networks.mmu import MMU
from ..networks.recurrent import Recurrent
from ..networks.team import Team
from . import chapter7
from .base import Cell
from .chapter7 import Plan

TITLE = "difference rewards, levels of credit, memory, sharing"
PUBLISHED = (
    "Not in the dissertation, which names rewards at more than two levels as future work. D is the "
    "difference reward G - G without the agent; D++ adds copies of it (Rahmattalabi et al. 2016)."
)
BUDGETS = chapter7.BUDGETS
PLANS = {
    "smoke": Plan(1_500, 2),
    "quick": Plan(150_000, 2),
    "full": Plan(500_000, 3),
    "published": Plan(2_000_000, 5, 0.1),
}


def cells(budget: str) -> list[Cell]:
    plan = PLANS[budget]
    env = chapter7.task("merl", coupling=4, rewards=("global", "local", "difference", "dpp"))
    teams = {
        "merl": {},
        "merl on D": {"learners": (dataclasses.replace(LOCAL, signal="difference"),)},
        "merl on D++": {"learners": (dataclasses.replace(LOCAL, signal="dpp"),)},
        "merl on local and D++": {
            "learners": (LOCAL, dataclasses.replace(LOCAL, signal="dpp")),
        },
        "merl, one policy for all": {"network": Team(sharing="everything")},
        "merl, nothing shared": {"network": Team(sharing="nothing")},
        "ea": {"learners": ()},
        "ea, fitness D++": {"learners": (), "fitness": "dpp"},
        "ea with MMU heads": {"learners": (), "network": Team(trunk=(), head=MMU(hidden=10))},
        "ea with GRU heads": {
            "learners": (),
            "network": Team(trunk=(), head=Recurrent(cell="gru", hidden=10)),
        },
    }
    found = []
    for name, fields in teams.items():
        algorithm = MERL.merl(env, **({"updates_per_frame": plan.updates_per_frame} | fields))
        if budget == "smoke":
            network = algorithm.network
            algorithm = dataclasses.replace(chapter7.shrunk(algorithm), network=network)
        name = f"{name.replace(',', ' /')}, coupling 4, all rewards"
        found.append(Cell(name, algorithm, None, plan.runs, 0, plan.frames))
    return found


measure = chapter7.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    return [
        chapter7.scores(measured),
        *chapter7.curves(measured),
        chapter7.about(
            "D and D++ are computed by the simulator from what happened, with the paths of the "
            "others as they were. Memory is evolved only.",
        ),
    ]
