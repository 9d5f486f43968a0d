"""Algorithm 3: what each memory cell of a champion does, cell by cell."""

import dataclasses
from typing import Any

import jax

from .. import tree
from ..analysis import memory
from ..environments.sequence_classification import SequenceClassification
from ..report.sections import Table, Text
from ..runs.store import Run
from . import chapter3
from .base import Cell

TITLE = "the pseudo-algorithm a champion runs"
PUBLISHED = (
    "Algorithm 3 of the dissertation: at -1, M3 gains about 1; at +1, M5 loses about 1; otherwise "
    "memory is not updated; the class is a function of M2, M3 and M5."
)


def cells(budget: str) -> list[Cell]:
    return chapter3.deepest_cells(budget)


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    ((name, cell),) = runs.items()
    policies = chapter3.champions(cell)
    chosen, lengths = chapter3.best(policies)
    task, key = SequenceClassification(depth=21), jax.random.key(70_000)
    found = [
        memory.pseudo_algorithm(tree.take(policies, i), task, key=key) for i in range(len(cell))
    ]
    return {
        "cell": name,
        "champion": chosen,
        "signals right": chapter3.rounded(lengths, 1),
        "algorithm": memory.describe(found[chosen]),
        "roles": [[dataclasses.asdict(role) for role in roles] for roles in found],
    }


def sections(measured: dict[str, Any]) -> list[Any]:
    best = measured["roles"][measured["champion"]]
    return [
        Text(f"Run {measured['champion']}", measured["algorithm"].split("\n")),
        Table(
            "Its cells: mean move per step",
            ["cell", "at +1", "at -1", "at a distractor", "role"],
            [
                [
                    f"M{r['cell'] + 1}",
                    f"{r['plus']:+.3f}",
                    f"{r['minus']:+.3f}",
                    f"{r['distractor']:+.2g}",
                    r["role"],
                ]
                for r in best
            ],
        ),
        Table(
            "Every run",
            ["run", "random signals right in a row", *(f"M{r['cell'] + 1}" for r in best)],
            [
                [str(i), f"{length:.0f}", *(r["role"] for r in roles)]
                for i, (roles, length) in enumerate(
                    zip(measured["roles"], measured["signals right"], strict=True)
                )
            ],
        ),
    ]
