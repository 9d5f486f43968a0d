"""Figure 4.2: Converge, a learning robot beside a static one."""

from typing import Any

from . import chapter4
from .base import Cell

TITLE = "Extended T-Maze, Converge"
PUBLISHED = (
    "Figure 4.2 of the dissertation, 10 runs, mean ± standard error, %: MMU 41.3 ± 2.4 (FSP) and "
    "33.7 ± 1.4 (RESP) 2-deep, 29.8 ± 2.7 and 28.0 ± 1.5 3-deep; feed-forward 15.0 ± 0.1, "
    "16.5 ± 0.2, 7.1 ± 0.2, 8.0 ± 0.1."
)
BUDGETS = chapter4.BUDGETS
GIVEN = {
    "converge 2-deep, fsp, mmu": "41.3 ± 2.4",
    "converge 2-deep, resp, mmu": "33.7 ± 1.4",
    "converge 3-deep, fsp, mmu": "29.8 ± 2.7",
    "converge 3-deep, resp, mmu": "28.0 ± 1.5",
    "converge 2-deep, fsp, ff": "15.0 ± 0.1",
    "converge 2-deep, resp, ff": "16.5 ± 0.2",
    "converge 3-deep, fsp, ff": "7.1 ± 0.2",
    "converge 3-deep, resp, ff": "8.0 ± 0.1",
}


def cells(budget: str) -> list[Cell]:
    return chapter4.beside_a_static_robot("converge", budget)


measure = chapter4.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    return [
        chapter4.scores(measured, GIVEN),
        *chapter4.curves(measured),
        *chapter4.pictures(measured),
        chapter4.about(
            "Fitness has the author's undisclosed bonuses: 0.1/T for a trial in which all robots "
            "took one path, and 0.05/(T-1) for exploring. Tests and tables are of the score alone. "
            f"{chapter4.APART} They were chosen with seeds from 600 on, after these seeds had been "
            "run without them; those numbers are in the changelog. Beside RESP they were left out "
            "after they had not helped on these seeds. "
            "Without memory a robot goes to the "
            "first endpoint or to the last one, in every trial.",
        ),
    ]
