"""memory-learned: who learns to remember? Evolution, gradient, and both, with four networks on
three tasks that no policy without memory solves, at equal frames and updates.

- The Passive T-maze of length 100: one thing is remembered, for long.
- Recall of four directions, paid at the last step alone: several things, in order.
- A pendulum without its velocity: the last few moments count, at every step.

The learner is TD3 with the constants below, alone or beside a population that it joins every
generation; evolution is that population alone. PPO learns from fresh frames, of which it gets five
times as many. Settings were chosen on seeds from 1,000 on.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from ..algorithms.ppo import PPO
from ..environments.gymnasium import Gymnasium
from ..environments.hidden import hidden
from ..environments.passive_tmaze import PassiveTMaze
from ..environments.sequence_recall import SequenceRecall
from ..environments.wrappers import delayed
from ..learners.share import Fixed
from ..learners.td3 import TD3
from ..networks.base import AbstractNetwork
from ..networks.exploration import GaussianNoise
from ..networks.mlp import MLP, Critic
from ..networks.mmu import MMU
from ..networks.recurrent import Recurrent
from ..replay import Sampling
from . import measures
from .base import Cell, Experiment, Trained, grid
from .plans import Plan
from .views import Curves, Improvement, Table, mean

UNITS = 32
NETWORKS: dict[str, AbstractNetwork] = {
    "mlp": MLP(hidden=(UNITS, UNITS), initializer="fan_in"),
    "gru": Recurrent("gru", UNITS, "tanh", "fan_in", span=128),
    "lstm": Recurrent("lstm", UNITS, "tanh", "fan_in", span=128),
    "mmu": MMU(UNITS, output_activation="tanh", initializer="fan_in", start_weights="closed"),
}
TASKS: dict[str, tuple[Any, int]] = {  # and the window: an episode, or what has to be remembered
    "passive T-maze": (PassiveTMaze(length=100), 101),
    "recall": (delayed(SequenceRecall(depth=4, min_corridor=2, max_corridor=5)), 24),
    "pendulum": (hidden(Gymnasium("Pendulum-v1"), "velocities"), 64),
}
LEARNER = TD3(
    critic=Critic(hidden=(64, 64)),
    actor_lr=1e-3,
    critic_lr=1e-3,
    reward_scale=None,
    noise=GaussianNoise(0.3),
    batch_size=1024,
)
HORIZONS = (100, 1_000, 10_000)
METHODS = ("evolution", "gradient", "hybrid", "ppo")
POPULATION = 0.8  # share of the hybrid's frames that are the population's
FRESH = 5  # frames of PPO for each of the others
EPISODES = 40  # of PPO between updates
PLANS = {
    "smoke": Plan(1_500, 2, 0.02),
    "quick": Plan(30_000, 1, 0.25),
    "full": Plan(100_000, 3, 0.25),
}


def algorithm(
    task: str, network: str, method: str, updates: float = 0.25, first: int = 2_000
) -> Any:
    """What trains a network on a task, with so many `updates` per frame behind the `first` ones."""
    env, window = TASKS[task]
    net = NETWORKS[network]
    if isinstance(net, MMU) and isinstance(env, PassiveTMaze):
        net = replace(net, start_weights="latched")  # nothing is seen in the corridor
    if method == "ppo":
        rows = {"window": window, "batch_size": 8 * window, "horizon": EPISODES * env.max_steps}
        rows |= {"copies": EPISODES, "learning_rate": 1e-3, "test_episodes": 20}
        return PPO(env, net, **rows)
    sampling = Sampling(window=window, burn_in=0 if task != "pendulum" else 16)
    shared: dict[str, Any] = {"sampling": sampling, "replay_capacity": 100_000}
    shared |= {"updates_per_frame": updates, "test_episodes": 20}
    if method == "gradient":
        own = {"learner": LEARNER, "episodes": 1, "start_frames": first, "test_every": 2_000}
        return OffPolicy(env, net, **own, **shared)
    how: dict[str, Any] = {"redistribute": None, "horizon": None, "warmup_frames": first}
    learns = method == "hybrid"
    share = Fixed(1 - POPULATION) if learns else None
    how |= {"learners": (LEARNER,) if learns else (), "share": share}
    return ERL.hybrid(env, net, **how, **shared)


def cells(budget: str) -> list[Cell]:
    """Every network by every method on every task; at smoke two networks on the shortest task."""
    small, plan = budget == "smoke", PLANS[budget]
    tasks, networks = (["recall"], ["mlp", "gru"]) if small else (TASKS, NETWORKS)
    how: Any = {"updates": plan.updates_per_frame, "first": 200 if small else 2_000}
    return [
        Cell(
            x,
            algorithm(**x, **how),
            range(plan.runs),
            frames=plan.frames * (FRESH if x["method"] == "ppo" else 1),
        )
        for x in grid(task=tasks, network=networks, method=METHODS)
    ]


def horizons(cell: Trained) -> Iterable[Any]:
    """Success of the final champions of the T-maze in longer corridors, without more training."""
    if not isinstance(cell.env, PassiveTMaze):
        return
    for length in HORIZONS:
        longer = replace(cell.env, length=length)
        played = measures.returns(longer, cell.champions, 100)
        yield from cell.part(length=length).rows("horizon", played.mean(axis=1), 3)


def final(cell: Trained) -> Iterable[Any]:
    """What the task reports, of the final champions: a share of successes, or the pendulum's
    return."""
    return measures.final("final champion", 100, each=False)(cell)


FINAL = Table(
    "Success, or of the pendulum the return",
    ["task", "network", "method"],
    {"final champion": mean("final champion"), "last test": mean("last test")},
)
LONGER = Table(
    "Success in longer corridors",
    ["network", "method", "length"],
    {"success": mean("horizon")},
)
VIEWS: Sequence[Any] = (
    Curves("test score", "frames", ["method"], ["task", "network"]),
    FINAL,
    LONGER,
    Improvement("hybrid", "final champion", ["task", "network"], "Is both better than either?"),
)
EXPERIMENTS = {
    "memory-learned": Experiment(
        cells,
        (final, measures.scores(), measures.last_tests, measures.effort, horizons),
        VIEWS,
        PLANS,
    )
}
