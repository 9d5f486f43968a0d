"""Table 4.1: a fleet with three memory cells, in every configuration of the case study."""

from collections.abc import Iterable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..analysis import fleet
from ..environments.server_fleet import ServerFleet
from ..networks.dmmu import DMMU
from ..report import sections as page
from ..report.rows import Results, Row, Series, rows, series
from .base import Cell, Experiment, Trained, Value
from .fig_3_4a import rounded
from .fig_4_2 import BUDGETS
from .fig_4_7 import MUTATION, STRONGER, about, cell, references
from .table_3_1 import best_seed, names, of_best
from .views import Of, Runs, Table, computed, each, known, of_metric

CONFIGURATIONS = ("GGNN", "NNGG", "NGGN", "GNNG", "GNGN", "NGNG")  # G: genuine, N: nefarious
GIVEN = (6.0, 4.0, 5.0, 4.0, 5.0, 4.0)
EPISODES = 30  # per fitness: ten may miss a configuration
PLANS = {"smoke": (4, 2), "quick": (300, 2), "full": (2_000, 10), "published": (15_000, 10)}


def cells(budget: str) -> list[Cell]:
    """DMMUs of three memory cells on the fleet of the case study."""
    labels = {"task": "case study", "network": "dmmu"}
    env, network = ServerFleet.case_study(), DMMU(hidden=3)
    told = {"mutation": MUTATION, "episodes": EPISODES}
    return [cell(budget, labels, env, network, PLANS[budget], **told)]


def played(trained: Trained) -> Iterator[Row | Series]:
    """Every configuration, as each champion plays it: reward, final memory, its order (the
    signature), and by step and server the device that was chosen (-1: none, the server is told
    what its request was worth) and what was written to each cell."""
    totals = []
    for seed, run in zip(trained.seeds, trained.runs, strict=True):
        totals.append(0.0)
        for letters in CONFIGURATIONS:
            genuine = jnp.array([letter == "G" for letter in letters])
            found = fleet.trace_fleet(trained.env, run.champion, genuine, key=jax.random.key(0))
            labels, one = {**trained.labels, "configuration": letters}, [seed]
            totals[-1] += (reward := float(np.sum(found.net)))
            yield Row(labels, seed, "reward", reward)
            memory, cells = rounded(found.memory[-1])[None], names(found.memory.shape[1])
            yield from rows("memory", memory, labels, seed=one, cell=cells)
            order = np.asarray(found.signature)[None]
            yield from rows("signature", order, labels, seed=one, rank=None)
            steps, servers = range(1, len(found.acting) + 1), "AB"
            chosen = np.where(found.acting, found.device, -1).T[None]
            yield from series("device", "step", steps, chosen, labels, seed=one, server=servers)
            writes = rounded(np.abs(found.writes)).transpose(1, 2, 0)[None]
            axes = {"seed": one, "server": servers, "cell": cells}
            yield from series("write", "step", steps, writes, labels, **axes)
    yield Row(trained.labels, None, "best run", int(np.argmax(totals)))


def upper_bound(trained: Trained) -> list[Row]:
    """The most that a fleet that does not know the classes can reach on average, exactly."""
    bound = round(fleet.best_discovery(trained.env), 4)
    return [Row(trained.labels, None, "upper bound", bound)]


def as_given(results: Results, values: Sequence[Value]) -> page.Cell:
    """Whether a run has rewards as good as the table's, whatever it tries first."""
    found = sorted(row.value for row in of_metric(results, "reward").rows)
    return "yes" if all(a >= b for a, b in zip(found, sorted(GIVEN), strict=True)) else "no"


def signatures(results: Results, values: Sequence[Value]) -> page.Cell:
    """How many different ones a run has."""
    found = results.array("signature", "configuration", "rank")
    return len({tuple(row) for row in found.tolist()})


def listed(metric: str) -> Of:
    """All values of a run's metric, as a list."""
    return lambda results, values: (
        f"[{', '.join(f'{row.value:.3g}' for row in of_metric(results, metric).rows)}]"
    )


def as_published(results: Results, values: Sequence[Value]) -> page.Cell:
    """The published reward of a configuration."""
    (name,) = results.levels("configuration")
    return GIVEN[CONFIGURATIONS.index(name)]


def title(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """Which run is the best one."""
    text = f"Seed {best_seed(results)} has the highest sum of rewards; its champion is shown."
    yield page.Text("The best run", [text])


EXPERIMENT = Experiment(
    published="Table 4.1 of the dissertation: rewards 6, 4, 5, 4, 5, 4 in the six configurations, "
    "and final memories whose order, the signature, is another one in each.",
    cells=cells,
    measures=(played, upper_bound, references),
    views=(
        title,
        of_best(
            Table(
                "Champion of the best run",
                rows=("configuration",),
                columns={
                    "published reward": as_published,
                    "measured": each("reward", form="g"),
                    "final memory": listed("memory"),
                    "signature": listed("signature"),
                },
                caption="G: genuine, N: nefarious. Which configuration is the easy one follows "
                "from the devices that a fleet tries first. Signature: cells in ascending order.",
            )
        ),
        Runs(
            "Every run",
            {
                "rewards": each("reward", form="g"),
                "mean": computed("reward", np.mean),
                "as Table 4.1 or better": as_given,
                "different signatures": signatures,
            },
        ),
        Table(
            "Baselines and bounds: mean reward",
            rows=("task",),
            columns={
                "random servers": known("reference", policy="random"),
                "one action": known("reference", policy="fixed"),
                "a script that discovers": known("reference", policy="discovering"),
                "upper bound without knowing the classes": known("upper bound"),
                "an oracle": known("reference", policy="oracle"),
            },
            caption="Whoever knows the classes has 6 in each configuration. A fleet has to find "
            "out: on average no fleet has more than the mean of the published table, 28/6.",
        ),
        about(EPISODES, STRONGER),
    ),
    budgets=BUDGETS,
)
