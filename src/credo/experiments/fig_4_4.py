"""Figure 4.4: two to four learning robots, Spread, no static robot."""

from .base import Cell, Experiment
from .fig_4_2 import BUDGETS, CURVES, SCORES, about, cell, levels, pictures, shares


def cells(budget: str) -> list[Cell]:
    """By depth, size of the team and network."""
    depths, sizes = ((2,), (2,)) if budget == "smoke" else ((2, 3), (2, 3, 4))
    return [
        cell(budget, "spread", depth, network, robots=robots)
        for depth in depths
        for robots in sizes
        for network in ("mmu", "ff")
    ]


EXPERIMENT = Experiment(
    published="Figure 4.4 of the dissertation (bars without numbers): MMU teams are better than "
    "feed-forward ones at every size and grow with it, 2-deep and 3-deep; feed-forward teams "
    "hardly do.",
    cells=cells,
    measures=(levels, shares),
    views=(SCORES, CURVES, pictures, about("Every robot has a population of its own.")),
    budgets=BUDGETS,
)
