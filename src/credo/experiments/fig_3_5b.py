"""Figure 3.5b: MMUs trained at one depth, tested at depths up to 101."""

from collections.abc import Sequence

import jax
import numpy as np

from ..analysis import counting, floors
from ..report import sections as page
from ..report.rows import Results, Series, series
from .base import Experiment, Trained, Value
from .fig_3_4a import LINE, TEST, evolved, rounded
from .fig_3_5a import best
from .views import Curves, Table, at, constant, mean, published

DEPTHS = (2, 3, 4, 5, 6, 8, 10, 13, 16, 21, 26, 31, 41, 51, 66, 81, 91, 96, 101)
SHOWN = (16, 21, 66, 101)
SWEEP = "success by depth"


def first_mistakes(trained: Trained, depth: int, batches: int = 50) -> np.ndarray:
    """Signals that the champions answer right before the first mistake `[runs, sequences]`, at
    most `depth`. Sequences of one batch share their distractors; so there are many batches."""
    keys = jax.random.split(jax.random.key(40_000), batches)
    parts = [
        np.asarray(counting.longest_correct(trained.champions, depth, TEST // batches, key=key))
        for key in keys
    ]
    return np.concatenate(parts, axis=1)


def sweep(trained: Trained) -> list[Series]:
    """Success by the depth of the test. An answer must be right at every signal, so one stream of
    101 tests every depth up to there: success at depth d is a first mistake after signal d."""
    lengths = first_mistakes(trained, DEPTHS[-1])
    success = rounded(np.stack([(lengths >= d).mean(axis=1) for d in DEPTHS], axis=1))
    told = trained.labels
    return series(SWEEP, "depth of the test", DEPTHS, success, told, seed=trained.seeds)


def curves(title: str, published: float) -> Curves:
    """A figure for each trainer, a line for each depth of the training."""
    return Curves(
        SWEEP,
        "depth of the test",
        line=("depth",),
        panel=LINE,
        title=title,
        y_label="success, 1,000 fresh sequences",
        levels={"published, 21-deep at 101": constant(published)},
        y_range=(0.0, 1.02),
    )


def baselines(results: Results, values: Sequence[Value]) -> list[page.Section]:
    """Exact success without counting, at the depths of the table."""
    found = [100 * max(floors.classification_floors(depth).values()) for depth in SHOWN]
    columns = [f"at {depth}" for depth in SHOWN]
    row = [f"{value:.1f}" for value in found]
    return [
        page.Table("Baseline: the best policy that keeps at most one signal, %", columns, [row])
    ]


EXPERIMENT = Experiment(
    published="Figure 3.5b of the dissertation: trained 21-deep, 50.4 ± 9.3 % at depth 101 and "
    "56.4 ± 10.9 % at 66; trained 5-deep, 36.7 ± 4.3 % at 16; the best single network 100 % up to "
    "depth 91, 98 % at 96 and 96 % at 101.",
    cells=evolved,
    measures=(sweep,),
    views=(
        curves("Champions by the depth they were trained at: {panel}", 0.504),
        Table(
            "Success, %",
            rows=("depth", *LINE),
            columns={
                heading: of
                for depth in SHOWN
                for heading, of in {
                    f"at {depth}": at(depth, mean(SWEEP, 100, 1)),
                    f"published at {depth}": published(f"success at depth {depth}"),
                }.items()
            }
            | {"best run at 101": at(101, best(SWEEP))},
            titles={"depth": "trained at depth"},
            caption="The upper bound is 100 at every depth.",
        ),
        baselines,
    ),
    values=(
        Value("50.4 ± 9.3", "success at depth 101", "Figure 3.5b", {"depth": 21}),
        Value("56.4 ± 10.9", "success at depth 66", "Figure 3.5b", {"depth": 21}),
        Value("36.7 ± 4.3", "success at depth 16", "Figure 3.5b", {"depth": 5}),
    ),
)
