"""Figure 5.4: ERL without selection."""

from typing import Any

import numpy as np

from ..algorithms.erl import ERL
from ..evolution.selection import Uniform
from ..report.sections import Table
from . import chapter5
from .base import Cell

TITLE = "ERL without selection"
PUBLISHED = (
    "Figure 5.4 of the dissertation: without the selection operator the score, as a share of the "
    "best of full ERL, falls by about 80 % on HalfCheetah and Swimmer."
)
BUDGETS = chapter5.BUDGETS
TASKS = ("HalfCheetah-v5", "Swimmer-v5")


def cells(budget: str) -> list[Cell]:
    return [
        cell
        for task in chapter5.tasks(budget, TASKS)
        for cell in (
            chapter5.cell("erl", ERL.erl, task, budget),
            chapter5.cell("erl no selection", ERL.erl, task, budget, selection=Uniform()),
        )
    ]


measure = chapter5.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    return [
        *chapter5.by_task(measured),
        ablation(measured),
        chapter5.scores(measured),
        chapter5.about(
            measured,
            "Without selection parents and elites are drawn uniformly. The champion that is tested "
            "is still the fittest of its generation.",
        ),
    ]


def ablation(measured: dict[str, Any]) -> Table:
    """Scores above a random policy, as a share of the best that full ERL had."""
    rows = []
    for task in chapter5.tasks_in(measured):
        pair = {cell["label"]: cell for cell in chapter5.of_task(measured, task)}
        if len(pair) < 2:
            continue
        floor = pair["erl"]["floor"][0]
        mean = {
            label: np.array(cell["score"], np.float64).mean(axis=0) - floor
            for label, cell in pair.items()
        }
        best = np.nanmax(mean["erl"])
        left = mean["erl no selection"][-1] / best if best > 0 else float("nan")
        change = f"{100 * (left - 1):+.0f} %" if best > 0 else "ERL is no better than random"
        rows.append([task, best, mean["erl no selection"][-1], "~ -80 %", change])
    return Table(
        "What is lost without selection",
        ["task", "best of ERL", "last of no selection", "published change", "measured change"],
        rows,
        caption="Means over runs, less the score of a random policy.",
    )
