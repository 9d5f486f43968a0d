"""Figure 3.5a: MMUs trained on 10..20 distractors, tested on 0..101."""

from typing import Any

import jax
import jax.numpy as jnp

from ..environments.sequence_classification import SequenceClassification
from ..report.sections import Curve, Figure, Reference, Table
from ..runs.store import Run
from . import chapter3, fig_3_4a
from .base import Cell

TITLE = "generalization to 0..101 distractors"
PUBLISHED = (
    "Figure 3.5a of the dissertation: the 21-deep networks reach 43.2 ± 13.2 % with 101 "
    "distractors between signals; the best single network 100 % at every number of distractors."
)
GAPS = {"smoke": (0, 15), "quick": (0, 5, 10, 15, 20, 40, 60, 80, 101)}
GAPS["full"] = (0, 1, 2, 3, 5, 7, 10, 12, 15, 18, 20, 25, 30, 40, 50, 60, 70, 80, 90, 101)
PUBLISHED_AT_LAST = 0.432


def cells(budget: str) -> list[Cell]:
    return chapter3.classification_cells(budget, variants=("as coded", "ours"))


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    return {
        name: sweep(cell, SequenceClassification(cell[0].algorithm.env.depth, 0, 101), GAPS[budget])
        for name, cell in runs.items()
    }


def sweep(cell: list[Run], task: Any, gaps: tuple[int, ...]) -> dict[str, Any]:
    """Success `[runs, gaps]` of a cell's champions."""
    policies, key = chapter3.champions(cell), jax.random.key(20_000)
    rows = [
        chapter3.success_with_gap(
            task, policies, jnp.int32(gap), key=key, episodes=chapter3.TEST // 5
        )
        for gap in gaps
    ]
    return {"gaps": list(gaps), "success": chapter3.rounded(jnp.stack(rows, axis=1))}


def sections(measured: dict[str, Any]) -> list[Any]:
    return [
        *(
            figure(measured, variant, "distractors between signals", PUBLISHED_AT_LAST)
            for variant in fig_3_4a.variants(measured)
        ),
        table(measured, {21: "43.2 ± 13.2"}, "distractors"),
    ]


def figure(measured: dict[str, Any], variant: str, x_label: str, published: float | None) -> Figure:
    return Figure(
        f"Champions of depth-trained runs, {variant}",
        x_label,
        "success, 200 fresh sequences",
        [
            Curve(f"{depth}-deep", cell["gaps"], cell["success"])
            for depth, cell in fig_3_4a.of_variant(measured, variant).items()
        ],
        references=(Reference("published, 21-deep at 101", published),) if published else (),
        y_range=(0.0, 1.02),
        caption="Trained on 10 to 20.",
    )


def table(measured: dict[str, Any], given: dict[int, str], what: str) -> Table:
    first = next(iter(measured.values()))["gaps"]
    shown = [i for i, gap in enumerate(first) if gap in (first[0], 15, 40, 101)]
    rows = []
    for name, cell in measured.items():
        depth, variant = chapter3.split_name(name)
        values = [chapter3.percent([run[i] for run in cell["success"]]) for i in shown]
        best = f"{100 * max(run[shown[-1]] for run in cell['success']):.1f}"
        rows.append([str(depth), variant, *values, given.get(depth, ""), best])
    last = first[shown[-1]]
    return Table(
        "Success in percent, mean ± standard error over runs",
        [
            "depth",
            "variant",
            *(f"{first[i]} {what}" for i in shown),
            f"published at {last}" if last == 101 else "published",
            f"best run at {last}",
        ],
        rows,
    )
