"""Figure 5.4: ERL without selection."""

from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np

from ..algorithms.erl import ERL
from ..evolution.selection import Uniform
from ..report.rows import Results
from ..report.sections import Table
from .base import Cell, Experiment, Value
from .dissertation import notes, told
from .fig_5_3 import MUJOCO, TABLE, cell, curves, tasks

WITH, WITHOUT = "erl", "erl without selection"


def cells(budget: str) -> list[Cell]:
    """ERL with and without selection."""
    builds = {WITH: ERL.erl, WITHOUT: partial(ERL.erl, selection=Uniform())}
    chosen = tasks(budget, ("HalfCheetah-v5", "Swimmer-v5"))
    return [cell(x, builds[x], task, budget) for task in chosen for x in builds]


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
    **told("fig-5.4", "mujoco"),
    **MUJOCO,
    cells=cells,
    views=(curves(), ablation, TABLE, notes("mujoco", "fig-5.4")),
)
