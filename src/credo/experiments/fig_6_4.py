"""Figure 6.4: how much the resource manager explores."""

from ..learners.manager import UCB
from .base import Cell, Experiment
from .dissertation import notes, told
from .fig_5_3 import TABLE, curves
from .fig_6_5 import ALLOCATION, ATTRIBUTION, HUMANOID, PORTFOLIOS, cerl, tasks


def cells(budget: str) -> list[Cell]:
    """CERL at each coefficient c of UCB; 0.9 is the published one."""
    (task,) = tasks(budget, (HUMANOID,))
    found = [
        cerl(task, budget, labels={"exploration": c}, manager=UCB(exploration=c))
        for c in (0.0, 5.0, 10.0)
    ]
    return [found[0], cerl(task, budget), *found[1:]]


EXPERIMENT = Experiment(
    **told("fig-6.4", "mujoco"),
    **PORTFOLIOS,
    cells=cells,
    views=(curves(), TABLE, ALLOCATION, *ATTRIBUTION, notes("mujoco", "fig-6.4")),
)
