"""Figure 3.12: an MMU by gradient on sequence recall, beside evolution."""

from .base import Cell, Experiment
from .dissertation import notes, told
from .fig_3_4a import LINE, MEASURES, SUMMARY, TABLE, cell
from .fig_3_11 import GRADIENT, at_deepest, by_instances, over_instances

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
    **told("fig-3.12"),
    cells=cells,
    measures=(*MEASURES, over_instances),
    views=(
        SUMMARY,
        by_instances("(a) {panel}", ("depth",), LINE),
        at_deepest,
        TABLE,
        notes("gradient"),
    ),
)
