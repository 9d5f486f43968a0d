"""Figure 3.9a: success of an evolved MMU on sequence recall, by depth."""

from .base import Cell, Experiment, Value
from .fig_3_4a import BY_DEPTH, TABLE, baseline, cell, learning, success, summary

DEPTHS = {"smoke": (2,), "quick": (1, 2, 3, 4, 6), "full": (1, 2, 3, 4, 5, 6)}


def cells(budget: str) -> list[Cell]:
    """20-cell MMUs, as in the author's code."""
    presets = ("as coded", "ours")
    return [cell(budget, "recall", depth, preset) for preset in presets for depth in DEPTHS[budget]]


EXPERIMENT = Experiment(
    published="Figure 3.9a of the dissertation: more than 45 % at every depth from 1 to 6 after "
    "10,000 generations; 6-deep 46.3 ± 0.9 %.",
    cells=cells,
    measures=(baseline, success, learning),
    views=(summary(), BY_DEPTH, TABLE),
    values=(
        Value("> 45", "success", "Figure 3.9a, text"),
        Value("46.3 ± 0.9", "success", "Figure 3.9a", {"depth": 6}),
    ),
)
