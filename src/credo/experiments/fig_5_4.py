"""Figure 5.4: ERL without selection."""

from collections.abc import Iterable, Sequence

import numpy as np

from ..algorithms.erl import ERL
from ..evolution.selection import Uniform
from ..report.rows import Results
from ..report.sections import Table
from .base import Cell, Experiment, Value
from .fig_5_3 import BUDGETS, MEASURES, REFERENCES, cell, curves, notes, table, tasks

WITH, WITHOUT = "erl", "erl without selection"


def cells(budget: str) -> list[Cell]:
    """ERL with and without selection."""
    return [
        made
        for task in tasks(budget, ("HalfCheetah-v5", "Swimmer-v5"))
        for made in (
            cell(WITH, ERL.erl, task, budget),
            cell(WITHOUT, ERL.erl, task, budget, selection=Uniform()),
        )
    ]


def ablation(results: Results, values: Sequence[Value]) -> Iterable[Table]:
    """Scores above a random policy, as a share of the best that full ERL had."""
    rows = []
    for task in results.levels("task"):
        here = results.where(task=task)
        if {WITH, WITHOUT} <= set(here.levels("method")):
            baseline = here.value("random", method=WITH)
            best, last = (
                here.array("test score", "seed", method=method).astype(np.float64).mean(axis=0)
                - baseline
                for method in (WITH, WITHOUT)
            )
            best, last = np.nanmax(best), last[-1]
            change = f"{100 * (last / best - 1):+.0f} %" if best > 0 else "no better than random"
            rows.append([task, best, last, "~ -80 %", change])
    columns = ["task", "best of ERL", "last without selection", "published change", "change"]
    if rows:
        caption = "Means over runs, less the mean return of a random policy."
        yield Table("What is lost without selection", columns, rows, caption)


EXPERIMENT = Experiment(
    published="Figure 5.4 of the dissertation: without the selection operator the score, as a "
    "share of the best of full ERL, falls by about 80 % on HalfCheetah and Swimmer.",
    budgets=BUDGETS,
    cells=cells,
    measures=MEASURES,
    values=REFERENCES,
    views=(
        curves(),
        ablation,
        table(),
        notes(
            "Without selection parents and elites are drawn uniformly. The champion that is tested "
            "is still the fittest of its generation."
        ),
    ),
)
