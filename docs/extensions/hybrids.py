"""The tables of `docs/results/hybrids.md`: each hybrid beside its parts, from what is committed.

python docs/extensions/hybrids.py      # writes them anew, after results were added
"""

import contextlib
import io
import pathlib
from collections.abc import Callable, Sequence

import numpy as np
from blocks import Block

from credo.analysis import statistics
from credo.experiments import decoys, hybrids
from credo.experiments.base import Cell, kept
from credo.experiments.rovers import SHARE
from credo.report.rows import Results

ROOT = pathlib.Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "results" / "hybrids.md"
PARTS = (hybrids.LEARNER, hybrids.EVOLUTION)
RETURN = "return"


def runs(results: Results, metric: str, **labels: str | float) -> np.ndarray:
    """The mean of each run, in the order of the seeds; of those that have one."""
    found = results.by_seed(metric, **labels)
    means = np.array([np.mean(np.asarray(found[seed], float)) for seed in sorted(found)])
    return means[np.isfinite(means)]


def number(x: float, metric: str) -> str:
    return f"{x:.2f}" if metric == SHARE else f"{x:,.0f}"


def cell(values: np.ndarray, metric: str) -> str:
    """Mean, and each run; "no data" of none."""
    if not len(values):
        return "no data"
    each = "; ".join(number(x, metric) for x in values)
    return f"**{number(values.mean(), metric)}** ({each})"


def chance(ours: np.ndarray, theirs: np.ndarray) -> str:
    """That a run of the first is better than one of the second, with its interval."""
    if len(ours) < 2 or len(theirs) < 2:
        return ""
    low, high = statistics.improvement_interval(ours, theirs)
    better = statistics.probability_of_improvement(ours, theirs)
    return f", P {better:.2f} ({low:.2f} to {high:.2f})"


def results(experiment: str, cells: Callable[[str], list[Cell]]) -> Results | None:
    """What is committed of the cells as they are today: a preset that was changed has no data."""
    path = ROOT / "results" / experiment / "full" / "results.json"
    with contextlib.redirect_stderr(io.StringIO()):
        return kept(path, cells("full"), [])


def table(
    found: Results | None,
    metric: str,
    ours: str,
    others: Sequence[str],
    rows: Sequence[tuple[str, dict[str, str | float]]],
    what: str,
) -> str:
    """A row for each place, with labels: ours, and the others with how likely ours is better."""
    lines = [f"| {' | '.join([what, ours, *others])} |", "|" + "---|" * (2 + len(others))]
    for name, labels in rows:
        values = [
            runs(found, metric, method=x, **labels) if found is not None else np.array([])
            for x in (ours, *others)
        ]
        told = [cell(x, metric) + chance(values[0], x) for x in values[1:]]
        lines.append(f"| {' | '.join([name, cell(values[0], metric), *told])} |")
    return "\n".join(lines) + "\n"


def dense() -> str:
    places = [(task, {"task": task}) for task in hybrids.TASKS]
    found = results("hybrid-dense", hybrids.dense)
    return table(found, RETURN, hybrids.HYBRID, PARTS, places, "300,000 frames")


def late() -> str:
    places = [(task, {"task": task}) for task in hybrids.TASKS]
    others = (*PARTS, hybrids.DECOMPOSED)
    return table(
        results("hybrid-late", hybrids.late),
        RETURN,
        hybrids.HYBRID,
        others,
        places,
        "500,000 frames",
    )


def shared() -> str:
    places = [
        (f"coupling {n}, misleading {share:g}", {"coupling": n, "mislead": share})
        for n in (3, 4)
        for share in (0.0, 0.3, 0.6, 0.8)
    ]
    others = decoys.METHODS[1:]
    found = results("beyond-7-decoys", decoys.decoys)
    return table(found, SHARE, decoys.HYBRID, others, places, "share of the bound")


BLOCKS = {
    Block.of(PAGE, make.__name__, "docs/extensions/hybrids.py"): make
    for make in (dense, late, shared)
}

if __name__ == "__main__":
    for block, make in BLOCKS.items():
        block.write(make())
