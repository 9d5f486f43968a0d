"""Figure 4.3: Spread, a learning robot beside a static one."""

from typing import Any

from . import chapter4
from .base import Cell

TITLE = "Extended T-Maze, Spread"
PUBLISHED = (
    "Figure 4.3 of the dissertation, 10 runs, mean ± standard error, %: MMU 77.0 ± 0.7 (FSP) and "
    "75.1 ± 0.6 (RESP) 2-deep, 67.5 ± 0.4 and 63.7 ± 0.3 3-deep; feed-forward 69.3 ± 2.0, "
    "69.4 ± 1.2, 60.0 ± 1.0, 60.0 ± 0.8."
)
BUDGETS = chapter4.BUDGETS
GIVEN = {
    "spread 2-deep, fsp, mmu": "77.0 ± 0.7",
    "spread 2-deep, resp, mmu": "75.1 ± 0.6",
    "spread 3-deep, fsp, mmu": "67.5 ± 0.4",
    "spread 3-deep, resp, mmu": "63.7 ± 0.3",
    "spread 2-deep, fsp, ff": "69.3 ± 2.0",
    "spread 2-deep, resp, ff": "69.4 ± 1.2",
    "spread 3-deep, fsp, ff": "60.0 ± 1.0",
    "spread 3-deep, resp, ff": "60.0 ± 0.8",
}


def cells(budget: str) -> list[Cell]:
    return chapter4.beside_a_static_robot("spread", budget)


measure = chapter4.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    return [
        chapter4.scores(measured, GIVEN),
        *chapter4.curves(measured),
        *chapter4.pictures(measured),
        chapter4.about(
            "The dissertation gives 48 % and 33 % for the static robot alone; by its own rules it "
            "observes the reward in 54.2 % and 52.1 % of the trials.",
        ),
    ]
