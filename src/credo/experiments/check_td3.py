"""Check of the learner: TD3 alone against its authors' learning curves at 300,000 frames."""

from .base import Cell, Experiment, Value
from .fig_5_3 import MEASURES, REFERENCES, curves, notes, table, tasks, td3
from .views import published

AUTHORS = {"HalfCheetah-v5": (7697.0, 727.0), "Hopper-v5": (2410.0, 900.0)}  # mean ± s.d.


def cells(budget: str) -> list[Cell]:
    """TD3 on the tasks of which its authors show curves."""
    return [td3(task, budget) for task in tasks(budget, tuple(AUTHORS))]


def values() -> list[Value]:
    """The authors' numbers, and what to stay above."""
    source, found = "learning curves of TD3's authors, 300,000 frames of v1", []
    for task, (mean, deviation) in AUTHORS.items():
        found.append(Value(mean, "return", source, {"task": task}, f"± {deviation:g}"))
        found.append(Value(mean - 2 * deviation, "less 2 s.d.", source, {"task": task}))
    return found


EXPERIMENT = Experiment(
    published="Not in the dissertation, which took TD3 as given. The learning curves of TD3's "
    "authors have, at 300,000 frames of v1 tasks, 7697 ± 727 on HalfCheetah and 2410 ± 900 on "
    "Hopper (mean ± standard deviation).",
    cells=cells,
    measures=MEASURES,
    values=[*REFERENCES, *values()],
    views=(
        curves(
            **{
                "authors, 300k frames": published("return", number=True),
                "less 2 s.d.": published("less 2 s.d."),
            }
        ),
        table("Published: TD3's authors, 300,000 frames; shorter runs cannot be compared."),
        notes(),
    ),
)
