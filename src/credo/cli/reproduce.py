"""`credo reproduce EXPERIMENT`."""

import dataclasses
import pathlib
from typing import Literal

from .. import require
from ..experiments.catalogue import EXPERIMENTS
from .line import Line
from .names import fail


@dataclasses.dataclass
class Reproduce:
    """Rerun a figure or table of `credo list experiments`. What was run is not run again."""

    experiment: str
    _: dataclasses.KW_ONLY
    budget: Literal["smoke", "quick", "full", "million", "published"] = "quick"
    """smoke: seconds to minutes, proves nothing; quick: minutes; full: hours; some have million and
    published."""
    runs: int | None = None  # independent runs of each cell, at least 1; None: as the budget says
    only: str | None = None
    """Cells whose name has this regular expression, as '2-deep, fsp'; a word that is in none lists
    them. What was measured of other cells stays. None: all."""
    jobs: int | None = None  # processes, at least 1; None: one per core
    output: str = "reproduced"  # folder for the page and its data
    work: str = "runs/reproduce"  # folder for the runs behind them

    def __post_init__(self):
        require.at_least("runs", self.runs, 1)
        require.at_least("jobs", self.jobs, 1)


def run(line: Line) -> None:
    """Run what is missing, measure, and say where the page is."""
    command = line.command(Reproduce)
    line.done()
    if command.experiment not in EXPERIMENTS:
        fail(f"no experiment {command.experiment!r}", command.experiment, EXPERIMENTS)
    from ..experiments import base

    given = {name: getattr(command, name) for name in ("runs", "only", "jobs")}
    given |= {name: pathlib.Path(getattr(command, name)) for name in ("output", "work")}
    print(f"page: {base.reproduce(command.experiment, command.budget, **given)}")
