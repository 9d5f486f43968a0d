"""Table 3.1: the memory after each of the 8 permutations of depth 3, and which cells matter."""

from typing import Any

import numpy as np

from .. import tree
from ..analysis import memory
from ..environments.sequence_classification import SequenceClassification
from ..report.sections import Table, Text
from ..runs.store import Run
from . import chapter3
from .base import Cell

TITLE = "final memory of the 8 permutations of depth 3"
PUBLISHED = (
    "Table 3.1 of the dissertation: permutations with equal sums end in equal states of the "
    "relevant cells; the signature (their indices in ascending order of value) predicts the "
    "class; a constant cell is a needed bias."
)


def cells(budget: str) -> list[Cell]:
    return chapter3.deepest_cells(budget)


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    ((name, cell),) = runs.items()
    policies = chapter3.champions(cell)
    chosen, lengths = chapter3.best(policies)
    task = SequenceClassification(depth=3, min_gap=15, max_gap=15)
    return {
        "cell": name,
        "champion": chosen,
        "signals right": chapter3.rounded(lengths, 1),
        "runs": [_probe(tree.take(policies, i), task) for i in range(len(cell))],
    }


def _probe(policy: Any, task: SequenceClassification) -> dict[str, Any]:
    states = memory.final_states(policy, task)
    sequences = memory.lay_out(task, memory.permutations(3))
    relevance = memory.relevant_cells(policy, sequences)
    final = np.asarray(states.memory)
    relevant = final[:, list(relevance.needed)]
    sums = np.asarray(states.sums)
    same = [np.ptp(relevant[sums == s], axis=0).max(initial=0.0) for s in np.unique(sums)]
    signatures = memory.signature(states.memory, relevance.needed)
    classes = {tuple(s): set() for s in signatures.tolist()}
    for s, total in zip(signatures.tolist(), sums, strict=True):
        classes[tuple(s)].add(bool(total > 0))
    return {
        "permutations": np.asarray(states.signals, int).tolist(),
        "sums": sums.astype(int).tolist(),
        "memory": chapter3.rounded(final, 2),
        "right": np.asarray(states.right).all(axis=1).tolist(),
        "masking costs": chapter3.rounded(relevance.marginal_value, 3),
        "needed": [int(c) for c in relevance.needed],
        "signatures": signatures.tolist(),
        "spread within equal sums": chapter3.rounded(max(same), 4),
        "signature predicts class": all(len(seen) == 1 for seen in classes.values()),
    }


def sections(measured: dict[str, Any]) -> list[Any]:
    best = measured["runs"][measured["champion"]]
    needed = ", ".join(f"M{c + 1}" for c in best["needed"])
    rows = [
        [
            str(i + 1),
            str(p),
            f"{s:+d}",
            str(m),
            str([m[c] for c in best["needed"]]),
            str(sig),
            "yes" if right else "no",
        ]
        for i, (p, s, m, sig, right) in enumerate(
            zip(
                best["permutations"],
                best["sums"],
                best["memory"],
                best["signatures"],
                best["right"],
                strict=True,
            )
        )
    ]
    summary = [
        [
            str(i),
            f"{length:.0f}",
            f"{sum(run['right'])}/8",
            ", ".join(f"M{c + 1}" for c in run["needed"]),
            f"{run['spread within equal sums']:.2g}",
            "yes" if run["signature predicts class"] else "no",
        ]
        for i, (run, length) in enumerate(
            zip(measured["runs"], measured["signals right"], strict=True)
        )
    ]
    return [
        Table(
            f"Champion of run {measured['champion']}, the best of its cell; needed: {needed}",
            ["#", "permutation", "sum", "final memory", f"[{needed}]", "signature", "right"],
            rows,
            caption="15 distractors between signals.",
        ),
        Table(
            "Every run",
            [
                "run",
                "random signals right in a row",
                "permutations right",
                "needed cells",
                "spread within equal sums",
                "signature predicts class",
            ],
            summary,
            caption="Spread: the largest difference of a needed cell's final value between "
            "permutations of equal sum; 0 in the dissertation's champion. Random signals: mean of "
            "10 streams of at most 10,000.",
        ),
        Text(
            "Masking",
            [
                "A masked cell is held at 0 before every step; the needed cells are the smallest "
                "set that keeps the success over the 8 permutations with all others masked."
            ],
        ),
    ]
