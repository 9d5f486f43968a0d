"""Figure 3.7: where a champion writes over 21 signals that flip their sign."""

from typing import Any

import numpy as np

from ..runs.store import Run
from . import chapter3, fig_3_6
from .base import Cell

TITLE = "write heat map, depth 21"
PUBLISHED = (
    "Figure 3.7 of the dissertation: over -1, +1, -1, … one cell is written at each -1 and another "
    "at each +1; distractors, which write nothing, are left out."
)


def cells(budget: str) -> list[Cell]:
    return chapter3.deepest_cells(budget)


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    return fig_3_6.heat_map(runs, np.array([-1.0, 1.0] * 10 + [-1.0], np.float32))


def sections(measured: dict[str, Any]) -> list[Any]:
    return fig_3_6.pages(measured, [t for t, x in enumerate(measured["inputs"]) if x])
