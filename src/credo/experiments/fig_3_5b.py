"""Figure 3.5b: MMUs trained at one depth, tested at depths up to 101."""

from collections.abc import Sequence

import jax
import numpy as np

from ..analysis import bounds
from ..analysis.generalization import first_mistakes
from ..environments.sequence_classification import SequenceClassification
from ..report import sections as page
from ..report.rows import Results, Series, series
from .base import Experiment, Trained, Value
from .dissertation import told
from .fig_3_4a import LINE, TEST, evolved, learned, rounded
from .views import Curves, Table, at, best, constant, mean, published

DEPTHS = (2, 3, 4, 5, 6, 8, 10, 13, 16, 21, 26, 31, 41, 51, 66, 81, 91, 96, 101)
SHOWN = (16, 21, 66, 101)
SWEEP = "success by depth"


def sweep(trained: Trained) -> list[Series]:
    """Success by the depth of the test; streams of 101 signals test every depth up to there."""
    lengths = first_mistakes(trained.champions, DEPTHS[-1], TEST, key=jax.random.key(40_000))
    success = rounded(np.stack([(lengths >= d).mean(axis=1) for d in DEPTHS], axis=1))
    axis, labels = (SWEEP, "depth of the test", DEPTHS), trained.labels
    return series(*axis, success, labels, seed=trained.seeds)


def curves(title: str, published: float) -> Curves:
    """A figure for each trainer, a line for each depth of the training."""
    return learned(
        y=SWEEP,
        x="depth of the test",
        line=("depth",),
        panel=LINE,
        title=title,
        y_label="success, 1,000 fresh sequences",
        levels={"published, 21-deep at 101": constant(published)},
    )


def baselines(results: Results, values: Sequence[Value]) -> list[page.Section]:
    """Exact success without counting, at the depths of the table."""
    found = [100 * bounds.best_baseline(SequenceClassification(x))[1] for x in SHOWN]
    title = "Baseline: the best policy that keeps at most one signal, %"
    return [page.Table(title, [f"at {x}" for x in SHOWN], [[f"{x:.1f}" for x in found]])]


COLUMNS = {f"at {x}": at(x, mean(SWEEP, 100, 1)) for x in SHOWN}
COLUMNS |= {f"published at {x}": published(f"success at depth {x}") for x in SHOWN}
COLUMNS |= {"best run at 101": at(101, best(SWEEP, 100))}
TRAINED = {"depth": "trained at depth"}
EXPERIMENT = Experiment(
    **told("fig-3.5b"),
    cells=evolved,
    measures=(sweep,),
    views=(
        curves("Champions by the depth they were trained at: {panel}", 0.504),
        Table("Success, %", ("depth", *LINE), COLUMNS, titles=TRAINED, caption="Upper bound: 100."),
        baselines,
    ),
)
