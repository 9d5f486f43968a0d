"""Figure 3.5a: MMUs trained on 10..20 distractors, tested on 0..101."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..analysis.generalization import success_with_gap
from ..environments.sequence_classification import SequenceClassification
from ..report.rows import Series, series
from .base import Cell, Experiment, Trained, Value
from .fig_3_4a import LINE, TEST, evolved, rounded
from .views import Curves, Table, at, computed, constant, mean, published

GAPS = {"smoke": (0, 15), "quick": (0, 5, 10, 15, 20, 40, 60, 80, 101)}
GAPS["full"] = (0, 1, 2, 3, 5, 7, 10, 12, 15, 18, 20, 25, 30, 40, 50, 60, 70, 80, 90, 101)
DISTRACTORS, SWEEP = "distractors between signals", "success by distractors"


def cells(budget: str) -> list[Cell]:
    """As Figure 3.4a."""
    return evolved(budget, ("as coded", "ours"))


def sweep(trained: Trained) -> list[Series]:
    """Success by the number of distractors between signals."""
    task = SequenceClassification(trained.env.depth, 0, 101)
    return swept(SWEEP, DISTRACTORS, trained, task, GAPS[trained.budget])


def swept(metric: str, x: str, trained: Trained, task: Any, gaps: tuple[int, ...]) -> list[Series]:
    """Success of the champions when every gap (or corridor) of a sequence has the same length."""
    policies, key = trained.champions, jax.random.key(20_000)
    found = [
        success_with_gap(task, policies, jnp.int32(gap), key=key, episodes=TEST // 5)
        for gap in gaps
    ]
    success = rounded(jnp.stack(found, axis=1))
    return series(metric, x, gaps, success, trained.labels, seed=trained.seeds)


def views(
    metric: str, x: str, what: str, first: int, **levels: float
) -> tuple[Callable[..., Any], ...]:
    """Curves by depth of the training, and a table of some points."""
    curves = Curves(
        metric,
        x,
        line=("depth",),
        panel=LINE,
        title="Champions by the depth they were trained at: {panel}",
        y_label="success, 200 fresh sequences",
        levels={name: constant(value) for name, value in levels.items()},
        y_range=(0.0, 1.02),
        caption="Trained on 10 to 20.",
    )
    columns = {f"{gap} {what}": at(gap, mean(metric, 100, 1)) for gap in (first, 15, 40, 101)}
    columns |= {"published at 101": published("success at 101 distractors")}
    columns |= {"best run, longest": best(metric)}
    return curves, Table("Success, %", rows=("depth", *LINE), columns=columns)


def best(metric: str) -> Any:
    """The best run, in percent."""
    return computed(metric, lambda x: f"{100 * np.max(x):.1f}")


EXPERIMENT = Experiment(
    published="Figure 3.5a of the dissertation: the 21-deep networks reach 43.2 ± 13.2 % with 101 "
    "distractors between signals; the best single network 100 % at every number of distractors.",
    cells=cells,
    measures=(sweep,),
    views=views(SWEEP, DISTRACTORS, "distractors", 0, **{"published, 21-deep at 101": 0.432}),
    values=(
        Value("43.2 ± 13.2", "success at 101 distractors", "Figure 3.5a, text", {"depth": 21}),
    ),
)
