"""Check of the other learners: DDPG and SAC alone (and TD3 beside them) on two cheap tasks.

Not in the dissertation. Settings and published returns are those of RL Baselines3 Zoo for
Pendulum-v1 at 20,000 frames; on InvertedPendulum-v5, which pays 1 per step, the upper bound of
1,000 is what to compare with. `full` has 3 runs, `published` 10 of the same frames.
"""

import dataclasses
from typing import Any

from ..algorithms.off_policy import OffPolicy
from ..learners.base import AbstractLearner
from ..learners.sac import SAC
from ..learners.td3 import TD3, TD3_NETWORK, ddpg
from ..networks.exploration import GaussianNoise
from ..networks.mlp import MLP, Critic
from .base import Cell, Experiment
from .mujoco import MEASURES, TABLE, cell, curves
from .plans import Plan
from .views import published

SWING, BALANCE = "Pendulum-v1", "InvertedPendulum-v5"
PLANS = {  # frames of either task, and runs
    "smoke": (600, 600, 2),
    "quick": (10_000, 10_000, 2),
    "full": (20_000, 30_000, 3),
    "published": (20_000, 30_000, 10),
}
LARGE = Critic(hidden=(400, 300))
FAST: dict[str, Any] = {"gamma": 0.98, "actor_lr": 1e-3, "critic_lr": 1e-3}


def learners() -> dict[str, tuple[AbstractLearner, MLP, int]]:
    """Learner, network and random frames at the start, as the Zoo has them for Pendulum-v1."""
    large = dataclasses.replace(TD3_NETWORK, hidden=(400, 300))
    alike: dict[str, Any] = FAST | {"critic": LARGE, "noise": GaussianNoise(0.1)}
    unclipped = {"tau": 5e-3, "actor_max_norm": None, "critic_max_norm": None, "actor_scale": 1.0}
    return {
        "ddpg": (ddpg(**alike, **unclipped, batch_size=256), large, 10_000),
        "sac": (SAC(actor_lr=1e-3, critic_lr=1e-3, alpha_lr=1e-3), TD3_NETWORK, 100),
        "td3": (TD3(**alike), large, 10_000),
    }


def cells(budget: str) -> list[Cell]:
    """Each learner on both tasks."""
    swing, balance, runs = PLANS[budget]
    return [
        cell(
            f"{name} alone",  # the same learners have other settings elsewhere
            OffPolicy.td3,
            task,
            budget,
            runs=Plan(frames, runs),
            network=network,
            learner=learner,
            start_frames=min(start if task == SWING else 1_000, frames // 2),
            test_every=1_000,
        )
        for name, (learner, network, start) in learners().items()
        for task, frames in ((SWING, swing), (BALANCE, balance))
    ]


LEVELS = {f"{x}, Zoo": published("return", number=True, method=f"{x} alone") for x in learners()}
LEVELS["upper bound"] = published("upper bound")
VIEWS = (curves(**LEVELS), TABLE)
EXPERIMENTS = {"check-learners": Experiment(cells, MEASURES, VIEWS, PLANS)}
