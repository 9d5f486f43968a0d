"""Figure 3.10: recall networks trained on corridors of 10..20 steps, tested on 1..101."""

from typing import Any

from ..environments.sequence_recall import SequenceRecall
from ..runs.store import Run
from . import chapter3, fig_3_4a, fig_3_5a
from .base import Cell

TITLE = "recall in corridors of 1..101 steps"
PUBLISHED = (
    "Figure 3.10 of the dissertation (a curve without numbers): success falls to a plateau away "
    "from the trained 10..20 steps, further the deeper the task. Its corridors of 0 steps have no "
    "junction to turn at: the shortest here has 1 step."
)


def cells(budget: str) -> list[Cell]:
    return chapter3.recall_cells(budget)


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    lengths = tuple(max(1, gap) for gap in fig_3_5a.GAPS[budget])
    lengths = tuple(dict.fromkeys(lengths))
    measured = {}
    for name, cell in runs.items():
        trained = cell[0].algorithm.env
        # Distances keep the unit of training, or longer corridors would look like shorter ones.
        unit = trained.unit or trained.max_corridor
        task = SequenceRecall(trained.depth, 1, 101, unit=unit)
        measured[name] = fig_3_5a.sweep(cell, task, lengths)
    return measured


def sections(measured: dict[str, Any]) -> list[Any]:
    return [
        *(
            fig_3_5a.figure(measured, variant, "steps per corridor", None)
            for variant in fig_3_4a.variants(measured)
        ),
        fig_3_5a.table(measured, {}, "steps"),
    ]
