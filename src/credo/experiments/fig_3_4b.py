"""Figure 3.4b: an evolved MMU beside evolved recurrent networks, sequence classification."""

from .base import Cell, Experiment
from .fig_3_4a import TABLE, baseline, cell, learning, success, summary

DEPTHS = {"smoke": (3,), "quick": (2, 4, 6), "full": (2, 3, 4, 5, 6)}
NETWORKS = ("mmu", "lstm", "gru", "rnn")


def cells(budget: str) -> list[Cell]:
    """Four networks under the same operators."""
    return [
        cell(budget, "classification", depth, preset, network=network)
        for preset in ("as coded", "ours")
        for network in NETWORKS
        for depth in DEPTHS[budget]
    ]


EXPERIMENT = Experiment(
    published="Figure 3.4b of the dissertation (curves): the MMU after 1,000 generations is above "
    "NEAT-RNN and NEAT-LSTM after 15,000 (Rawal & Miikkulainen 2016), at depths 2 to 6. Here the "
    "networks have a fixed form and are evolved by the same operators; NEAT is not here yet.",
    cells=cells,
    measures=(baseline, success, learning),
    views=(summary(), TABLE),
)
