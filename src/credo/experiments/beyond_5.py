"""Beyond chapter 5: who made the champions of ERL."""

from typing import Any

from ..analysis import attribution
from ..report import run_page as report
from ..runs.store import Run
from . import chapter5
from .base import Cell

TITLE = "who made the champions of ERL"
PUBLISHED = (
    "Not in the dissertation, which counts what became of the learner's actors (Table 5.2) and not "
    "what became of them later. Here every champion's line is followed back."
)
BUDGETS = chapter5.BUDGETS


def cells(budget: str) -> list[Cell]:
    return chapter5.erl_cells(budget)


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    return {name: lineage(name, cell) for name, cell in runs.items()}


def lineage(name: str, cell: list[Run]) -> dict[str, Any]:
    """Scores and attribution of the runs of a cell."""
    return {
        **chapter5.outcome(name, cell),
        "learners": report.learner_names(cell[0].algorithm.learners),
        "attribution": attribution.summary([run.metrics for run in cell]),
    }


def sections(measured: dict[str, Any]) -> list[Any]:
    found = []
    for name, cell in measured.items():
        found += report.attributed(cell["attribution"], cell["learners"], f"{name}: ")
    return [
        *found,
        *chapter5.by_task(measured),
        chapter5.scores(measured),
        chapter5.about(
            measured,
            "The last to change a champion is mutation nearly always, elites and fresh actors of "
            "the learner aside: most offspring are mutated. Shares of weights say more: a child "
            "has them from its parent, a crossed one from each of two what it took of them, and "
            "mutation does not change whose line it is.",
        ),
    ]
