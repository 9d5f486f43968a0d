"""Beyond chapter 5: who made the champions of ERL. Also how attributions are shown."""

from collections.abc import Iterable, Sequence

from ..analysis.attribution import FATES
from ..report.rows import Results
from ..report.sections import Section
from . import measures, table_5_2
from .base import Experiment, Value
from .fig_5_3 import BUDGETS, MEASURES, REFERENCES, VARIANTS, curves, notes, table
from .views import Curves, Table, each, mean, of_metric

CELL = (*VARIANTS, "task")
SHARES = (0.0, 1.0)


def makers(results: Results, values: Sequence[Value]) -> Iterable[Section]:
    """A line for each operator that was the last to change a champion."""
    found = of_metric(results, "last changed by").curves
    made = {curve.labels["operator"] for curve in found if any(curve.values)}
    return Curves(
        "last changed by",
        "frames",
        ["operator"],
        CELL,
        title="{panel}: who was the last to change the champion",
        y_label="share of champions, mean of a tenth of the run",
        where={"operator": tuple(made)},
        y_range=SHARES,
    )(results, values)


ancestry = Curves(
    "ancestry",
    "frames",
    ["ancestor"],
    CELL,
    title="{panel}: where the champion's weights come from",
    y_label="expected share",
    y_range=SHARES,
)
allocation = Curves(
    "allocation so far",
    "frames",
    ["learner"],
    CELL,
    title="{panel}: workers of each learner so far",
    y_label="share of all workers",
    y_range=SHARES,
)
fates = Table(
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
    published="Not in the dissertation, which counts what became of the learner's actors (Table "
    "5.2) and not what became of them later. Here every champion's line is followed back.",
    budgets=BUDGETS,
    cells=table_5_2.cells,
    measures=(*MEASURES, measures.lineage),
    values=REFERENCES,
    views=(
        makers,
        ancestry,
        fates,
        curves(),
        table(),
        notes(
            "The last to change a champion is mutation nearly always, elites and fresh actors of "
            "the learner aside: most offspring are mutated. Shares of weights say more: a child "
            "has them from its parent, a crossed one from each of two what it took of them, and "
            "mutation does not change whose line it is.",
        ),
    ),
)
