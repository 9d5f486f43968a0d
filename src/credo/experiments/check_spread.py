"""MADDPG and MATD3 on simple_spread, before they serve as baselines."""

from typing import Any

import jax
import numpy as np

from .. import tree
from ..algorithms.off_policy import OffPolicy
from ..analysis import planner
from ..environments.simple_spread import SimpleSpread
from ..learners.td3 import maddpg, matd3
from ..networks.exploration import GaussianNoise
from ..networks.mlp import Critic
from ..networks.team import JointCritic, Team
from ..report.sections import Curve, Figure, Reference, Table, Text
from ..rollout import evaluate
from ..runs.store import Run
from . import chapter7
from .base import Cell
from .chapter5 import middle
from .chapter7 import Plan

TITLE = "MADDPG and MATD3 on simple_spread"
PUBLISHED = (
    "Not in the dissertation. Others on simple_spread_v3 (continuous actions, local_ratio 0.5, "
    "mean per agent): random -26.7, MADDPG -9.6 ± 0.3 after 10M steps, MATD3 -7.4 to -8.4 with one "
    "seed stuck at -23.9, a script -7.5."
)
PLANS = {
    "smoke": Plan(1_000, 2),
    "quick": Plan(100_000, 2, 0.1),
    "full": Plan(1_000_000, 3, 0.1),
}
EPISODES = 500
PUBLISHED_SCORES = {"maddpg": "-9.6 ± 0.3", "matd3": "-7.4 … -8.4, one -23.9"}
BOUNDS = {"maddpg": -12.0, "matd3": -10.0}  # to be beaten before they serve as baselines
LEARNERS = {"matd3": matd3, "maddpg": maddpg}


def cells(budget: str) -> list[Cell]:
    plan = PLANS[budget]
    return [
        Cell(
            f"{name}, simple spread",
            _algorithm(name, plan, budget),
            None,
            plan.runs,
            frames=plan.frames,
        )
        for name in LEARNERS
    ]


def _algorithm(name: str, plan: Plan, budget: str) -> OffPolicy:
    learner = LEARNERS[name](
        critic=JointCritic(Critic(hidden=(128, 128))),
        signal="local",
        gamma=0.95,
        noise=GaussianNoise(0.2),
        batch_size=256,
    )
    algorithm = OffPolicy.matd3(
        SimpleSpread(),
        Team(trunk=(128, 128), activation="relu"),
        learner=learner,
        episodes=20,
        updates_per_frame=plan.updates_per_frame,
        replay_capacity=1_000_000,
        test_every=20_000,
        test_episodes=100,
    )
    return chapter7.shrunk(algorithm) if budget == "smoke" else algorithm


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    return {name: chapter7.outcome(name, cell, EPISODES, random) for name, cell in runs.items()}


def random(env: SimpleSpread) -> dict[str, float]:
    """Mean return of actions drawn uniformly."""
    anybody = tree.stack(planner.RandomTeam(env.agents))
    played = evaluate(env, anybody, EPISODES, key=jax.random.key(21_000))
    return {"random": round(float(np.mean(played.of("global"))), 2)}


def sections(measured: dict[str, Any]) -> list[Any]:
    any_cell = next(iter(measured.values()))
    figure = Figure(
        "simple_spread",
        "frames",
        "return of the actor, mean per agent",
        [Curve(cell["method"], cell["frames"], cell["score"]) for cell in measured.values()],
        references=(
            Reference("random", any_cell["reference"]["random"]),
            Reference("a script", -7.5),
        ),
    )
    table = Table(
        "Return per episode, mean over agents",
        ["method", "floor: random", "published", "to be beaten", "ours, median (range)", "frames"],
        [
            [
                cell["method"],
                cell["reference"]["random"],
                PUBLISHED_SCORES[cell["method"]],
                BOUNDS[cell["method"]],
                middle(cell["final"]),
                f"{np.mean(cell['played']):,.0f}",
            ]
            for cell in measured.values()
        ],
        caption=f"Ours: {EPISODES} fresh episodes without noise.",
    )
    words = (
        "The task is SimpleSpread, a JAX version that matches mpe2's simple_spread_v3 step for "
        "step. A frame is one joint step; an update moves all three agents. Published numbers are "
        "of other code and more frames."
    )
    return [figure, table, Text("How to read it", [words])]
