"""Table 3.2: how far the champions count."""

from collections.abc import Iterable, Iterator, Sequence

import jax
import numpy as np

from ..analysis import counting
from ..report import sections as page
from ..report.rows import Results, Row, rows
from .base import Cell, Experiment, Trained, Value
from .fig_3_4a import deepest, rounded
from .table_3_1 import names
from .views import Of, Runs, computed, of_metric, of_seed

SIGNALS = {"smoke": (100, 100), "quick": (10_000, 10_000), "full": (100_000, 1_000_000)}
SIGNS = ("-1", "+1")


def cells(budget: str) -> list[Cell]:
    """The deepest runs of Figure 3.4a, by the author's operators and ours."""
    return deepest(budget, ("as coded", "ours"))


def study(trained: Trained) -> Iterator[Row]:
    """So many signals -1, then so many +1: the memory on the way, and how many of each sign every
    cell counted."""
    fed, key = SIGNALS[trained.budget], jax.random.key(50_000)
    yield from rows("signals fed", fed, trained.labels, sign=SIGNS)
    found = counting.counting_study(trained.champions, *fed, key=key)
    final = rounded(found.memory, 2)
    told = {"seed": trained.seeds, "cell": names(final.shape[2])}
    for minus, plus, memory in zip(found.negatives, found.positives, final, strict=True):
        at = {**trained.labels, "negatives": int(minus), "positives": int(plus)}
        yield from rows("memory", memory, at, **told)
    counted = np.moveaxis(np.asarray(found.counted), 1, 2)
    yield from rows("signals counted", counted, trained.labels, **told, sign=SIGNS)


def streams(trained: Trained, signals: int, count: int = 10) -> list[Row]:
    """Signals of random streams of ±1 answered right in a row, by run and stream."""
    found = counting.longest_correct(trained.champions, signals, count, key=jax.random.key(60_000))
    return rows("signals right", found, trained.labels, seed=trained.seeds, stream=None)


def random_signals(trained: Trained) -> list[Row]:
    """As many as there were of +1."""
    return streams(trained, SIGNALS[trained.budget][1])


def furthest(sign: str) -> Of:
    """How far the cell that counts this sign furthest gets, and which it is."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        found = of_metric(results.where(sign=sign), "signals counted").rows
        best = max(found, key=lambda row: row.value)
        return f"{best.value:,} ({best.labels['cell'] if best.value else 'none'})"

    return of


def champion(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """The dissertation's table for the champion that goes furthest, of each preset."""
    for preset in results.levels("preset"):
        here = results.where(preset=preset)
        right = here.by_seed("signals right")
        best = max(right, key=lambda seed: (min(right[seed]), np.mean(right[seed])))
        run = of_seed(here, best)
        body = []
        for at in run.levels("negatives", "positives"):
            memory = run.where(negatives=at[0], positives=at[1]).rows
            body.append([f"{n:,}" for n in at] + [f"{row.value:,.2f}" for row in memory])
        yield page.Table(
            f"Memory of seed {best}, {preset}", ["#-1", "#+1", *run.levels("cell")], body
        )


EXPERIMENT = Experiment(
    published="Table 3.2 of the dissertation: after 10^5 signals -1 and then 10^6 signals +1, one "
    "cell of the champion counted +1 to 1,000,000; the other counted -1 to 1,244 and saturated.",
    cells=cells,
    measures=(study, random_signals),
    views=(
        Runs(
            "How far each champion counts: {panel}",
            {
                "-1": furthest("-1"),
                "+1": furthest("+1"),
                "random signals right, worst of 10": computed(
                    "signals right", lambda x: f"{int(x.min()):,}"
                ),
                "median of 10": computed("signals right", lambda x: f"{int(np.median(x)):,}"),
            },
            panel=("preset",),
            caption="Counted: the signals of one sign at each of which the cell moved the same "
            "way, before it once did not; 100,000 of -1 were fed and then 1,000,000 of +1 (10,000 "
            "of each at quick). Random signals: answered right in a row in streams of ±1, which "
            "share their distractors; they end at as many as there were of +1.",
        ),
        champion,
    ),
)
