"""Figure 7.1: two rovers, two POIs, and a local reward that misleads."""

from typing import Any

import numpy as np

from ..environments.rover import Rover
from ..evolution.mutation import MatrixMutation
from ..networks.team import Team
from . import measures
from .base import Cell, Experiment
from .dissertation import notes, told
from .fig_7_4 import MEASURES, Plan, cell, curves, rewards, table
from .views import Table, count, each

PLANS = {
    "smoke": Plan(1_000, 2),
    "quick": Plan(100_000, 2),
    "full": Plan(400_000, 5),
    "published": Plan(2_000_000, 5),
}
# What sets one rover apart from the other must be able to change alone: with a shared trunk and
# mutation of all matrices at once 6 of 17 runs of MERL found both POIs.
TEAM = Team(sharing="nothing")
MUTATION = MatrixMutation(
    gate="matrix",
    probability=0.2,
    fraction=0.3,
    super_probability=0.2,
    reset_probability=0.05,
    vectors=False,
)
SETTINGS = {"population_size": 50, "episodes": 5, "workers": 10, "mutation": MUTATION}
FRESH = 200  # chosen by looking at others
COMPARED = ("merl", "ea", "td3 mixed", "td3 global", "td3 local")


def cells(budget: str) -> list[Cell]:
    """Every method, with the local reward of fig-7.4."""
    found, labels = [], {"task": "motivating example"}
    for method in COMPARED:
        env = Rover.motivating(local="progress", rewards=rewards(method))
        settings: dict[str, Any] = {"first_seed": FRESH, "network": TEAM, **SETTINGS}
        found.append(cell(method, env, labels, budget, PLANS[budget], **settings))
    return found


BOTH = Table(
    "Frames until a test found both POIs in at least nine of ten worlds",
    ["method"],
    {
        "runs that did": count("both after", np.isfinite),
        "after frames, each run": each("both after"),
    },
)
EXPERIMENT = Experiment(
    **told("fig-7.1"),
    budgets=tuple(PLANS),
    cells=cells,
    measures=(measures.first("both after", 0.95, "frames"), *MEASURES),
    views=(BOTH, table("method"), curves("task"), notes("rovers", "fig-7.1")),
)
