"""Figures 3.5, 3.10 and 3.13: champions of chapter 3 with other distractors, corridors and depths
than they were trained on.

Figure 3.5 is of section 3.2.2 (classification: distractors in a, depth in b), Figure 3.10 of 3.3.2
(recall, evolved) and Figure 3.13 of 3.4.2 (recall, by gradient). Training has 10 to 20 distractors
between signals, or steps per corridor; tests reach to 101, as in the dissertation. The runs are
those of Figures 3.4a, 3.9a and 3.12, which are not trained again. A budget is that of these
figures, and says how many lengths are tested (`GAPS`).
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..analysis import bounds
from ..analysis.generalization import first_mistakes, success_with_gap
from ..environments.sequence_classification import SequenceClassification
from ..environments.sequence_recall import SequenceRecall
from ..report import sections as page
from ..report.rows import Results, Series
from .base import Experiment, Trained, Value
from .sequences import (
    BOTH,
    CLASSIFICATION,
    LINE,
    PRESETS,
    RECALL,
    TEST,
    curves,
    every,
    recall_by_gradient,
)
from .views import Curves, Table, at, best, constant, mean, published

GAPS = {"smoke": (0, 15), "quick": (0, 5, 10, 15, 20, 40, 60, 80, 101)}
"""Distractors between signals, or steps per corridor, that are tested, by budget: 2, 9 or
20 of them. A corridor has at least 1 step."""
GAPS["full"] = (0, 1, 2, 3, 5, 7, 10, 12, 15, 18, 20, 25, 30, 40, 50, 60, 70, 80, 90, 101)
DEPTHS = (2, 3, 4, 5, 6, 8, 10, 13, 16, 21, 26, 31, 41, 51, 66, 81, 91, 96, 101)
SHOWN = (16, 21, 66, 101)
"""Depths of the table: those for which section 3.2.2.2 gives numbers (5-deep champions at 16,
21-deep ones at 66 and 101), and 21 itself."""
DISTRACTORS = ("success by distractors", "distractors between signals")
CORRIDORS = ("success by corridor", "steps per corridor")
DEEPER = ("success by depth", "depth of the test")


def by_gap(trained: Trained) -> list[Series]:
    """Success of the champions when every gap of a sequence has the same length: distractors
    between signals, or steps of a corridor.

    **Returns:** for each run a series in [0, 1] over the lengths of the budget, at each the share
    of 200 fresh sequences that is answered right throughout: "success by distractors" of
    classification, "success by corridor" of recall.
    """
    env, gaps = trained.env, GAPS[trained.budget]
    (metric, x), task = DISTRACTORS, SequenceClassification(env.depth, 0, 101)
    if isinstance(env, SequenceRecall):
        # Distances keep the unit of training, or longer corridors would look like shorter ones.
        (metric, x), unit = CORRIDORS, env.unit or env.max_corridor
        task = SequenceRecall(env.depth, 1, 101, unit=unit)
        gaps = tuple(dict.fromkeys(max(1, gap) for gap in gaps))
    key, policies = jax.random.key(20_000), trained.champions
    found = [
        success_with_gap(task, policies, jnp.int32(gap), key=key, episodes=TEST // 5)
        for gap in gaps
    ]
    return trained.series(metric, (x, gaps), jnp.stack(found, axis=1), 4)


def by_depth(trained: Trained) -> list[Series]:
    """Success by the depth of the test; streams of 101 signals test every depth up to there.

    **Returns:** for each run a series "success by depth" in [0, 1] over `DEPTHS`, of 1,000 fresh
    sequences. Classification only.
    """
    lengths = first_mistakes(trained.champions, DEPTHS[-1], TEST, key=jax.random.key(40_000))
    success = np.stack([(lengths >= depth).mean(axis=1) for depth in DEPTHS], axis=1)
    metric, x = DEEPER
    return trained.series(metric, (x, DEPTHS), success, 4)


def figure(axis: tuple[str, str], title: str, tests: str, **more: Any) -> Curves:
    """A figure for each trainer, a line for each depth of the training."""
    y, x = axis
    label = f"success, {tests} fresh sequences"
    return curves(y=y, x=x, line=("depth",), panel=LINE, title=title, y_label=label, **more)


def of_gaps(axis: tuple[str, str], what: str, first: int, **levels: float) -> tuple[Any, ...]:
    """Curves by depth of the training, and a table of some points. `axis`: metric and name of its
    axis. `first`: the shortest length in the table. `levels`: published success in [0, 1], by name,
    as lines in the figure."""
    known = {name: constant(value) for name, value in levels.items()}
    columns = {f"{x} {what}": at(x, mean(axis[0], 100, 1)) for x in (first, 15, 40, 101)}
    columns |= {"published at 101": published("success at 101 distractors")}
    columns |= {"best run, longest": best(axis[0], 100)}
    shown = figure(axis, BY_TRAINING, "200", levels=known, caption="Trained on 10 to 20.")
    return shown, Table("Success, %", ("depth", *LINE), columns)


def baselines(results: Results, values: Sequence[Value]) -> list[page.Section]:
    """Exact success without counting, at the depths of the table."""
    found = [100 * bounds.best_baseline(SequenceClassification(x))[1] for x in SHOWN]
    title = "Baseline: the best policy that keeps at most one signal, %"
    return [page.Table(title, [f"at {x}" for x in SHOWN], [[f"{x:.1f}" for x in found]])]


AT_101 = "published, 21-deep at 101"
BY_TRAINING = "Champions by the depth they were trained at: {panel}"
OF_DISTRACTORS = of_gaps(DISTRACTORS, "distractors", 0, **{AT_101: 0.432})
OF_CORRIDORS = of_gaps(CORRIDORS, "steps", 1)
TRAINED = {"depth": "trained at depth"}
AT_DEPTHS = Table(
    "Success, %",
    ("depth", *LINE),
    {f"at {x}": at(x, mean(DEEPER[0], 100, 1)) for x in SHOWN}
    | {f"published at {x}": published(f"success at depth {x}") for x in SHOWN}
    | {"best run at 101": at(101, best(DEEPER[0], 100))},
    titles=TRAINED,
    caption="Upper bound: 100.",
)
OF_DEPTHS = figure(DEEPER, BY_TRAINING, "1,000", levels={AT_101: constant(0.504)})
EXPERIMENTS = {
    "fig-3.5a": Experiment(
        every("classification", CLASSIFICATION, BOTH), (by_gap,), OF_DISTRACTORS
    ),
    "fig-3.5b": Experiment(
        every("classification", CLASSIFICATION, PRESETS),
        (by_depth,),
        (OF_DEPTHS, AT_DEPTHS, baselines),
    ),
    "fig-3.10": Experiment(every("recall", RECALL, BOTH), (by_gap,), OF_CORRIDORS),
    "fig-3.13": Experiment(recall_by_gradient, (by_gap,), OF_CORRIDORS),
}
