"""Figure 6.5: CERL, its learners alone, and evolution on four tasks. Also what all experiments on
CERL share: portfolios, their parts, measurements and views."""

from dataclasses import replace
from typing import Any

from ..algorithms.erl import ERL
from ..environments.gymnasium import Gymnasium
from ..learners.td3 import TD3
from . import beyond_5, fig_5_3, measures
from .base import Cell, Experiment
from .dissertation import notes, told
from .fig_5_3 import BUDGETS, STAND_IN, TABLE, VARIANTS, cell, curves, long_view, td3
from .views import Table, mean, published

PORTFOLIO = (0.9, 0.99, 0.997, 0.9995)  # γ of learners L1 to L4
TASKS = ("Hopper-v5", "Swimmer-v5", "HalfCheetah-v5", "Walker2d-v5")
HUMANOID = "Humanoid-v5"


def cerl(task: str, budget: str, method: str = "cerl", **fields: Any) -> Cell:
    """CERL with the published portfolio, unless `fields` have another."""
    return cell(method, ERL.cerl, task, budget, **fields)


def portfolio(gammas: tuple[float, ...]) -> tuple[TD3, ...]:
    """TD3 as in `ERL.cerl`, at these discounts."""
    like = ERL.cerl(Gymnasium(STAND_IN)).learners[0]
    assert isinstance(like, TD3)
    return tuple(replace(like, gamma=gamma) for gamma in gammas)


def parts(task: str, budget: str, gammas: tuple[float, ...] = PORTFOLIO) -> list[Cell]:
    """What a portfolio is made of: evolution, and each of its learners, alone."""
    alone = [td3(task, budget, gamma) for gamma in gammas]
    return [cerl(task, budget, "ea of cerl", learners=(), manager=None), *alone]


def tasks(budget: str, of: tuple[str, ...] = TASKS) -> tuple[str, ...]:
    """Fewer at quick: a portfolio of four takes four times as long."""
    return fig_5_3.tasks(budget, of)[: 1 if budget == "quick" else None]


def cells(budget: str) -> list[Cell]:
    """CERL and its parts."""
    chosen = tasks(budget)
    found = [x for task in chosen for x in (cerl(task, budget), *parts(task, budget))]
    return found + long_view(chosen, budget)


ATTRIBUTION = (beyond_5.makers, beyond_5.ANCESTRY, beyond_5.ALLOCATION, beyond_5.FATE)
ALLOCATION = Table(
    "Cumulative allocation, in percent of all rollout workers",
    ["task", *VARIANTS, "learner"],
    {"published": published("allocation, %"), "measured": mean("allocation", 100, digits=1)},
    caption="An even share of four learners is 25 %.",
)
PORTFOLIOS: dict[str, Any] = {
    "budgets": BUDGETS,
    "measures": (*fig_5_3.MEASURES, measures.of_portfolio),
}
EXPERIMENT = Experiment(
    **told("fig-6.5", "mujoco"),
    **PORTFOLIOS,
    cells=cells,
    views=(curves(), TABLE, *ATTRIBUTION, notes("mujoco", "swimmer")),
)
