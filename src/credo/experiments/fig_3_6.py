"""Figure 3.6: where and when a champion writes, on the permutation [-1, 1, -1]."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .. import tree
from ..analysis import memory
from ..environments.sequence_classification import SequenceClassification
from ..report.sections import HeatMap, Table
from ..runs.store import Run
from . import chapter3
from .base import Cell

TITLE = "write heat map, depth 3"
PUBLISHED = (
    "Figure 3.6 of the dissertation: two cells are written at signals, one at -1 and one at +1; "
    "at distractors nothing is written."
)


def cells(budget: str) -> list[Cell]:
    return chapter3.deepest_cells(budget)


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    return heat_map(runs, np.array([-1.0, 1.0, -1.0], np.float32))


def heat_map(runs: dict[str, list[Run]], signals: np.ndarray) -> dict[str, Any]:
    """Writes of the best champion, 15 distractors between signals; and for every champion the
    share of its writing that happens at signals."""
    ((name, cell),) = runs.items()
    policies = chapter3.champions(cell)
    chosen, _ = chapter3.best(policies)
    depth = len(signals)
    task = SequenceClassification(depth, 15, 15)
    inputs = task.lay_out(jnp.asarray(signals), jnp.full(depth, 15)).inputs
    writes = [
        np.asarray(memory.write_magnitudes(tree.take(policies, i), inputs))
        for i in range(len(cell))
    ]
    share = [memory.share_at_signals(jnp.asarray(w), inputs) for w in writes]
    return {
        "cell": name,
        "champion": chosen,
        "inputs": [int(x) for x in inputs[:, 0]],
        "writes": chapter3.rounded(writes[chosen].T, 3),
        "share at signals": chapter3.rounded(share),
    }


def sections(measured: dict[str, Any]) -> list[Any]:
    return pages(measured, range(len(measured["inputs"])))


def pages(measured: dict[str, Any], shown: Any) -> list[Any]:
    shown = list(shown)
    writes = measured["writes"]
    return [
        HeatMap(
            f"Write magnitude of run {measured['champion']}'s champion",
            [[row[t] for t in shown] for row in writes],
            [f"M{i + 1}" for i in range(len(writes))],
            [f"{measured['inputs'][t]:+d}" if measured["inputs"][t] else "0" for t in shown],
            "input",
            "memory cell",
        ),
        Table(
            "Share of all writing that happens at signals",
            ["run", "share, %"],
            [[str(i), f"{100 * s:.2f}"] for i, s in enumerate(measured["share at signals"])],
            caption="100 where distractors move nothing, as published for the champion.",
        ),
    ]
