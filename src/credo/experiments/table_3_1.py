"""Table 3.1: the memory after each of the 8 permutations of depth 3, and which cells matter."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax
import numpy as np

from ..analysis import counting, memory
from ..environments.sequence_classification import SequenceClassification
from ..report import sections as page
from ..report.rows import Results, Row, rows
from .base import Experiment, Trained, Value
from .dissertation import notes, told
from .fig_3_4a import deepest, rounded
from .views import Runs, computed, each, of_metric, of_seed


def lengths(trained: Trained) -> np.ndarray:
    """How many signals of random streams each champion answers right in a row: the mean of 10
    streams of at most 10,000. The champion of champions is the one with most."""
    found = counting.longest_correct(trained.champions, 10_000, key=jax.random.key(30_000))
    return np.asarray(found, np.float64).mean(axis=1)


def signals_right(trained: Trained) -> list[Row]:
    """`lengths`, and the best run: its place among the seeds of the cell, from 0."""
    found, labels = lengths(trained), trained.labels
    best = Row(labels, None, "best run", int(found.argmax()))
    return [best, *rows("signals right", rounded(found, 1), labels, seed=trained.seeds)]


def best_seed(results: Results) -> int:
    """The seed of the run that is shown on its own."""
    return results.cells[0]["seeds"][results.value("best run")]


def of_best(view: Callable[..., Iterable[page.Section]]) -> Callable[..., Any]:
    """A view of the best run alone."""
    return lambda results, values: view(of_seed(results, best_seed(results)), values)


def names(cells: int) -> list[str]:
    """Memory cells as the dissertation names them: M1, M2, …"""
    return [f"M{i + 1}" for i in range(cells)]


def probe(trained: Trained) -> Iterator[Row]:
    """What each champion's memory ends in, by permutation, and its cells from 0 that are needed."""
    task = SequenceClassification(depth=3, min_gap=15, max_gap=15)
    for seed, run in zip(trained.seeds, trained.runs, strict=True):
        found = memory.probe(run.champion, task)
        axes: dict[str, Any] = {"labels": trained.labels, "seed": [seed]}
        cells = names(len(found["masking costs"]))
        for i, signals in enumerate(found["permutations"].tolist()):
            here = axes | {"labels": {**trained.labels, "permutation": str(signals)}}
            here["labels"]["sum"] = int(found["sums"][i])
            final = rounded(found["memory"][i : i + 1], 2)
            yield from rows("memory", final, **here, cell=cells)
            yield from rows("signature", found["signatures"][i : i + 1], **here, rank=None)
            yield from rows("right", found["right"][i : i + 1], **here)
        costs = rounded(found["masking costs"][None], 3)
        yield from rows("masking costs", costs, **axes, cell=cells)
        yield from rows("needed", found["needed"][None], **axes, rank=None)
        yield from rows("spread within equal sums", rounded(found["spread"][None]), **axes)
        yield from rows("signature predicts class", found["predicts"][None], **axes)


def needed(results: Results, values: Sequence[Value] = ()) -> str:
    """The cells that a run needs: "M1, M3"."""
    return ", ".join(f"M{x.value + 1}" for x in of_metric(results, "needed").rows)


def states(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """Table 3.1 of one run."""
    cells, body = needed(results), []
    for permutation, total in results.levels("permutation", "sum"):
        here = results.where(permutation=permutation)
        final = {x.labels["cell"]: x.value for x in of_metric(here, "memory").rows}
        relevant = [final[cell] for cell in cells.split(", ") if cell]
        signature = [x.value for x in of_metric(here, "signature").rows]
        shown = map(str, [list(final.values()), relevant, signature])
        body.append([permutation, f"{total:+d}", *shown, yes("right")(here, values)])
    title = f"Champion of seed {best_seed(results)}, the best of its cell; needed: {cells}"
    columns = ["permutation", "sum", "final memory", f"[{cells}]", "signature", "right"]
    yield page.Table(title, columns, body, caption="15 distractors between signals.")


def yes(metric: str) -> Callable[..., page.Cell]:
    """Yes or no, of one run."""
    return computed(metric, lambda x: "yes" if x.all() else "no")


RUNS = Runs(
    "Every run",
    {
        "random signals right in a row": each("signals right", form=".0f"),
        "permutations right": computed("right", lambda x: f"{x.sum():.0f}/8"),
        "needed cells": needed,
        "spread within equal sums": each("spread within equal sums", form=".2g"),
        "signature predicts class": yes("signature predicts class"),
    },
    caption="Spread: the largest difference of a needed cell's final value between permutations "
    "of equal sum; 0 in the dissertation's champion. Random signals: mean of 10 streams of at "
    "most 10,000.",
)
EXPERIMENT = Experiment(
    **told("table-3.1"),
    cells=deepest,
    measures=(signals_right, probe),
    views=(of_best(states), RUNS, notes("table-3.1")),
)
