"""Figure 3.5b: MMUs trained at one depth, tested at depths up to 101."""

from typing import Any

import numpy as np

from ..analysis import floors
from ..report.sections import Curve, Figure, Reference, Table
from ..runs.store import Run
from . import chapter3, fig_3_4a
from .base import Cell

TITLE = "generalization to depth 101"
PUBLISHED = (
    "Figure 3.5b of the dissertation: trained 21-deep, 50.4 ± 9.3 % at depth 101 and 56.4 ± 10.9 % "
    "at 66; trained 5-deep, 36.7 ± 4.3 % at 16; the best single network 100 % up to depth 91, 98 % "
    "at 96 and 96 % at 101."
)
DEPTHS = (2, 3, 4, 5, 6, 8, 10, 13, 16, 21, 26, 31, 41, 51, 66, 81, 91, 96, 101)
GIVEN = {(21, 101): "50.4 ± 9.3", (21, 66): "56.4 ± 10.9", (5, 16): "36.7 ± 4.3"}
SHOWN = (16, 21, 66, 101)


def cells(budget: str) -> list[Cell]:
    return chapter3.classification_cells(budget)


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    """An answer must be right at every signal, so that one stream of 101 signals tests every
    depth up to there: success at depth d is a first mistake after signal d."""
    measured = {}
    for name, cell in runs.items():
        lengths = chapter3.first_mistakes(chapter3.champions(cell), DEPTHS[-1], seed=40_000)
        success = np.stack([(lengths >= d).mean(axis=1) for d in DEPTHS], axis=1)
        measured[name] = {"depths": list(DEPTHS), "success": chapter3.rounded(success)}
    return measured


def sections(measured: dict[str, Any]) -> list[Any]:
    figures = []
    for variant in fig_3_4a.variants(measured):
        trained = fig_3_4a.of_variant(measured, variant).items()
        figures.append(
            Figure(
                f"Champions of depth-trained runs, {variant}",
                "depth of the test",
                "success, 1,000 fresh sequences",
                [Curve(f"trained {d}-deep", c["depths"], c["success"]) for d, c in trained],
                references=(Reference("published, 21-deep at 101", 0.504),),
                y_range=(0.0, 1.02),
            )
        )
    return [*figures, table(measured)]


def table(measured: dict[str, Any]) -> Table:
    rows = [["", "floor", *(_floor(depth) for depth in SHOWN), "", ""]]
    for name, cell in measured.items():
        trained, variant = chapter3.split_name(name)
        at = {d: [run[i] for run in cell["success"]] for i, d in enumerate(cell["depths"])}
        published = ", ".join(f"{v} at {d}" for (t, d), v in GIVEN.items() if t == trained)
        values = [chapter3.percent(at[depth]) for depth in SHOWN]
        best = f"{100 * max(at[101]):.1f}"
        rows.append([str(trained), variant, *values, published, best])
    return Table(
        "Success in percent, mean ± standard error over runs",
        ["trained", "variant", *(f"at {d}" for d in SHOWN), "published", "best run at 101"],
        rows,
        caption="The ceiling is 100 at every depth.",
    )


def _floor(depth: int) -> str:
    return f"{100 * max(floors.classification_floors(depth).values()):.1f}"
