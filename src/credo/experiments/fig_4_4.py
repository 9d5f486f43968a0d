"""Figure 4.4: two to four learning robots, Spread, no static robot."""

from typing import Any

from ..environments.extended_tmaze import ExtendedTMaze
from . import chapter4
from .base import Cell

TITLE = "Extended T-Maze, Spread, teams of learning robots"
PUBLISHED = (
    "Figure 4.4 of the dissertation (bars without numbers): MMU teams are better than feed-forward "
    "ones at every size and grow with it, 2-deep and 3-deep; feed-forward teams hardly do."
)
BUDGETS = chapter4.BUDGETS


def cells(budget: str) -> list[Cell]:
    depths, sizes = ((2,), (2,)) if budget == "smoke" else ((2, 3), (2, 3, 4))
    return [
        chapter4.cell(
            f"spread {depth}-deep, {robots} robots, {network}",
            ExtendedTMaze(depth=depth, robots=robots, objective="spread", partner=None),
            network,
            budget,
        )
        for depth in depths
        for robots in sizes
        for network in chapter4.NETWORKS
    ]


measure = chapter4.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    return [
        chapter4.scores(measured, {}),
        *chapter4.curves(measured),
        *chapter4.pictures(measured),
        chapter4.about("Every robot has a population of its own."),
    ]
