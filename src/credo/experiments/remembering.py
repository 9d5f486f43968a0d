"""What memory is good for, by gradient, on tasks that are known for something else.

- memory-velocities: TD3 on HalfCheetah and Hopper, with the whole state, and without velocities by
  a network with memory and by one without. All have the same updates per frame, of as many frames.
- memory-teams: the Extended T-Maze with two robots that learn and the server fleet of chapter 4,
  by MERL whose learner has memory too, beside its evolution alone at equal frames. Both tasks pay
  the team alone, so the learner has the team's reward; in the T-maze robots also have their
  difference reward. The fleet is a small one: 4 servers and 8 devices, 3 to 5 of them nefarious.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from ..algorithms.merl import LOCAL, MERL
from ..algorithms.off_policy import OffPolicy
from ..environments.extended_tmaze import ExtendedTMaze
from ..environments.gymnasium import Gymnasium
from ..environments.hidden import hidden
from ..environments.server_fleet import ServerFleet
from ..learners.td3 import TD3
from ..networks.base import AbstractNetwork
from ..networks.dmmu import DMMU
from ..networks.mlp import MLP
from ..networks.recurrent import Recurrent
from ..networks.team import Team
from ..replay import Sampling
from . import measures
from .base import Cell, Experiment, grid
from .plans import Plan
from .views import Curves, Table, mean

BATCH = 1_024  # frames of an update, of windows of 64
SEEN: dict[str, tuple[bool, AbstractNetwork]] = {  # whether velocities are hidden, and who acts
    "whole state, mlp": (False, MLP(hidden=(256, 256), initializer="uniform")),
    "no velocities, mlp": (True, MLP(hidden=(256, 256), initializer="uniform")),
    "no velocities, gru": (True, Recurrent("gru", 64, "tanh", "fan_in", span=32)),
}
PLANS = {
    "smoke": Plan(1_500, 1, 0.02),
    "quick": Plan(50_000, 1, 0.25),
    "full": Plan(100_000, 3, 0.25),
}
TEAM_PLANS = {
    "smoke": Plan(600, 1, 0.05),
    "quick": Plan(50_000, 1, 0.1),
    "full": Plan(200_000, 3, 0.1),
}


def velocities(budget: str) -> list[Cell]:
    """TD3 on two tasks, seeing three different things; at smoke on one of them, of few frames."""
    plan, small = PLANS[budget], budget == "smoke"
    tasks = ("HalfCheetah-v5", "Hopper-v5")
    tests: Any = {"start_frames": 200, "test_episodes": 2} if small else {"test_episodes": 10}
    cells = []
    for labels in grid(task=tasks[small:], seen=SEEN):
        hides, network = SEEN[str(labels["seen"])]
        env = Gymnasium(str(labels["task"]))
        algorithm = OffPolicy(
            hidden(env, "velocities") if hides else env,
            network,
            learner=TD3(batch_size=BATCH),
            updates_per_frame=plan.updates_per_frame,
            sampling=Sampling(window=64, burn_in=16),
            **tests,
        )
        cells.append(Cell(labels, algorithm, range(plan.runs), frames=plan.frames))
    return cells


def _team(task: str, network: str) -> tuple[Any, AbstractNetwork, str]:
    """A task, who acts there, and the reward that a learner maximises."""
    shared = DMMU(hidden=20, initializer="fan_in")
    private = Team(
        trunk=(), head=Recurrent("gru", 20, "tanh", "fan_in", span=32), sharing="nothing"
    )
    actor = shared if network == "dmmu" else private
    if task == "server fleet":
        return ServerFleet(servers=4, devices=8, nefarious=(3, 5)), actor, "net"
    maze = ExtendedTMaze(
        2, robots=2, objective="spread", partner=None, rewards=("score", "difference")
    )
    return maze, actor, "difference"


def teams(budget: str) -> list[Cell]:
    """Both tasks, shared and private memory, evolution alone and MERL."""
    plan, cells = TEAM_PLANS[budget], []
    small = {"population_size": 5, "episodes": 1, "workers": 2, "warmup_frames": 50}
    for labels in grid(
        task=("T-maze", "server fleet"), network=("dmmu", "gru"), method=("evolution", "merl")
    ):
        env, network, signal = _team(str(labels["task"]), str(labels["network"]))
        learner = replace(LOCAL, signal=signal, batch_size=BATCH)
        algorithm = MERL.merl(
            env,
            network,
            learners=(learner,) if labels["method"] == "merl" else (),
            updates_per_frame=plan.updates_per_frame,
            **(small if budget == "smoke" else {"workers": 10}),
        )
        cells.append(Cell(labels, algorithm, range(plan.runs), frames=plan.frames))
    return cells


MEASURES = (
    measures.final("final champion", 100, each=False),
    measures.scores(),
    measures.last_tests,
    measures.effort,
)
COLUMNS = {"final champion": mean("final champion"), "last test": mean("last test")}
VELOCITY_VIEWS: Sequence[Any] = (
    Curves("test score", "frames", ["seen"], ["task"]),
    Table("Return", ["task", "seen"], COLUMNS),
)
TEAM_VIEWS: Sequence[Any] = (
    Curves("test score", "frames", ["method"], ["task", "network"]),
    Table("What the task reports", ["task", "network", "method"], COLUMNS),
)
EXPERIMENTS = {
    "memory-velocities": Experiment(velocities, MEASURES, VELOCITY_VIEWS, PLANS),
    "memory-teams": Experiment(teams, MEASURES, TEAM_VIEWS, TEAM_PLANS),
}
