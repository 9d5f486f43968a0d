"""Attribution: what each part of a hybrid of evolution and gradient contributed.

Everything comes from the metrics of runs of ERL and CERL: columns by name, an entry per
generation, as in `metrics.csv`.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..algorithms.lineage import MAKERS
from . import statistics

Floats = NDArray[np.float64]
Metrics = Mapping[str, NDArray[Any]]

FATES = ("elite", "selected", "discarded")
WINDOW = 10  # the share of makers is a mean over the last tenth of a run


def known(metrics: Metrics) -> bool:
    """Whether a run recorded who made its champions."""
    return "champion_maker" in metrics


def learners(metrics: Metrics) -> int:
    """How many gradient learners the run had."""
    return sum(name.startswith("workers_") for name in metrics)


def injected(metrics: Metrics) -> Floats:
    """How many actors of each learner joined the population and were judged there: `[q]`."""
    return np.array([counts.sum() for counts in _fates(metrics)])


def fates(metrics: Metrics) -> Floats:
    """Shares of each learner's injected actors that became elite, were selected as parents, or
    were discarded: `[q, 3]`. NaN for a learner of which none was judged yet."""
    counts = _fates(metrics)
    total = counts.sum(axis=1, keepdims=True)
    return np.divide(counts, total, out=np.full_like(counts, np.nan), where=total > 0)


def allocation(metrics: Metrics) -> Floats:
    """Share of all workers so far that each learner had: `[q, generations]`."""
    workers = _columns(metrics, "workers_")
    total = np.cumsum(workers.sum(axis=0))
    return np.cumsum(workers, axis=1) / np.maximum(total, 1.0)[None]


def ancestry(metrics: Metrics) -> Floats:
    """Expected share of the champion's weights that go back to each learner's actor and, last, to
    the first draw, mutated since or not: `[q + 1, generations]`."""
    shares = _columns(metrics, "champion_share_")
    first = 1.0 - shares.sum(axis=0, keepdims=True)
    return np.concatenate([shares, first])


def makers(metrics: Metrics) -> Floats:
    """Share of the latest champions that each of `MAKERS` was the last to change:
    `[makers, generations]`, a moving average over a tenth of the run."""
    made = metrics["champion_maker"][None] == np.arange(len(MAKERS))[:, None]
    return statistics.moving_average(made, max(1, made.shape[1] // WINDOW))


def summary(runs: Sequence[Metrics], points: int = 60) -> dict[str, Any]:
    """All of the above for runs of one algorithm, over frames, as plain numbers: NaN is None.

    Curves are lists `[runs, what, points]` over `frames`; the value at a frame is that of the last
    generation that was over by then.
    """
    frames = axis([run["frames"] for run in runs], points)
    curves = {"makers": makers, "ancestry": ancestry, "allocation": allocation}
    return {
        "frames": frames.astype(int).tolist(),
        **{
            name: [plain(on_grid(run["frames"], curve(run), frames)) for run in runs]
            for name, curve in curves.items()
        },
        "allocated": [plain(allocation(run)[:, -1]) for run in runs],
        "injected": [injected(run).astype(int).tolist() for run in runs],
        "fates": [plain(fates(run)) for run in runs],
    }


def axis(xs: Sequence[ArrayLike], points: int) -> Floats:
    """At most `points` whole numbers up to where the longest of the runs ends."""
    last = max(float(np.asarray(x)[-1]) for x in xs)
    return np.unique(np.ceil(np.linspace(0.0, last, points + 1)[1:]))


def on_grid(x: ArrayLike, y: ArrayLike, grid: ArrayLike) -> Floats:
    """Values `y[..., rows]` at each grid point: those of the last row whose `x` is no larger. A run
    that ended earlier keeps its last value; NaN before the first row."""
    y = np.asarray(y, np.float64)
    row = np.searchsorted(np.asarray(x), np.asarray(grid), side="right") - 1
    return np.where(row < 0, np.nan, y[..., np.maximum(row, 0)])


def plain(x: ArrayLike, digits: int = 4) -> Any:
    """An array as JSON can hold it: rounded, None for what is not finite."""
    x = np.round(np.asarray(x, np.float64), digits)
    return np.where(np.isfinite(x), x, np.array(None, object)).tolist()


def _columns(metrics: Metrics, prefix: str) -> Floats:
    """Columns `prefix0`, `prefix1`, … of every learner: `[q, generations]`."""
    found = [metrics[f"{prefix}{i}"] for i in range(learners(metrics))]
    generations = len(metrics["generation"])
    return np.array(found, np.float64).reshape(len(found), generations)


def _fates(metrics: Metrics) -> Floats:
    """Counts `[q, 3]`."""
    return np.stack([_columns(metrics, f"{fate}_").sum(axis=1) for fate in FATES], axis=1)
