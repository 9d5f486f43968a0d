"""Note on runtime of section 5.5: what evolution adds to the time of a learner.

The dissertation says that ERL took about 3 % more time than DDPG. Both are run on HalfCheetah for
the same frames, 60,000 at quick and 200,000 at full, with one update per frame; what is compared is
seconds per frame once all is compiled. Times of a smoke run mean nothing.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from ..report import sections as page
from ..report.rows import Results, Row
from ..runs import log
from ..runs.loop import Run
from .base import Cell, Experiment, Trained, Value
from .mujoco import cell, tasks
from .plans import Plan
from .views import Table, mean, per_seed

PLANS = {"smoke": Plan(600, 2), "quick": Plan(60_000, 2), "full": Plan(200_000, 3)}
NEVER = 2**31 - 1
WARM = 0.25  # of the frames: what is compiled is compiled by then
TIME = "seconds per 1000 frames"


def cells(budget: str) -> list[Cell]:
    """Both without tests but the first: their tests differ in number. The task's episodes have the
    same length for all."""
    (task,) = tasks(budget, ("HalfCheetah-v5",))[:1]
    return [
        Cell({"method": x, "task": task, "untested": True}, c.algorithm, c.seeds, frames=c.frames)
        for x, build in {"erl": ERL.erl, "ddpg": OffPolicy.ddpg}.items()
        for c in [cell(x, build, task, budget, runs=PLANS[budget], test_every=NEVER)]
    ]


def times(cell: Trained) -> Iterable[Row]:
    """What the clock says of each run."""
    found = [rates(run) for run in cell.runs]
    for name in found[0]:
        yield from cell.rows(name, [x[name] for x in found], 6)


def rates(run: Run) -> dict[str, float]:
    """Seconds per 1,000 frames and updates per frame after the first quarter of a run; and seconds
    and frames of all of it."""
    metrics, timing = run.metrics, log.read(run.path / log.TIMING)
    # A line of the clock may stand for several generations; it has the time after the last.
    places = np.searchsorted(metrics["generation"], timing["generation"])
    columns = metrics["frames"], np.cumsum(metrics["updates"])
    frames, updates = (np.append(0.0, column[places]) for column in columns)
    seconds = np.append(0.0, timing["seconds"])
    first = min(int(np.searchsorted(frames, WARM * frames[-1])), len(places) - 1)
    played = frames[-1] - frames[first]
    return {
        TIME: 1000 * (seconds[-1] - seconds[first]) / played,
        "updates per frame": (updates[-1] - updates[first]) / played,
        "seconds": seconds[-1],
        "frames": frames[-1],
    }


def extra(results: Results, values: Sequence[Value]) -> Iterable[page.Table]:
    """Time of ERL over that of DDPG, seeds paired."""
    erl, ddpg = (per_seed(results.where(method=method), TIME) for method in ("erl", "ddpg"))
    added = {seed: 100 * (erl[seed] / ddpg[seed] - 1) for seed in erl if seed in ddpg}
    if added:
        yield page.Table(
            "Extra time of ERL, in percent",
            ["published", "measured"],
            [["+3", page.Summary(list(added.values()), list(added), digits=1)]],
            caption="Wall clock, seeds paired. Whatever else runs on the machine is in it: use "
            "--jobs 1 on an idle one. The population plays its episodes side by side, DDPG one at "
            "a time.",
        )


CLOCK = Table(
    "Time",
    ["task", "method"],
    {name: mean(name) for name in ("frames", "updates per frame", "seconds", TIME)},
    caption="Updates and time per frame after the first quarter of each run, so that compiling "
    "does not count.",
)
EXPERIMENTS = {"note-5.5": Experiment(cells, (times,), (CLOCK, extra))}
