"""Beyond chapter 6: a portfolio of unlike learners, and other resource managers."""

from typing import Any

from ..algorithms.off_policy import OffPolicy
from ..learners.manager import UCB, Thompson, Uniform
from ..learners.sac import SAC
from ..networks.mlp import ResidualCritic
from . import chapter5, chapter6
from .base import Cell

TITLE = "SAC and a critic of 2024 beside TD3, and three managers"
PUBLISHED = (
    "Not in the dissertation, whose learners differ in γ alone; it names SAC beside TD3, and "
    "learning in the manager, as future work. The critic is BroNet (Nauman et al. 2024), residual "
    "and normalised, without the rest of its method."
)
BUDGETS = chapter6.BUDGETS
MANAGERS = {"ucb": UCB(), "uniform": Uniform(), "thompson": Thompson()}
GAMMAS = (0.99, 0.997)  # of TD3


def cells(budget: str) -> list[Cell]:
    (task,) = chapter6.tasks(budget, ("Hopper-v5",))
    modern = SAC(critic=ResidualCritic())
    learners = (*chapter6.portfolio(GAMMAS), SAC(), modern)
    return [
        *(
            chapter6.cerl(f"cerl sac {name}", task, budget, learners=learners, manager=manager)
            for name, manager in MANAGERS.items()
        ),
        chapter5.td3(task, budget),
        chapter5.cell("sac", OffPolicy.sac, task, budget),
        chapter5.cell("sac bronet", OffPolicy.sac, task, budget, learner=modern),
    ]


measure = chapter6.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    with_manager = {name: cell for name, cell in measured.items() if "attribution" in cell}
    return [
        *chapter5.by_task(measured),
        chapter5.scores(measured, interval=True),
        chapter6.allocation(with_manager, {}),
        *chapter6.attributions(measured),
        chapter5.about(
            measured,
            "Every frame of everybody counts, and each learner of a portfolio makes as many "
            "updates per frame as one alone: a portfolio of four computes four times as much.",
        ),
    ]
