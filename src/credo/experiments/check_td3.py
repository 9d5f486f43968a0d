"""Check of the learner: TD3 alone against its authors' learning curves at 300,000 frames."""

from typing import Any

from ..report.sections import Reference
from . import chapter5
from .base import Cell

TITLE = "TD3 alone, against its authors"
PUBLISHED = (
    "Not in the dissertation, which took TD3 as given. The learning curves of TD3's authors have, "
    "at 300,000 frames of v1 tasks, 7697 ± 727 on HalfCheetah and 2410 ± 900 on Hopper."
)
AUTHORS = {"HalfCheetah-v5": (7697.0, 727.0), "Hopper-v5": (2410.0, 900.0)}
FRAMES = 300_000


def cells(budget: str) -> list[Cell]:
    return [chapter5.td3(task, budget) for task in chapter5.tasks(budget, tuple(AUTHORS))]


measure = chapter5.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    figures = []
    for task in chapter5.tasks_in(measured):
        mean, deviation = AUTHORS.get(task, (None, None))
        levels = () if mean is None else (Reference("authors, 300k frames", mean),)
        if mean is not None and deviation is not None:
            levels += (Reference("less 2 sd", mean - 2 * deviation),)
        figures.append(chapter5.curves(task, chapter5.of_task(measured, task), *levels))
    given = {
        name: f"{AUTHORS[cell['task']][0]:,.0f} ± {AUTHORS[cell['task']][1]:,.0f}"
        for name, cell in measured.items()
        if cell["task"] in AUTHORS
    }
    short = any(max(cell["played"]) < FRAMES for cell in measured.values())
    caution = "These runs are shorter than the 300,000 frames of the authors' numbers."
    return [
        *figures,
        chapter5.scores(measured, given, caption="Published: TD3's authors, 300,000 frames."),
        chapter5.about(measured, *([caution] if short else [])),
    ]
