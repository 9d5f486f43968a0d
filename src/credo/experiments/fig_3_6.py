"""Figure 3.6: where and when a champion writes, on the permutation [-1, 1, -1]."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..analysis import memory
from ..environments.sequence_classification import SequenceClassification
from ..report import sections as page
from ..report.rows import Results, Row, Series, rows, series
from .base import Experiment, Trained, Value
from .dissertation import told
from .fig_3_4a import deepest, rounded
from .table_3_1 import best_seed, lengths, names
from .views import Runs, each, of_metric


def writes_on(signals: Sequence[float]) -> Callable[[Trained], Iterator[Row | Series]]:
    """A measure: writes of the best champion, 15 distractors between these signals; and for every
    champion the share of its writing that happens at signals."""

    def measure(trained: Trained) -> Iterator[Row | Series]:
        depth, labels = len(signals), trained.labels
        given = jnp.asarray(signals, jnp.float32)
        inputs = SequenceClassification(depth, 15, 15).lay_out(given, jnp.full(depth, 15)).inputs
        best, steps = int(lengths(trained).argmax()), np.arange(1, len(inputs) + 1)
        yield Row(labels, None, "best run", best)
        yield from series("input", "step", steps, np.asarray(inputs[:, 0], int), labels)
        found = [jnp.abs(memory.writes(run.champion, inputs)) for run in trained.runs]
        cells = rounded(found[best], 3).T[None]
        axes: dict[str, Any] = {"seed": [trained.seeds[best]], "cell": names(len(cells[0]))}
        yield from series("write", "step", steps, cells, labels, **axes)
        share = rounded([memory.share_at_signals(x, inputs) for x in found])
        yield from rows("share at signals", share, labels, seed=trained.seeds)

    return measure


def heat_map(signals_only: bool) -> Callable[..., Iterable[page.Section]]:
    """A view: how far each step of the best champion moves each cell."""

    def view(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
        inputs = of_metric(results, "input").curves[0].values
        shown = [i for i, x in enumerate(inputs) if x or not signals_only]
        writes = of_metric(results, "write").curves
        yield page.HeatMap(
            f"Write magnitude of the champion of seed {best_seed(results)}",
            [[curve.values[i] for i in shown] for curve in writes],
            [str(curve.labels["cell"]) for curve in writes],
            [f"{inputs[i]:+d}" if inputs[i] else "0" for i in shown],
            "input",
            "memory cell",
        )

    return view


SHARES = Runs(
    "Share of all writing that happens at signals",
    {"share": each("share at signals", form=".2%")},
    caption="100 % where distractors move nothing, as published for the champion.",
)
EXPERIMENT = Experiment(
    **told("fig-3.6"),
    cells=deepest,
    measures=(writes_on([-1.0, 1.0, -1.0]),),
    views=(heat_map(signals_only=False), SHARES),
)
