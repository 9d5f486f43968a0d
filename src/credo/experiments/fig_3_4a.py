"""Figure 3.4a: success of an evolved MMU on sequence classification, by depth.

The cells of all of chapter 3 are made here, by `cell`, and what most of its figures measure.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from ..algorithms.bptt import BPTT
from ..algorithms.neuroevolution import Neuroevolution
from ..analysis import floors, statistics
from ..environments.sequence_classification import SequenceClassification
from ..environments.sequence_recall import SequenceRecall
from ..networks.base import AbstractNetwork
from ..networks.mmu import MMU
from ..networks.recurrent import Recurrent
from ..report.rows import Row, Series, rows, series
from ..report.sections import Text
from ..rollout import evaluate
from .base import Cell, Experiment, Trained, Value
from .views import Curves, Table, constant, known, mean, median, published

TEST = 1000  # fresh sequences for a final champion; the dissertation used 50
DEPTHS = {"smoke": (3,), "quick": (2, 5, 10, 21), "full": (2, 3, 4, 5, 6, 10, 15, 21)}
PRESETS = ("as written", "as coded", "ours")
TASKS = {"classification": SequenceClassification, "recall": SequenceRecall}
HIDDEN = {"classification": 5, "recall": 20}  # units, as in the author's code
TRAINERS = {
    "evolution": dict(
        zip(PRESETS, (Neuroevolution, Neuroevolution.as_coded, Neuroevolution.ours), strict=True)
    ),
    "gradient": dict(zip(PRESETS, (BPTT.as_written, BPTT.as_coded, BPTT.ours), strict=True)),
}
GENERATIONS = {  # by gradient: thousands of instances; recall still improves after 200
    ("classification", "evolution"): {"smoke": 20, "quick": 300, "full": 1000},
    ("classification", "gradient"): {"smoke": 10, "quick": 60, "full": 200},
    ("recall", "evolution"): {"smoke": 10, "quick": 500, "full": 10_000},
    ("recall", "gradient"): {"smoke": 10, "quick": 60, "full": 400},
}
RUNS = {"smoke": 2, "quick": 3, "full": 10}
FEWER = {"smoke": 2, "quick": 2, "full": 5}  # of what fails alike, and of networks beside the MMU
LINE = ("preset", "trainer", "network", "memory", "at equal instances", "ties free")


def cell(
    budget: str,
    task: str,
    depth: int,
    preset: str,
    trainer: str = "evolution",
    network: str = "mmu",
    *,
    memory: int | None = None,
    equal: bool = False,
) -> Cell:
    """Runs of one trainer, network and task of chapter 3.

    **Arguments:** `network`: mmu, lstm, gru or rnn, of the size that the task's MMU has. `memory`:
    cells of an MMU with encoder and decoder learned; None: as many as hidden units. `equal`:
    evolution ends when the gradient does, at equal reinforcement instances: one is a network times
    a training sequence (section 3.4), and both use 1,000 per generation.
    """
    labels = dict(task=task, depth=depth, preset=preset, trainer=trainer, network=network)
    labels |= {"memory": memory} if memory else {}
    labels |= {"at equal instances": True} if equal else {}
    few = network != "mmu" or memory or (trainer == "gradient" and preset != "ours")
    first = 200 if preset == "ours" else 0  # our settings were chosen by looking at lower seeds
    return Cell(
        labels,
        TRAINERS[trainer][preset](TASKS[task](depth=depth), _network(network, memory, task)),
        range(first, first + (FEWER if few else RUNS)[budget]),
        GENERATIONS[task, "gradient" if equal else trainer][budget],
    )


def _network(name: str, memory: int | None, task: str) -> AbstractNetwork:
    if name != "mmu":
        return Recurrent(cell=cast(Any, name), hidden=HIDDEN[task])
    if memory is None:
        return MMU(hidden=HIDDEN[task])
    return MMU(hidden=HIDDEN[task], memory=memory, encoder="learned", decoder="learned")


def evolved(
    budget: str, presets: Iterable[str] = PRESETS, depths: Iterable[int] | None = None
) -> list[Cell]:
    """MMUs on sequence classification, by evolution."""
    return [
        cell(budget, "classification", depth, preset)
        for preset in presets
        for depth in depths or DEPTHS[budget]
    ]


def deepest(budget: str, presets: Iterable[str] = ("ours",)) -> list[Cell]:
    """The 21-deep runs, into which the case study looks (3-deep at smoke)."""
    return evolved(budget, presets, DEPTHS[budget][-1:])


def cells(budget: str) -> list[Cell]:
    """The published rule for ties is not known: the author's operators also run where any answer
    is right at a tie, as in the author's program."""
    (coded,) = deepest(budget, ("as coded",))
    free = replace(coded.algorithm, env=replace(coded.algorithm.env, ties="free"))
    labels = {**coded.labels, "ties free": True}
    return [*evolved(budget), replace(coded, labels=labels, algorithm=free)]


# --------------------------------------------------------------------------------------- measures


def success(trained: Trained) -> list[Row]:
    """Strict success of the final champions on the same fresh sequences: the share of them that is
    answered right at every signal. No training run draws from the seed used here."""
    found = evaluate(trained.env, trained.champions, TEST, key=jax.random.key(10_000))
    share = jnp.mean(found.returns["success"], axis=1)
    return rows("success", rounded(share), trained.labels, seed=trained.seeds)


def baseline(trained: Trained) -> list[Row]:
    """The best of three policies that keep at most one signal (the first, the last, none)."""
    policy, value = floors.floor(trained.env)
    return [Row({**trained.labels, "policy": policy}, None, "baseline success", round(value, 4))]


def learning(trained: Trained) -> list[Row | Series]:
    """Each generation's champion on its 50 fresh sequences, as logged: raw, and smoothed by the
    author's moving average over 100 generations; every tenth generation, and the last one."""
    scores = np.stack([run.metrics["champion_score"] for run in trained.runs])
    keep = np.arange(9, scores.shape[1], 10)
    found: list[Row | Series] = []
    kinds = {"": scores, ", smoothed": statistics.moving_average(scores, 100)}
    for kind, x in kinds.items():
        told: dict[str, Any] = {"labels": trained.labels, "seed": trained.seeds}
        at = keep + 1
        found += series(f"test success{kind}", "generation", at, rounded(x[:, keep]), **told)
        found += rows(f"last test success{kind}", rounded(x[:, -1]), **told)
    return found


def rounded(x: Any, digits: int = 4) -> np.ndarray:
    """Short enough for a text file."""
    return np.round(np.asarray(x, np.float64), digits)


# ------------------------------------------------------------------------------------------ views

TABLE = Table(
    "Success, %",
    rows=("depth", *LINE),
    columns={
        "baseline": known("baseline success", 100),
        "published": published("success"),
        "measured": mean("success", 100, 1),
        "median (range)": median("success", 100),
        "upper bound": constant("100"),
        "50 sequences, raw": mean("last test success", 100, 1),
        "50 sequences, smoothed": mean("last test success, smoothed", 100, 1),
    },
    caption="Baseline: the best of three policies that keep at most one signal (the first, the "
    "last, none), computed exactly. Published: mean ± standard error.",
)


def summary(**levels: float) -> Curves:
    """Final success against depth."""
    return Curves(
        "success",
        "depth",
        line=LINE,
        title="Final champions on 1,000 fresh sequences",
        levels={name: constant(value) for name, value in levels.items()},
        y_range=(0.0, 1.02),
    )


BY_DEPTH = Curves(
    "test success, smoothed",
    "generation",
    line=("depth",),
    panel=LINE,
    title="Champion of each generation: {panel}",
    y_label="success, 50 fresh sequences",
    y_range=(0.0, 1.02),
    caption="Moving average over 100 generations, as in the dissertation; raw values are in "
    "results.json.",
)

EXPERIMENT = Experiment(
    published="Figure 3.4a of the dissertation: more than 80 % within 500 generations, and 87.6 ± "
    "6.85 % at depth 21 after 1,000 (its tie rule is not said; the author's program accepted any "
    "answer at a tie). Here a tie is class +1 and an answer must be right at every signal.",
    cells=cells,
    measures=(baseline, success, learning),
    views=(
        summary(**{"published, 21-deep": 0.876}),
        BY_DEPTH,
        TABLE,
        Text(
            "How to read it",
            [
                "Success is the share of sequences answered right at every signal. The last "
                "columns of the table are the published protocol, the champion of the last "
                "generation on 50 fresh sequences, raw and with the author's undisclosed moving "
                "average over 100 generations; the numbers to compare are those on 1,000 fresh "
                "sequences.",
            ],
        ),
    ),
    values=(Value("87.6 ± 6.9", "success", "Figure 3.4a; tie rule unknown", {"depth": 21}),),
)
