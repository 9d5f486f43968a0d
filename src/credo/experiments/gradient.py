"""Figures 3.11 and 3.12, and beyond chapter 3: MMUs by gradient, beside evolution after as many
reinforcement instances; with recurrent networks, depth 10^6 and memories of other sizes.

Section 3.4 makes the two trainers comparable by reinforcement instances: one is one network times
one training sequence. Both use 1,000 of them per generation (evolution 100 networks on 10
sequences; the gradient 1,000 sequences), so curves are drawn over instances. Figure 3.11 is of
section 3.4.1, Figure 3.12 of 3.4.2; `beyond-3` answers the future work of section 3.5, memory and
hidden layer of different sizes, and has no published numbers. At full the gradient has 200
generations on classification and 400 on recall, at quick 60, at smoke 10. At `published` the
author's own settings have his 1,000.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import jax
import numpy as np

from ..algorithms.bptt import BPTT
from ..report.rows import Results, Row, Series
from ..report.sections import Section
from .base import BUDGETS, Cell, Experiment, Trained, Value
from .generalization import DEEPER, DISTRACTORS, OF_DISTRACTORS, TRAINED, by_depth, by_gap, figure
from .measures import where
from .memories import MEDIAN, WORST, streams, to_the_end
from .sequences import (
    BOTH,
    DEEPEST,
    EVEN,
    GRADIENT,
    LINE,
    MEASURES,
    NETWORKS,
    SUMMARY,
    TABLE,
    cell,
    curves,
    every,
    recall_by_gradient,
)
from .views import Curves, Table, at, constant, known, mean, published

DEPTHS = {"smoke": (3,), "quick": (2, 5, 10, 21), "full": (2, 5, 10, 21)}
DEPTHS |= {"published": DEPTHS["full"]}
POINTS = 50  # of a learning curve
MEMORIES = {"classification": (2, 15), "recall": (10,)}
"""Memory cells of the MMUs whose memory and hidden layer differ in size; the others have as many
cells as hidden units, 5 and 20."""
SIGNALS = {"smoke": 200, "quick": 100_000, "full": 1_000_000}
"""Signals of the long streams of `beyond-3`; at full as many as Table 3.2 feeds of +1."""


def on_classification(budget: str) -> list[Cell]:
    """The gradient at four depths, the author's code at the deepest, and evolution, which has all
    of its own generations: its curve goes on where the gradient's ends."""
    task, trainer, whole = "classification", "gradient", budget == "published"
    return [
        *every(task, DEPTHS, GRADIENT[: 1 if whole else None], trainer=trainer)(budget),
        *every(task, DEEPEST, ("as coded",), trainer=trainer)(budget),
        *([] if whole else every(task, DEPTHS, BOTH)(budget)),
    ]


def on_recall(budget: str) -> list[Cell]:
    """Evolution has as many instances as the gradient: its 10,000 generations of Figure 3.9a are
    another question."""
    if budget == "published":
        return every("recall", EVEN, GRADIENT[:1], trainer="gradient")(budget)
    return recall_by_gradient(budget) + every("recall", EVEN, equal=True)(budget)


def on_the_deepest(budget: str) -> list[Cell]:
    """On the deepest task of each kind, our settings by evolution and by gradient; but for smoke
    also networks with an external memory."""
    external = () if budget == "smoke" else ("ntm", "dnc")
    evolved = ("evolution", True)
    networks = [(network, None) for network in (*NETWORKS, *external)]
    return [
        cell(budget, task, depths[budget][-1], "ours", trainer, network, memory, equal)
        for task, depths in {"classification": DEEPEST, "recall": EVEN}.items()
        for trainer, equal in (evolved, ("gradient", False))
        for network, memory in [*networks, *(("mmu", memory) for memory in MEMORIES[task])]
    ]


def over_instances(trained: Trained) -> list[Series]:
    """Success of each generation's champion on 50 fresh sequences, as means of equal stretches,
    against the instances used by their end: one is a network times a training sequence.

    **Returns:** for each run a series "success by instances" in [0, 1] of at most 99 points over
    "reinforcement instances"; generations that do not fill the last stretch are left out.
    """
    x, scores = trained.cell.algorithm, trained.scores
    batch = (x.updates, x.batch_size) if isinstance(x, BPTT) else (x.population_size, x.episodes)
    stretch = max(1, scores.shape[1] // POINTS)
    count = scores.shape[1] // stretch
    blocks = scores[:, : count * stretch].reshape(-1, count, stretch).mean(axis=2)
    used = batch[0] * batch[1] * stretch * np.arange(1, count + 1)
    return trained.series("success by instances", ("reinforcement instances", used), blocks, 4)


def weights(trained: Trained) -> list[Row]:
    """How many numbers a champion has."""
    count = sum(x.size for x in jax.tree.leaves(trained.runs[0].champion))
    return [trained.fact("weights", count)]


def deep(trained: Trained) -> list[Row]:
    """How many signals of long streams champions answer right before a mistake: for each run ten
    rows "signals right", and "signals fed" of the cell, which is all of them."""
    fed = SIGNALS[trained.budget]
    return [trained.fact("signals fed", fed), *streams(trained, fed)]


def by_instances(title: str, line: Sequence[str], panel: Sequence[str], **shown: str) -> Curves:
    """Learning curves over reinforcement instances."""
    return curves(
        y="success by instances",
        x="reinforcement instances",
        line=line,
        panel=panel,
        title=title,
        where=shown,
        y_label="success, 50 fresh sequences",
        caption="Means of equal stretches of generations, 1,000 instances each; not smoothed else.",
    )


def at_deepest(results: Results, values: Sequence[Value]) -> Iterable[Section]:
    """Gradient and evolution on the deepest task."""
    view = by_instances("(b) Gradient and evolution, {panel}", LINE, ("depth",))
    return view(results.where(depth=max(results.levels("depth"))), values)


AWAY = Table(
    "Away from what was trained: success, %",
    ("depth", *LINE),
    {
        "101 distractors": at(101, mean(DISTRACTORS[0], 100, 1)),
        "published at depth 101": published("success at depth 101"),
        "depth 101": at(101, mean(DEEPER[0], 100, 1)),
    },
    where={"trainer": "gradient"},
    titles=TRAINED,
)
BY_DEPTH = "(d) Champions tested at other depths: {panel}"
STREAMS = Table(
    "Long streams of signals",
    LINE,
    {
        "signals": known("signals fed"),
        "runs right to the end, on all of 10 streams": to_the_end,
        "best run, its worst stream": WORST,
        "median of all runs and streams": MEDIAN,
    },
    where={"task": "classification"},
    caption="Signals answered right in a row, distractors between them.",
)
# Networks by gradient, where they were not trained.
ELSEWHERE = [where(measure, trainer="gradient") for measure in (by_gap, by_depth)]
EXPERIMENTS = {
    "fig-3.11": Experiment(
        on_classification,
        (*MEASURES, over_instances, *ELSEWHERE),
        (
            SUMMARY,
            by_instances("(a) {panel}", ("depth",), LINE, trainer="gradient"),
            at_deepest,
            replace(OF_DISTRACTORS[0], levels={}),
            figure(
                DEEPER, BY_DEPTH, "1,000", levels={"published, 21-deep at 101": constant(0.145)}
            ),
            TABLE,
            AWAY,
        ),
        (*BUDGETS, "published"),
    ),
    "fig-3.12": Experiment(
        on_recall,
        (*MEASURES, over_instances),
        (SUMMARY, by_instances("(a) {panel}", ("depth",), LINE), at_deepest, TABLE),
        (*BUDGETS, "published"),
    ),
    "beyond-3": Experiment(
        on_the_deepest,
        (*MEASURES, over_instances, weights, where(deep, task="classification")),
        (
            by_instances("{panel}", LINE, ("task", "depth", "trainer")),
            replace(TABLE, rows=("task", *TABLE.rows)),
            Table("Weights of a network", ("task", *LINE), {"weights": known("weights")}),
            STREAMS,
        ),
    ),
}
