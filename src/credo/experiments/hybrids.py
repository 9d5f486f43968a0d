"""When does a hybrid win? One preset (`ERL.hybrid`), its learner alone and its evolution alone, at
equal frames and updates.

hybrid-dense: four tasks of MuJoCo as they are. hybrid-late: the same, where the whole return is
paid at the last step; beside the learner that sees returns as they are paid stands that of the
preset, which sees them decomposed. Shared rewards are beyond-7-decoys.

The preset was chosen on seeds from 1,000 on, with up to 300,000 frames of the four tasks; reported
runs have seeds from 0 on. Those of the hybrid have seeds from 10 on: how members are judged and who
gets the frames were changed after the curves of seeds 0 to 2 had been looked at (docs, hybrid).
"""

from collections.abc import Sequence
from functools import partial

from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from .base import Cell, Experiment
from .mujoco import MEASURES, STAND_IN, TABLE, cell, curves
from .plans import Plan
from .views import Improvement

TASKS = ("Swimmer-v5", "HalfCheetah-v5", "Hopper-v5", "Walker2d-v5")
HYBRID, LEARNER, EVOLUTION = "hybrid", "its learner alone", "its evolution alone"
DECOMPOSED = "its learner alone, returns decomposed"
METHODS = {
    HYBRID: ERL.hybrid,
    LEARNER: partial(OffPolicy.hybrid, redistribute=None),
    EVOLUTION: partial(ERL.hybrid, learners=()),
}
FIRST = {HYBRID: 10}  # the first seed; of all others 0
DENSE = {
    "smoke": Plan(600, 2),
    "quick": Plan(50_000, 2, 0.25),
    "full": Plan(300_000, 3),
    "million": Plan(1_000_000, 3),
}
LATE = DENSE | {"full": Plan(500_000, 3)}


def tasks(budget: str) -> Sequence[str]:
    """The tasks at a budget."""
    return {"smoke": (STAND_IN,), "quick": TASKS[:1]}.get(budget, TASKS)


def dense(budget: str) -> list[Cell]:
    """Every method on every task."""
    runs = DENSE[budget]
    return [
        cell(x, METHODS[x], task, budget, runs=runs, first_seed=FIRST.get(x, 0))
        for task in tasks(budget)
        for x in METHODS
    ]


def late(budget: str) -> list[Cell]:
    """The same with returns at the last step, and the learner that sees them decomposed."""
    methods = METHODS | {DECOMPOSED: OffPolicy.hybrid}
    return [
        cell(
            x, methods[x], task, budget, delayed=True, runs=LATE[budget], first_seed=FIRST.get(x, 0)
        )
        for task in tasks(budget)
        for x in methods
    ]


BETTER = Improvement(
    HYBRID,
    "return",
    ["task"],
    "Is the hybrid better than its parts?",
    caption="Final champions, means over 10 fresh episodes of each run.",
)
CURVES = curves()
VIEWS = (CURVES, BETTER, TABLE)
EXPERIMENTS = {
    "hybrid-dense": Experiment(dense, MEASURES, VIEWS, DENSE),
    "hybrid-late": Experiment(late, MEASURES, VIEWS, LATE),
}
