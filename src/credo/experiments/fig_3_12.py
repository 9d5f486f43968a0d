"""Figure 3.12: an MMU by gradient on sequence recall, beside evolution."""

from .base import Cell, Experiment
from .fig_3_4a import LINE, TABLE, baseline, cell, learning, success, summary
from .fig_3_11 import ABOUT, GRADIENT, at_deepest, by_instances, over_instances

DEPTHS = {"smoke": (2,), "quick": (2, 4, 6), "full": (2, 4, 6)}


def by_gradient(budget: str) -> list[Cell]:
    """MMUs on sequence recall, by gradient."""
    asked = [(depth, preset) for preset in GRADIENT for depth in DEPTHS[budget]]
    return [cell(budget, "recall", *x, "gradient") for x in asked]


def cells(budget: str) -> list[Cell]:
    """Evolution has as many instances as the gradient: its 10,000 generations of Figure 3.9a are
    another question."""
    evolution = [cell(budget, "recall", depth, "ours", equal=True) for depth in DEPTHS[budget]]
    return by_gradient(budget) + evolution


EXPERIMENT = Experiment(
    published="Figure 3.12 of the dissertation (curves without numbers): a very high level of "
    "accuracy at every depth from 1 to 6, better than by evolution after as many reinforcement "
    "instances.",
    cells=cells,
    measures=(baseline, success, learning, over_instances),
    views=(summary(), by_instances("(a) {panel}", ("depth",), LINE), at_deepest, TABLE, ABOUT),
)
