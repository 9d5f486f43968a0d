"""Figure 3.11: an MMU by gradient on sequence classification, beside evolution."""

from collections.abc import Iterable, Sequence

import numpy as np

from ..algorithms.bptt import BPTT
from ..report.rows import Results, Row, Series, series
from ..report.sections import Section
from . import fig_3_5a, fig_3_5b
from .base import Cell, Experiment, Trained, Value
from .dissertation import notes, told
from .fig_3_4a import LINE, MEASURES, SUMMARY, TABLE, cell, evolved, learned, rounded
from .views import Curves, Table, at, mean, published

DEPTHS = {"smoke": (3,), "quick": (2, 5, 10, 21), "full": (2, 5, 10, 21)}
GRADIENT = ("as written", "ours")
POINTS = 50  # of a learning curve


def cells(budget: str) -> list[Cell]:
    """The gradient at four depths, the author's code at the deepest, and evolution."""
    depths = DEPTHS[budget]
    asked = [(depth, preset) for preset in GRADIENT for depth in depths]
    asked.append((max(depths), "as coded"))
    trained = [cell(budget, "classification", *x, "gradient") for x in asked]
    return [*trained, *evolved(budget, ("as coded", "ours"), depths)]


def over_instances(trained: Trained) -> list[Series]:
    """Success of each generation's champion on 50 fresh sequences, as means of equal stretches,
    against the instances used by their end: one is a network times a training sequence."""
    x = trained.cell.algorithm
    batch = (x.updates, x.batch_size) if isinstance(x, BPTT) else (x.population_size, x.episodes)
    scores = np.stack([run.metrics["champion_score"] for run in trained.runs])
    stretch = max(1, scores.shape[1] // POINTS)
    count = scores.shape[1] // stretch
    blocks = rounded(scores[:, : count * stretch].reshape(-1, count, stretch).mean(axis=2))
    used = batch[0] * batch[1] * stretch * np.arange(1, count + 1)
    axis = ("success by instances", "reinforcement instances", used)
    return series(*axis, blocks, trained.labels, seed=trained.seeds)


def elsewhere(trained: Trained) -> Iterable[Row | Series]:
    """Networks by gradient, where they were not trained."""
    if trained.labels["trainer"] == "gradient":
        yield from (*fig_3_5a.sweep(trained), *fig_3_5b.sweep(trained))


def by_instances(title: str, line: Sequence[str], panel: Sequence[str], **where: str) -> Curves:
    """Learning curves over reinforcement instances."""
    return learned(
        y="success by instances",
        x="reinforcement instances",
        line=line,
        panel=panel,
        title=title,
        where=where,
        y_label="success, 50 fresh sequences",
        caption="Means of equal stretches of generations, 1,000 instances each; not smoothed else.",
    )


def at_deepest(results: Results, values: Sequence[Value]) -> Iterable[Section]:
    """Gradient and evolution on the deepest task."""
    view = by_instances("(b) Gradient and evolution, {panel}", LINE, ("depth",))
    return view(results.where(depth=max(results.levels("depth"))), values)


EXPERIMENT = Experiment(
    **told("fig-3.11"),
    cells=cells,
    measures=(*MEASURES, over_instances, elsewhere),
    views=(
        SUMMARY,
        by_instances("(a) {panel}", ("depth",), LINE, trainer="gradient"),
        at_deepest,
        fig_3_5a.views(fig_3_5a.SWEEP, "distractors", 0)[0],
        fig_3_5b.curves("(d) Champions tested at other depths: {panel}", 0.145),
        TABLE,
        Table(
            "Away from what was trained: success, %",
            rows=("depth", *LINE),
            columns={
                "101 distractors": at(101, mean(fig_3_5a.SWEEP[0], 100, 1)),
                "published at depth 101": published("success at depth 101"),
                "depth 101": at(101, mean(fig_3_5b.SWEEP, 100, 1)),
            },
            where={"trainer": "gradient"},
            titles=fig_3_5b.TRAINED,
        ),
        notes("gradient"),
    ),
)
