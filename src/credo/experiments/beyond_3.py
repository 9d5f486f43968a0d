"""Beyond chapter 3: four networks under evolution and gradient at the same instances, depth 10^6,
and an MMU whose memory has another size than its hidden layer."""

from typing import Any

import jax
import numpy as np

from ..analysis import counting
from ..environments.sequence_classification import SequenceClassification
from ..report.sections import Table, Text
from ..runs.store import Run
from . import chapter3, chapter3_gradient, fig_3_4a
from .base import Cell
from .chapter3_gradient import EQUAL, learning, variant_of

TITLE = "MMU, LSTM, GRU and RNN, by evolution and by gradient"
PUBLISHED = (
    "Not in the dissertation, which names an MMU whose memory and hidden layer differ in size as "
    "future work. Evolution and gradient have the same number of reinforcement instances; the "
    "networks the same number of units."
)
DEPTHS = {
    "smoke": {"classification": 3, "recall": 2},
    "quick": {"classification": 21, "recall": 6},
    "full": {"classification": 21, "recall": 6},
}
NETWORKS = {
    "classification": ("mmu", "lstm", "gru", "rnn", "mmu 5×2", "mmu 5×15"),
    "recall": ("mmu", "lstm", "gru", "rnn", "mmu 20×10"),
}
SIGNALS = {"smoke": 200, "quick": 100_000, "full": 1_000_000}
VARIANTS = (f"ours {EQUAL}", "ours by gradient")


def cells(budget: str) -> list[Cell]:
    return [
        chapter3_gradient.cell(task, depth, variant, budget, net)
        for task, depth in DEPTHS[budget].items()
        for variant in VARIANTS
        for net in NETWORKS[task]
    ]


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    measured = chapter3_gradient.measure(runs, budget)
    for name, cell in runs.items():
        measured[name]["weights"] = weights(cell[0])
        if isinstance(cell[0].algorithm.env, SequenceClassification):
            right = counting.longest_correct(
                chapter3.champions(cell), SIGNALS[budget], key=jax.random.key(60_000)
            )
            measured[name]["right"] = np.asarray(right).tolist()
            measured[name]["fed"] = SIGNALS[budget]
    return measured


def weights(run: Run) -> int:
    """How many numbers a champion has."""
    return sum(x.size for x in jax.tree.leaves(run.champion))


def sections(measured: dict[str, Any]) -> list[Any]:
    tasks = list(dict.fromkeys(name.split(" ")[0] for name in measured))
    found = []
    for task in tasks:
        of_task = {name: cell for name, cell in measured.items() if name.startswith(task)}
        (depth, *_) = (chapter3.split_name(name)[0] for name in of_task)
        found += [
            learning(
                f"{task}, {depth}-deep, {words}",
                {n: c for n, c in of_task.items() if ("gradient" in n) == gradient},
                variant_of,
            )
            for gradient, words in ((False, "evolution"), (True, "gradient"))
            if any(("gradient" in n) == gradient for n in of_task)
        ]
    return [*found, fig_3_4a.table(measured, {}), sizes(measured), *deep(measured), about()]


def sizes(measured: dict[str, Any]) -> Table:
    return Table(
        "Weights of a network",
        ["cell", "weights"],
        [[name, cell["weights"]] for name, cell in measured.items()],
    )


def deep(measured: dict[str, Any]) -> list[Table]:
    """How many signals of endless streams champions answer right before a mistake."""
    known = {name: cell for name, cell in measured.items() if "right" in cell}
    if not known:
        return []
    rows = []
    for name, cell in known.items():
        worst = [min(run) for run in cell["right"]]
        whole = sum(x >= cell["fed"] for x in worst)
        median = f"{int(np.median(cell['right'])):,}"
        rows.append([name, f"{whole} of {len(worst)}", f"{max(worst):,}", median])
    fed = next(iter(known.values()))["fed"]
    return [
        Table(
            f"Streams of {fed:,} signals",
            [
                "cell",
                "runs right to the end, on all of 10 streams",
                "best run, its worst stream",
                "median of all runs and streams",
            ],
            rows,
            caption="Signals answered right in a row, distractors between them.",
        )
    ]


def about() -> Text:
    return Text(
        "How to read it",
        [
            f"`ours {EQUAL}` is `ours` of neuroevolution, ended when the gradient is. The "
            "optimizer settings were chosen for the MMU (docs/gradient.md); the other networks "
            "start from plain Kaiming-normal weights and were not tuned.",
            "`mmu 5×15`: 5 hidden units, 15 memory cells, encoder and decoder learned.",
        ],
    )
