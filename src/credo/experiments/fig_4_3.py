"""Figure 4.3: Spread, a learning robot beside a static one."""

from .base import Cell, Experiment
from .dissertation import notes, told
from .fig_4_2 import BUDGETS, MEASURES, VIEWS, beside_a_static_robot


def cells(budget: str) -> list[Cell]:
    """Spread."""
    return beside_a_static_robot("spread", budget)


EXPERIMENT = Experiment(
    **told("fig-4.3"),
    budgets=BUDGETS,
    cells=cells,
    measures=MEASURES,
    views=(*VIEWS, notes("T-mazes", "fig-4.3")),
)
