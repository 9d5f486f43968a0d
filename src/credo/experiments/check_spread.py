"""MADDPG and MATD3 on simple_spread, before they serve as baselines."""

import functools

import numpy as np

from .. import tree
from ..algorithms.off_policy import OffPolicy
from ..analysis import scripts
from ..environments.simple_spread import SimpleSpread
from ..learners.td3 import maddpg, matd3
from ..networks.exploration import GaussianNoise
from ..networks.mlp import Critic
from ..networks.team import JointCritic, Team
from . import measures
from .base import Cell, Experiment
from .dissertation import notes, told
from .fig_7_4 import Plan
from .small import shrunk
from .views import Curves, Table, known, mean, plain, published

PLANS = {
    "smoke": Plan(1_000, 2),
    "quick": Plan(100_000, 2, 0.1),
    "full": Plan(1_000_000, 3, 0.1),
}
EPISODES = 500
LEARNERS = {"matd3": matd3, "maddpg": maddpg}


def cells(budget: str) -> list[Cell]:
    """Both learners."""
    plan, found = PLANS[budget], []
    for method in LEARNERS:
        algorithm = build(method, plan)
        algorithm = shrunk(algorithm) if budget == "smoke" else algorithm
        labels = {"method": method, "task": "simple spread"}
        found.append(Cell(labels, algorithm, range(plan.runs), frames=plan.frames))
    return found


def build(method: str, plan: Plan) -> OffPolicy:
    """With the settings of the published results."""
    learner = LEARNERS[method](
        critic=JointCritic(Critic(hidden=(128, 128))),
        signal="local",
        gamma=0.95,
        noise=GaussianNoise(0.2),
        batch_size=256,
    )
    return OffPolicy.matd3(
        SimpleSpread(),
        Team(trunk=(128, 128), activation="relu"),
        learner=learner,
        episodes=20,
        updates_per_frame=plan.updates_per_frame,
        replay_capacity=1_000_000,
        test_every=20_000,
        test_episodes=100,
    )


@functools.cache
def random(env: SimpleSpread) -> dict[str, float]:
    """Mean return of actions drawn uniformly."""
    team = tree.stack(scripts.random_team(env))
    played = measures.returns(env, team, EPISODES, measures.BASELINE_KEY)
    return {"random": round(float(np.mean(played)), 2)}


COLUMNS = {
    "baseline: random": known("random"),
    "published": published("return"),
    "to be exceeded": published("to be exceeded"),
    "final actor": mean("return"),
    "median": plain("return", of=np.median),
    "frames": plain("frames"),
}
CAPTION = f"Final actor: {EPISODES} fresh episodes without noise."
LEVELS = {"random": known("random"), "a script": published("a script")}
CURVES = Curves(
    "test score",
    "frames",
    ["method"],
    title="simple_spread",
    y_label="return of the actor, mean per agent",
    levels=LEVELS,
)
EXPERIMENT = Experiment(
    **told("check-spread"),
    cells=cells,
    measures=(
        measures.final(episodes=EPISODES, digits=3, each=False),
        measures.scores(digits=3),
        measures.effort,
        measures.of_task(random),
    ),
    views=(
        CURVES,
        Table("Return per episode, mean over agents", ["method"], COLUMNS, caption=CAPTION),
        notes("check-spread"),
    ),
)
