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
from .fig_3_4a import deepest, rounded
from .views import Runs, computed, each, of_metric, of_seed

PERMUTATION = ("permutation", "sum")


def lengths(trained: Trained) -> np.ndarray:
    """How many signals of random streams each champion answers right in a row: the mean of 10
    streams of at most 10,000. The champion of champions is the one with most."""
    found = counting.longest_correct(trained.champions, 10_000, key=jax.random.key(30_000))
    return np.asarray(found, np.float64).mean(axis=1)


def signals_right(trained: Trained) -> list[Row]:
    """`lengths`, and the best run: its place among the seeds of the cell, from 0."""
    found, told = lengths(trained), trained.labels
    best = Row(told, None, "best run", int(found.argmax()))
    return [best, *rows("signals right", rounded(found, 1), told, seed=trained.seeds)]


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
    """What each champion's memory ends in, by permutation; what masking a cell costs; which cells
    are needed, and whether their order predicts the class."""
    task = SequenceClassification(depth=3, min_gap=15, max_gap=15)
    for seed, run in zip(trained.seeds, trained.runs, strict=True):
        policy = run.champion
        states = memory.final_states(policy, task)
        found = memory.relevant_cells(policy, memory.lay_out(task, memory.permutations(3)))
        yield from _by_permutation(states, found.needed, {"labels": trained.labels, "seed": seed})
        told = {"labels": trained.labels, "seed": [seed]}
        cells = names(len(found.marginal_value))
        needed = [[i in found.needed for i in range(len(cells))]]
        yield from rows("needed", needed, **told, cell=cells)
        costs = rounded(found.marginal_value, 3)[None]
        yield from rows("cost of masking", costs, **told, cell=cells)
        sums = np.asarray(states.sums)
        final = np.asarray(states.memory)[:, list(found.needed)]
        far = [np.ptp(final[sums == s], axis=0).max(initial=0.0) for s in np.unique(sums)]
        yield from rows("spread within equal sums", [rounded(max(far))], **told)
        signatures = memory.signature(states.memory, found.needed).tolist()
        pairs = {(tuple(s), bool(x > 0)) for s, x in zip(signatures, sums, strict=True)}
        known = len({s for s, _ in pairs}) == len(pairs)
        yield from rows("signature predicts class", [known], **told)


def _by_permutation(states: Any, needed: tuple[int, ...], told: Any) -> Iterator[Row]:
    final, right = np.asarray(states.memory), np.asarray(states.right).all(axis=1)
    signatures = memory.signature(states.memory, needed)
    for i, signals in enumerate(np.asarray(states.signals, int).tolist()):
        here, seed = told["labels"] | dict(permutation=str(signals), sum=sum(signals)), told["seed"]
        cells = names(final.shape[1])
        yield from rows("memory", rounded(final[i : i + 1], 2), here, seed=[seed], cell=cells)
        yield from rows("signature", signatures[i : i + 1], here, seed=[seed], rank=None)
        yield Row(here, seed, "right", bool(right[i]))


def needed(results: Results, values: Sequence[Value] = ()) -> str:
    """The cells that a run needs: "M1, M3"."""
    return ", ".join(x.labels["cell"] for x in of_metric(results, "needed").rows if x.value)


def states(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """Table 3.1 of one run."""
    cells = needed(results)
    body = []
    for permutation, total in results.levels(*PERMUTATION):
        here = results.where(permutation=permutation)
        final = {x.labels["cell"]: x.value for x in of_metric(here, "memory").rows}
        signature = [x.value for x in of_metric(here, "signature").rows]
        relevant = [final[cell] for cell in cells.split(", ")] if cells else []
        shown = [list(final.values()), relevant, signature]
        right = "yes" if here.value("right") else "no"
        body.append([permutation, f"{total:+d}", *map(str, shown), right])
    seed = next(x.seed for x in results.rows)
    columns = ["permutation", "sum", "final memory", f"[{cells}]", "signature", "right"]
    title = f"Champion of seed {seed}, the best of its cell; needed: {cells}"
    yield page.Table(title, columns, body, caption="15 distractors between signals.")


def told(metric: str) -> Callable[..., page.Cell]:
    """Yes or no, of one run."""
    return computed(metric, lambda x: "yes" if x.all() else "no")


EXPERIMENT = Experiment(
    published="Table 3.1 of the dissertation: permutations with equal sums end in equal states of "
    "the relevant cells; the signature (their indices in ascending order of value) predicts the "
    "class; a constant cell is a needed bias.",
    cells=deepest,
    measures=(signals_right, probe),
    views=(
        of_best(states),
        Runs(
            "Every run",
            {
                "random signals right in a row": each("signals right", form=".0f"),
                "permutations right": computed("right", lambda x: f"{x.sum():.0f}/8"),
                "needed cells": needed,
                "spread within equal sums": each("spread within equal sums", form=".2g"),
                "signature predicts class": told("signature predicts class"),
            },
            caption="Spread: the largest difference of a needed cell's final value between "
            "permutations of equal sum; 0 in the dissertation's champion. Random signals: mean of "
            "10 streams of at most 10,000.",
        ),
        page.Text(
            "Masking",
            [
                "A masked cell is held at 0 before every step; the needed cells are the smallest "
                "set that keeps the success over the 8 permutations with all others masked."
            ],
        ),
    ),
)
