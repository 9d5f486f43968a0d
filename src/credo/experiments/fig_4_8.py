"""Figure 4.8: who writes what to the shared memory, and when."""

from collections.abc import Iterable, Sequence

import numpy as np

from ..report import sections as page
from ..report.rows import Results
from .base import Experiment, Value
from .dissertation import notes, told
from .fig_4_2 import BUDGETS
from .table_3_1 import of_best
from .table_4_1 import MEASURES, cells
from .views import Runs, of_metric


def heat_maps(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """Writes of each server of the best champion, by step and memory cell, in the configuration of
    section 4.2.4."""
    for server in results.levels("server"):
        here = results.where(configuration="NGGN", server=server)
        (devices,) = of_metric(here, "device").curves
        writes = of_metric(here, "write").curves
        chosen = [f"device {x}" if x >= 0 else "told" for x in devices.values]
        yield page.HeatMap(
            f"Server {server}: magnitude of its writes",
            [curve.values for curve in writes],
            [str(curve.labels["cell"]) for curve in writes],
            [f"t={t}: {word}" for t, word in zip(devices.at, chosen, strict=True)],
            "step",
            "memory cell",
        )


def share_when_told(results: Results, values: Sequence[Value]) -> page.Cell:
    """The share of a run's writing that happens when a server is told, in percent."""
    dims = ("configuration", "server")
    when = results.array("device", *dims).astype(int) < 0
    writes = results.array("write", *dims, "cell").astype(np.float64).sum(axis=2)
    return f"{100 * writes[when].sum() / writes.sum():.1f}"


SHARES = Runs(
    "Share of all writing that happens when a server is told what its request was worth",
    {"share, %": share_when_told},
    caption="Over the six configurations; half of the steps are of that kind.",
)
EXPERIMENT = Experiment(
    **told("fig-4.8"),
    budgets=BUDGETS,
    cells=cells,
    measures=MEASURES,
    views=(of_best(heat_maps), SHARES, notes("case study", "fig-4.8")),
)
