"""Figure 3.4b: an evolved MMU beside evolved recurrent networks, sequence classification."""

from .base import Cell, Experiment
from .dissertation import told
from .fig_3_4a import MEASURES, SUMMARY, TABLE, cell

DEPTHS = {
    "classification": {"smoke": (3,), "quick": (2, 4, 6), "full": (2, 3, 4, 5, 6)},
    "recall": {"smoke": (2,), "quick": (2, 4, 6), "full": (1, 2, 3, 4, 5, 6)},
}


def networks(budget: str, task: str, preset: str) -> list[Cell]:
    """Four networks under the same operators."""
    return [
        cell(budget, task, depth, preset, network=network)
        for network in ("mmu", "lstm", "gru", "rnn")
        for depth in DEPTHS[task][budget]
    ]


def cells(budget: str) -> list[Cell]:
    """By the author's operators and by ours."""
    return [x for y in ("as coded", "ours") for x in networks(budget, "classification", y)]


VIEWS = (SUMMARY, TABLE)
EXPERIMENT = Experiment(**told("fig-3.4b"), cells=cells, measures=MEASURES, views=VIEWS)
