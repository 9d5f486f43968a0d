"""Table 4.1: a fleet with three memory cells, in every configuration of the case study."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..analysis import fleet
from ..environments.server_fleet import ServerFleet
from ..evolution.mutation import MatrixMutation
from ..networks.dmmu import DMMU
from ..report import sections as page
from ..report.rows import Results, Row, Series, rows, series
from .base import Cell, Experiment, Trained, Value
from .dissertation import notes, told
from .fig_3_4a import rounded
from .fig_4_2 import BUDGETS
from .fig_4_7 import cell, references
from .table_3_1 import best_seed, names, of_best
from .views import Of, Runs, Table, computed, each, known, of_metric, published

CONFIGURATIONS = ("GGNN", "NNGG", "NGGN", "GNNG", "GNGN", "NGNG")  # G: genuine, N: nefarious
PLANS = {"smoke": (4, 2), "quick": (300, 2), "full": (2_000, 10), "published": (15_000, 10)}
MUTATION = MatrixMutation(
    probability=0.5, one_in=10, strength=0.3, super_probability=0.1, reset_probability=0.1
)


def cells(budget: str) -> list[Cell]:
    """DMMUs of three memory cells on the fleet of the case study.

    Mutation is stronger than the printed one (0.9 of the matrices, 10 % noise, no more), which
    learns much slower: docs/notes/team-memory.md. Ten episodes, as printed, may miss one.
    """
    labels = {"task": "case study", "network": "dmmu"}
    task, fields = (ServerFleet.case_study(), DMMU(hidden=3)), {"mutation": MUTATION}
    return [cell(budget, labels, *task, PLANS[budget], **fields, episodes=30)]


def played(trained: Trained) -> Iterator[Row | Series]:
    """Every configuration, as each champion plays it, and which run has the most rewards."""
    totals = np.zeros(len(trained.runs))
    for i, run in enumerate(trained.runs):
        for letters in CONFIGURATIONS:
            genuine = jnp.array([letter == "G" for letter in letters])
            found = fleet.trace_fleet(trained.env, run.champion, genuine, key=jax.random.key(0))
            totals[i] += np.sum(found.net)
            labels = {**trained.labels, "configuration": letters}
            yield from episode(found, {"labels": labels, "seed": [trained.seeds[i]]})
    yield Row(trained.labels, None, "best run", int(np.argmax(totals)))


def episode(found: fleet.FleetTrace, axes: dict[str, Any]) -> Iterator[Row | Series]:
    """Reward, final memory, its order (the signature); and by step and server the device that was
    chosen (-1: none, the server is told what its request was worth), and what was written."""
    cells, steps = names(found.memory.shape[1]), range(1, len(found.acting) + 1)
    yield from rows("reward", [float(np.sum(found.net))], **axes)
    yield from rows("memory", rounded(found.memory[-1:]), **axes, cell=cells)
    yield from rows("signature", np.asarray(found.signature)[None], **axes, rank=None)
    chosen = np.where(found.acting, found.device, -1).T[None]
    yield from series("device", "step", steps, chosen, **axes, server="AB")
    writes = rounded(np.abs(found.writes)).transpose(1, 2, 0)[None]
    yield from series("write", "step", steps, writes, **axes, server="AB", cell=cells)


def upper_bound(trained: Trained) -> list[Row]:
    """The most that a fleet that does not know the classes can reach on average, exactly."""
    bound = round(fleet.best_discovery(trained.env), 4)
    return [Row(trained.labels, None, "upper bound", bound)]


def as_published(results: Results, values: Sequence[Value]) -> page.Cell:
    """Whether a run has rewards as good as the table's, whatever it tries first."""
    found = sorted(row.value for row in of_metric(results, "reward").rows)
    given = sorted(x.value for x in values if x.metric == "reward")
    return "yes" if all(a >= b for a, b in zip(found, given, strict=True)) else "no"


def signatures(results: Results, values: Sequence[Value]) -> page.Cell:
    """How many different ones a run has."""
    return len(set(map(tuple, results.array("signature", "configuration", "rank").tolist())))


def listed(metric: str) -> Of:
    """All values of a run's metric, as a list."""
    text = each(metric, form=".3g")
    return lambda results, values: f"[{text(results, values)}]"


def best(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """Every configuration, as the champion of the best run plays it."""
    title = f"Champion of seed {best_seed(results)}, the best of its cell"
    columns = {
        "published reward": published("reward"),
        "measured": each("reward", form="g"),
        "final memory": listed("memory"),
        "signature": listed("signature"),
    }
    caption = (
        "G: genuine, N: nefarious. Which configuration is the easy one follows from the devices "
        "that a fleet tries first. Signature: cells in ascending order."
    )
    return of_best(Table(title, ("configuration",), columns, caption=caption))(results, values)


RUNS = Runs(
    "Every run",
    {
        "rewards": each("reward", form="g"),
        "mean": computed("reward", np.mean),
        "as Table 4.1 or better": as_published,
        "different signatures": signatures,
    },
)
BOUNDS = Table(
    "Baselines and bounds: mean reward",
    rows=("task",),
    columns={
        "random servers": known("reference", policy="random"),
        "one action": known("reference", policy="fixed"),
        "a script that discovers": known("reference", policy="discovering"),
        "upper bound without knowing the classes": known("upper bound"),
        "an oracle": known("reference", policy="oracle"),
    },
    caption="Whoever knows the classes has 6 in each configuration. A fleet has to find out: on "
    "average no fleet has more than the mean of the published table, 28/6.",
)
MEASURES = (played, upper_bound, references)
EXPERIMENT = Experiment(
    **told("table-4.1"),
    budgets=BUDGETS,
    cells=cells,
    measures=MEASURES,
    views=(best, RUNS, BOUNDS, notes("case study")),
)
