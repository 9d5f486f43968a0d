"""Figure 6.4: how much the resource manager explores."""

from ..learners.manager import UCB
from .base import Cell, Experiment
from .fig_5_3 import BUDGETS, REFERENCES, curves, notes, table
from .fig_6_5 import ALLOCATION, ATTRIBUTION, HUMANOID, MEASURES, cerl, tasks

COEFFICIENTS = (0.0, 0.9, 5.0, 10.0)
PUBLISHED_C = 0.9


def cells(budget: str) -> list[Cell]:
    """CERL at each coefficient c of UCB."""
    (task,) = tasks(budget, (HUMANOID,))
    return [
        cerl(task, budget)
        if c == PUBLISHED_C
        else cerl(task, budget, labels={"exploration": c}, manager=UCB(exploration=c))
        for c in COEFFICIENTS
    ]


EXPERIMENT = Experiment(
    published="Figure 6.4 of the dissertation (curves without numbers), on Humanoid: c = 0.9 is "
    "best; 0 and 5 learn too, with more frames; 10 needs more still.",
    budgets=BUDGETS,
    cells=cells,
    measures=MEASURES,
    values=REFERENCES,
    views=(
        curves(),
        table(),
        ALLOCATION,
        *ATTRIBUTION,
        notes(f"Exploration is the manager's c; where none is named, it is {PUBLISHED_C}."),
    ),
)
