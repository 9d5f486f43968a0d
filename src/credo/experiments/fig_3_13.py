"""Figure 3.13: recall by gradient, trained in corridors of 10..20 steps, tested in 1..101."""

from typing import Any

from ..runs.store import Run
from . import fig_3_10, fig_3_12
from .base import Cell

TITLE = "recall by gradient in corridors of 1..101 steps"
PUBLISHED = (
    "Figure 3.13 of the dissertation (a curve without numbers): generalization to other corridors "
    "is comparable to that by evolution (Figure 3.10)."
)


def cells(budget: str) -> list[Cell]:
    return fig_3_12.gradient_cells(budget)


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    return fig_3_10.measure(runs, budget)


def sections(measured: dict[str, Any]) -> list[Any]:
    return fig_3_10.sections(measured)
