"""Figure 3.9a: success of an evolved MMU on Sequence Recall, by depth."""

from typing import Any

from ..runs.store import Run
from . import chapter3, fig_3_4a
from .base import Cell

TITLE = "success by depth, Sequence Recall"
PUBLISHED = (
    "Figure 3.9a of the dissertation: more than 45 % at every depth from 1 to 6 after 10,000 "
    "generations; 6-deep 46.3 ± 0.9 %."
)
GIVEN = {1: "> 45", 2: "> 45", 3: "> 45", 4: "> 45", 5: "> 45", 6: "46.3 ± 0.9"}


def cells(budget: str) -> list[Cell]:
    return chapter3.recall_cells(budget)


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    return fig_3_4a.measure(runs, budget)


def sections(measured: dict[str, Any]) -> list[Any]:
    return [
        fig_3_4a.summary(measured, published=None),
        *(fig_3_4a.by_depth(measured, variant) for variant in fig_3_4a.variants(measured)),
        fig_3_4a.table(measured, GIVEN),
    ]
