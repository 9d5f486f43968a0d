"""Figure 5.2: the double pendulum, and the same paid only at the end of an episode."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from ..report.rows import Results, Row, rows
from . import measures
from .base import Cell, Experiment, Trained, Value
from .fig_5_3 import REFERENCES, TESTS, Plan, cell, curves, notes, table
from .views import Table, count, published

TASK, SOLVED = "InvertedDoublePendulum-v5", 9000.0  # mean return of the champion's test
# A test of ten episodes passes champions that fall in every fifth world; runs go on until at most
# one world of a hundred is lost.
TEST, STOP = 100, 9200.0
METHODS = {  # the kind, and how it is built
    "erl": ("erl", ERL.erl),
    "erl ours": ("erl", ERL.ours),
    "ddpg": ("ddpg", OffPolicy.ddpg),
    "ddpg spread": ("ddpg", functools.partial(OffPolicy.ddpg, redistribute=True)),
    "ea": ("ea", ERL.ea),
}
# An episode is a few steps long until the task is nearly solved: episodes end most runs, frames
# those that hold the pendulum up for long and never quite solve the task.
LIMITS = {  # (frames, generations); of 11, 1 and 10 episodes
    "smoke": {"erl": (600, 10), "ddpg": (600, 100), "ea": (600, 10)},
    "quick": {"erl": (60_000, 200), "ddpg": (60_000, 2_000), "ea": (200_000, 500)},
    "full": {"erl": (1_500_000, 909), "ddpg": (1_500_000, 10_000), "ea": (5_000_000, 2_500)},
}
RARELY: dict[str, Any] = {"test_every": 10}  # generations
FRESH = 300  # ours was chosen by looking at other seeds of the hard task
RUNS = {"smoke": 2, "quick": 2, "full": 3, "published": 5}


def cells(budget: str) -> list[Cell]:
    """Every method on both tasks; redistribution matters only on the hard one."""
    limits = LIMITS.get(budget, LIMITS["full"])
    return [
        cell(
            method,
            build,
            TASK,
            budget,
            delayed=delayed,
            planned=Plan(limits[kind][0], RUNS[budget], 2.0 if method == "erl ours" else 1.0),
            generations=limits[kind][1],
            stop_at=STOP,
            first_seed=FRESH if method == "erl ours" else 0,
            test_episodes=TEST,
            **(RARELY if kind == "ea" else {}),
        )
        for delayed in (False, True)
        for method, (kind, build) in METHODS.items()
        if delayed or method != "ddpg spread"
    ]


def played(cell: Trained) -> list[Row]:
    """Episodes of each run."""
    counts = [int(measures.over(run, "episodes")[-1]) for run in cell.runs]
    return rows("episodes", counts, cell.labels, seed=cell.seeds)


def after(results: Results, values: Sequence[Value]) -> str | None:
    """When each run solved the task."""
    solved, ended = results.by_seed("solved after"), results.by_seed("episodes")
    told = [
        f"{n:,}" if n is not None else f"not in {ended[seed][0]:,}" for seed, (n,) in solved.items()
    ]
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
EPISODE_CURVES = dataclasses.replace(
    curves(solved=lambda results, values: SOLVED), x="episodes", panel=()
)


def values() -> list[Value]:
    """Read from the figure."""
    standard = {"erl": "< 3,000", "ddpg": "< 3,000", "ea": "~22,000"}
    hard = {"erl": "~10,000", "erl ours": "~10,000", "ddpg": "fails", "ea": "~22,000"}
    return [
        Value(text, "episodes", "the figure", {"method": method, "delayed": delayed})
        for delayed, given in ((False, standard), (True, hard))
        for method, text in given.items()
    ]


EXPERIMENT = Experiment(
    published="Figure 5.2 of the dissertation: ERL and DDPG solve the standard task in fewer than "
    "3,000 episodes and EA in about 22,000; of the hard one, which pays the whole return at the "
    "last step, ERL needs about 10,000 episodes, EA 22,000, and DDPG fails.",
    budgets=("smoke", "quick", "full", "published"),
    cells=cells,
    measures=(
        measures.first("solved after", SOLVED, "episodes"),
        played,
        measures.final(),
        measures.scores("episodes"),
        *TESTS,
    ),
    values=[*REFERENCES, *values()],
    views=(
        dataclasses.replace(EPISODE_CURVES, title="Standard task", where={"delayed": False}),
        dataclasses.replace(
            EPISODE_CURVES, title="Hard task, paid at the last step", where={"delayed": True}
        ),
        EPISODES,
        table(references=False),
        notes(
            "Episodes count those of the whole population and of its learner. A run ends when the "
            f"mean return of its champion's test reaches {STOP:,.0f} ({TEST} episodes), or "
            "at its limit. DDPG is tested every 5,000 frames only, EA every tenth generation, ERL "
            "every generation. Learners of `erl ours` and `ddpg spread` see the return of an "
            "episode in equal parts over its frames; the task still pays it at the end, and "
            "fitness is what the task paid.",
        ),
    ),
)
