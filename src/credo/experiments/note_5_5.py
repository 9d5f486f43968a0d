"""Note on runtime of section 5.5: what evolution adds to the time of a learner."""

from typing import Any

import numpy as np

from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from ..analysis import attribution
from ..report.sections import Table
from ..runs import log
from ..runs.store import Run
from . import chapter5
from .base import Cell
from .chapter5 import Plan

TITLE = "time of ERL over that of DDPG"
PUBLISHED = (
    "Section 5.5 of the dissertation: ERL took about 3 % more time than DDPG, most of it mutation."
)
PLANS = {"smoke": Plan(600, 2), "quick": Plan(60_000, 2), "full": Plan(200_000, 3)}
TASK = "HalfCheetah-v5"  # its episodes have the same length for everybody
NEVER = 2**31 - 1
WARM = 0.25  # of the frames: what is compiled is compiled by then


def cells(budget: str) -> list[Cell]:
    """Both without tests but the first: their tests differ in number."""
    (task,) = chapter5.tasks(budget, (TASK,))
    kinds = {"erl untested": ERL.erl, "ddpg untested": OffPolicy.ddpg}
    return [
        chapter5.cell(
            label,
            build,
            task,
            budget,
            planned=PLANS[budget],
            test_every=NEVER,
        )
        for label, build in kinds.items()
    ]


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    return {
        name: {
            "task": chapter5.task_of(cell[0].algorithm.env),
            "label": chapter5.label_of(name),
            **{
                key: attribution.plain([rate[key] for rate in map(rates, cell)], 6)
                for key in ("seconds per 1000 frames", "updates per frame", "seconds", "frames")
            },
        }
        for name, cell in runs.items()
    }


def rates(run: Run) -> dict[str, float]:
    """Time and updates per frame after the first quarter of a run."""
    metrics, timing = run.metrics, log.read(run.path / "timing.csv")
    # A line of the clock may stand for several generations; it has the time after the last.
    rows = np.searchsorted(metrics["generation"], timing["generation"])
    columns = metrics["frames"], np.cumsum(metrics["updates"])
    frames, updates = (np.append(0.0, column[rows]) for column in columns)
    seconds = np.append(0.0, timing["seconds"])
    first = min(int(np.searchsorted(frames, WARM * frames[-1])), len(rows) - 1)
    played = frames[-1] - frames[first]
    return {
        "seconds per 1000 frames": 1000 * (seconds[-1] - seconds[first]) / played,
        "updates per frame": (updates[-1] - updates[first]) / played,
        "seconds": seconds[-1],
        "frames": frames[-1],
    }


def sections(measured: dict[str, Any]) -> list[Any]:
    rows = [
        [
            cell["task"],
            cell["label"].removesuffix(" untested"),
            chapter5.spread(cell["frames"]),
            chapter5.spread(cell["updates per frame"]),
            chapter5.spread(cell["seconds"]),
            chapter5.spread(cell["seconds per 1000 frames"]),
        ]
        for cell in measured.values()
    ]
    return [
        Table(
            "Time, mean ± standard deviation over runs",
            ["task", "algorithm", "frames", "updates per frame", "seconds", "s per 1000 frames"],
            rows,
            caption="Updates and time per frame after the first quarter of each run, so that "
            "compiling does not count.",
        ),
        *([extra(measured)] if len(measured) == 2 else []),
        chapter5.about(measured),
    ]


def extra(measured: dict[str, Any]) -> Table:
    time = {cell["label"]: np.array(cell["seconds per 1000 frames"]) for cell in measured.values()}
    added = 100 * (time["erl untested"] / time["ddpg untested"] - 1)
    return Table(
        "Extra time of ERL",
        ["published, %", "measured, %", "each seed, %"],
        [["+3", chapter5.spread(added), ", ".join(f"{x:+.1f}" for x in added)]],
        caption="Wall clock, seeds paired. Whatever else runs on the machine is in it: use "
        "--jobs 1 on an idle one. The population plays its episodes side by side, DDPG one at a "
        "time.",
    )
