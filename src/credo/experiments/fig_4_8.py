"""Figure 4.8: who writes what to the shared memory, and when."""

from collections.abc import Iterable, Sequence

import numpy as np

from ..report import sections as page
from ..report.rows import Results
from .base import Experiment, Value
from .fig_4_2 import BUDGETS
from .fig_4_7 import STRONGER, about
from .table_3_1 import of_best
from .table_4_1 import EPISODES, cells, played, references, upper_bound
from .views import Runs, of_metric

SHOWN = "NGGN"  # the configuration in the text of section 4.2.4


def heat_maps(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """Writes of each server of the best champion, by step and memory cell."""
    shown = results.where(configuration=SHOWN)
    for server in shown.levels("server"):
        here = shown.where(server=server)
        (devices,) = of_metric(here, "device").curves
        writes = of_metric(here, "write").curves
        told = [f"device {x}" if x >= 0 else "told" for x in devices.values]
        yield page.HeatMap(
            f"Server {server}: magnitude of its writes",
            [curve.values for curve in writes],
            [curve.labels["cell"] for curve in writes],
            [f"t={t}: {word}" for t, word in zip(devices.at, told, strict=True)],
            "step",
            "memory cell",
        )


def share_when_told(results: Results, values: Sequence[Value]) -> page.Cell:
    """The share of a run's writing that happens when a server is told, in percent."""
    dims = ("configuration", "server")
    told = results.array("device", *dims).astype(int) < 0
    writes = results.array("write", *dims, "cell").astype(np.float64).sum(axis=2)
    return f"{100 * writes[told].sum() / writes.sum():.1f}"


EXPERIMENT = Experiment(
    published="Figure 4.8 of the dissertation: servers write when they are told what their last "
    "request was worth, in the steps behind an action, and hardly when they act; each to cells of "
    "its own.",
    cells=cells,
    measures=(played, upper_bound, references),
    views=(
        of_best(heat_maps),
        Runs(
            "Share of all writing that happens when a server is told what its request was worth",
            {"share, %": share_when_told},
            caption="Over the six configurations; half of the steps are of that kind.",
        ),
        about(
            EPISODES,
            STRONGER,
            f"Shown is the configuration of the dissertation's text, {SHOWN}, on a linear scale "
            "(there a logarithmic one).",
        ),
    ),
    budgets=BUDGETS,
)
