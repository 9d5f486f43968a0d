"""Table 5.2: what became of the learner's actors in the population."""

from typing import Any

import numpy as np

from ..algorithms.erl import ERL
from ..analysis import attribution
from ..report.rows import Row, rows
from .base import Cell, Experiment, Trained, Value
from .fig_5_3 import BUDGETS, MEASURES, REFERENCES, cell, curves, notes, table, tasks
from .views import Table, each, known, mean, published

FATES = attribution.FATES
PUBLISHED = {
    "HalfCheetah": ("83.8 ± 9.3", "14.3 ± 9.1", "2.3 ± 2.5"),
    "Swimmer": ("4.0 ± 2.8", "20.3 ± 18.1", "76.0 ± 20.4"),
    "Reacher": ("68.3 ± 9.9", "19.7 ± 6.9", "9.0 ± 6.9"),
    "Ant": ("66.7 ± 1.7", "15.0 ± 1.4", "18.0 ± 0.8"),
    "Hopper": ("28.7 ± 8.5", "33.7 ± 4.1", "37.7 ± 4.5"),
    "Walker2d": ("38.5 ± 1.5", "39.0 ± 1.9", "22.5 ± 0.5"),
}
VALUES = [
    Value(text, "fate, %", "Table 5.2", {"task": f"{task}-v5", "fate": fate})
    for task, texts in PUBLISHED.items()
    for fate, text in zip(FATES, texts, strict=True)
]


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


EXPERIMENT = Experiment(
    published="Table 5.2 of the dissertation: of the learner's actors that were copied into the "
    "population, how many became elite, were selected, or were discarded (mean ± standard "
    "deviation over runs). HalfCheetah and Swimmer are the extremes.",
    budgets=BUDGETS,
    cells=cells,
    measures=(fates, *MEASURES),
    values=[*REFERENCES, *VALUES],
    views=(
        Table(
            "What became of injected actors, in percent",
            ["task", "fate"],
            {
                "by chance": known("by chance", 100),
                "published": published("fate, %"),
                "measured": mean("fate", 100, digits=1),
            },
            where={"fate": FATES},
            caption="By chance: what an actor of random rank would meet, computed. Selected: the "
            "parent of an offspring, but no elite.",
        ),
        Table("Actors that were judged", ["task"], {"each run": each("injected")}),
        curves(),
        table(),
        notes(),
    ),
)
