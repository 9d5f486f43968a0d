"""Figures 4.2 to 4.4: robots in Extended T-Mazes, beside a static one (Converge and Spread) and in
teams that learn. Also the budgets and learning curves of all of chapter 4.

Figures 4.2 (Converge, section 4.1.4) and 4.3 (Spread, 4.1.5) have one learning robot beside a
static one: FSP explores the endpoints in a fixed order, RESP in one drawn for each evaluation.
Figure 4.4 (4.1.6) has teams of 2 to 4 that learn. All are at depths 2 and 3 (4 and 8 endpoints) and
compare MMUs with feed-forward networks of as many hidden units: what memory is worth.

The dissertation has 10 runs and tests of 15 evaluations. `published` is 10,000 generations and 10
runs, `quick` 200 and 2; the function `full` says what `full` is.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Literal

import jax
import numpy as np

from ..algorithms.ccea import CCEA
from ..algorithms.neuroevolution import author_mutation
from ..analysis import bounds, maze_trace, statistics, tmaze
from ..environments.extended_tmaze import ExtendedTMaze
from ..evolution.breeder import altered
from ..evolution.islands import Islands
from ..networks.base import AbstractNetwork
from ..networks.mlp import MLP
from ..networks.mmu import MMU
from ..networks.recurrent import Recurrent
from ..report import mazes
from ..report import sections as page
from ..report.rows import Results, Row, Series
from .base import Cell, Experiment, Measure, Trained, Value, named, rounded
from .measures import returns
from .memories import names
from .views import Curves, Table, known, mean, median, of_metric, panels, present, published

BUDGETS = ("smoke", "quick", "full", "published")
POINTS, SMOOTHED = 100, 100  # of a learning curve; generations of the author's moving average
START: dict[str, Any] = {"start_memory": "zero", "start_weights": "open"}
NETWORKS: dict[str, tuple[AbstractNetwork, AbstractNetwork]] = {  # and a tiny one for smoke
    "mmu": (
        MMU(hidden=20, alpha=1.0, block_activation="tanh", output_activation="tanh", **START),
        MMU(hidden=3, output_activation="tanh"),
    ),
    "ff": (MLP(hidden=(20,), activation="sigmoid"), MLP(hidden=(3,))),
    "lstm": (Recurrent("lstm", 20, "tanh"), Recurrent("lstm", 3, "tanh")),
    "gru": (Recurrent("gru", 20, "tanh"), Recurrent("gru", 3, "tanh")),
}
OPERATORS: dict[str, Any] = {
    # Of an MMU's 2,000 weights about 40 are hit, not 200 as with the author's 20 %.
    "mutation": author_mutation(limit=40.0, fraction=0.03, reset_probability=0.1),
    "cross_repeated": True,
}
ISLANDS = Islands(4, renewal=0.002)
"""Of Converge beside FSP; beside RESP they did not help. docs/notes/team-memory.md has the trials
behind this, `START` and `OPERATORS`, and the seeds that they were made with."""
SMOKE = {"population_size": 12, "elite_fraction": 0.34, "teams": 1}  # an elite an island
SMOKE |= {"episodes": 2, "test_episodes": 2}
PLANS = {"smoke": (5, 2), "quick": (200, 2), "published": (10_000, 10)}  # generations, runs
LONGER = {"fsp": 10_000, "resp": 4_000}  # generations of Converge 3-deep, which rises late
PLACE = ("task", "depth", "partner", "robots")
LINE = ("network", "fitness")
METRIC = "share of trials"
EPISODE = ("goal", "observed", "partner", "endpoint", "company", "reward")
OF_ROBOTS = ("endpoint", "company", "reward")
Task = Literal["converge", "spread"]
Partner = Literal["fsp", "resp"]


def cell(
    budget: str,
    task: Task,
    depth: int,
    network: str,
    *,
    partner: Partner | None = None,
    robots: int = 1,
    fitness: str | None = None,
) -> Cell:
    """Runs of CCEA in an Extended T-Maze: one robot beside a static `partner`, or a team of
    `robots` that learn.

    Converge has the author's bonuses, for training: what is tested and reported is the score.
    `fitness`: a reward of the task beside its score; None: the score, or with the bonuses.
    """
    place: dict[str, Any] = {"partner": partner} if partner else {"robots": robots}
    labels = {"task": task, "depth": depth, **place, "network": network}
    labels |= {"fitness": fitness} if fitness else {}
    bonus = task == "converge" and partner is not None
    env = ExtendedTMaze(depth, robots=robots, objective=task, partner=partner, shaping=bonus)
    env = replace(env, rewards=("score", fitness)) if fitness else env
    fields = OPERATORS | {"fitness": fitness or ("shaped" if bonus else None)}
    fields |= {"islands": ISLANDS} if (task, partner) == ("converge", "fsp") else {}
    large, tiny = NETWORKS[network]
    algorithm = CCEA.ccea(env, large, **fields)
    if budget == "smoke":
        algorithm = altered(algorithm, network=tiny, **SMOKE)
    generations, runs = full(env, network) if budget == "full" else PLANS[budget]
    return Cell(labels, algorithm, range(500, 500 + runs), generations)  # chosen on other seeds


def full(env: ExtendedTMaze, network: str) -> tuple[int, int]:
    """Generations and runs at the full budget. A generation of three robots takes three times as
    long as one of one; a feed-forward network has two policies to choose from, and finds the better
    one soon."""
    if env.robots > 1:
        return 1_000, 3
    if network == "ff":
        return 500, 3
    late = env.objective == "converge" and env.depth > 2
    return (LONGER[env.partner] if late and env.partner else 2_000), 3


def every(task: Task, **places: Sequence[Any]) -> Callable[[str], list[Cell]]:
    """Cells of both networks at both depths, by budget. `places`: partners or sizes of a team, of
    which smoke has what costs little: one depth, both partners and the smallest team."""

    def cells(budget: str) -> list[Cell]:
        ((name, chosen),) = places.items()
        smoke = budget == "smoke"
        return [
            cell(budget, task, depth, network, **{name: place})
            for depth in ((2,) if smoke else (2, 3))
            for place in (chosen[:1] if smoke and name == "robots" else chosen)
            for network in ("mmu", "ff")
        ]

    return cells


def smoothed(metric: str, digits: int) -> Measure:
    """The champions' tests on the way, smoothed by the author's moving average."""

    def measure(trained: Trained) -> list[Series]:
        scores = trained.scores
        at = np.unique(np.linspace(0, scores.shape[1] - 1, POINTS).astype(int))
        values = statistics.moving_average(scores, SMOOTHED)[:, at]
        return trained.series(f"test {metric}, smoothed", ("generation", at + 1), values, digits)

    return measure


def levels(trained: Trained) -> list[Row]:
    """Exact shares of policies that take no learning, and their upper bound: facts "baseline" by
    `policy`, and "upper bound", whose label `kind` is "optimal" where a policy reaches it."""
    known, (bound, kind) = bounds.baselines(trained.env), bounds.upper_bound(trained.env)
    baselines = [trained.fact("baseline", round(known[k], 4), policy=k) for k in known]
    return [*baselines, trained.fact("upper bound", round(bound, 4), kind=kind)]


def shares(trained: Trained) -> Iterator[Row | Series]:
    """Shares of trials in which the reward is observed, in 1,000 fresh episodes (the dissertation
    used 15); and one episode of the best champion, if it has memory.

    **Returns:** a row "share of trials" in [0, 1] for each run; of a cell with memory "best run"
    (its place among the seeds, from 0) and the series of `episode` over "trial".
    """
    final = returns(trained.env, trained.champions, 1000, reward="score").mean(axis=1)
    yield from trained.rows(METRIC, final, 4)
    best = int(np.argmax(np.where(np.isfinite(final), rounded(final, 4), -np.inf)))
    champion, key = trained.runs[best].champion, jax.random.key(20_001)
    if jax.tree.leaves(champion.start(key=key)):
        yield trained.fact("best run", best)
        trace = maze_trace.trace_maze(trained.env, champion, key=key)
        yield from episode(trained, trained.seeds[best], trace.plain(trained.env))


def episode(trained: Trained, seed: int, played: dict[str, Any]) -> Iterator[Series]:
    """An episode, trial by trial. Of a team without its memories: too much for a page."""
    at, robots = ("trial", range(1, trained.env.trials + 1)), range(1, trained.env.robots + 1)
    one = trained.part(seed)
    for metric in EPISODE:
        each: dict[str, Any] = {"robot": robots} if metric in OF_ROBOTS else {}
        if played[metric] is not None:
            yield from one.series(metric, at, [played[metric]], **each)
    if len(robots) == 1:
        cells = names(len(played["memory"][0]))
        yield from one.series("memory", at, [played["memory"]], robot=robots, cell=cells)


def pictures(results: Results, values: Sequence[Value]) -> Iterator[page.Section]:
    """An episode of the best final champion of each cell that has memory."""
    for labels, here in panels(results, (*PLACE, *LINE)):
        curves = {x: of_metric(here, x).curves for x in (*EPISODE, "memory")}
        if not curves["goal"]:
            continue
        found = {metric: [x.values for x in lines] for metric, lines in curves.items()}
        played = {x: found[x] if x in OF_ROBOTS else next(iter(found[x]), None) for x in EPISODE}
        played |= {"depth": labels["depth"], "memory": [found["memory"]] if found["memory"] else ()}
        name, seeds = named(present(labels)), len(here.by_seed(METRIC))
        title = f"An episode of {name}: seed {curves['goal'][0].seed}, the best of {seeds}"
        yield from mazes.pictures(title, played)


def without_memory(results: Results, values: Sequence[Value]) -> page.Cell:
    """The best share without memory. To imitate takes no learning, but memory; in Converge it is
    also the upper bound."""
    found = of_metric(results, "baseline").rows
    best = [row.value for row in found if row.labels["policy"] != tmaze.IMITATING]
    return f"{100 * max(best, default=0.0):.1f}" if found else None


def bound(results: Results, values: Sequence[Value]) -> page.Cell:
    """The upper bound, and how far to trust it."""
    found = of_metric(results, "upper bound").rows
    return f"{100 * found[0].value:.1f} ({found[0].labels['kind']})" if found else None


def of_the_bound(results: Results, values: Sequence[Value]) -> page.Cell:
    """What share of the upper bound the median run has."""
    final = [x for (x,) in results.by_seed(METRIC).values() if x is not None]
    return f"{100 * float(np.median(final)) / results.value('upper bound'):.1f}" if final else None


SCORES = Table(
    "Share of trials in which the final champion team observes the reward, %",
    (*PLACE, *LINE),
    {
        "baseline: best without memory": without_memory,
        "published": published(METRIC),
        "measured": mean(METRIC, 100, 1),
        "median (range)": median(METRIC, 100),
        "upper bound": bound,
        "median, share of the upper bound": of_the_bound,
    },
    caption="Measured: 1,000 fresh episodes without change of the networks. Published: mean ± "
    "standard error. Baselines and optima are exact; an upper bound may be out of reach: "
    "credo.analysis.tmaze.",
)
POLICIES = ("always left", "always right", "static robot alone", tmaze.IMITATING, "one at each end")
CURVES = Curves(
    f"test {METRIC}, smoothed",
    "generation",
    line=LINE,
    panel=PLACE,
    y_label="share of trials",
    levels={name: known("baseline", policy=name) for name in POLICIES}
    | {kind: known("upper bound", kind=kind) for kind in ("optimal", "upper bound")},
    caption=f"The champion team of each generation; mean of {SMOOTHED} generations, as the "
    "author's.",
)
MEASURES = (levels, shares, smoothed(METRIC, 3))
EXPERIMENTS = {
    name: Experiment(cells, MEASURES, (SCORES, CURVES, pictures), BUDGETS)
    for name, cells in {
        "fig-4.2": every("converge", partner=("fsp", "resp")),
        "fig-4.3": every("spread", partner=("fsp", "resp")),
        "fig-4.4": every("spread", robots=(2, 3, 4)),
    }.items()
}
