"""Figure 5.3: ERL, EA and DDPG on six tasks. Also what all experiments on MuJoCo share: tasks,
budgets, measurements, the table of scores, and what to know before comparing."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from ..algorithms.ppo import PPO
from ..environments.gymnasium import Gymnasium
from ..environments.wrappers import delayed as with_delay
from ..report.rows import Labels, Results
from . import measures
from .base import Cell, Experiment, Value
from .small import shrunk
from .views import Curves, Notes, Of, Table, known, mean, plain, published, where

BUDGETS = ("smoke", "quick", "full", "million", "published")
TASKS = ("HalfCheetah-v5", "Swimmer-v5", "Reacher-v5", "Ant-v5", "Hopper-v5", "Walker2d-v5")
STAND_IN = "InvertedPendulum-v5"  # for every task at smoke, with tiny networks
METHODS = {"erl": ERL.erl, "ea": ERL.ea, "ddpg": OffPolicy.ddpg, "ppo": PPO.ppo}


class Plan(NamedTuple):
    """The runs of a cell."""

    frames: int
    runs: int
    updates_per_frame: float = 1.0


PLANS = {
    "smoke": Plan(600, 2),
    "quick": Plan(50_000, 2, 0.25),
    "full": Plan(300_000, 2),
    "million": Plan(1_000_000, 5),
    "published": Plan(2_000_000, 5),
}
PLANS_OF_TASKS = {
    ("full", "Swimmer-v5"): Plan(500_000, 3, 0.1),
    ("full", "Humanoid-v5"): Plan(100_000, 2),
    # Hopper has 4M in chapter 5, and 5M and 1.5M in chapter 6: runs of 5M hold them all.
    ("published", "Hopper-v5"): Plan(5_000_000, 5),
    ("published", "Ant-v5"): Plan(6_000_000, 5),
    ("published", "Walker2d-v5"): Plan(8_000_000, 5),
    ("published", "Humanoid-v5"): Plan(1_000_000, 5),
}
TD3_FULL_RUNS = 3

# Scores of others, final evaluations at 1M frames.
TD3_1M = {"HalfCheetah": 9567.0, "Hopper": 3391.0, "Walker2d": 4413.0, "Ant": 4243.0}
ERL_1M = {"HalfCheetah": 8684.0, "Hopper": 2288.0, "Walker2d": 2188.0, "Ant": 3716.0}
FLASHSAC_1M = {"HalfCheetah": 14465.0, "Hopper": 4064.0, "Walker2d": 7346.0, "Ant": 7590.0}
OTHERS = {
    "TD3, 1M frames": ("its authors, 10 seeds, v1 of the tasks", TD3_1M),
    "ERL rerun, 1M frames": ("a later paper, v2", ERL_1M | {"Swimmer": 350.0}),
    "FlashSAC, 1M frames": ("its authors, 5 seeds, v4", FLASHSAC_1M | {"Humanoid": 12606.0}),
}
BOUNDS = {
    "Reacher": (0.0, "every reward is a cost"),
    "InvertedPendulum": (1000.0, "1 per step"),
    # The tip's goal is 2 - 1.2 above its reach.
    "InvertedDoublePendulum": (9360.0, "10 per step, less the tip's squared distance to its goal"),
}
VERSIONS = {
    "HalfCheetah": "its reward is that of v2",
    "Swimmer": "its reward is that of v2",
    "Reacher": "the distance is paid after the step instead of before it, and one number of the "
    "observation that was always 0 is gone",
    "Ant": "no bonus is paid for the step of a fall, contact forces are observed and always cost",
    "Hopper": "no bonus is paid for the step of a fall",
    "Walker2d": "no bonus is paid for the step of a fall, and both feet have the same friction",
    "Pendulum": "the published numbers are of the same version",
    "InvertedPendulum": "nothing is paid for the step of the fall",
    "InvertedDoublePendulum": "no bonus is paid for the step of the fall, and two numbers of the "
    "observation that were always 0 are gone",
    "Humanoid": "no bonus is paid for the step of a fall, contacts cost, and numbers of the "
    "observation that were always 0 are gone",
}


REFERENCES = [
    Value(score, title, source, {"task": f"{task}-v5"})
    for title, (source, scores) in OTHERS.items()
    for task, score in scores.items()
] + [Value(bound, "upper bound", why, {"task": f"{t}-v5"}) for t, (bound, why) in BOUNDS.items()]


# ------------------------------------------------------------------------------------------ cells


def tasks(budget: str, of: tuple[str, ...] = TASKS) -> tuple[str, ...]:
    """The tasks of an experiment at a budget."""
    return {"smoke": (STAND_IN,), "quick": of[:2]}.get(budget, of)


def plan(budget: str, task: str) -> Plan:
    """The runs of most cells."""
    return PLANS_OF_TASKS.get((budget, task), PLANS[budget])


def cell(
    method: str,
    build: Callable[..., Any],
    task: str,
    budget: str,
    *,
    labels: Labels | None = None,
    delayed: bool | None = None,
    planned: Plan | None = None,
    generations: int | None = None,
    stop_at: float | None = None,
    first_seed: int = 0,
    **overrides: Any,
) -> Cell:
    """Runs of what `build(env, **overrides)` makes. `labels`: what tells it from others of the
    method. `delayed`: whether rewards are paid at the end of an episode, where cells differ in it.
    """
    runs = planned or plan(budget, task)
    env: Any = with_delay(Gymnasium(task)) if delayed else Gymnasium(task)
    algorithm = build(env, **overrides)
    if hasattr(algorithm, "updates_per_frame"):
        algorithm = dataclasses.replace(algorithm, updates_per_frame=runs.updates_per_frame)
    if budget == "smoke":
        algorithm = shrunk(algorithm)
    told = {"method": method, **(labels or {}), "task": task}
    told |= {} if delayed is None else {"delayed": delayed}
    seeds = range(first_seed, first_seed + runs.runs)
    return Cell(told, algorithm, seeds, generations, runs.frames, stop_at)


def td3(task: str, budget: str) -> Cell:
    """TD3 with the constants of its authors, alone."""
    chosen = plan(budget, task)
    if budget == "full":
        chosen = chosen._replace(runs=TD3_FULL_RUNS)
    return cell("td3", OffPolicy.td3, task, budget, planned=chosen)


def td3_gamma(task: str, budget: str, gamma: float) -> Cell:
    """The same at another discount."""
    if gamma == 0.99:
        return td3(task, budget)
    learner = dataclasses.replace(OffPolicy.td3(Gymnasium(task)).learner, gamma=gamma)
    labels = {"gamma": gamma}
    return cell("td3", OffPolicy.td3, task, budget, labels=labels, learner=learner)


def cells(budget: str) -> list[Cell]:
    """Every method on every task; on Swimmer also TD3 with a longer view."""
    found = [
        cell(method, build, task, budget)
        for task in tasks(budget)
        for method, build in METHODS.items()
    ]
    long_view = "Swimmer-v5" in tasks(budget)
    return [*found, td3_gamma("Swimmer-v5", budget, 0.9999)] if long_view else found


# ----------------------------------------------------------------------------- measures and views

TESTS = (measures.last_tests, measures.effort, measures.of_task(measures.random_actions))
MEASURES = (measures.final(), measures.scores(), *TESTS)


VARIANTS = ("method", "gamma", "exploration", "manager")  # what lines and rows differ in


def curves(**levels: Of) -> Curves:
    """The champions' tests as they were logged, a figure for each task."""
    return Curves(
        "test score",
        "frames",
        VARIANTS,
        ["task"],
        y_label="return of the champion",
        levels={"random policy": known("random")} | levels,
    )


def table(caption: str = "", references: bool = True) -> Table:
    """Scores of every cell, beside a random policy, what was published, what others reached
    (`references`) and an upper bound."""
    others = (*OTHERS, "upper bound") if references else ("upper bound",)
    return Table(
        "Return",
        ["task", "delayed", *VARIANTS],
        {
            "random policy": known("random"),
            "published": published("return"),
            "final champion": mean("return"),
            "median": plain("return", of=np.median),
            "last test": mean("last test"),
            "last test, smoothed": plain("last test, smoothed"),
            "frames": plain("frames"),
            "updates per frame": plain("updates per frame"),
            **{title: published(title) for title in others},
        },
        caption="Final champion: 10 fresh episodes without noise. Last test: the "
        f"published protocol, as logged; smoothed over {measures.SMOOTHED} generations, as the "
        "author did (of a learner alone, a generation is an episode). "
        f"Random policy: actions drawn uniformly, mean of 100 episodes. {caption}".strip(),
    )


def versions(results: Results) -> str:
    """How the tasks of a page differ from those of the dissertation."""
    names = [task.partition("-")[0] for task in results.levels("task")]
    told = "; ".join(f"{name}: {VERSIONS[name]}" for name in names)
    return (
        f"The dissertation used v2 of the tasks. Here {told}. Scores of different versions are "
        "near, not equal."
    )


def stand_in(results: Results) -> str | None:
    """What smoke pages are about."""
    if results.budget == "smoke":
        return f"{STAND_IN} with tiny networks stands in for the published tasks."
    return None


def notes(*paragraphs: Any) -> Notes:
    """What to know before comparing: versions, frames, stand-ins."""
    frames = (
        "Frames are the environment steps of population and learners together; those of tests are "
        "not counted. A run that has ended keeps its last score in the figures."
    )
    return Notes([stand_in, frames, versions, *paragraphs])


SWIMMER = where(
    "That only evolution solves Swimmer is a matter of the discount: at 0.99 a stroke pays too "
    "late. The row with gamma 0.9999 shows what a learner alone does with a longer view (published "
    "elsewhere: 359 at 1M frames).",
    gamma=0.9999,
)
EXPERIMENT = Experiment(
    published="Figure 5.3 of the dissertation (curves without numbers): ERL beats DDPG on all six "
    "tasks, EA on all but Swimmer, where they are equal, and PPO on four of six.",
    budgets=BUDGETS,
    cells=cells,
    measures=MEASURES,
    values=REFERENCES,
    views=(
        curves(),
        table(),
        notes(
            "DDPG has the learner of ERL, alone, with the same networks, batch and updates per "
            "frame, after 1,000 frames of random actions; EA is the evolution of ERL, alone. The "
            "dissertation's DDPG and PPO were those of OpenAI Baselines. PPO here does not "
            "normalise observations and rewards, which theirs does: it is a lower line.",
            SWIMMER,
        ),
    ),
)
