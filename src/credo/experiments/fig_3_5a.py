"""Figure 3.5a: MMUs trained on 10..20 distractors, tested on 0..101."""

from typing import Any

import jax
import jax.numpy as jnp

from ..analysis.generalization import success_with_gap
from ..environments.sequence_classification import SequenceClassification
from ..report.rows import Series, series
from .base import Cell, Experiment, Trained
from .dissertation import told
from .fig_3_4a import LINE, TEST, evolved, learned, rounded
from .views import Table, at, best, constant, mean, published

GAPS = {"smoke": (0, 15), "quick": (0, 5, 10, 15, 20, 40, 60, 80, 101)}
GAPS["full"] = (0, 1, 2, 3, 5, 7, 10, 12, 15, 18, 20, 25, 30, 40, 50, 60, 70, 80, 90, 101)
SWEEP = "success by distractors", "distractors between signals"


def cells(budget: str) -> list[Cell]:
    """As Figure 3.4a."""
    return evolved(budget, ("as coded", "ours"))


def sweep(trained: Trained) -> list[Series]:
    """Success by the number of distractors between signals."""
    task = SequenceClassification(trained.env.depth, 0, 101)
    return swept(SWEEP, trained, task, GAPS[trained.budget])


def swept(
    axis: tuple[str, str], trained: Trained, task: Any, gaps: tuple[int, ...]
) -> list[Series]:
    """Success of the champions when every gap (or corridor) of a sequence has the same length."""
    policies, key = trained.champions, jax.random.key(20_000)
    found = [
        success_with_gap(task, policies, jnp.int32(gap), key=key, episodes=TEST // 5)
        for gap in gaps
    ]
    values = rounded(jnp.stack(found, axis=1))
    return series(*axis, gaps, values, trained.labels, seed=trained.seeds)


def views(axis: tuple[str, str], what: str, first: int, **levels: float) -> tuple[Any, ...]:
    """Curves by depth of the training, and a table of some points."""
    curves = learned(
        y=axis[0],
        x=axis[1],
        line=("depth",),
        panel=LINE,
        title="Champions by the depth they were trained at: {panel}",
        y_label="success, 200 fresh sequences",
        levels={name: constant(value) for name, value in levels.items()},
        caption="Trained on 10 to 20.",
    )
    columns = {f"{x} {what}": at(x, mean(axis[0], 100, 1)) for x in (first, 15, 40, 101)}
    columns |= {"published at 101": published("success at 101 distractors")}
    columns |= {"best run, longest": best(axis[0], 100)}
    return curves, Table("Success, %", rows=("depth", *LINE), columns=columns)


VIEWS = views(SWEEP, "distractors", 0, **{"published, 21-deep at 101": 0.432})
EXPERIMENT = Experiment(**told("fig-3.5a"), cells=cells, measures=(sweep,), views=VIEWS)
