"""Table 5.2: what became of the learner's actors in the population."""

from typing import Any

import numpy as np

from ..algorithms.erl import ERL
from ..analysis import attribution
from ..report.rows import Row, rows
from .base import Cell, Experiment, Trained
from .dissertation import notes, told
from .fig_5_3 import BUDGETS, MEASURES, TABLE, cell, curves, tasks
from .views import Table, each, known, mean, published

FATES = attribution.FATES


def cells(budget: str) -> list[Cell]:
    """ERL by Table 5.1 on every task."""
    return [cell("erl", ERL.erl, task, budget) for task in tasks(budget)]


def fates(cell: Trained) -> list[Row]:
    """Shares of the learner's actors that were judged in the population, and what chance says."""
    metrics, algorithm = [run.metrics for run in cell.runs], cell.cell.algorithm
    shares = attribution.plain([attribution.fates(m)[0] for m in metrics])
    counts = [int(attribution.injected(m)[0]) for m in metrics]
    return [
        *rows("fate", shares, cell.labels, seed=cell.seeds, fate=FATES),
        *rows("injected", counts, cell.labels, seed=cell.seeds),
        *rows("by chance", expected(algorithm), cell.labels, fate=FATES),
        *rows("sync period", algorithm.sync_period, cell.labels),
    ]


def expected(algorithm: Any) -> list[float]:
    """Shares of an actor that is no better or worse than the others: a random rank, and as many
    tournaments as there are offspring."""
    k, e = algorithm.population_size, algorithm.elites
    entrants = algorithm.breeder.selection.size
    ranks = np.arange(e, k)  # of those that are no elite, 0 the best
    wins = ((k - ranks) / k) ** entrants - ((k - ranks - 1) / k) ** entrants
    selected = np.sum(1.0 - (1.0 - wins) ** (k - e)) / k
    return [round(float(x), 4) for x in (e / k, selected, 1.0 - e / k - selected)]


TABLE_5_2 = Table(
    "What became of injected actors, in percent",
    ["task", "fate"],
    {
        "by chance": known("by chance", 100),
        "published": published("fate, %"),
        "measured": mean("fate", 100, digits=1),
    },
    where={"fate": FATES},
    caption="By chance: what an actor of random rank would meet, computed. Selected: the parent of "
    "an offspring, but no elite.",
)
JUDGED = Table("Actors that were judged", ["task"], {"each run": each("injected")})
EXPERIMENT = Experiment(
    **told("table-5.2", "mujoco"),
    budgets=BUDGETS,
    cells=cells,
    measures=(fates, *MEASURES),
    views=(TABLE_5_2, JUDGED, curves(), TABLE, notes("mujoco")),
)
