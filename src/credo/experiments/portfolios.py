"""Chapter 6 and beyond: CERL, what its portfolios are made of, and its resource managers.

Figure 6.2 is the motivating example (section 6.1): two learners that fail alone, on Hopper. The
others are of section 6.3: CERL beside evolution and each of its four learners alone (Figure 6.3 on
Humanoid, with ERL of one learner; Figure 6.5 on four more tasks), the manager's exploration (Figure
6.4), and how workers were allocated (Table 6.1). `beyond-6` has a portfolio of TD3 and SAC under
three managers. Budgets are those of `mujoco`, but `quick` has the first task only.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from ..environments.gymnasium import Gymnasium
from ..learners.manager import UCB, Thompson, Uniform
from ..learners.sac import SAC
from ..learners.td3 import TD3
from ..networks.mlp import ResidualCritic
from . import mujoco
from .base import Cell, Experiment
from .measures import of_portfolio
from .mujoco import ALLOCATED, ANCESTRY, CURVES, FATE, TABLE, cell, curves, makers, td3
from .views import Table, mean, published

PORTFOLIO = (0.9, 0.99, 0.997, 0.9995)  # γ of learners L1 to L4
EXTREME = (0.0, 1.0)
"""γ of the two learners of Figure 6.2: one sees only the next reward, the other all of them."""
TASKS = ("Hopper-v5", "Swimmer-v5", "HalfCheetah-v5", "Walker2d-v5")
HOPPER, HUMANOID = ("Hopper-v5",), ("Humanoid-v5",)
MANAGERS = {"ucb": UCB(), "uniform": Uniform(), "thompson": Thompson()}


def cerl(task: str, budget: str, method: str = "cerl", **fields: Any) -> Cell:
    """CERL with the published portfolio, unless `fields` have another."""
    return cell(method, ERL.cerl, task, budget, **fields)


def portfolio(gammas: Sequence[float]) -> tuple[TD3, ...]:
    """TD3 as in `ERL.cerl`, at these discounts."""
    like = ERL.cerl(Gymnasium(mujoco.STAND_IN)).learners[0]
    assert isinstance(like, TD3)
    return tuple(replace(like, gamma=gamma) for gamma in gammas)


def parts(task: str, budget: str, gammas: Sequence[float] = PORTFOLIO) -> list[Cell]:
    """What a portfolio is made of: evolution, and each of its learners, alone."""
    alone = [td3(task, budget, gamma) for gamma in gammas]
    return [cerl(task, budget, "ea of cerl", learners=(), manager=None), *alone]


# Cells of each experiment on a task at a budget.


def of_two(task: str, budget: str) -> list[Cell]:
    """A portfolio of two learners that fail alone, and its parts."""
    made = cerl(task, budget, "cerl of gamma 0 and 1", learners=portfolio(EXTREME))
    return [made, *parts(task, budget, EXTREME)]


def beside_erl(task: str, budget: str) -> list[Cell]:
    """CERL, ERL with the discount that TD3's authors chose, and the parts of CERL."""
    erl = cerl(task, budget, "erl td3", learners=portfolio((0.99,)))
    return [cerl(task, budget), erl, *parts(task, budget)]


def exploring(task: str, budget: str) -> list[Cell]:
    """CERL at each coefficient c of UCB; 0.9 is the published one."""
    none, *more = (
        cerl(task, budget, labels={"exploration": c}, manager=UCB(exploration=c))
        for c in (0.0, 5.0, 10.0)
    )
    return [none, cerl(task, budget), *more]


def unlike(task: str, budget: str) -> list[Cell]:
    """A portfolio of two TD3s and two SACs under each manager, and three of them alone."""
    modern = SAC(critic=ResidualCritic())
    both = {"learners": (*portfolio((0.99, 0.997)), SAC(), modern)}
    return [
        *(
            cerl(task, budget, "cerl with sac", labels={"manager": x}, manager=MANAGERS[x], **both)
            for x in MANAGERS
        ),
        td3(task, budget),
        cell("sac", OffPolicy.sac, task, budget),
        cell("sac bronet", OffPolicy.sac, task, budget, learner=modern),
    ]


def on(
    of: Sequence[str], cells: Callable[[str, str], list[Cell]], more: bool = False
) -> Callable[[str], list[Cell]]:
    """Cells on these tasks, fewer at quick: a portfolio of four takes four times as long. `more`:
    with TD3 of a longer view on Swimmer."""

    def of_budget(budget: str) -> list[Cell]:
        tasks = mujoco.tasks(budget, of)[: 1 if budget == "quick" else None]
        found = [cell for task in tasks for cell in cells(task, budget)]
        return found + (mujoco.long_view(tasks, budget) if more else [])

    return of_budget


MEASURES = (*mujoco.MEASURES, of_portfolio)
ATTRIBUTION = (makers, ANCESTRY, ALLOCATED, FATE)
ALLOCATION = Table(
    "Cumulative allocation, in percent of all rollout workers",
    ["task", *mujoco.VARIANTS, "learner"],
    {"published": published("allocation, %"), "measured": mean("allocation", 100, digits=1)},
    caption="An even share of four learners is 25 %.",
)
NUMBER = published("return", number=True)
EXPERIMENTS = {
    name: Experiment(cells, MEASURES, views, mujoco.BUDGETS)
    for name, cells, views in (
        (
            "fig-6.2",
            on(HOPPER, of_two),
            (curves(**{"published CERL, 5M": NUMBER}), TABLE, *ATTRIBUTION),
        ),
        (
            "fig-6.3",
            on(HUMANOID, beside_erl),
            (curves(**{"published CERL, 1M": NUMBER}), TABLE, *ATTRIBUTION),
        ),
        ("fig-6.4", on(HUMANOID, exploring), (CURVES, TABLE, ALLOCATION, *ATTRIBUTION)),
        (
            "fig-6.5",
            on(TASKS, lambda *x: [cerl(*x), *parts(*x)], more=True),
            (CURVES, TABLE, *ATTRIBUTION),
        ),
        (
            "table-6.1",
            on((*TASKS, *HUMANOID), lambda *x: [cerl(*x)]),
            (ALLOCATION, *ATTRIBUTION, CURVES, TABLE),
        ),
        ("beyond-6", on(HOPPER, unlike), (CURVES, TABLE, ALLOCATION, *ATTRIBUTION)),
    )
}
