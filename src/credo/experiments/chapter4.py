"""Chapter 4, first half: cooperative coevolution in the Extended T-Maze, and its scores."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from .. import tree
from ..algorithms.ccea import CCEA
from ..algorithms.neuroevolution import author_mutation
from ..analysis import attribution, maze_trace, statistics, tmaze
from ..environments.extended_tmaze import ExtendedTMaze
from ..evolution.islands import Islands
from ..networks.base import AbstractNetwork
from ..networks.mlp import MLP
from ..networks.mmu import MMU
from ..report import mazes
from ..report.page import Curve, Figure, HeatMap, Reference, Table, Text, Tracks
from ..rollout import evaluate
from ..runs.loop import Run
from .base import Cell

BUDGETS = ("smoke", "quick", "full", "published")
EPISODES = 1000  # fresh evaluations of a final champion team; the dissertation used 15
POINTS = 100  # of a learning curve
SMOOTHED = 100  # generations; the author's undisclosed moving average
PARTNERS: tuple[Literal["fsp", "resp"], ...] = ("fsp", "resp")
NETWORKS: dict[str, AbstractNetwork] = {
    "mmu": MMU(
        hidden=20,
        alpha=1.0,
        block_activation="tanh",
        output_activation="tanh",
        start_memory="zero",
        start_weights="open",
    ),
    "ff": MLP(hidden=(20,), activation="sigmoid"),
}


class Plan(NamedTuple):
    """The runs of a cell."""

    generations: int
    runs: int


PLANS = {
    "smoke": Plan(5, 2),
    "quick": Plan(200, 2),
    "full": Plan(2_000, 3),
    "published": Plan(10_000, 10),
}
OPERATORS: dict[str, Any] = {
    # Of an MMU's 2,000 weights about 40 are hit, not 200 as with the author's 20 %.
    "mutation": author_mutation(limit=40.0, fraction=0.03, reset_probability=0.1),
    "cross_repeated": True,
}
ISLANDS = Islands(4, renewal=0.002)  # of Converge beside FSP; beside RESP they do not help
APART = (
    "In Converge beside FSP a population is four islands of 25 that breed apart; every 500 "
    "generations on average the weakest is settled anew."
)
FIRST_SEED = 500  # settings were chosen by looking at other seeds
LONGER = {"fsp": 10_000, "resp": 4_000}  # generations of Converge 3-deep, which rises late
SETTLED = 500  # generations; a feed-forward network has two policies to choose from
TEAMS = Plan(1_000, 3)  # of full budgets: a generation of three robots takes three times as long


def cell(name: str, env: ExtendedTMaze, network: str, budget: str, **fields: Any) -> Cell:
    """Runs of CCEA with one of `NETWORKS`, on the bonuses of a task that has them."""
    given = OPERATORS | {"fitness": "shaped" if env.shaping else None}
    if (env.objective, env.partner) == ("converge", "fsp"):
        given["islands"] = ISLANDS
    algorithm = CCEA.ccea(env, NETWORKS[network], **given | fields)
    if budget == "smoke":
        small = MMU(hidden=3, output_activation="tanh") if network == "mmu" else MLP(hidden=(3,))
        algorithm = dataclasses.replace(
            algorithm,
            network=small,
            population_size=12,
            elite_fraction=0.34,  # one of an island
            teams=1,
            episodes=2,
            test_episodes=2,
        )
    plan = full(env, network) if budget == "full" else PLANS[budget]
    return Cell(name, algorithm, plan.generations, plan.runs, FIRST_SEED)


def full(env: ExtendedTMaze, network: str) -> Plan:
    """Runs of a cell at the full budget."""
    if env.robots > 1:
        return TEAMS
    if network == "ff":
        return PLANS["full"]._replace(generations=SETTLED)
    if env.objective == "converge" and env.depth > 2 and env.partner is not None:
        return PLANS["full"]._replace(generations=LONGER[env.partner])
    return PLANS["full"]


def beside(
    partner: Literal["fsp", "resp"], objective: Literal["converge", "spread"], depth: int
) -> ExtendedTMaze:
    """One robot that learns, beside a static one. Converge has the author's bonuses, for training:
    what is tested and reported is the score."""
    return ExtendedTMaze(
        depth=depth, objective=objective, partner=partner, shaping=objective == "converge"
    )


def beside_a_static_robot(objective: Literal["converge", "spread"], budget: str) -> list[Cell]:
    """Figures 4.2 and 4.3: a learning robot beside a static one, by depth, kind and network."""
    depths = (2,) if budget == "smoke" else (2, 3)
    return [
        cell(
            f"{objective} {depth}-deep, {partner}, {network}",
            beside(partner, objective, depth),
            network,
            budget,
        )
        for depth in depths
        for partner in PARTNERS
        for network in NETWORKS
    ]


# ---------------------------------------------------------------------------------------- scores


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    """Scores of every cell."""
    return {name: outcome(name, cell) for name, cell in runs.items()}


def outcome(name: str, runs: list[Run]) -> dict[str, Any]:
    """Learning of a cell, beside floors and what nobody can pass, and an episode of its best."""
    env = runs[0].algorithm.env
    kind, bound = tmaze.ceiling(env)
    found = learned(name, runs, EPISODES, "score", 4)
    best = int(np.argmax([-np.inf if x is None else x for x in found["final"]]))
    return found | {
        "floors": {name: round(share, 4) for name, share in floors(env).items()},
        "ceiling": [kind, round(bound, 4)],
        "episode": episode(best, env, runs[best].champion),
    }


def episode(run: int, env: ExtendedTMaze, champion: Any) -> dict[str, Any] | None:
    """One episode of a run's champion, trial by trial; None if it has no memory, where all trials
    are the same. Of a team without what is in its memories: too much for a page."""
    key = jax.random.key(20_001)
    if not jax.tree.leaves(champion.start(key=key)):
        return None
    trace = maze_trace.trace_maze(env, champion, key=key)
    left_out = {} if env.robots == 1 else {"memory": None}
    return {"run": run} | trace.plain(env) | left_out


def learned(name: str, runs: list[Run], episodes: int, signal: str, digits: int) -> dict[str, Any]:
    """Curves of the champions' tests, and the final champions in fresh episodes that they share."""
    env = runs[0].algorithm.env
    champions = tree.stack(*(run.champion for run in runs))
    played = evaluate(env, champions, episodes, key=jax.random.key(20_000))
    scores = np.stack([run.metrics["champion_score"] for run in runs])
    grid = np.unique(np.linspace(0, scores.shape[1] - 1, POINTS).astype(int))
    where, network = name.rsplit(", ", 1)
    smoothed = statistics.moving_average(scores, SMOOTHED)[:, grid]
    return {
        "where": where,
        "network": network,
        "generation": (grid + 1).tolist(),
        "smoothed": attribution.plain(smoothed, digits - 1),
        "final": attribution.plain(np.mean(played.of(signal), axis=1), digits),
    }


def floors(env: ExtendedTMaze) -> dict[str, float]:
    """Shares of trials that take no learning."""
    if env.robots == 1:
        return tmaze.floors(env)
    # Every endpoint is as likely as any other; without memory there are the first and the last.
    return {"one at each end": min(2, env.robots) / env.endpoints}


# ----------------------------------------------------------------------------------------- pages


def curves(measured: dict[str, Any]) -> list[Figure]:
    """A figure per task: the champion team of each generation, smoothed."""
    return by_place(
        measured,
        "share of trials",
        lambda cell: cell["floors"] | {cell["ceiling"][0]: cell["ceiling"][1]},
    )


def by_place(
    measured: dict[str, Any], y_label: str, levels: Callable[[dict[str, Any]], dict[str, float]]
) -> list[Figure]:
    """A figure per place, with every network and the levels of the place."""
    figures = []
    for where in dict.fromkeys(cell["where"] for cell in measured.values()):
        found = [cell for cell in measured.values() if cell["where"] == where]
        figures.append(
            Figure(
                where,
                "generation",
                y_label,
                [Curve(cell["network"], cell["generation"], cell["smoothed"]) for cell in found],
                references=tuple(Reference(*level) for level in levels(found[0]).items()),
                caption=f"Mean of {SMOOTHED} generations, as the author's.",
            )
        )
    return figures


def pictures(measured: dict[str, Any]) -> list[Tracks | HeatMap]:
    """An episode of the best final champion of each cell that has memory; nothing of results that
    were measured before there were such pictures."""
    return [
        picture
        for name, cell in measured.items()
        if cell.get("episode") is not None
        for picture in mazes.pictures(
            f"An episode of {name}: run {cell['episode']['run']}, the best of {len(cell['final'])}",
            cell["episode"],
        )
    ]


def scores(measured: dict[str, Any], published: dict[str, str]) -> Table:
    """Every cell beside floors, what was published, and what nobody can pass."""
    rows = []
    for name, cell in measured.items():
        kind, bound = cell["ceiling"]
        final = np.array(cell["final"])
        # To imitate takes no learning, but memory; in Converge it is also what nobody can pass.
        floor = [share for name, share in cell["floors"].items() if name != tmaze.IMITATING]
        rows.append(
            [
                cell["where"],
                cell["network"],
                percent(max(floor, default=0.0)),
                published.get(name, "–"),
                spread(final),
                f"{percent(bound)} ({kind})",
                percent(float(np.median(final)) / bound),
            ]
        )
    return Table(
        "Share of trials in which the final champion team observes the reward, %",
        [
            "task",
            "network",
            "floor: best without memory",
            "published",
            "ours, median (range)",
            "nobody can pass",
            "ours, share of that",
        ],
        rows,
        caption=f"Ours: {EPISODES} fresh evaluations without change of the networks. Floors and "
        "optima are exact; an upper bound may be out of reach: credo.analysis.tmaze.",
    )


def percent(x: float) -> str:
    return f"{100 * x:.1f}"


def spread(x: Any, times: float = 100) -> str:
    """Median and range over runs, as percent or `times` as much; of one run just that."""
    x = times * np.asarray(x)
    if x.size == 1:
        return f"{x.item():.1f}"
    return f"{np.median(x):.1f} ({x.min():.1f}…{x.max():.1f})"


def about(*paragraphs: str) -> Text:
    """What to know before comparing."""
    return Text(
        "How to read it",
        [
            "CCEA (Algorithm 4) with k 100, φ 5, z 7, a test of 15 evaluations per generation; "
            "networks of 20 hidden units. Both kinds of network have the same operators: those of "
            "the author's sequence code (one gate per genome, a part of each matrix hit with 20 % "
            "noise, repeated survivors crossed), with one entry and up to 3 % of a matrix hit in "
            "place of 20 %, a tenth of the hits drawn anew, weights clipped to ±40; Algorithm 4 "
            "prints 10 % noise and no crossover. Biases are mutated too. MMUs have α 1, a tanh for "
            "φ and no memory at first; their input and write gates start open, read gates shut, "
            "weights on inputs large and on memory small. These settings were chosen for the MMU "
            "on Converge beside FSP, with other seeds, the start by its first 100 generations at "
            "depth 3; nothing was chosen for feed-forward networks, which can play two policies "
            "only.",
            *paragraphs,
        ],
    )
