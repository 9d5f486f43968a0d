"""Table 6.1: which learners CERL gave its workers to."""

from .base import Cell, Experiment, Value
from .fig_5_3 import BUDGETS, REFERENCES, curves, notes, table
from .fig_6_5 import ALLOCATION, ATTRIBUTION, HUMANOID, MEASURES, PORTFOLIO, TASKS, cerl, tasks

PUBLISHED = {  # percent of L1 to L4
    "Humanoid": (24.0, 35.0, 20.0, 20.0),
    "Hopper": (14.0, 27.0, 32.0, 27.0),
    "Swimmer": (17.0, 20.0, 36.0, 27.0),
    "HalfCheetah": (29.0, 32.0, 24.0, 15.0),
    "Walker2d": (14.0, 28.0, 33.0, 25.0),
}
VALUES = [
    Value(
        percent, "allocation, %", "Table 6.1", {"task": f"{task}-v5", "learner": f"TD3 γ {gamma:g}"}
    )
    for task, shares in PUBLISHED.items()
    for gamma, percent in zip(PORTFOLIO, shares, strict=True)
]


def cells(budget: str) -> list[Cell]:
    """CERL on every task."""
    return [cerl(task, budget) for task in tasks(budget, (*TASKS, HUMANOID))]


EXPERIMENT = Experiment(
    published="Table 6.1 of the dissertation: cumulative share of workers of learners L1 to L4, "
    "γ = 0.9, 0.99, 0.997 and 0.9995. L2, it says, is preferred in general; its numbers say so on "
    "two of five tasks.",
    budgets=BUDGETS,
    cells=cells,
    measures=MEASURES,
    values=[*REFERENCES, *VALUES],
    views=(ALLOCATION, *ATTRIBUTION, curves(), table(), notes()),
)
