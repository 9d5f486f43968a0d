"""Figure 3.9a: success of an evolved MMU on sequence recall, by depth."""

from .base import Cell, Experiment
from .dissertation import told
from .fig_3_4a import BY_DEPTH, MEASURES, SUMMARY, TABLE, cell

DEPTHS = {"smoke": (2,), "quick": (1, 2, 3, 4, 6), "full": (1, 2, 3, 4, 5, 6)}


def cells(budget: str) -> list[Cell]:
    """20-cell MMUs, as in the author's code."""
    presets = ("as coded", "ours")
    return [cell(budget, "recall", depth, preset) for preset in presets for depth in DEPTHS[budget]]


VIEWS = (SUMMARY, BY_DEPTH, TABLE)
EXPERIMENT = Experiment(**told("fig-3.9a"), cells=cells, measures=MEASURES, views=VIEWS)
