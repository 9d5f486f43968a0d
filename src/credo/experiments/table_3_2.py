"""Table 3.2: how far the champions count."""

from typing import Any

import jax
import numpy as np

from ..analysis import counting
from ..report.sections import Table
from ..runs.store import Run
from . import chapter3
from .base import Cell

TITLE = "counting study"
PUBLISHED = (
    "Table 3.2 of the dissertation: after 10^5 signals -1 and then 10^6 signals +1, one cell of "
    "the champion counted +1 to 1,000,000; the other counted -1 to 1,244 and saturated."
)
SIGNALS = {"smoke": (100, 100), "quick": (10_000, 10_000), "full": (100_000, 1_000_000)}


def cells(budget: str) -> list[Cell]:
    return chapter3.deepest_cells(budget, variants=("as coded", "ours"))


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    negatives, positives = SIGNALS[budget]
    measured = {}
    for name, cell in runs.items():
        policies = chapter3.champions(cell)
        study = counting.counting_study(policies, negatives, positives, key=jax.random.key(50_000))
        right = counting.longest_correct(policies, positives, key=jax.random.key(60_000))
        measured[name] = {
            "fed": [negatives, positives],
            "rows": np.stack([study.negatives, study.positives], axis=1).tolist(),
            "memory": chapter3.rounded(np.moveaxis(np.asarray(study.memory), 0, 1), 2),
            "counted": np.asarray(study.counted).tolist(),
            "random signals right": np.asarray(right).tolist(),
        }
    return measured


def sections(measured: dict[str, Any]) -> list[Any]:
    return [
        section
        for name, cell in measured.items()
        for section in (verdicts(name, cell), champion(name, cell))
    ]


def verdicts(name: str, cell: dict[str, Any]) -> Table:
    """Which champions count, and how far."""
    rows = []
    for run, (counted, right) in enumerate(
        zip(cell["counted"], cell["random signals right"], strict=True)
    ):
        far = [_furthest(cells) for cells in counted]
        depth = max(cell["fed"])
        rows.append(
            [
                str(run),
                *(f"{n:,} ({m})" for n, m in far),
                f"{min(right):,}",
                f"{int(np.median(right)):,}",
                "yes" if min(right) >= depth else "no",
            ]
        )
    return Table(
        f"{name}: how far each champion counts",
        [
            "run",
            f"-1, of {cell['fed'][0]:,}",
            f"+1, of {cell['fed'][1]:,}",
            "random signals right, worst of 10",
            "median of 10",
            f"counts to {max(cell['fed']):,}",
        ],
        rows,
        caption="Counted: the signals of one sign at each of which the cell moved the same way, "
        "before it once did not. Random signals: answered right in a row in streams of ±1, "
        "which share their distractors.",
    )


def champion(name: str, cell: dict[str, Any]) -> Table:
    """The dissertation's table for the champion that goes furthest."""
    right = cell["random signals right"]
    best = max(range(len(right)), key=lambda i: (min(right[i]), np.mean(right[i])))
    memory = cell["memory"][best]
    return Table(
        f"{name}: memory of run {best}",
        ["#-1", "#+1", *(f"M{i + 1}" for i in range(len(memory[0])))],
        [
            [f"{minus:,}", f"{plus:,}", *(f"{value:,.2f}" for value in row)]
            for (minus, plus), row in zip(cell["rows"], memory, strict=True)
        ],
    )


def _furthest(cells: list[int]) -> tuple[int, str]:
    best = int(np.argmax(cells))
    return cells[best], f"M{best + 1}" if cells[best] else "none"
