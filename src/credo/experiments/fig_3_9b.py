"""Figure 3.9b: an evolved MMU beside evolved recurrent networks, Sequence Recall."""

from typing import Any

from ..runs.store import Run
from . import chapter3_gradient, fig_3_4b
from .base import Cell

TITLE = "MMU, LSTM, GRU and RNN by evolution, Sequence Recall"
PUBLISHED = (
    "Figure 3.9b of the dissertation (curves): the MMU beside NEAT-RNN, NEAT-LSTM and "
    "NEAT-LSTM-Info-max. Here the networks have a fixed form and are evolved by the same "
    "operators; NEAT is not here yet."
)
DEPTHS = {"smoke": (2,), "quick": (2, 4, 6), "full": (1, 2, 3, 4, 5, 6)}


def cells(budget: str) -> list[Cell]:
    return [
        chapter3_gradient.cell("recall", depth, "ours", budget, net)
        for net in fig_3_4b.NETWORKS
        for depth in DEPTHS[budget]
    ]


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    return fig_3_4b.measure(runs, budget)


def sections(measured: dict[str, Any]) -> list[Any]:
    return fig_3_4b.sections(measured)
