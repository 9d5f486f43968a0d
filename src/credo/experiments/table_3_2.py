"""Table 3.2: how far the champions count."""

from collections.abc import Iterable, Iterator, Sequence

import jax
import numpy as np

from ..analysis import counting
from ..report import sections as page
from ..report.rows import Results, Row, Series, rows, series
from .base import Cell, Experiment, Trained, Value
from .dissertation import told
from .fig_3_4a import deepest, rounded
from .table_3_1 import names
from .views import Of, Runs, computed, of_metric, of_seed

SIGNALS = {"smoke": (100, 100), "quick": (10_000, 10_000), "full": (100_000, 1_000_000)}
SIGNS = ("-1", "+1")


def cells(budget: str) -> list[Cell]:
    """The deepest runs of Figure 3.4a, by the author's operators and ours."""
    return deepest(budget, ("as coded", "ours"))


def study(trained: Trained) -> Iterator[Row | Series]:
    """So many signals -1, then so many +1: the memory on the way, how many of each sign every cell
    counted, and how many random signals are answered right."""
    fed, labels = SIGNALS[trained.budget], trained.labels
    yield from rows("signals fed", fed, labels, sign=SIGNS)
    found = counting.counting_study(trained.champions, *fed, key=jax.random.key(50_000))
    memory = rounded(np.moveaxis(np.asarray(found.memory), 0, -1), 2)
    axes = {"seed": trained.seeds, "cell": names(memory.shape[1])}
    at = {"-1": np.unique(found.negatives), "+1": np.unique(found.positives)[1:]}
    first = len(at["-1"])
    for sign, part in (("-1", memory[..., :first]), ("+1", memory[..., first:])):
        here = {**labels, "sign": sign}
        yield from series("memory", "signals of this sign", at[sign], part, here, **axes)
    counted = np.moveaxis(np.asarray(found.counted), 1, 2)
    yield from rows("signals counted", counted, labels, **axes, sign=SIGNS)
    yield from streams(trained, fed[1])


def streams(trained: Trained, signals: int, count: int = 10) -> list[Row]:
    """Signals of random streams of ±1 answered right in a row, by run and stream."""
    key = jax.random.key(60_000)
    found = counting.longest_correct(trained.champions, signals, count, key=key)
    return rows("signals right", found, trained.labels, seed=trained.seeds, stream=None)


def furthest(sign: str) -> Of:
    """How far the cell that counts this sign furthest gets, and which it is."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        here = results.where(sign=sign)
        best = max(of_metric(here, "signals counted").rows, key=lambda row: row.value)
        cell = best.labels["cell"] if best.value else "none"
        return f"{best.value:,} of {here.value('signals fed'):,} ({cell})"

    return of


def to_the_end(results: Results, values: Sequence[Value]) -> page.Cell:
    """How many runs are right to the end, on all of their streams."""
    fed = max(row.value for row in of_metric(results, "signals fed").rows)

    def count(x: np.ndarray) -> str:
        whole = int((x.min(axis=1) >= fed).sum())
        return f"{whole} of {len(x)}" if len(x) > 1 else "yes" if whole else "no"

    return computed("signals right", count)(results, values)


WORST = computed("signals right", lambda x: f"{int(x.min(axis=1).max()):,}")
MEDIAN = computed("signals right", lambda x: f"{int(np.median(x)):,}")


def champion(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """The dissertation's table for the champion that goes furthest, of each preset."""
    for preset in results.levels("preset"):
        here = results.where(preset=preset)
        right, fed = here.by_seed("signals right"), here.value("signals fed", sign="-1")
        best = max(right, key=lambda seed: (min(right[seed]), np.mean(right[seed])))
        body = []
        for sign in SIGNS:
            found = of_seed(here, best).where(sign=sign).curves
            for i, n in enumerate(found[0].at):
                counts = (n, 0) if sign == "-1" else (fed, n)
                body.append([*map("{:,}".format, counts), *(f"{x.values[i]:,.2f}" for x in found)])
        columns = ["#-1", "#+1", *(x.labels["cell"] for x in found)]
        yield page.Table(f"Memory of seed {best}, {preset}", columns, body)


RUNS = Runs(
    "How far each champion counts: {panel}",
    {
        "-1": furthest("-1"),
        "+1": furthest("+1"),
        "random signals right, worst of 10": WORST,
        "median of 10": MEDIAN,
        "right to the end": to_the_end,
    },
    panel=("preset",),
    caption="Counted: the signals of one sign at each of which the cell moved the same way, before "
    "it once did not. Random signals: answered right in a row in streams of ±1, which share their "
    "distractors and are as long as the one of +1.",
)
EXPERIMENT = Experiment(**told("table-3.2"), cells=cells, measures=(study,), views=(RUNS, champion))
