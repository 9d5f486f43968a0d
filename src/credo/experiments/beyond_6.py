"""Beyond chapter 6: a portfolio of unlike learners, and other resource managers."""

from ..algorithms.off_policy import OffPolicy
from ..learners.manager import UCB, Thompson, Uniform
from ..learners.sac import SAC
from ..networks.mlp import ResidualCritic
from .base import Cell, Experiment
from .fig_5_3 import BUDGETS, REFERENCES, cell, curves, notes, table, td3
from .fig_6_5 import ALLOCATION, ATTRIBUTION, MEASURES, cerl, portfolio, tasks

MANAGERS = {"ucb": UCB(), "uniform": Uniform(), "thompson": Thompson()}


def cells(budget: str) -> list[Cell]:
    """A portfolio of two TD3s and two SACs under each manager, and three of them alone."""
    (task,) = tasks(budget, ("Hopper-v5",))
    modern = SAC(critic=ResidualCritic())
    learners = (*portfolio((0.99, 0.997)), SAC(), modern)
    managed = [
        cerl(
            task,
            budget,
            "cerl with sac",
            labels={"manager": name},
            learners=learners,
            manager=manager,
        )
        for name, manager in MANAGERS.items()
    ]
    sac = cell("sac", OffPolicy.sac, task, budget)
    return [
        *managed,
        td3(task, budget),
        sac,
        cell("sac bronet", OffPolicy.sac, task, budget, learner=modern),
    ]


EXPERIMENT = Experiment(
    published="Not in the dissertation, whose learners differ in γ alone; it names SAC beside TD3, "
    "and learning in the manager, as future work. The critic is BroNet (Nauman et al. 2024), "
    "residual and normalised, without the rest of its method.",
    budgets=BUDGETS,
    cells=cells,
    measures=MEASURES,
    values=REFERENCES,
    views=(
        curves(),
        table(),
        ALLOCATION,
        *ATTRIBUTION,
        notes(
            "All frames count, those of the population and of every learner, and each learner of a "
            "portfolio makes as many updates per frame as one alone: a portfolio of four computes "
            "four times as much."
        ),
    ),
)
