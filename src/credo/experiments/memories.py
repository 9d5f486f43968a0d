"""Tables 3.1 and 3.2, Figures 3.6 and 3.7, Algorithm 3: what the 21-deep champions of Figure 3.4a
remember, when they write, and how far they count.

The case study of section 3.2.3 looks into one network, "21-champ": its final memories (3.2.3.1,
Table 3.1), its writes (3.2.3.2, Figures 3.6 and 3.7), how far it counts (3.2.3.3, Table 3.2) and
the algorithm that it runs (3.2.3.4). Here every run is measured, of the author's operators and of
ours, so that a reader sees how usual such a network is, and the best run of each is shown on its
own as the dissertation does. It is the one that answers most signals of random streams (`lengths`);
Table 3.2 chooses it by streams of its own. A budget is that of Figure 3.4a; at smoke champions are
3-deep.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..analysis import counting, memory
from ..environments.sequence_classification import SequenceClassification
from ..report import sections as page
from ..report.rows import Results, Row, Series, rows, series
from .base import Cell, Experiment, Trained, Value
from .sequences import deepest, deepest_coded
from .views import SEED, Of, Table, computed, each, of_metric, of_seed

SIGNALS = {"smoke": (100, 100), "quick": (10_000, 10_000), "full": (100_000, 1_000_000)}
"""Signals -1, then +1, that the counting study feeds; at full those of Table 3.2."""
SIGNS = ("-1", "+1")
ROLES = {  # metrics of `memory.CellRole`
    "plus": "move at +1",
    "minus": "move at -1",
    "distractor": "move at a distractor",
    "drift": "drift between signals",
    "plus_share": "share of +1 at which it moves",
    "minus_share": "share of -1 at which it moves",
    "role": "role",
}

# ------------------------------------------------------------------------------ the best champion


def streams(trained: Trained, signals: int, count: int = 10) -> list[Row]:
    """Signals of random streams of ±1 answered right in a row, by run and stream.

    **Arguments:** `signals`: length of a stream, at least 1. `count`: how many streams.

    **Returns:** a row "signals right" in 0..`signals` for each run and `stream`.
    """
    found = counting.longest_correct(trained.champions, signals, count, key=jax.random.key(60_000))
    return trained.rows("signals right", found, stream=None)


def lengths(trained: Trained) -> np.ndarray:
    """How many signals of random streams each champion answers right in a row: the mean of 10
    streams of at most 10,000. The champion of champions is the one with most."""
    found = counting.longest_correct(trained.champions, 10_000, key=jax.random.key(30_000))
    return np.asarray(found, np.float64).mean(axis=1)


def signals_right(trained: Trained) -> list[Row]:
    """`lengths`, and the best run: its place among the seeds of the cell, from 0."""
    found = lengths(trained)
    best = trained.fact("best run", int(found.argmax()))
    return [best, *trained.rows("signals right", found, 1)]


def best_seed(results: Results) -> int:
    """The seed of the run that is shown on its own."""
    return results.cells[0]["seeds"][results.value("best run")]


def of_best(view: Callable[..., Iterable[page.Section]]) -> Callable[..., Any]:
    """A view of the best run alone."""
    return lambda results, values: view(of_seed(results, best_seed(results)), values)


def of_presets(view: Callable[..., Iterable[page.Section]]) -> Callable[..., Any]:
    """A view of each preset, which is named in its titles."""

    def views(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
        for preset in results.levels("preset"):
            for section in view(results.where(preset=preset), values):
                yield replace(section, title=f"{section.title}, {preset}")

    return views


def names(cells: int) -> list[str]:
    """Memory cells as the dissertation names them: M1, M2, …"""
    return [f"M{i + 1}" for i in range(cells)]


# ----------------------------------------------------------------------------- what they end in


def probe(trained: Trained) -> Iterator[Row]:
    """What each champion's memory ends in, by permutation, and its cells from 0 that are needed.

    The sequences are those of Table 3.1: all 8 of depth 3, 15 distractors between signals.
    **Returns:** for each run and permutation "memory" by cell, "signature" (needed cells in
    ascending order of their value) by rank, and "right"; for each run "masking costs" by cell (the
    share of success lost when it is held at 0), "needed", "spread within equal sums" and
    "signature predicts class".
    """
    task = SequenceClassification(depth=3, min_gap=15, max_gap=15)
    for seed, run in zip(trained.seeds, trained.runs, strict=True):
        one, found = trained.part(seed), memory.probe(run.champion, task)
        cells = names(len(found["masking costs"]))
        for i, signals in enumerate(found["permutations"].tolist()):
            here = one.part(permutation=str(signals), sum=int(found["sums"][i]))
            yield from here.rows("memory", [found["memory"][i]], 2, cell=cells)
            yield from here.rows("signature", [found["signatures"][i]], rank=None)
            yield from here.rows("right", [found["right"][i]])
        yield from one.rows("masking costs", [found["masking costs"]], 3, cell=cells)
        yield from one.rows("needed", [found["needed"]], rank=None)
        yield from one.rows("spread within equal sums", [found["spread"]], 4)
        yield from one.rows("signature predicts class", [found["predicts"]])


def needed(results: Results, values: Sequence[Value] = ()) -> str:
    """The cells that a run needs: "M1, M3"."""
    return ", ".join(f"M{x.value + 1}" for x in of_metric(results, "needed").rows)


def states(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """Table 3.1 of one run."""
    cells, body = needed(results), []
    for permutation, total in results.levels("permutation", "sum"):
        here = results.where(permutation=permutation)
        final = {x.labels["cell"]: x.value for x in of_metric(here, "memory").rows}
        relevant = [final[cell] for cell in cells.split(", ") if cell]
        signature = [x.value for x in of_metric(here, "signature").rows]
        shown = map(str, [list(final.values()), relevant, signature])
        body.append([permutation, f"{total:+d}", *shown, yes("right")(here, values)])
    title = f"Champion of seed {best_seed(results)}, the best of its cell; needed: {cells}"
    columns = ["permutation", "sum", "final memory", f"[{cells}]", "signature", "right"]
    yield page.Table(title, columns, body, caption="15 distractors between signals.")


def yes(metric: str) -> Of:
    """Yes or no, of one run."""
    return computed(metric, lambda x: "yes" if x.all() else "no")


IN_A_ROW = {"random signals right in a row": each("signals right", form=".0f")}
EVERY_RUN = Table(
    "Every run: {panel}",
    [SEED],
    IN_A_ROW
    | {
        "permutations right": computed("right", lambda x: f"{x.sum():.0f}/8"),
        "needed cells": needed,
        "spread within equal sums": each("spread within equal sums", form=".2g"),
        "signature predicts class": yes("signature predicts class"),
    },
    panel=("preset",),
    caption="Spread: the largest difference of a needed cell's final value between permutations "
    "of equal sum; 0 in the dissertation's champion. Random signals: mean of 10 streams of at "
    "most 10,000.",
)

# ----------------------------------------------------------------------------- when they write


def writes_on(signals: Sequence[float]) -> Callable[[Trained], Iterator[Row | Series]]:
    """A measure: writes of the best champion, 15 distractors between these signals; and for every
    champion the share of its writing that happens at signals.

    **Returns:** series "input" of the cell and "write" (magnitude, by memory cell) of the best
    champion over "step", counted from 1; rows "share at signals" in [0, 1], one per run.
    """

    def measure(trained: Trained) -> Iterator[Row | Series]:
        depth, given = len(signals), jnp.asarray(signals, jnp.float32)
        inputs = SequenceClassification(depth, 15, 15).lay_out(given, jnp.full(depth, 15)).inputs
        best, at = int(lengths(trained).argmax()), ("step", np.arange(1, len(inputs) + 1))
        yield trained.fact("best run", best)
        yield from series("input", *at, np.asarray(inputs[:, 0], int), trained.labels)
        found = [jnp.abs(memory.writes(run.champion, inputs)) for run in trained.runs]
        cells, one = found[best].T, trained.part(trained.seeds[best])
        yield from one.series("write", at, [cells], 3, cell=names(len(cells)))
        share = [memory.share_at_signals(x, inputs) for x in found]
        yield from trained.rows("share at signals", share, 4)

    return measure


def write_map(
    title: str, writes: Sequence[Series], steps: Mapping[int, str], x_label: str
) -> page.HeatMap:
    """How far some `steps`, by their places and names, move each cell."""
    values = [[curve.values[i] for i in steps] for curve in writes]
    cells = [str(curve.labels["cell"]) for curve in writes]
    return page.HeatMap(title, values, cells, list(steps.values()), x_label, "memory cell")


def writes(signals_only: bool) -> Callable[..., Iterable[page.Section]]:
    """A view: how far each step of the best champion moves each cell."""

    def view(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
        inputs = of_metric(results, "input").curves[0].values
        steps = {i: f"{x:+d}" if x else "0" for i, x in enumerate(inputs) if x or not signals_only}
        title = f"Write magnitude of the champion of seed {best_seed(results)}"
        yield write_map(title, of_metric(results, "write").curves, steps, "input")

    return view


SHARES = Table(
    "Share of all writing that happens at signals: {panel}",
    [SEED],
    {"share": each("share at signals", form=".2%")},
    panel=("preset",),
    caption="100 % where distractors move nothing, as published for the champion.",
)

# ------------------------------------------------------------------------------ how far they count


def ours_and_coded(budget: str) -> list[Cell]:
    """By the author's operators and ours."""
    return deepest_coded(budget) + deepest(budget)


def study(trained: Trained) -> Iterator[Row | Series]:
    """So many signals -1, then so many +1: the memory on the way, how many of each sign every cell
    counted, and how many random signals are answered right.

    **Returns:** for each run series "memory" by cell and sign over "signals of this sign" (1, 2, 5,
    10, …), rows "signals counted" by cell and sign, and ten rows "signals right" (`streams`, as
    long as the second part). "signals fed" by sign belongs to the cell.
    """
    fed = SIGNALS[trained.budget]
    yield from rows("signals fed", fed, trained.labels, sign=SIGNS)
    found = counting.counting_study(trained.champions, *fed, key=jax.random.key(50_000))
    held = np.moveaxis(np.asarray(found.memory), 0, -1)
    minus, plus = np.unique(found.negatives), np.unique(found.positives)[1:]
    parts = (minus, held[..., : len(minus)]), (plus, held[..., len(minus) :])
    cells = names(held.shape[1])
    for sign, (at, part) in zip(SIGNS, parts, strict=True):
        here, axis = trained.part(sign=sign), ("signals of this sign", at)
        yield from here.series("memory", axis, part, 2, cell=cells)
    counted = np.moveaxis(np.asarray(found.counted), 1, 2)
    yield from trained.rows("signals counted", counted, cell=cells, sign=SIGNS)
    yield from streams(trained, fed[1])


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


COUNTED = Table(
    "How far each champion counts: {panel}",
    [SEED],
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

# --------------------------------------------------------------------------- the algorithm they run


def roles(trained: Trained) -> Iterator[Row]:
    """Mean moves of each cell of each champion in 50 sequences, and what they amount to; of the
    best one the whole algorithm as text.

    **Returns:** the rows of `signals_right`, a text "algorithm", and for each run and memory cell
    the metrics of `ROLES`; moves are in units of memory per step.
    """
    best, *lengths = signals_right(trained)
    task, key = SequenceClassification(depth=21), jax.random.key(70_000)
    found = [memory.pseudo_algorithm(run.champion, task, key=key) for run in trained.runs]
    yield from (best, *lengths, trained.fact("algorithm", memory.describe(found[best.value])))
    for seed, cells in zip(trained.seeds, found, strict=True):
        for role in cells:
            here = trained.part(seed, cell=f"M{role.cell + 1}")
            for name, metric in ROLES.items():
                yield from here.rows(metric, [getattr(role, name)])


def algorithm(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """The pseudo-algorithm of the best run."""
    yield page.Text(f"Seed {best_seed(results)}", results.value("algorithm").split("\n"))


MOVES = {
    "at +1": each("move at +1", form="+.3f"),
    "at -1": each("move at -1", form="+.3f"),
    "at a distractor": each("move at a distractor", form="+.2g"),
    "role": each("role", form=""),
}
OF_CELLS = of_best(Table("Its cells: mean move per step", ("cell",), MOVES))
OF_RUNS = IN_A_ROW | {cell: each("role", form="", cell=cell) for cell in names(5)}
FLIPS = [-1.0, 1.0] * 10 + [-1.0]
EXPERIMENTS = {
    "table-3.1": Experiment(
        ours_and_coded, (signals_right, probe), (of_presets(of_best(states)), EVERY_RUN)
    ),
    "table-3.2": Experiment(ours_and_coded, (study,), (COUNTED, champion)),
    "fig-3.6": Experiment(
        ours_and_coded, (writes_on([-1.0, 1.0, -1.0]),), (of_presets(writes(False)), SHARES)
    ),
    "fig-3.7": Experiment(ours_and_coded, (writes_on(FLIPS),), (of_presets(writes(True)), SHARES)),
    "alg-3.3": Experiment(
        ours_and_coded,
        (roles,),
        (
            of_presets(algorithm),
            of_presets(OF_CELLS),
            Table("Every run: {panel}", [SEED], OF_RUNS, panel=("preset",)),
        ),
    ),
}
