"""MADDPG and MATD3 on simple_spread, before they serve as baselines.

Not in the dissertation, whose Figure 7.4 compares MERL with both. Published returns are of other
code, MADDPG's after 10 million steps; `full` has 1 million and 3 runs, `quick` 100,000 and 2.
Returns are sums over the 25 steps of an episode, means over the three agents, and never positive.
"""

import functools

import numpy as np

from .. import tree
from ..algorithms.off_policy import OffPolicy
from ..analysis import scripts
from ..environments.simple_spread import SimpleSpread
from ..networks.exploration import GaussianNoise
from ..networks.mlp import Critic
from ..networks.team import JointCritic, Team
from . import measures
from .base import Cell, Experiment
from .plans import Plan, planned
from .rovers import LEARNERS
from .views import Curves, Table, known, mean, plain, published

PLANS = {
    "smoke": Plan(1_000, 2, 0.05),
    "quick": Plan(100_000, 2, 0.1),
    "full": Plan(1_000_000, 3, 0.1),
}
EPISODES = 500


def cells(budget: str) -> list[Cell]:
    """Both learners."""
    return [
        planned({"method": x, "task": "simple spread"}, build(x), PLANS[budget], budget)
        for x in LEARNERS
    ]


def build(method: str) -> OffPolicy:
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
        replay_capacity=1_000_000,
        test_every=20_000,
        test_episodes=100,
    )


@functools.cache
def random(env: SimpleSpread) -> dict[str, float]:
    """Mean return of actions drawn uniformly."""
    team = tree.single(scripts.random_team(env))
    played = measures.returns(env, team, EPISODES, measures.BASELINE_KEY)
    return {"random": round(float(np.mean(played)), 2)}


TABLE = Table(
    "Return per episode, mean over agents",
    ["method"],
    {
        "baseline: random": known("random"),
        "published": published("return"),
        "to be exceeded": published("to be exceeded"),
        "final actor": mean("return"),
        "median": plain("return", of=np.median),
        "frames": plain("frames"),
    },
    caption=f"Final actor: {EPISODES} fresh episodes without noise.",
)
CURVES = Curves(
    "test score",
    "frames",
    ["method"],
    title="simple_spread",
    y_label="return of the actor, mean per agent",
    levels={"random": known("random"), "a script": published("a script")},
)
MEASURES = (
    measures.final(episodes=EPISODES, digits=3, each=False),
    measures.scores(digits=3),
    measures.effort,
    measures.of_task(random),
)
EXPERIMENTS = {"check-spread": Experiment(cells, MEASURES, (CURVES, TABLE))}
