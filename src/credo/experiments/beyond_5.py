"""Beyond chapter 5: who made the champions of ERL. Also how attributions are shown."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from ..analysis.attribution import FATES
from ..report.rows import Results
from ..report.sections import Section
from . import measures, table_5_2
from .base import Experiment, Value
from .dissertation import notes, told
from .fig_5_3 import BUDGETS, MEASURES, TABLE, VARIANTS, curves
from .views import Curves, Table, each, mean, of_metric

CELL = (*VARIANTS, "task")


def makers(results: Results, values: Sequence[Value]) -> Iterable[Section]:
    """A line for each operator that was the last to change a champion."""
    found = of_metric(results, "last changed by").curves
    made = {curve.labels["operator"] for curve in found if any(curve.values)}
    return replace(MADE, where={"operator": tuple(made)})(results, values)


def shares(metric: str, line: str, title: str, y_label: str) -> Curves:
    """Shares over frames, a figure for each cell."""
    told: dict[str, Any] = {"title": f"{{panel}}: {title}", "y_label": y_label}
    return Curves(metric, "frames", [line], CELL, y_range=(0.0, 1.0), **told)


MADE = shares(
    "last changed by",
    "operator",
    "who was the last to change the champion",
    "share of champions, mean of a tenth of the run",
)
ANCESTRY = shares(
    "ancestry", "ancestor", "where the champion's weights come from", "expected share"
)
ALLOCATION = shares(
    "allocation so far", "learner", "workers of each learner so far", "share of all workers"
)
FATE = Table(
    "Learners: their workers, and the fate of their actors in the population",
    ["task", *VARIANTS, "learner"],
    {
        "workers, %": mean("allocation", 100, digits=1),
        "injected, each run": each("injected"),
        **{f"{fate}, %": mean("fate", 100, digits=1, fate=fate) for fate in FATES},
    },
    caption="Injected: actors that were judged; the last ones may not have been. Selected: a "
    "parent, but no elite.",
)
EXPERIMENT = Experiment(
    **told("beyond-5", "mujoco"),
    budgets=BUDGETS,
    cells=table_5_2.cells,
    measures=(*MEASURES, measures.lineage),
    views=(makers, ANCESTRY, FATE, curves(), TABLE, notes("mujoco", "beyond-5")),
)
