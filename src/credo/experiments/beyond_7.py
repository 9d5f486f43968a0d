"""Beyond chapter 7: difference rewards, D++, recurrent heads, and what teams share."""

import dataclasses
from typing import Any

from ..algorithms.merl import LOCAL, MERL
from ..networks.mmu import MMU
from ..networks.recurrent import Recurrent
from ..networks.team import Team
from .base import Cell, Experiment
from .dissertation import notes, told
from .fig_7_4 import MEASURES, Plan, curves, rovers, table
from .small import shrunk

PLANS = {
    "smoke": Plan(1_500, 2),
    "quick": Plan(150_000, 2),
    "full": Plan(500_000, 3),
    "published": Plan(2_000_000, 5, 0.1),
}
DPP = dataclasses.replace(LOCAL, signal="dpp")
GRU = Recurrent(cell="gru", hidden=10)
TEAMS: dict[str, dict[str, Any]] = {
    "merl": {},
    "merl on D": {"learners": (dataclasses.replace(LOCAL, signal="difference"),)},
    "merl on D++": {"learners": (DPP,)},
    "merl on local and D++": {"learners": (LOCAL, DPP)},
    "merl, one policy for all": {"network": Team(sharing="everything")},
    "merl, nothing shared": {"network": Team(sharing="nothing")},
    "ea": {"learners": ()},
    "ea, fitness D++": {"learners": (), "fitness": "dpp"},
    "ea with MMU heads": {"learners": (), "network": Team(trunk=(), head=MMU(hidden=10))},
    "ea with GRU heads": {"learners": (), "network": Team(trunk=(), head=GRU)},
}


def cells(budget: str) -> list[Cell]:
    """Every team at coupling 4."""
    plan, found = PLANS[budget], []
    env = rovers("merl", coupling=4, rewards=("global", "local", "difference", "dpp"))
    for method, fields in TEAMS.items():
        algorithm = MERL.merl(env, updates_per_frame=plan.updates_per_frame, **fields)
        if budget == "smoke":
            algorithm = shrunk(algorithm, network=algorithm.network)
        labels = {"method": method, "coupling": 4, "task": "all rewards"}
        found.append(Cell(labels, algorithm, range(plan.runs), frames=plan.frames))
    return found


EXPERIMENT = Experiment(
    **told("beyond-7"),
    budgets=tuple(PLANS),
    cells=cells,
    measures=MEASURES,
    views=(table("coupling", "method"), curves("coupling"), notes("rovers", "beyond-7")),
)
