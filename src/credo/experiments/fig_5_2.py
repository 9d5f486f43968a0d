"""Figure 5.2: the double pendulum, and the same paid only at the end of an episode."""

import functools
from typing import Any

import numpy as np

from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from ..report.sections import Reference, Table
from ..runs.store import Run
from . import chapter5
from .base import Cell
from .chapter5 import Plan

TITLE = "standard and hard inverted double pendulum"
PUBLISHED = (
    "Figure 5.2 of the dissertation: ERL and DDPG solve the standard task in fewer than 3,000 "
    "episodes and EA in about 22,000; of the hard one, which pays the whole return at the last "
    "step, ERL needs about 10,000 episodes, EA 22,000, and DDPG fails."
)
BUDGETS = ("smoke", "quick", "full", "published")
TASK, SOLVED = "InvertedDoublePendulum-v5", 9000.0  # mean return of the champion's test
# A test of ten episodes passes champions that fall in every fifth world; runs go on until at most
# one world of a hundred is lost.
TEST, STOP = 100, 9200.0
ALGORITHMS = {
    "erl": ERL.erl,
    "erl ours": ERL.ours,
    "ddpg": OffPolicy.ddpg,
    "ddpg spread": functools.partial(OffPolicy.ddpg, redistribute=True),
    "ea": ERL.ea,
}
# An episode is a few steps long until the task is nearly solved: episodes end most runs, frames
# those that hold the pendulum up for long and never quite solve the task.
LIMITS = {  # (frames, generations); of 11, 1 and 10 episodes
    "smoke": {"erl": (600, 10), "ddpg": (600, 100), "ea": (600, 10)},
    "quick": {"erl": (60_000, 200), "ddpg": (60_000, 2_000), "ea": (200_000, 500)},
    "full": {"erl": (1_500_000, 909), "ddpg": (1_500_000, 10_000), "ea": (5_000_000, 2_500)},
}
FRESH = 300  # ours was chosen by looking at other seeds of the hard task
RUNS = {"smoke": 2, "quick": 2, "full": 3, "published": 5}
GIVEN = {
    "erl": "< 3,000",
    "ddpg": "< 3,000",
    "ea": "~22,000",
    "erl delayed": "~10,000",
    "erl ours delayed": "~10,000",
    "ddpg delayed": "fails",
    "ea delayed": "~22,000",
}


def cells(budget: str) -> list[Cell]:
    limits = LIMITS.get(budget, LIMITS["full"])
    return [
        chapter5.cell(
            label,
            build,
            TASK,
            budget,
            delayed=delayed,
            planned=Plan(limits[kind][0], RUNS[budget], 2.0 if label == "erl ours" else 1.0),
            generations=limits[kind][1],
            stop_at=STOP,
            first_seed=FRESH if label == "erl ours" else 0,
            test_episodes=TEST,
            **({"test_every": 10} if kind == "ea" else {}),
        )
        for delayed in (False, True)
        for label, build in ALGORITHMS.items()
        if delayed or not label.endswith(" spread")
        for kind in (label.partition(" ")[0],)
    ]


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    measured = {}
    for name, cell in runs.items():
        found = chapter5.outcome(name, cell, axis="episodes")
        found["solved after"] = [_solved(run) for run in cell]
        found["episodes played"] = [int(_episodes(run)[-1]) for run in cell]
        measured[name] = found
    return measured


def _episodes(run: Run) -> np.ndarray:
    return chapter5.over(run, run.metrics, "episodes")


def _solved(run: Run) -> int | None:
    """Episodes played when a champion's test first reached `SOLVED`."""
    reached = np.flatnonzero(run.metrics["champion_score"] >= SOLVED)
    return int(_episodes(run)[reached[0]]) if reached.size else None


def sections(measured: dict[str, Any]) -> list[Any]:
    variants = {
        "Standard task": [cell for name, cell in measured.items() if not name.endswith("delayed")],
        "Hard task, paid at the last step": [
            cell for name, cell in measured.items() if name.endswith("delayed")
        ],
    }
    level = Reference("solved", SOLVED)
    return [
        *(
            chapter5.curves(title, cells, level, axis="episodes")
            for title, cells in variants.items()
            if cells
        ),
        solved(measured),
        chapter5.scores(measured, reference={}),
        chapter5.about(
            measured,
            "Episodes count those of the whole population and of its learner. A run ends when the "
            f"mean return of its champion's test reaches {STOP:,.0f} ({TEST} episodes), or "
            "at its limit. DDPG is tested every 5,000 frames only, EA every tenth generation, ERL "
            "every generation. "
            "Learners of `ours` and `spread` see the return of an episode in equal parts over its "
            "frames; the task still pays it at the end, and fitness is what the task paid.",
        ),
    ]


def solved(measured: dict[str, Any]) -> Table:
    rows = []
    for cell in measured.values():
        after = [
            f"{n:,}" if n is not None else f"not in {played:,}"
            for n, played in zip(cell["solved after"], cell["episodes played"], strict=True)
        ]
        count = sum(n is not None for n in cell["solved after"])
        good = sum(np.mean(np.array(run, np.float64)) >= SOLVED for run in cell["final"])
        rows.append(
            [
                cell["label"],
                GIVEN.get(cell["label"], ""),
                f"{count} of {len(after)}",
                ", ".join(after),
                f"{good} of {len(after)}",
            ]
        )
    return Table(
        "Episodes until the task was solved",
        [
            "algorithm",
            "published",
            "runs that solved it",
            "after episodes, each run",
            f"final champion has {SOLVED:,.0f} in {chapter5.EPISODES} fresh episodes",
        ],
        rows,
    )
