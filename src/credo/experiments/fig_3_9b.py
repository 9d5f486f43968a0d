"""Figure 3.9b: an evolved MMU beside evolved recurrent networks, sequence recall."""

from .base import Cell, Experiment
from .dissertation import told
from .fig_3_4a import MEASURES
from .fig_3_4b import VIEWS, networks


def cells(budget: str) -> list[Cell]:
    """By our operators."""
    return networks(budget, "recall", "ours")


EXPERIMENT = Experiment(**told("fig-3.9b"), cells=cells, measures=MEASURES, views=VIEWS)
