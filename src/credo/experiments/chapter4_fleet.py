"""Chapter 4, second half: fleets of servers with shared, private or no memory, and their scores."""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np

from .. import tree
from ..algorithms.neuroevolution import Neuroevolution
from ..analysis import attribution, fleet, statistics
from ..environments.server_fleet import ServerFleet
from ..evolution.mutation import MatrixMutation
from ..networks.base import AbstractNetwork
from ..networks.dmmu import DMMU
from ..networks.mlp import MLP
from ..networks.recurrent import Recurrent
from ..networks.team import Centralized, Team
from ..rollout import evaluate
from ..runs.loop import Run
from ..runs.page import Curve, Figure, Reference, Table, Text
from .base import Cell

BUDGETS = ("smoke", "quick", "full", "published")
EPISODES = 500  # fresh ones for a final champion; the dissertation used 10
POINTS = 100  # of a learning curve
SMOOTHED = 100  # generations; the author's undisclosed moving average
FIRST_SEED = 200  # settings were chosen by looking at seeds below


MUTATION = MatrixMutation(
    probability=0.5,
    one_in=10,
    strength=0.3,
    super_probability=0.1,
    reset_probability=0.1,
)
"""Stronger than the printed one (0.9 of the matrices, 10 % noise, no more), which learns much
slower: docs/team-memory.md."""


def alone(head: AbstractNetwork) -> Team:
    """A network of its own for each server, without contact."""
    return Team(trunk=(), head=head, sharing="nothing")


def networks(hidden: int = 30) -> dict[str, AbstractNetwork]:
    """DMMU and its baselines, `hidden` units and cells each, the centralized one ten times."""
    return {
        "dmmu": DMMU(hidden=hidden),
        "lstmne": alone(Recurrent("lstm", hidden, "tanh", "fan_in")),
        "lstmsm": DMMU(cell="lstm", hidden=hidden),
        "grusm": DMMU(cell="gru", hidden=hidden),
        "ffne": alone(reactive(hidden)),
        "cnf": Centralized(reactive(10 * hidden)),
    }


def reactive(hidden: int) -> MLP:
    """Without memory; weights as small at first as those of the others, else outputs saturate."""
    return MLP(hidden=(hidden,), activation="sigmoid", initializer="fan_in")


class Plan(NamedTuple):
    """The runs of a cell."""

    generations: int
    runs: int


PLANS = {
    "smoke": Plan(4, 2),
    "quick": Plan(100, 2),
    "full": Plan(2_000, 1),
    "published": Plan(15_000, 10),
}


def cell(
    name: str, env: ServerFleet, network: AbstractNetwork, budget: str, plan: Plan, **fields: Any
) -> Cell:
    """Runs of Algorithm 5."""
    algorithm = Neuroevolution.dmmu(env, network, **{"mutation": MUTATION} | fields)
    if budget == "smoke":
        algorithm = dataclasses.replace(
            algorithm, population_size=6, elite_fraction=0.2, episodes=2, test_episodes=2
        )
    return Cell(name, algorithm, plan.generations, plan.runs, FIRST_SEED)


# ---------------------------------------------------------------------------------------- scores


def outcome(name: str, runs: list[Run], references: dict[str, float]) -> dict[str, Any]:
    """Curves of the champions' tests, and the final ones in fresh episodes that they share."""
    env = runs[0].algorithm.env
    champions = tree.stack(*(run.champion for run in runs))
    played = evaluate(env, champions, EPISODES, key=jax.random.key(20_000))
    scores = np.stack([run.metrics["champion_score"] for run in runs])
    grid = np.unique(np.linspace(0, scores.shape[1] - 1, POINTS).astype(int))
    where, network = name.rsplit(", ", 1)
    return {
        "where": where,
        "network": network,
        "generation": (grid + 1).tolist(),
        "smoothed": attribution.plain(statistics.moving_average(scores, SMOOTHED)[:, grid], 2),
        "final": attribution.plain(np.mean(played.of("net"), axis=1), 3),
        "reference": references,
    }


def references(env: ServerFleet) -> dict[str, float]:
    """Mean floors, discoverer and oracle."""
    found = fleet.floors_and_ceilings(env, 1000, key=jax.random.key(21_000))
    return {name: round(mean, 2) for name, (mean, _) in found.items()}


# ----------------------------------------------------------------------------------------- pages


def curves(measured: dict[str, Any]) -> list[Figure]:
    """A figure per task: the champion of each generation, smoothed."""
    figures = []
    for where in dict.fromkeys(cell["where"] for cell in measured.values()):
        found = [cell for cell in measured.values() if cell["where"] == where]
        known = found[0]["reference"]
        figures.append(
            Figure(
                where,
                "generation",
                "net requests served",
                [Curve(cell["network"], cell["generation"], cell["smoothed"]) for cell in found],
                references=(
                    Reference("random", known["random"]),
                    Reference("a script that discovers", known["discovering"]),
                ),
                caption=f"Mean of {SMOOTHED} generations, as the author's.",
            )
        )
    return figures


def scores(measured: dict[str, Any], published: dict[str, str]) -> Table:
    """Every cell beside floors, what was published, and ceilings."""
    rows = []
    for name, cell in measured.items():
        known, final = cell["reference"], np.array(cell["final"])
        rows.append(
            [
                cell["where"],
                cell["network"],
                known["random"],
                known["fixed"],
                published.get(name, "–"),
                f"{np.median(final):.1f} ({final.min():.1f}…{final.max():.1f})",
                known["discovering"],
                known["oracle"],
            ]
        )
    return Table(
        "Genuine minus nefarious requests that the final champion serves",
        [
            "task",
            "network",
            "floor: random",
            "floor: one action",
            "published",
            "ours, median (range)",
            "a script that discovers",
            "an oracle",
        ],
        rows,
        caption=f"Ours: {EPISODES} fresh episodes. The script shares what it finds at once: a "
        "lower bound on what discovering can reach. The oracle knows the classes.",
    )


def about(episodes: int, *paragraphs: str) -> Text:
    """What to know before comparing."""
    return Text(
        "How to read it",
        [
            f"Algorithm 5 with k 100, 4 elites, {episodes} episodes per fitness (printed: 10), the "
            "same budget for every network. Centralized networks have no agents that could change "
            "places. Mutation is stronger than printed: half of the matrices, a tenth of their "
            "weights, 30 % noise, a tenth of the hits super (10 times the weight) and a tenth "
            "drawn anew.",
            *paragraphs,
        ],
    )
