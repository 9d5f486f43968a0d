"""Beyond chapter 3: four networks under evolution and gradient at the same instances, depth 10^6,
and an MMU whose memory has another size than its hidden layer."""

from dataclasses import replace

import jax

from ..report.rows import Row
from .base import Cell, Experiment, Trained
from .dissertation import notes, told
from .fig_3_4a import LINE, MEASURES, TABLE, cell
from .fig_3_11 import by_instances, over_instances
from .table_3_2 import MEDIAN, WORST, streams, to_the_end
from .views import Table, known

SMOKE, OTHERWISE = {"classification": 3, "recall": 2}, {"classification": 21, "recall": 6}
MEMORIES = {"classification": (2, 15), "recall": (10,)}  # beside as many cells as hidden units
SIGNALS = {"smoke": 200, "quick": 100_000, "full": 1_000_000}


def cells(budget: str) -> list[Cell]:
    """On the deepest task of each kind, our settings by evolution and by gradient."""
    return [
        cell(budget, task, depth, "ours", trainer, network, memory, trainer == "evolution")
        for task, depth in (SMOKE if budget == "smoke" else OTHERWISE).items()
        for trainer in ("evolution", "gradient")
        for network, memory in [
            *((name, None) for name in ("mmu", "lstm", "gru", "rnn")),
            *(("mmu", memory) for memory in MEMORIES[task]),
        ]
    ]


def weights(trained: Trained) -> list[Row]:
    """How many numbers a champion has."""
    count = sum(x.size for x in jax.tree.leaves(trained.runs[0].champion))
    return [Row(trained.labels, None, "weights", count)]


def deep(trained: Trained) -> list[Row]:
    """How many signals of long streams champions answer right before a mistake."""
    if trained.labels["task"] == "recall":
        return []
    fed = SIGNALS[trained.budget]
    return [Row(trained.labels, None, "signals fed", fed), *streams(trained, fed)]


STREAMS = Table(
    "Long streams of signals",
    rows=LINE,
    columns={
        "signals": known("signals fed"),
        "runs right to the end, on all of 10 streams": to_the_end,
        "best run, its worst stream": WORST,
        "median of all runs and streams": MEDIAN,
    },
    where={"task": "classification"},
    caption="Signals answered right in a row, distractors between them.",
)
EXPERIMENT = Experiment(
    **told("beyond-3"),
    cells=cells,
    measures=(*MEASURES, over_instances, weights, deep),
    views=(
        by_instances("{panel}", LINE, ("task", "depth", "trainer")),
        replace(TABLE, rows=("task", *TABLE.rows)),
        Table("Weights of a network", ("task", *LINE), {"weights": known("weights")}),
        STREAMS,
        notes("beyond-3"),
    ),
)
