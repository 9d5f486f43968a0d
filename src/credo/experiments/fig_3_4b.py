"""Figure 3.4b: an evolved MMU beside evolved recurrent networks, Sequence Classification."""

from typing import Any

from ..runs.store import Run
from . import chapter3_gradient, fig_3_4a
from .base import Cell

TITLE = "MMU, LSTM, GRU and RNN by evolution, Sequence Classification"
PUBLISHED = (
    "Figure 3.4b of the dissertation (curves): the MMU after 1,000 generations is above NEAT-RNN "
    "and NEAT-LSTM after 15,000 (Rawal & Miikkulainen 2016), at depths 2 to 6. Here the networks "
    "have a fixed form and are evolved by the same operators; NEAT is not here yet."
)
DEPTHS = {"smoke": (3,), "quick": (2, 4, 6), "full": (2, 3, 4, 5, 6)}
NETWORKS = ("mmu", "lstm", "gru", "rnn")
VARIANTS = ("as coded", "ours")


def cells(budget: str) -> list[Cell]:
    return [
        chapter3_gradient.cell("classification", depth, variant, budget, net)
        for variant in VARIANTS
        for net in NETWORKS
        for depth in DEPTHS[budget]
    ]


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    return fig_3_4a.measure(runs, budget)


def sections(measured: dict[str, Any]) -> list[Any]:
    return [fig_3_4a.summary(measured, published=None), fig_3_4a.table(measured, {})]
