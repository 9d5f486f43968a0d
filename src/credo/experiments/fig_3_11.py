"""Figure 3.11: an MMU by gradient on Sequence Classification, beside evolution."""

from typing import Any

from ..report.sections import Curve, Figure, Reference, Table, Text
from ..runs.store import Run
from . import chapter3, chapter3_gradient, fig_3_4a, fig_3_5a, fig_3_5b
from .base import Cell
from .chapter3_gradient import depth_of, learning, of_depth, of_variant, variant_of

TITLE = "an MMU by gradient, Sequence Classification"
PUBLISHED = (
    "Figure 3.11 of the dissertation (curves): success by gradient is lower the deeper the task, "
    "and lower than by evolution; trained 21-deep, 14.5 ± 2.3 % at depth 101 against 50.4 ± 9.3 % "
    "by evolution. There a tie was class +1 for the gradient and free for evolution; here it is "
    "class +1 for both."
)
DEPTHS = {"smoke": (3,), "quick": (2, 5, 10, 21), "full": (2, 5, 10, 21)}
GRADIENT = ("as written by gradient", "ours by gradient")
EVOLUTION = ("as coded", "ours")


def cells(budget: str) -> list[Cell]:
    depths = DEPTHS[budget]
    deepest = chapter3_gradient.cell("classification", max(depths), "as coded by gradient", budget)
    return [
        *(
            chapter3_gradient.cell("classification", depth, variant, budget)
            for variant in GRADIENT
            for depth in depths
        ),
        deepest,
        *chapter3.classification_cells(budget, depths, EVOLUTION),
    ]


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    measured = chapter3_gradient.measure(runs, budget)
    trained = chapter3_gradient.by_gradient(runs)
    for part, module in (("distractors", fig_3_5a), ("depths", fig_3_5b)):
        for name, found in module.measure(trained, budget).items():
            measured[name][part] = found
    return measured


def sections(measured: dict[str, Any]) -> list[Any]:
    tested = {name: cell for name, cell in measured.items() if "depths" in cell}
    deepest = max(chapter3.split_name(name)[0] for name in measured)
    every = fig_3_4a.variants(tested)
    return [
        fig_3_4a.summary(measured, published=None),
        *(learning(f"(a) {v}", of_variant(measured, v), depth_of) for v in every),
        learning(
            f"(b) Gradient and evolution, {deepest}-deep, a tie is class +1 for both",
            of_depth(measured, deepest),
            variant_of,
        ),
        *(
            fig_3_5a.figure(
                {name: cell["distractors"] for name, cell in of_variant(tested, v).items()},
                v,
                "distractors between signals",
                None,
            )
            for v in every
        ),
        *(deeper(of_variant(tested, v), v) for v in every),
        fig_3_4a.table(measured, {}),
        *([elsewhere(tested)] if tested else []),
        about(),
    ]


def deeper(tested: dict[str, Any], variant: str) -> Figure:
    return Figure(
        f"(d) Champions tested at other depths, {variant}",
        "depth of the test",
        "success, 1,000 fresh sequences",
        [
            Curve(f"trained {depth_of(name)}", cell["depths"]["depths"], cell["depths"]["success"])
            for name, cell in tested.items()
        ],
        references=(Reference("published, 21-deep at 101", 0.145),),
        y_range=(0.0, 1.02),
    )


def elsewhere(tested: dict[str, Any]) -> Table:
    """Champions where they were not trained."""
    rows = []
    for name, cell in tested.items():
        depth, variant = chapter3.split_name(name)
        gaps, depths = cell["distractors"], cell["depths"]
        wide = [run[-1] for run in gaps["success"]]
        far = [run[-1] for run in depths["success"]]
        published = "14.5 ± 2.3" if depth == 21 else ""
        rows.append([str(depth), variant, chapter3.percent(wide), published, chapter3.percent(far)])
    first = next(iter(tested.values()))
    return Table(
        "Away from what was trained: success in percent, mean ± standard error over runs",
        [
            "trained",
            "variant",
            f"{first['distractors']['gaps'][-1]} distractors",
            "published at depth 101",
            f"depth {first['depths']['depths'][-1]}",
        ],
        rows,
    )


def about() -> Text:
    return Text(
        "How to read it",
        [
            "`as written`: Adam 0.01, L2 0.1, smooth L1, batches of 1,000, the mean of their "
            "losses. `as coded`: one training set of 1,000, the sum of their losses, against which "
            "L2 of 0.1 is next to nothing. `ours` is in docs/gradient.md, with what was tried.",
            "A reinforcement instance is one network times one training sequence.",
        ],
    )
