"""Figure 3.4a: success of an evolved MMU on Sequence Classification, by depth."""

import dataclasses
from typing import Any

from ..analysis import floors
from ..report.sections import Curve, Figure, Reference, Table, Text
from ..runs.store import Run
from . import chapter3
from .base import Cell

TITLE = "success by depth, Sequence Classification"
PUBLISHED = (
    "Figure 3.4a of the dissertation: more than 80 % within 500 generations, and 87.6 ± 6.85 % at "
    "depth 21 after 1,000 (its tie rule is not said; the author's program accepted any answer at "
    "a tie). Here a tie is class +1 and an answer must be right at every signal."
)
GIVEN = {21: "87.6 ± 6.9"}


def cells(budget: str) -> list[Cell]:
    """The published rule for ties is not known: the author's operators also run where any answer
    is right at a tie, as in his program."""
    (deepest,) = chapter3.deepest_cells(budget, variants=("as coded",))
    free = dataclasses.replace(deepest.algorithm.env, ties="free")
    algorithm = dataclasses.replace(deepest.algorithm, env=free)
    return [
        *chapter3.classification_cells(budget),
        Cell(f"{deepest.name}, ties free", algorithm, deepest.generations, deepest.runs),
    ]


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    measured = {}
    for name, cell in runs.items():
        task = cell[0].algorithm.env
        floor, value = floors.floor(task)
        measured[name] = {
            "floor": [floor, round(value, 4)],
            "success": chapter3.rounded(chapter3.success(task, chapter3.champions(cell))),
            "curve": chapter3.curves(cell),
        }
    return measured


def sections(measured: dict[str, Any]) -> list[Any]:
    return [
        summary(measured),
        *(by_depth(measured, variant) for variant in variants(measured)),
        table(measured),
        Text(
            "How to read it",
            [
                "Success is the share of sequences answered right at every signal. The last "
                "column of the table is the published protocol, the champion of the last "
                "generation on 50 fresh sequences, raw and with the author's undisclosed moving "
                "average over 100 generations; the numbers to compare are those on 1,000 fresh "
                "sequences.",
            ],
        ),
    ]


def variants(measured: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(chapter3.split_name(name)[1] for name in measured))


def of_variant(measured: dict[str, Any], variant: str) -> dict[int, dict[str, Any]]:
    """Results by depth."""
    split = {name: chapter3.split_name(name) for name in measured}
    return {depth: measured[name] for name, (depth, v) in split.items() if v == variant}


def summary(measured: dict[str, Any], published: float | None = 0.876) -> Figure:
    """Final success against depth, a curve per variant."""
    curves = []
    for variant in variants(measured):
        cell = of_variant(measured, variant)
        runs = [
            [cell[d]["success"][i] for d in cell]
            for i in range(len(next(iter(cell.values()))["success"]))
        ]
        curves.append(Curve(variant, list(cell), runs))
    references = (Reference("published, 21-deep", published),) if published else ()
    return Figure(
        "Final champions on 1,000 fresh sequences",
        "depth",
        "success",
        curves,
        references=references,
        y_range=(0.0, 1.02),
    )


def by_depth(measured: dict[str, Any], variant: str) -> Figure:
    """Learning curves of one variant, a curve per depth."""
    return Figure(
        f"Champion of each generation, {variant}",
        "generation",
        "success, 50 fresh sequences",
        [
            Curve(f"{depth}-deep", cell["curve"]["generation"], cell["curve"]["smoothed"])
            for depth, cell in of_variant(measured, variant).items()
        ],
        y_range=(0.0, 1.02),
        caption="Moving average over 100 generations, as in the dissertation; raw values are in "
        "results.json.",
    )


def table(measured: dict[str, Any], given: dict[int, str] = GIVEN) -> Table:
    rows = []
    for name, cell in measured.items():
        depth, variant = chapter3.split_name(name)
        rows.append(
            [
                str(depth),
                variant,
                f"{100 * cell['floor'][1]:.1f}",
                given.get(depth, ""),
                chapter3.percent(cell["success"]),
                chapter3.spread(cell["success"]),
                "100",
                f"{chapter3.percent(cell['curve']['last raw'])} / "
                f"{chapter3.percent(cell['curve']['last smoothed'])}",
            ]
        )
    return Table(
        "Success in percent, mean ± standard error over runs",
        [
            "depth",
            "variant",
            "floor",
            "published",
            "measured",
            "median (range)",
            "ceiling",
            "50 sequences, raw / smoothed",
        ],
        rows,
        caption="Floor: the best of three policies that keep at most one signal (the first, the "
        "last, none), computed exactly. Published: tie rule unknown. Standard errors with n - 1.",
    )
