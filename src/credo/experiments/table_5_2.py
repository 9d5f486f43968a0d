"""Table 5.2: what became of the learner's actors in the population."""

from typing import Any

import numpy as np

from ..analysis import attribution
from ..report.sections import Table
from ..runs.store import Run
from . import chapter5
from .base import Cell

TITLE = "fate of the learner's actors"
PUBLISHED = (
    "Table 5.2 of the dissertation: of the learner's actors that were copied into the population, "
    "how many became elite, were selected, or were discarded. HalfCheetah and Swimmer are the "
    "extremes."
)
BUDGETS = chapter5.BUDGETS
GIVEN = {
    "HalfCheetah": ("83.8 ± 9.3", "14.3 ± 9.1", "2.3 ± 2.5"),
    "Swimmer": ("4.0 ± 2.8", "20.3 ± 18.1", "76.0 ± 20.4"),
    "Reacher": ("68.3 ± 9.9", "19.7 ± 6.9", "9.0 ± 6.9"),
    "Ant": ("66.7 ± 1.7", "15.0 ± 1.4", "18.0 ± 0.8"),
    "Hopper": ("28.7 ± 8.5", "33.7 ± 4.1", "37.7 ± 4.5"),
    "Walker2d": ("38.5 ± 1.5", "39.0 ± 1.9", "22.5 ± 0.5"),
}


def cells(budget: str) -> list[Cell]:
    return chapter5.erl_cells(budget)


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    measured = {}
    for name, cell in runs.items():
        metrics = [run.metrics for run in cell]
        measured[name] = {
            **chapter5.outcome(name, cell),
            "injected": [int(attribution.injected(m)[0]) for m in metrics],
            "fates": [attribution.plain(attribution.fates(m)[0]) for m in metrics],
            "sync period": cell[0].algorithm.sync_period,
            "expected": expected(cell[0].algorithm),
        }
    return measured


def expected(algorithm: Any) -> list[float]:
    """Shares of an actor that is no better or worse than the others: a random rank, and as many
    tournaments as there are offspring."""
    k, e = algorithm.population_size, algorithm.elites
    entrants = algorithm.selection.size
    ranks = np.arange(e, k)  # of those that are no elite, 0 the best
    wins = ((k - ranks) / k) ** entrants - ((k - ranks - 1) / k) ** entrants
    selected = np.sum(1.0 - (1.0 - wins) ** (k - e)) / k
    return [round(float(x), 4) for x in (e / k, selected, 1.0 - e / k - selected)]


def sections(measured: dict[str, Any]) -> list[Any]:
    rows = []
    for cell in measured.values():
        shares = np.array(cell["fates"], np.float64)  # [runs, 3]
        given = GIVEN.get(cell["task"].partition("-")[0], ("–",) * 3)
        for i, fate in enumerate(attribution.FATES):
            judged = shares[np.isfinite(shares[:, i]), i]
            rows.append(
                [
                    cell["task"] if i == 0 else "",
                    fate,
                    f"{100 * cell['expected'][i]:.1f}",
                    given[i],
                    chapter5.spread(100 * judged) if judged.size else "–",
                    ", ".join(map(str, cell["injected"])) if i == 0 else "",
                ]
            )
    return [
        Table(
            "Share of injected actors in percent, mean ± standard deviation over runs",
            ["task", "fate", "by chance", "published", "measured", "actors judged, each run"],
            rows,
            caption="By chance: what an actor of random rank would meet, computed. Selected: the "
            "parent of an offspring, but no elite.",
        ),
        *chapter5.by_task(measured),
        chapter5.scores(measured),
        chapter5.about(measured),
    ]
