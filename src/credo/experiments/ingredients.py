"""What each ingredient of the preset `hybrid` is worth: one changed at a time.

hybrid-learner: its learner alone on HalfCheetah and Hopper. hybrid-ingredients: the whole on
HalfCheetah, where the learner does most, and on Swimmer, where evolution does. Rows "without" lack
what the preset has; rows "with" have what was built, tried and left out.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from ..evolution.cem import CEM
from ..learners.coach import Coached
from ..learners.manager import Progress
from ..learners.sac import modern
from ..learners.share import Fixed
from ..learners.surrogate import Preselection
from ..learners.td3 import TD3, TD3_NETWORK
from ..networks.mlp import MLP, AbstractCritic, Critic, ResidualCritic
from ..networks.values import Histogram, Quantiles
from ..replay import Sampling
from .base import Cell, Experiment
from .hybrids import HYBRID as TOGETHER
from .hybrids import LEARNER as ALONE
from .mujoco import MEASURES, STAND_IN, cell
from .plans import Plan
from .views import Curves, Table, known, mean, plain

WHOLE = "as it is"
LEARNER_TASKS = ("HalfCheetah-v5", "Hopper-v5")
HYBRID_TASKS = ("HalfCheetah-v5", "Swimmer-v5")


def critic(**fields: Any) -> AbstractCritic:
    """That of `modern`, changed."""
    return replace(modern().critic, **fields)


def sac(**fields: Any) -> dict[str, Any]:
    """The algorithm's fields with `modern` changed."""
    return {"learner": modern(**fields)}


AS_PAID = {"reward_scale": 1.0, "temperature": 1.0}  # a small temperature needs scaled rewards
RELU = TD3_NETWORK
SMALL = MLP(hidden=(64, 64), activation="tanh", initializer="uniform")
LEARNER: dict[str, dict[str, Any]] = {  # fields of `OffPolicy.hybrid` that change
    WHOLE: {},
    "without LayerNorm": sac(critic=critic(normalization="none")),
    "without histograms": sac(critic=Critic(normalization="before")),
    "without histograms and scaled rewards": sac(critic=Critic(normalization="before"), **AS_PAID),
    "with temperature 1 at first": sac(temperature=1.0),
    "with batches of 256, an actor that always moves": sac(batch_size=256, policy_delay=1),
    "with quantiles": sac(critic=critic(values=Quantiles())),
    "with targets that follow at once": sac(tau=1.0),
    "with a residual critic": sac(critic=ResidualCritic(values=Histogram())),
    "with returns of 3 steps": {"sampling": Sampling(steps=3)},
    "with age that counts": {"sampling": Sampling(half_life=100_000)},
    "with normalised observations": {"normalize_observations": True},
    "with a relu policy": {"network": RELU},
    "TD3 of its authors": {"learner": TD3(), "network": RELU},
    "SAC of its authors": sac(critic=Critic(), **AS_PAID, batch_size=256, policy_delay=1)
    | {"network": RELU},
}
HYBRID: dict[str, dict[str, Any]] = {  # fields of `ERL.hybrid` that change
    WHOLE: {},
    "without truncation": {"horizon": None},
    "without what learners earn: half of the frames": {"share": Fixed(0.5)},
    "without injection": {"sync_period": 1_000_000},
    "with a relu policy": {"network": RELU},
    "with a policy of 64 x 64": {"network": SMALL},
    "with TD3 of its authors": {"learners": (TD3(),)},
    "with CEM": {"breeder": CEM()},
    "with a coach": {"coach": Coached()},
    "with preselection": {"surrogate": Preselection()},
    "with two discounts and a manager": {
        "learners": (modern(gamma=0.99), modern(gamma=0.997)),
        "manager": Progress(),
    },
}
PLANS = {
    "smoke": Plan(600, 1),
    "quick": Plan(50_000, 2, 0.25),
    "full": Plan(300_000, 1),
}
HYBRID_PLANS = PLANS | {"full": Plan(150_000, 1)}


def cells(
    method: str,
    build: Callable[..., Any],
    changes: dict[str, dict[str, Any]],
    tasks: tuple[str, ...],
    plans: dict[str, Plan],
    budget: str,
) -> list[Cell]:
    """Every change on every task."""
    tasks = {"smoke": (STAND_IN,), "quick": tasks[:1]}.get(budget, tasks)
    plan = plans[budget]
    return [
        cell(method, partial(build, **fields), task, budget, labels={"change": change}, runs=plan)
        for task in tasks
        for change, fields in changes.items()
    ]


VIEWS = (
    Table(
        "Return",
        ["task", "change"],
        {
            "random policy": known("random"),
            "final champion": mean("return"),
            "last test": plain("last test"),
        },
        caption="Final champion: 10 fresh episodes. The tests are those that were logged.",
    ),
    Curves(
        "test score",
        "frames",
        ["change"],
        ["task"],
        y_label="return of the champion",
        levels={"random policy": known("random")},
    ),
)
EXPERIMENTS = {
    "hybrid-learner": Experiment(
        partial(cells, ALONE, OffPolicy.hybrid, LEARNER, LEARNER_TASKS, PLANS),
        MEASURES,
        VIEWS,
        PLANS,
    ),
    "hybrid-ingredients": Experiment(
        partial(cells, TOGETHER, ERL.hybrid, HYBRID, HYBRID_TASKS, HYBRID_PLANS),
        MEASURES,
        VIEWS,
        HYBRID_PLANS,
    ),
}
