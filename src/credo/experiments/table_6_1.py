"""Table 6.1: which learners CERL gave its workers to."""

from .base import Cell, Experiment
from .dissertation import notes, told
from .fig_5_3 import TABLE, curves
from .fig_6_5 import ALLOCATION, ATTRIBUTION, HUMANOID, PORTFOLIOS, TASKS, cerl, tasks


def cells(budget: str) -> list[Cell]:
    """CERL on every task."""
    return [cerl(task, budget) for task in tasks(budget, (*TASKS, HUMANOID))]


EXPERIMENT = Experiment(
    **told("table-6.1", "mujoco"),
    **PORTFOLIOS,
    cells=cells,
    views=(ALLOCATION, *ATTRIBUTION, curves(), TABLE, notes("mujoco")),
)
