"""Check of the learner: TD3 alone against its authors' learning curves at 300,000 frames."""

from .base import Cell, Experiment
from .dissertation import notes, told
from .fig_5_3 import MEASURES, TABLE, curves, tasks, td3
from .views import published


def cells(budget: str) -> list[Cell]:
    """TD3 on the tasks of which its authors show curves."""
    return [td3(task, budget) for task in tasks(budget, ("HalfCheetah-v5", "Hopper-v5"))]


AUTHORS = {
    "authors, 300k frames": published("return", number=True),
    "less 2 s.d.": published("less 2 s.d."),
}
EXPERIMENT = Experiment(
    **told("check-td3", "mujoco"),
    cells=cells,
    measures=MEASURES,
    views=(curves(**AUTHORS), TABLE, notes("mujoco", "check-td3")),
)
