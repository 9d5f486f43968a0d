"""Figure 4.2: Converge, a learning robot beside a static one. Also what all T-mazes of chapter 4
share: cells, measurements, pictures, the table."""

from collections.abc import Iterator, Sequence
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
from ..report.rows import Results, Row, Series, rows, series
from ..rollout import evaluate
from .base import Cell, Experiment, Trained, Value, named
from .dissertation import notes, told
from .fig_3_4a import rounded
from .table_3_1 import names
from .views import Curves, Table, combinations, known, mean, median, of_metric, present, published

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
ISLANDS = Islands(4, renewal=0.002)  # of Converge beside FSP; beside RESP they do not help
SMOKE = {"population_size": 12, "elite_fraction": 0.34, "teams": 1}  # an elite an island
SMOKE |= {"episodes": 2, "test_episodes": 2}
PLANS = {"smoke": (5, 2), "quick": (200, 2), "published": (10_000, 10)}  # generations, runs
LONGER = {"fsp": 10_000, "resp": 4_000}  # generations of Converge 3-deep, which rises late
PLACE = ("task", "depth", "partner", "robots")
LINE = ("network", "fitness")
METRIC = "share of trials"
EPISODE = ("goal", "observed", "partner", "endpoint", "company", "reward")
OF_ROBOTS = ("endpoint", "company", "reward")


def cell(
    budget: str,
    task: Literal["converge", "spread"],
    depth: int,
    network: str,
    *,
    partner: Literal["fsp", "resp"] | None = None,
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
    long as one of one; a feed-forward network has two policies to choose from, and is settled."""
    if env.robots > 1:
        return 1_000, 3
    if network == "ff":
        return 500, 3
    late = env.objective == "converge" and env.depth > 2
    return (LONGER[env.partner] if late and env.partner else 2_000), 3


def beside_a_static_robot(task: Literal["converge", "spread"], budget: str) -> list[Cell]:
    """Figures 4.2 and 4.3: a learning robot beside a static one, by depth, kind and network."""
    partners: tuple[Literal["fsp", "resp"], ...] = ("fsp", "resp")
    return [
        cell(budget, task, depth, network, partner=partner)
        for depth in ((2,) if budget == "smoke" else (2, 3))
        for partner in partners
        for network in ("mmu", "ff")
    ]


def cells(budget: str) -> list[Cell]:
    """Converge."""
    return beside_a_static_robot("converge", budget)


def learned(
    trained: Trained, metric: str, reward: str, episodes: int, digits: int
) -> list[Row | Series]:
    """The final champions in fresh episodes that all of them share, and the champions' tests on
    the way, smoothed by the author's moving average."""
    played = evaluate(trained.env, trained.champions, episodes, key=jax.random.key(20_000))
    final = rounded(np.mean(played.of(reward), axis=1), digits)
    scores = np.stack([run.metrics["champion_score"] for run in trained.runs])
    at = np.unique(np.linspace(0, scores.shape[1] - 1, POINTS).astype(int))
    smoothed = rounded(statistics.moving_average(scores, SMOOTHED)[:, at], digits - 1)
    axes: dict[str, Any] = {"labels": trained.labels, "seed": trained.seeds}
    lines = series(f"test {metric}, smoothed", "generation", at + 1, smoothed, **axes)
    return [*rows(metric, final, **axes), *lines]


def levels(trained: Trained) -> list[Row]:
    """Exact shares of policies that take no learning, and their upper bound."""
    env, labels = trained.env, trained.labels
    known, (bound, kind) = bounds.baselines(env), bounds.upper_bound(env)
    baselines = [Row({**labels, "policy": k}, None, "baseline", round(known[k], 4)) for k in known]
    return [*baselines, Row({**labels, "kind": kind}, None, "upper bound", round(bound, 4))]


def shares(trained: Trained) -> Iterator[Row | Series]:
    """Shares of trials in which the reward is observed, in 1,000 fresh episodes (the dissertation
    used 15); and one episode of the best champion, if it has memory."""
    found = learned(trained, METRIC, "score", 1000, 4)
    yield from found
    final = [-np.inf if row.value is None else row.value for row in found if isinstance(row, Row)]
    best = int(np.argmax(final))
    champion, key = trained.runs[best].champion, jax.random.key(20_001)
    if jax.tree.leaves(champion.start(key=key)):
        yield Row(trained.labels, None, "best run", best)
        trace = maze_trace.trace_maze(trained.env, champion, key=key)
        yield from episode(trained, trained.seeds[best], trace.plain(trained.env))


def episode(trained: Trained, seed: int, played: dict[str, Any]) -> Iterator[Series]:
    """An episode, trial by trial. Of a team without its memories: too much for a page."""
    axes: dict[str, Any] = {"labels": trained.labels, "seed": [seed]}
    at, robots = range(1, trained.env.trials + 1), range(1, trained.env.robots + 1)
    for metric in EPISODE:
        each: dict[str, Any] = {"robot": robots} if metric in OF_ROBOTS else {}
        if played[metric] is not None:
            yield from series(metric, "trial", at, [played[metric]], **axes, **each)
    if len(robots) == 1:
        axes |= {"robot": robots, "cell": names(len(played["memory"][0]))}
        yield from series("memory", "trial", at, [played["memory"]], **axes)


def pictures(results: Results, values: Sequence[Value]) -> Iterator[page.Section]:
    """An episode of the best final champion of each cell that has memory."""
    for key in combinations(results, (*PLACE, *LINE)):
        labels: dict[str, Any] = dict(zip((*PLACE, *LINE), key, strict=True))
        here = results.where(**labels)
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
    rows=(*PLACE, *LINE),
    columns={
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
MEASURES = (levels, shares)
VIEWS = (SCORES, CURVES, pictures)
EXPERIMENT = Experiment(
    **told("fig-4.2"),
    budgets=BUDGETS,
    cells=cells,
    measures=MEASURES,
    views=(*VIEWS, notes("T-mazes", "fig-4.2")),
)
