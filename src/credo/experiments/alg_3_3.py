"""Algorithm 3: what each memory cell of a champion does, cell by cell."""

from collections.abc import Iterable, Iterator, Sequence

import jax

from ..analysis import memory
from ..environments.sequence_classification import SequenceClassification
from ..report import sections as page
from ..report.rows import Results, Row
from .base import Experiment, Trained, Value
from .dissertation import told
from .fig_3_4a import deepest
from .table_3_1 import best_seed, of_best, signals_right
from .views import Runs, Table, each

METRICS = {  # of `memory.CellRole`
    "plus": "move at +1",
    "minus": "move at -1",
    "distractor": "move at a distractor",
    "drift": "drift between signals",
    "plus_share": "share of +1 at which it moves",
    "minus_share": "share of -1 at which it moves",
    "role": "role",
}


def roles(trained: Trained) -> Iterator[Row]:
    """Mean moves of each cell of each champion in 50 sequences, and what they amount to; of the
    best one the whole algorithm as text."""
    best, *lengths = signals_right(trained)
    task, key = SequenceClassification(depth=21), jax.random.key(70_000)
    found = [memory.pseudo_algorithm(run.champion, task, key=key) for run in trained.runs]
    text = memory.describe(found[best.value])
    yield from (best, *lengths, Row(trained.labels, None, "algorithm", text))
    for seed, cells in zip(trained.seeds, found, strict=True):
        for role in cells:
            labels = {**trained.labels, "cell": f"M{role.cell + 1}"}
            yield from (Row(labels, seed, METRICS[k], getattr(role, k)) for k in METRICS)


def algorithm(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """The pseudo-algorithm of the best run."""
    yield page.Text(f"Seed {best_seed(results)}", results.value("algorithm").split("\n"))


COLUMNS = {
    "at +1": each("move at +1", form="+.3f"),
    "at -1": each("move at -1", form="+.3f"),
    "at a distractor": each("move at a distractor", form="+.2g"),
    "role": each("role", form=""),
}
RUNS = {"random signals right in a row": each("signals right", form=".0f")}
RUNS |= {cell: each("role", form="", cell=cell) for cell in ("M1", "M2", "M3", "M4", "M5")}
EXPERIMENT = Experiment(
    **told("alg-3.3"),
    cells=deepest,
    measures=(roles,),
    views=(
        algorithm,
        of_best(Table("Its cells: mean move per step", rows=("cell",), columns=COLUMNS)),
        Runs("Every run", RUNS),
    ),
)
