"""Chapter 7 on the rover domain: the methods that are compared, and their scores."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from .. import tree
from ..algorithms.merl import LOCAL, MERL
from ..algorithms.off_policy import OffPolicy
from ..analysis import attribution, planner
from ..environments.rover import Rover
from ..learners.td3 import TD3, maddpg, matd3
from ..networks.mlp import Critic
from ..networks.team import JointCritic, Team
from ..report.sections import Curve, Figure, Reference, Table, Text
from ..rollout import evaluate
from ..runs.store import Run
from .base import Cell
from .chapter5 import middle, number

BUDGETS = ("smoke", "quick", "full", "published")
EPISODES = 100  # fresh worlds that measure a final champion
WORLDS = 50  # for floors and ceilings
POINTS = 100  # of a learning curve
METHODS = (
    "merl",
    "ea",
    "td3 local",
    "td3 mixed",
    "td3 global",
    "matd3 mixed",
    "matd3 global",
    "maddpg mixed",
    "maddpg global",
)


class Plan(NamedTuple):
    """The runs of a cell."""

    frames: int
    runs: int
    updates_per_frame: float = 0.05


def build(method: str, env: Rover, updates_per_frame: float) -> Any:
    """One of `METHODS`, all with the same discount, rates, batch, team and frames per update."""
    kind, _, reward = method.partition(" ")
    if kind in ("merl", "ea"):
        learners = (LOCAL,) if kind == "merl" else ()
        return MERL.merl(env, learners=learners, updates_per_frame=updates_per_frame)
    # What is paid at the last step is not paid again behind it.
    fields = {"signal": reward, "bootstrap_truncated": reward != "global"}
    learner = {
        "td3": lambda: dataclasses.replace(LOCAL, **fields),
        "matd3": lambda: matd3(**fields),
        "maddpg": lambda: maddpg(**fields),
    }[kind]()
    return OffPolicy.matd3(
        env, learner=learner, updates_per_frame=updates_per_frame, replay_capacity=100_000
    )


def task(method: str, **fields: Any) -> Rover:
    """The rover domain with the reward signals that a method needs, and the local reward that was
    best for MERL and for TD3 alone (docs/merl.md says what was tried)."""
    mixed = ("mixed",) if method.endswith("mixed") else ()
    settings: dict[str, Any] = {"rewards": ("global", "local", *mixed), "local": "progress"}
    settings |= fields
    return Rover(**settings)


def cell(
    method: str,
    env: Rover,
    where: str,
    budget: str,
    planned: Plan,
    first_seed: int = 0,
    network: Team | None = None,
    **settings: Any,
) -> Cell:
    """Runs of a method; `settings`: fields of those that have a population."""
    algorithm = build(method, env, planned.updates_per_frame)
    if network is not None:
        algorithm = dataclasses.replace(algorithm, network=network)
    if isinstance(algorithm, MERL):
        algorithm = dataclasses.replace(algorithm, **settings)
    if budget == "smoke":
        algorithm = shrunk(algorithm)
    name = f"{method}, {where}"
    return Cell(name, algorithm, None, planned.runs, first_seed, planned.frames)


def shrunk(algorithm: Any) -> Any:
    """The same with tiny networks, teams and batches: it learns nothing, in seconds."""
    fields: dict[str, Any] = {"replay_capacity": 5_000, "network": Team(trunk=(8,))}
    if isinstance(algorithm, MERL):
        fields |= {"population_size": 5, "episodes": 1, "workers": 2, "warmup_frames": 100}
        fields["learners"] = tuple(map(_small, algorithm.learners))
    else:
        fields |= {"learner": _small(algorithm.learner), "start_frames": 100, "episodes": 2}
        fields |= {"test_every": 300}
    return dataclasses.replace(algorithm, test_episodes=2, **fields)


def _small(learner: Any) -> TD3:
    critic = Critic(hidden=(8,))
    critic = JointCritic(critic) if learner.critic.joint else critic
    return dataclasses.replace(learner, critic=critic, batch_size=16)


# ---------------------------------------------------------------------------------------- scores


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    """Scores of every cell."""
    return {name: outcome(name, cell) for name, cell in runs.items()}


def outcome(
    name: str,
    runs: list[Run],
    episodes: int = EPISODES,
    reference: Callable[[Any], dict[str, float]] | None = None,
) -> dict[str, Any]:
    """Curves of the champion's tests, and the final champions in fresh worlds that they share.

    **Arguments:** `reference`: floors and ceilings of the task; by default those of `references`.
    """
    env = runs[0].algorithm.env
    champions = tree.stack(*(run.champion for run in runs))
    played = evaluate(env, champions, episodes, key=jax.random.key(20_000))
    metrics = [run.metrics for run in runs]
    xs = [m["frames"] for m in metrics]
    grid = attribution.axis(xs, POINTS)
    method, _, where = name.partition(", ")
    return {
        "method": method,
        "where": where,
        "frames": grid.astype(int).tolist(),
        "score": [
            attribution.plain(attribution.on_grid(x, m["champion_score"], grid), 3)
            for x, m in zip(xs, metrics, strict=True)
        ],
        "final": attribution.plain(np.mean(played.of("global"), axis=1), 3),
        "played": [int(x[-1]) for x in xs],
        "updates per frame": attribution.plain(
            [m["updates"].sum() / m["frames"][-1] for m in metrics], 3
        ),
        "reference": (reference or references)(env),
    }


def references(env: Rover) -> dict[str, float]:
    """Mean floors, and what a team with full knowledge reaches and nobody can pass."""
    env = dataclasses.replace(env, rewards=("global",))
    if env not in _REFERENCES:
        rows = planner.floors_and_ceilings(env, WORLDS, key=jax.random.key(21_000))
        _REFERENCES[env] = {k: round(float(np.mean([r[k] for r in rows])), 3) for k in rows[0]}
    return _REFERENCES[env]


_REFERENCES: dict[Rover, dict[str, float]] = {}


# ----------------------------------------------------------------------------------------- pages


def places(measured: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(found["where"] for found in measured.values()))


def curves(measured: dict[str, Any], published: dict[str, float] | None = None) -> list[Figure]:
    """A figure per place: champions' tests of every method, beside floors and ceiling."""
    figures = []
    for where in places(measured):
        found = [cell for cell in measured.values() if cell["where"] == where]
        lines = [
            Reference(name, found[0]["reference"][key])
            for name, key in (("random", "random"), ("greedy script", "greedy"))
            if key in found[0]["reference"]
        ]
        lines += [Reference(f"published {name}", y) for name, y in (published or {}).items()]
        figures.append(
            Figure(
                where,
                "frames",
                "share of POIs, champion",
                [Curve(cell["method"], cell["frames"], cell["score"]) for cell in found],
                references=tuple(lines),
            )
        )
    return figures


def scores(measured: dict[str, Any], published: dict[str, str] | None = None) -> Table:
    """Every method beside floors, what was published, and ceiling."""
    rows = []
    for name, cell in measured.items():
        known = cell["reference"]
        rows.append(
            [
                cell["where"],
                cell["method"],
                number(known["random"]),
                number(known["greedy"]) if "greedy" in known else "–",
                (published or {}).get(name, "–"),
                middle(cell["final"]),
                number(known["scripted"]),
                number(known["bound"]),
                f"{np.mean(cell['played']):,.0f}",
                number(np.mean(cell["updates per frame"])),
            ]
        )
    return Table(
        "Share of POIs that the final champion observes",
        [
            "task",
            "method",
            "floor: random",
            "floor: greedy script",
            "published",
            "ours, median (range)",
            "planner reached",
            "nobody can pass",
            "frames",
            "updates per frame",
        ],
        rows,
        caption=f"Ours: {EPISODES} fresh worlds without noise, the same for all. Floors and "
        f"planner: {WORLDS} worlds. The greedy script drives to the closest POI that its sensors "
        "show; the planner knows every position.",
    )


def about(*paragraphs: str) -> Text:
    """What to know before comparing."""
    return Text(
        "How to read it",
        [
            "A frame is one joint step of a team; those of the whole population and of learners "
            "are counted, those of tests are not. All methods have the same multi-headed team, "
            "discount (0.97), rates, batch, exploration noise and updates per frame; one update "
            "moves all heads. Critics of MERL and TD3 see one agent (2 × 100 units), those of "
            "MATD3 and MADDPG the whole team (2 × 128 units for each agent). `mixed` is local + "
            f"{Rover().mixed_weight:g} · global, a weight that was not searched.",
            *paragraphs,
        ],
    )
