"""Figure 3.12: an MMU by gradient on Sequence Recall, beside evolution."""

from typing import Any

from ..runs.store import Run
from . import chapter3, chapter3_gradient, fig_3_4a, fig_3_11
from .base import Cell
from .chapter3_gradient import depth_of, learning, of_depth, of_variant, variant_of

TITLE = "an MMU by gradient, Sequence Recall"
PUBLISHED = (
    "Figure 3.12 of the dissertation (curves without numbers): a very high level of accuracy at "
    "every depth from 1 to 6, better than by evolution after as many reinforcement instances."
)
DEPTHS = {"smoke": (2,), "quick": (2, 4, 6), "full": (2, 4, 6)}
GRADIENT = fig_3_11.GRADIENT


def cells(budget: str) -> list[Cell]:
    """Evolution has as many instances as the gradient: its 10,000 generations of Figure 3.9a
    are another question."""
    return [
        *gradient_cells(budget),
        *(
            chapter3_gradient.cell("recall", depth, f"ours {chapter3_gradient.EQUAL}", budget)
            for depth in DEPTHS[budget]
        ),
    ]


def gradient_cells(budget: str) -> list[Cell]:
    return [
        chapter3_gradient.cell("recall", depth, variant, budget)
        for variant in GRADIENT
        for depth in DEPTHS[budget]
    ]


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    return chapter3_gradient.measure(runs, budget)


def sections(measured: dict[str, Any]) -> list[Any]:
    deepest = max(chapter3.split_name(name)[0] for name in measured)
    return [
        fig_3_4a.summary(measured, published=None),
        *(
            learning(f"(a) {v}", of_variant(measured, v), depth_of)
            for v in fig_3_4a.variants(measured)
        ),
        learning(
            f"(b) Gradient and evolution, {deepest}-deep", of_depth(measured, deepest), variant_of
        ),
        fig_3_4a.table(measured, {}),
        fig_3_11.about(),
    ]
