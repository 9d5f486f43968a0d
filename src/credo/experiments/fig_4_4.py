"""Figure 4.4: two to four learning robots, Spread, no static robot."""

from .base import Cell, Experiment
from .dissertation import notes, told
from .fig_4_2 import BUDGETS, MEASURES, VIEWS, cell


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
    **told("fig-4.4"),
    budgets=BUDGETS,
    cells=cells,
    measures=MEASURES,
    views=(*VIEWS, notes("T-mazes", "fig-4.4")),
)
