"""Figure 6.3: CERL and its parts on Humanoid."""

from .base import Cell, Experiment
from .dissertation import notes, told
from .fig_5_3 import TABLE, curves
from .fig_6_5 import ATTRIBUTION, HUMANOID, PORTFOLIOS, cerl, parts, portfolio, tasks
from .views import published


def cells(budget: str) -> list[Cell]:
    """CERL, ERL with the discount that TD3's authors chose, and the parts of CERL."""
    (task,) = tasks(budget, (HUMANOID,))
    erl = cerl(task, budget, "erl td3", learners=portfolio((0.99,)))
    return [cerl(task, budget), erl, *parts(task, budget)]


LEVELS = {"published CERL, 1M": published("return", number=True)}
EXPERIMENT = Experiment(
    **told("fig-6.3", "mujoco"),
    **PORTFOLIOS,
    cells=cells,
    views=(curves(**LEVELS), TABLE, *ATTRIBUTION, notes("mujoco", "fig-6.3")),
)
