"""Figure 6.5: CERL, its learners alone, and evolution on four tasks. Also what all experiments on
CERL share: portfolios, their parts, measurements and views."""

import dataclasses
from typing import Any

from ..algorithms.erl import ERL
from ..environments.gymnasium import Gymnasium
from ..learners.td3 import TD3
from ..report.rows import Row, Series
from . import beyond_5, measures
from .base import Cell, Experiment, Trained
from .fig_5_3 import (
    BUDGETS,
    REFERENCES,
    STAND_IN,
    SWIMMER,
    VARIANTS,
    cell,
    curves,
    notes,
    table,
    td3_gamma,
)
from .fig_5_3 import MEASURES as SCORES
from .fig_5_3 import tasks as all_tasks
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
    return tuple(dataclasses.replace(like, gamma=gamma) for gamma in gammas)


def parts(task: str, budget: str, gammas: tuple[float, ...] = PORTFOLIO) -> list[Cell]:
    """What a portfolio is made of: evolution, and each of its learners, alone."""
    alone = [td3_gamma(task, budget, gamma) for gamma in gammas]
    return [cerl(task, budget, "ea of cerl", learners=(), manager=None), *alone]


def tasks(budget: str, of: tuple[str, ...] = TASKS) -> tuple[str, ...]:
    """Fewer at quick: a portfolio of four takes four times as long."""
    return all_tasks(budget, of)[:1] if budget == "quick" else all_tasks(budget, of)


def cells(budget: str) -> list[Cell]:
    """CERL and its parts; on Swimmer also TD3 with a longer view."""
    chosen = tasks(budget)
    found = [x for task in chosen for x in (cerl(task, budget), *parts(task, budget))]
    long_view = "Swimmer-v5" in chosen
    return [*found, td3_gamma("Swimmer-v5", budget, 0.9999)] if long_view else found


# ----------------------------------------------------------------------------- measures and views


def lineage(cell: Trained) -> list[Row | Series]:
    """Attribution, of cells that have a portfolio."""
    learners = getattr(cell.cell.algorithm, "learners", ())
    return measures.lineage(cell) if len(learners) > 1 else []


MEASURES = (*SCORES, lineage)
ATTRIBUTION = (beyond_5.makers, beyond_5.ancestry, beyond_5.allocation, beyond_5.fates)
ALLOCATION = Table(
    "Cumulative allocation, in percent of all rollout workers",
    ["task", *VARIANTS, "learner"],
    {"published": published("allocation, %"), "measured": mean("allocation", 100, digits=1)},
    caption="An even share of four learners is 25 %.",
)

EXPERIMENT = Experiment(
    published="Figure 6.5 of the dissertation (curves without numbers): TD3 at γ 0.99 needs fewer "
    "frames than CERL on Hopper, HalfCheetah and Walker2d, CERL fewer than the other TD3s; of "
    "Swimmer only CERL and evolution are said to be capable.",
    budgets=BUDGETS,
    cells=cells,
    measures=MEASURES,
    values=REFERENCES,
    views=(curves(), table(), *ATTRIBUTION, notes(SWIMMER)),
)
