"""MADDPG and MATD3 on simple_spread, before they serve as baselines."""

import functools

import numpy as np

from .. import tree
from ..algorithms.off_policy import OffPolicy
from ..analysis import planner
from ..environments.simple_spread import SimpleSpread
from ..learners.td3 import maddpg, matd3
from ..networks.exploration import GaussianNoise
from ..networks.mlp import Critic
from ..networks.team import JointCritic, Team
from . import measures
from .base import Cell, Experiment, Value
from .fig_7_4 import Plan
from .small import shrunk
from .views import Curves, Notes, Table, known, mean, plain, published

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
    team = tree.stack(planner.RandomTeam(env.agents))
    played = measures.returns(env, team, EPISODES, measures.BASELINE_KEY)
    return {"random": round(float(np.mean(played)), 2)}


EXPERIMENT = Experiment(
    published="Not in the dissertation. Others on simple_spread_v3 (continuous actions, "
    "local_ratio 0.5, mean per agent): random -26.7, MADDPG -9.6 ± 0.3 after 10M steps, MATD3 "
    "-7.4 to -8.4 with one seed stuck at -23.9, a script -7.5.",
    cells=cells,
    measures=(
        measures.final(episodes=EPISODES, digits=3, each=False),
        measures.scores(digits=3),
        measures.effort,
        measures.of_task(random),
    ),
    values=[
        Value(-9.6, "return", "other code, 10M steps", {"method": "maddpg"}, "± 0.3"),
        Value("-7.4 … -8.4, one -23.9", "return", "other code", {"method": "matd3"}),
        Value(-12.0, "to be exceeded", "our choice", {"method": "maddpg"}),
        Value(-10.0, "to be exceeded", "our choice", {"method": "matd3"}),
        Value(-7.5, "a script", "other code"),
    ],
    views=(
        Curves(
            "test score",
            "frames",
            ["method"],
            title="simple_spread",
            y_label="return of the actor, mean per agent",
            levels={"random": known("random"), "a script": published("a script")},
        ),
        Table(
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
        ),
        Notes(
            [
                "The task is SimpleSpread, a JAX version that matches mpe2's simple_spread_v3 step "
                "for step. A frame is one joint step; an update moves all three agents. Published "
                "numbers are of other code and more frames."
            ]
        ),
    ),
)
