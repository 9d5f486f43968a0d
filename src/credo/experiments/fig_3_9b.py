"""Figure 3.9b: an evolved MMU beside evolved recurrent networks, sequence recall."""

from .base import Cell, Experiment
from .fig_3_4a import TABLE, baseline, cell, learning, success, summary
from .fig_3_4b import NETWORKS

DEPTHS = {"smoke": (2,), "quick": (2, 4, 6), "full": (1, 2, 3, 4, 5, 6)}


def cells(budget: str) -> list[Cell]:
    """Four networks under the same operators."""
    return [
        cell(budget, "recall", depth, "ours", network=network)
        for network in NETWORKS
        for depth in DEPTHS[budget]
    ]


EXPERIMENT = Experiment(
    published="Figure 3.9b of the dissertation (curves): the MMU beside NEAT-RNN, NEAT-LSTM and "
    "NEAT-LSTM-Info-max. Here the networks have a fixed form and are evolved by the same "
    "operators; NEAT is not here yet.",
    cells=cells,
    measures=(baseline, success, learning),
    views=(summary(), TABLE),
)
