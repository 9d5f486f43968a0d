"""Figure 5.3: ERL, EA and DDPG on six tasks. Also what all experiments on MuJoCo share: tasks,
budgets, measurements and the table of scores."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from ..algorithms.ppo import PPO
from ..environments.gymnasium import Gymnasium
from ..environments.wrappers import delayed as with_delay
from ..report.rows import Labels
from . import measures
from .base import Cell, Experiment
from .dissertation import notes, told
from .small import shrunk
from .views import Curves, Of, Table, known, mean, plain, published

BUDGETS = ("smoke", "quick", "full", "million", "published")
TASKS = ("HalfCheetah-v5", "Swimmer-v5", "Reacher-v5", "Ant-v5", "Hopper-v5", "Walker2d-v5")
STAND_IN = "InvertedPendulum-v5"  # for every task at smoke, with tiny networks
METHODS = {"erl": ERL.erl, "ea": ERL.ea, "ddpg": OffPolicy.ddpg, "ppo": PPO.ppo}


class Plan(NamedTuple):
    """The runs of a cell."""

    frames: int
    runs: int
    updates_per_frame: float = 1.0


PLANS: dict[Any, Plan] = {  # by budget; by budget and task where that has one of its own
    "smoke": Plan(600, 2),
    "quick": Plan(50_000, 2, 0.25),
    "full": Plan(300_000, 2),
    "million": Plan(1_000_000, 5),
    "published": Plan(2_000_000, 5),
    ("full", "Swimmer-v5"): Plan(500_000, 3, 0.1),
    ("full", "Humanoid-v5"): Plan(100_000, 2),
    # Hopper has 4M in chapter 5, and 5M and 1.5M in chapter 6: runs of 5M hold them all.
    ("published", "Hopper-v5"): Plan(5_000_000, 5),
    ("published", "Ant-v5"): Plan(6_000_000, 5),
    ("published", "Walker2d-v5"): Plan(8_000_000, 5),
    ("published", "Humanoid-v5"): Plan(1_000_000, 5),
}


def tasks(budget: str, of: tuple[str, ...] = TASKS) -> tuple[str, ...]:
    """The tasks of an experiment at a budget."""
    return {"smoke": (STAND_IN,), "quick": of[:2]}.get(budget, of)


def plan(budget: str, task: str) -> Plan:
    """The runs of most cells."""
    return PLANS.get((budget, task), PLANS[budget])


def cell(
    method: str,
    build: Callable[..., Any],
    task: str,
    budget: str,
    *,
    labels: Labels | None = None,
    delayed: bool | None = None,
    planned: Plan | None = None,
    first_seed: int = 0,
    ends: dict[str, Any] | None = None,
    **fields: Any,
) -> Cell:
    """Runs of what `build(env, **fields)` makes. `labels`: what tells it from others of the method.
    `delayed`: whether rewards are paid at the end of an episode, where cells differ in it. `ends`:
    other limits of a run than frames."""
    runs = planned or plan(budget, task)
    env: Any = with_delay(Gymnasium(task)) if delayed else Gymnasium(task)
    algorithm = build(env, **fields)
    if hasattr(algorithm, "updates_per_frame"):
        algorithm = dataclasses.replace(algorithm, updates_per_frame=runs.updates_per_frame)
    if budget == "smoke":
        algorithm = shrunk(algorithm)
    told = {"method": method, **(labels or {}), "task": task}
    told |= {} if delayed is None else {"delayed": delayed}
    seeds = range(first_seed, first_seed + runs.runs)
    return Cell(told, algorithm, seeds, frames=runs.frames, **(ends or {}))


def td3(task: str, budget: str, gamma: float = 0.99) -> Cell:
    """TD3 with the constants of its authors, alone, or at another discount."""
    planned = plan(budget, task)
    if gamma == 0.99:
        planned = planned._replace(runs=3) if budget == "full" else planned
        return cell("td3", OffPolicy.td3, task, budget, planned=planned)
    learner = dataclasses.replace(OffPolicy.td3(Gymnasium(task)).learner, gamma=gamma)
    return cell("td3", OffPolicy.td3, task, budget, labels={"gamma": gamma}, learner=learner)


def long_view(tasks: tuple[str, ...], budget: str) -> list[Cell]:
    """On Swimmer, TD3 with a longer view."""
    return [td3(task, budget, 0.9999) for task in tasks if task == "Swimmer-v5"]


def cells(budget: str) -> list[Cell]:
    """Every method on every task."""
    chosen = tasks(budget)
    found = [cell(x, METHODS[x], task, budget) for task in chosen for x in METHODS]
    return found + long_view(chosen, budget)


TESTS = (measures.last_tests, measures.effort, measures.of_task(measures.random_actions))
MEASURES = (measures.final(), measures.scores(), *TESTS)
VARIANTS = ("method", "gamma", "exploration", "manager")  # what lines and rows differ in


def curves(**levels: Of) -> Curves:
    """The champions' tests as they were logged, a figure for each task."""
    levels = {"random policy": known("random")} | levels
    label = "return of the champion"
    return Curves("test score", "frames", VARIANTS, ["task"], y_label=label, levels=levels)


OTHERS = ("TD3, 1M frames", "ERL rerun, 1M frames", "FlashSAC, 1M frames", "upper bound")
COLUMNS = {
    "random policy": known("random"),
    "published": published("return"),
    "final champion": mean("return"),
    "median": plain("return", of=np.median),
    "last test": mean("last test"),
    "last test, smoothed": plain("last test, smoothed"),
    "frames": plain("frames"),
    "updates per frame": plain("updates per frame"),
    **{title: published(title) for title in OTHERS},
}
TABLE = Table(
    "Return",
    ["task", "delayed", *VARIANTS],
    COLUMNS,
    caption="Final champion: 10 fresh episodes without noise. Last test: the published protocol, "
    f"as logged; smoothed over {measures.SMOOTHED} generations, as the author did (of a learner "
    "alone, a generation is an episode). Random policy: actions drawn uniformly, mean of 100 "
    "episodes.",
)
MUJOCO: dict[str, Any] = {"budgets": BUDGETS, "measures": MEASURES}
EXPERIMENT = Experiment(
    **told("fig-5.3", "mujoco"),
    **MUJOCO,
    cells=cells,
    views=(curves(), TABLE, notes("mujoco", "fig-5.3", "swimmer")),
)
