"""Beyond chapter 6: a portfolio of unlike learners, and other resource managers."""

from ..algorithms.off_policy import OffPolicy
from ..learners.manager import UCB, Thompson, Uniform
from ..learners.sac import SAC
from ..networks.mlp import ResidualCritic
from .base import Cell, Experiment
from .dissertation import notes, told
from .fig_5_3 import TABLE, cell, curves, td3
from .fig_6_5 import ALLOCATION, ATTRIBUTION, PORTFOLIOS, cerl, portfolio, tasks

MANAGERS = {"ucb": UCB(), "uniform": Uniform(), "thompson": Thompson()}


def cells(budget: str) -> list[Cell]:
    """A portfolio of two TD3s and two SACs under each manager, and three of them alone."""
    (task,) = tasks(budget, ("Hopper-v5",))
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


EXPERIMENT = Experiment(
    **told("beyond-6", "mujoco"),
    **PORTFOLIOS,
    cells=cells,
    views=(curves(), TABLE, ALLOCATION, *ATTRIBUTION, notes("mujoco", "beyond-6")),
)
