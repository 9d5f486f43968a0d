"""Figure 4.7: DMMU and its baselines on the server fleet, synchronous and asynchronous. Also what
all fleets of chapter 4 share: cells, measurements, the table.

Section 4.2.3 compares networks with and without memory, shared or not, centralized or not, on 10
servers and 20 devices of which 7 to 13 are nefarious; GRUs with shared memory are added here. The
score is net requests, genuine minus nefarious ones served in an episode. The dissertation has 10
runs and tests of 10 episodes. `published` has its 10 runs, of the author's 15,000 generations;
`full` one run of 2,000 and three of the six networks, `quick` two runs of 100, `smoke` a fleet of 2
servers and 4 devices.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .. import tree
from ..algorithms.neuroevolution import Neuroevolution
from ..analysis import bounds, fleet
from ..environments.server_fleet import ServerFleet
from ..environments.wrappers import NoisyObservations
from ..evolution.breeder import altered
from ..evolution.mutation import MatrixMutation
from ..networks.base import AbstractNetwork
from ..networks.dmmu import DMMU, DMMUPolicy
from ..networks.mlp import MLP
from ..networks.recurrent import Recurrent
from ..networks.team import Centralized, Team
from ..report.rows import Row
from .base import Cell, Experiment, Trained
from .measures import final, returns
from .tmazes import BUDGETS, SMOOTHED, smoothed
from .views import Curves, Table, known, mean, median, published

EPISODES = 500  # fresh ones for a final champion; the dissertation used 10
METRIC = "net requests"
TIMING: dict[str, Any] = {"synchronous": 1, "asynchronous": (0, 2)}
"""Steps that a server is busy after a request: Figure 4.7a, and b, where they are drawn."""
PLANS = {"smoke": (4, 2), "quick": (100, 2), "full": (2_000, 1), "published": (15_000, 10)}
HIT = 3  # matrices of a large fleet that a mutation changes, on average


def gentle(env: ServerFleet, network: AbstractNetwork) -> MatrixMutation:
    """Of large fleets: few matrices at a time, so that a server that has learned something keeps
    it, and nothing drawn anew, so that weights stay as small as their inputs need them."""
    genome = eqx.filter_eval_shape(lambda key: network.init(*env.sizes, key=key), jax.random.key(0))
    share = min(0.9, HIT / len(jax.tree.leaves(genome)))
    return MatrixMutation(probability=share, one_in=10, strength=0.5, super_probability=0.05)


def networks(hidden: int = 30) -> dict[str, AbstractNetwork]:
    """DMMU and its baselines, `hidden` units and cells each, the centralized one ten times. All
    start with weights N(0, 1)."""

    def reactive(units: int) -> MLP:
        # Without memory. Its output weights are smaller, else outputs saturate and are all equal.
        return MLP(hidden=(units,), activation="sigmoid", output_scale=units**-0.5)

    def alone(head: AbstractNetwork) -> Team:
        return Team(trunk=(), head=head, sharing="nothing")

    of_teams = DMMU(hidden=hidden, initializer="normal", bias_std=1.0)
    return {
        "dmmu": replace(of_teams, start_weights="shut"),
        "lstmne": alone(Recurrent("lstm", hidden, "tanh")),
        "lstmsm": replace(of_teams, cell="lstm"),
        "grusm": replace(of_teams, cell="gru"),
        "ffne": alone(reactive(hidden)),
        "cnf": Centralized(reactive(10 * hidden)),
    }


def cell(
    budget: str,
    labels: dict[str, Any],
    env: ServerFleet,
    network: AbstractNetwork,
    plan: tuple[int, int],
    **fields: Any,
) -> Cell:
    """Runs of Algorithm 5; `plan`: generations and runs."""
    algorithm = Neuroevolution.dmmu(env, network, **fields)
    if budget == "smoke":
        sizes = {"population_size": 6, "elite_fraction": 0.2, "episodes": 2, "test_episodes": 2}
        algorithm = altered(algorithm, **sizes)
    generations, runs = plan
    seeds = range(200, 200 + runs)  # settings were chosen by looking at lower ones
    return Cell(labels, algorithm, seeds, generations)


def cells(budget: str) -> list[Cell]:
    """Both timings and all networks; at full three of them, as far as compute goes."""
    tiny = budget == "smoke"
    sizes: dict[str, Any] = {"servers": 2, "devices": 4, "nefarious": 2} if tiny else {}
    found = []
    for timing, busy in TIMING.items():
        # Counts are observed as small numbers: 20 devices with 5 requests each would drown the one
        # number that says what a request was worth.
        env = ServerFleet(scale=(0.02, 1.0), busy=busy, **sizes)
        for name, network in networks(2 if tiny else 30).items():
            if budget != "full" or name in ("dmmu", "lstmne", "ffne"):
                labels = {"task": "server fleet", "timing": timing, "network": name}
                mutation = gentle(env, network)
                found.append(cell(budget, labels, env, network, PLANS[budget], mutation=mutation))
    return found


def clear(env: ServerFleet | NoisyObservations) -> ServerFleet:
    """A fleet's task without noise."""
    found = env.env if isinstance(env, NoisyObservations) else env
    assert isinstance(found, ServerFleet)
    return found


@cache
def _references(env: ServerFleet) -> dict[str, float]:
    return bounds.baselines(env) | {"oracle": bounds.upper_bound(env).value}


def references(trained: Trained) -> list[Row]:
    """Mean net requests of baselines, of a script that discovers, and of an oracle, in 1,000
    episodes: facts "reference" by `policy` (random, fixed, discovering, oracle)."""
    return [
        trained.fact("reference", round(value, 2), policy=name)
        for name, value in _references(clear(trained.env)).items()
    ]


def without_writing(trained: Trained) -> list[Row]:
    """Net requests of DMMUs whose agents do not write."""
    teams = [run.champion for run in trained.runs]
    if not all(isinstance(team, DMMUPolicy) and team.config.cell == "mmu" for team in teams):
        return []
    silent = tree.stack(*map(fleet.without_writing, teams))
    played = returns(trained.env, silent, EPISODES, reward="net")
    return trained.rows(f"{METRIC} while nobody writes", np.mean(played, axis=1), 3)


CURVES = Curves(
    f"test {METRIC}, smoothed",
    "generation",
    line=("network", "noise"),
    panel=("task", "timing"),
    y_label="net requests served",
    levels={
        "random": known("reference", policy="random"),
        "a script that discovers": known("reference", policy="discovering"),
    },
    caption=f"The champion of each generation; mean of {SMOOTHED} generations, as the author's.",
)
SCORES = Table(
    "Genuine minus nefarious requests that the final champion serves",
    ("timing", "network", "noise"),
    {
        "baseline: random": known("reference", policy="random"),
        "baseline: one action": known("reference", policy="fixed"),
        "published": published(METRIC),
        "measured": mean(METRIC, 1, 1),
        "median (range)": median(METRIC),
        "median (range) without writing": median(f"{METRIC} while nobody writes"),
        "a script that discovers": known("reference", policy="discovering"),
        "an oracle": known("reference", policy="oracle"),
    },
    caption=f"Measured: {EPISODES} fresh episodes. Published: mean ± standard error. The script "
    "shares what it finds at once: a lower bound on what discovering can reach. The oracle knows "
    "the classes. Without writing a DMMU has no memory, neither of others nor of its own, but "
    "the last output.",
)
MEASURES = (
    references,
    final(METRIC, EPISODES, 3, each=False, reward="net"),
    smoothed(METRIC, 2),
    without_writing,
)
EXPERIMENTS = {"fig-4.7": Experiment(cells, MEASURES, (SCORES, CURVES), BUDGETS)}
