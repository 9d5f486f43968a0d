"""Figure 6.2: CERL with two learners that fail alone."""

from .base import Cell, Experiment
from .dissertation import notes, told
from .fig_5_3 import TABLE, curves
from .fig_6_5 import ATTRIBUTION, PORTFOLIOS, cerl, parts, portfolio, tasks
from .views import published

GAMMAS = (0.0, 1.0)


def cells(budget: str) -> list[Cell]:
    """The portfolio and its parts."""
    (task,) = tasks(budget, ("Hopper-v5",))
    made = cerl(task, budget, "cerl of gamma 0 and 1", learners=portfolio(GAMMAS))
    return [made, *parts(task, budget, GAMMAS)]


LEVELS = {"published CERL, 5M": published("return", number=True)}
EXPERIMENT = Experiment(
    **told("fig-6.2", "mujoco"),
    **PORTFOLIOS,
    cells=cells,
    views=(curves(**LEVELS), TABLE, *ATTRIBUTION, notes("mujoco")),
)
