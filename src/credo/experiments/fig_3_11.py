"""Figure 3.11: an MMU by gradient on sequence classification, beside evolution."""

from collections.abc import Iterable, Sequence

import numpy as np

from ..algorithms.bptt import BPTT
from ..report.rows import Results, Row, Series, series
from ..report.sections import Section, Text
from . import fig_3_5a, fig_3_5b
from .base import Cell, Experiment, Trained, Value
from .fig_3_4a import LINE, TABLE, baseline, cell, evolved, learning, rounded, success, summary
from .views import Curves, Table, at, mean, published

DEPTHS = {"smoke": (3,), "quick": (2, 5, 10, 21), "full": (2, 5, 10, 21)}
GRADIENT = ("as written", "ours")
INSTANCES, POINTS = "reinforcement instances", 50  # of a learning curve


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
    algorithm = trained.cell.algorithm
    each = (
        algorithm.updates * algorithm.batch_size
        if isinstance(algorithm, BPTT)
        else algorithm.population_size * algorithm.episodes
    )
    scores = np.stack([run.metrics["champion_score"] for run in trained.runs])
    stretch = max(1, scores.shape[1] // POINTS)
    count = scores.shape[1] // stretch
    blocks = rounded(scores[:, : count * stretch].reshape(-1, count, stretch).mean(axis=2))
    used, told = each * stretch * np.arange(1, count + 1), trained.labels
    return series("success by instances", INSTANCES, used, blocks, told, seed=trained.seeds)


def elsewhere(trained: Trained) -> Iterable[Row | Series]:
    """Networks by gradient, where they were not trained."""
    if trained.labels["trainer"] == "gradient":
        return [*fig_3_5a.sweep(trained), *fig_3_5b.sweep(trained)]
    return []


def by_instances(title: str, line: Sequence[str], panel: Sequence[str], **where: str) -> Curves:
    """Learning curves over reinforcement instances."""
    return Curves(
        "success by instances",
        INSTANCES,
        line=line,
        panel=panel,
        title=title,
        where=where,
        y_label="success, 50 fresh sequences",
        y_range=(0.0, 1.02),
        caption="Means of equal stretches of generations, 1,000 instances each; not smoothed else.",
    )


def at_deepest(results: Results, values: Sequence[Value]) -> Iterable[Section]:
    """Gradient and evolution on the deepest task."""
    view = by_instances("(b) Gradient and evolution, {panel}", LINE, ("depth",))
    return view(results.where(depth=max(results.levels("depth"))), values)


ABOUT = Text(
    "How to read it",
    [
        "`as written`: Adam 0.01, L2 0.1, smooth L1, batches of 1,000, the mean of their losses. "
        "`as coded`: one training set of 1,000, the sum of their losses, against which L2 of 0.1 "
        "is next to nothing. `ours` is in docs/gradient.md, with what was tried.",
        "A reinforcement instance is one network times one training sequence.",
    ],
)
EXPERIMENT = Experiment(
    published="Figure 3.11 of the dissertation (curves): success by gradient is lower the deeper "
    "the task, and lower than by evolution; trained 21-deep, 14.5 ± 2.3 % at depth 101 against "
    "50.4 ± 9.3 % by evolution. There a tie was class +1 for the gradient and free for evolution; "
    "here it is class +1 for both.",
    cells=cells,
    measures=(baseline, success, learning, over_instances, elsewhere),
    views=(
        summary(),
        by_instances("(a) {panel}", ("depth",), LINE, trainer="gradient"),
        at_deepest,
        fig_3_5a.views(fig_3_5a.SWEEP, fig_3_5a.DISTRACTORS, "distractors", 0)[0],
        fig_3_5b.curves("(d) Champions tested at other depths: {panel}", 0.145),
        TABLE,
        Table(
            "Away from what was trained: success, %",
            rows=("depth", *LINE),
            columns={
                "101 distractors": at(101, mean(fig_3_5a.SWEEP, 100, 1)),
                "published at depth 101": published("success at depth 101"),
                "depth 101": at(101, mean(fig_3_5b.SWEEP, 100, 1)),
            },
            where={"trainer": "gradient"},
            titles={"depth": "trained at depth"},
        ),
        ABOUT,
    ),
    values=(
        Value("14.5 ± 2.3", "success at depth 101", "text", {"depth": 21, "trainer": "gradient"}),
    ),
)
