"""Chapter 3 by gradient, and recurrent networks beside the MMU: cells, and success by instances.

A reinforcement instance is one network times one training sequence (section 3.4): both trainers
use 1,000 per generation here, 100 networks × 10 sequences and 1 network × 1,000.
"""

import dataclasses
from typing import Any

import numpy as np

from ..algorithms.bptt import BPTT
from ..environments.sequence_classification import SequenceClassification
from ..environments.sequence_recall import SequenceRecall
from ..networks.base import AbstractNetwork
from ..networks.mmu import MMU
from ..networks.recurrent import Recurrent
from ..report.sections import Curve, Figure
from ..runs.store import Run
from . import chapter3, fig_3_4a
from .base import Cell

TASKS = {"classification": SequenceClassification, "recall": SequenceRecall}
HIDDEN = {"classification": 5, "recall": 20}  # units, as in the author's code
VARIANTS = chapter3.VARIANTS | {
    "as written by gradient": BPTT.as_written,
    "as coded by gradient": BPTT.as_coded,
    "ours by gradient": BPTT.ours,
}
FIRST_SEED = chapter3.FIRST_SEED | {"ours by gradient": 200}  # chosen by looking at seeds 0 to 4
RUNS = {"smoke": 2, "quick": 3, "full": 10}
FEWER = {"smoke": 2, "quick": 2, "full": 5}  # of what fails alike, and of networks beside the MMU
GENERATIONS = {  # by gradient: thousands of instances; recall still improves after 200
    "classification": {"smoke": 10, "quick": 60, "full": 200},
    "recall": {"smoke": 10, "quick": 60, "full": 400},
}
POINTS = 50  # of a learning curve
EQUAL = "at equal instances"  # evolution that ends when the gradient does


def network(name: str, task: str) -> AbstractNetwork:
    """mmu, lstm, gru or rnn of the size that the task's MMU has; `mmu h×m` has h hidden units, m
    memory cells, and an encoder and a decoder that are learned."""
    if name == "mmu":
        return MMU(hidden=HIDDEN[task])
    if name.startswith("mmu "):
        hidden, memory = map(int, name.removeprefix("mmu ").split("×"))
        return MMU(hidden=hidden, memory=memory, encoder="learned", decoder="learned")
    return Recurrent(cell=name, hidden=HIDDEN[task])  # pyright: ignore[reportArgumentType]


def cell(task: str, depth: int, variant: str, budget: str, net: str = "mmu") -> Cell:
    """Runs of one trainer and network; by evolution the cell of `chapter3` with another network.

    **Arguments:** `variant`: one of `VARIANTS`, with `EQUAL` behind for evolution that has as many
    instances as the gradient.
    """
    trainer = variant.removesuffix(f" {EQUAL}")
    name = f"{task} {depth}-deep {variant}" + ("" if net == "mmu" else f", {net}")
    few = net != "mmu" or variant in ("as written by gradient", "as coded by gradient")
    runs = (FEWER if few else RUNS)[budget]
    if "gradient" in trainer or trainer != variant:
        algorithm = VARIANTS[trainer](TASKS[task](depth=depth), network(net, task))
        generations = GENERATIONS[task][budget]
        return Cell(name, algorithm, generations, runs, FIRST_SEED.get(trainer, 0))
    known = evolved(task, budget, (depth,), (variant,))[0]
    if net == "mmu":
        return known
    algorithm = VARIANTS[variant](known.algorithm.env, network(net, task))
    return dataclasses.replace(known, name=name, algorithm=algorithm, runs=runs)


def evolved(
    task: str, budget: str, depths: tuple[int, ...], variants: tuple[str, ...]
) -> list[Cell]:
    """The MMUs of figures 3.4a and 3.9a, at the depths that they have."""
    if task == "classification":
        return chapter3.classification_cells(budget, depths, variants)
    cells = chapter3.recall_cells(budget, variants)
    return [cell for cell in cells if chapter3.split_name(cell.name)[0] in depths]


def by_gradient(runs: dict[str, list[Run]]) -> dict[str, list[Run]]:
    """The cells that were trained by gradient."""
    return {name: cell for name, cell in runs.items() if isinstance(cell[0].algorithm, BPTT)}


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    """Floors, final success and learning curves, also over instances."""
    measured = fig_3_4a.measure(runs, budget)
    for name, cell in runs.items():
        measured[name]["by instances"] = over_instances(cell)
    return measured


def over_instances(runs: list[Run]) -> dict[str, Any]:
    """Success of each generation's champion on 50 fresh sequences, as means of equal stretches,
    against the instances used by their end."""
    algorithm = runs[0].algorithm
    each = (
        algorithm.updates * algorithm.batch_size
        if isinstance(algorithm, BPTT)
        else algorithm.population_size * algorithm.episodes
    )
    scores = np.stack([run.metrics["champion_score"] for run in runs])
    stretch = max(1, scores.shape[1] // POINTS)
    count = scores.shape[1] // stretch
    blocks = scores[:, : count * stretch].reshape(len(runs), count, stretch)
    return {
        "instances": (each * stretch * np.arange(1, count + 1)).tolist(),
        "success": chapter3.rounded(blocks.mean(axis=2)),
    }


def learning(title: str, measured: dict[str, Any], label: Any = None) -> Figure:
    """Success by instances, a curve per cell. `label`: of a cell's name; None: the name."""
    return Figure(
        title,
        "reinforcement instances",
        "success, 50 fresh sequences",
        [
            Curve(
                label(name) if label else name,
                cell["by instances"]["instances"],
                cell["by instances"]["success"],
            )
            for name, cell in measured.items()
        ],
        y_range=(0.0, 1.02),
        caption="Means of equal stretches of generations, 1,000 instances each; not smoothed else.",
    )


def of_depth(measured: dict[str, Any], depth: int) -> dict[str, Any]:
    return {name: cell for name, cell in measured.items() if chapter3.split_name(name)[0] == depth}


def of_variant(measured: dict[str, Any], variant: str) -> dict[str, Any]:
    return {
        name: cell for name, cell in measured.items() if chapter3.split_name(name)[1] == variant
    }


def depth_of(name: str) -> str:
    return f"{chapter3.split_name(name)[0]}-deep"


def variant_of(name: str) -> str:
    return chapter3.split_name(name)[1]
