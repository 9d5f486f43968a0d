"""Figure 7.4: the rover domain at couplings 1 to 7. Also what all experiments on rovers share:
methods, measurements, the table of scores."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from ..algorithms.merl import LOCAL, MERL
from ..algorithms.off_policy import OffPolicy
from ..environments.rover import Rover
from ..evolution.breeder import altered
from ..learners.td3 import maddpg, matd3
from ..networks.team import Team
from ..report.rows import Labels
from . import measures
from .base import Cell, Experiment
from .dissertation import notes, told
from .small import shrunk
from .views import Curves, Table, known, mean, plain, published

METHODS: dict[str, tuple[str, str]] = {  # what learns, and from which reward
    "merl": ("merl", "local"),
    "ea": ("ea", "global"),
    **{f"td3 {reward}": ("td3", reward) for reward in ("local", "mixed", "global")},
    **{f"matd3 {reward}": ("matd3", reward) for reward in ("mixed", "global")},
    **{f"maddpg {reward}": ("maddpg", reward) for reward in ("mixed", "global")},
}
COMPARED = [method for method in METHODS if method not in ("td3 mixed", "td3 global")]


class Plan(NamedTuple):
    """The runs of a cell."""

    frames: int
    runs: int
    updates_per_frame: float = 0.05


PLANS = {
    "smoke": Plan(1_500, 2),
    "quick": Plan(150_000, 2),
    "full": Plan(300_000, 3),
    "published": Plan(2_000_000, 5, 0.1),
}
COUPLINGS = {"smoke": (2,), "quick": (1, 2, 4, 7)}
CODED = {"motion": "as-coded", "start": "as-coded", "local": "closeness"}
DYNAMICS = {
    "author's dynamics": CODED,
    "author's dynamics and sensors": CODED | {"observation": "as-coded"},
}


def build(method: str, env: Rover, updates_per_frame: float) -> Any:
    """A method, all with the same discount, rates, batch, team and frames per update."""
    kind, reward = METHODS[method]
    if kind in ("merl", "ea"):
        learners = (LOCAL,) if kind == "merl" else ()
        return MERL.merl(env, learners=learners, updates_per_frame=updates_per_frame)
    # What is paid at the last step is not paid again behind it.
    fields: dict[str, Any] = {"signal": reward, "bootstrap_truncated": reward != "global"}
    if kind == "td3":
        learner = dataclasses.replace(LOCAL, **fields)
    else:
        learner = {"matd3": matd3, "maddpg": maddpg}[kind](**fields)
    settings: dict[str, Any] = {"learner": learner, "updates_per_frame": updates_per_frame}
    return OffPolicy.matd3(env, replay_capacity=100_000, **settings)


def rewards(method: str) -> tuple[str, ...]:
    """The rewards that a method's task has."""
    return ("global", "local", *(["mixed"] if METHODS[method][1] == "mixed" else []))


def rovers(method: str, **fields: Any) -> Rover:
    """The rover domain, with the local reward that was best for MERL and for TD3 alone
    (docs/notes/hybrids.md says what was tried) unless `fields` have another."""
    return Rover(**({"rewards": rewards(method), "local": "progress"} | fields))


def cell(
    method: str,
    env: Rover,
    labels: Labels,
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
        algorithm = altered(algorithm, **settings)
    if budget == "smoke":
        algorithm = shrunk(algorithm)
    seeds = range(first_seed, first_seed + planned.runs)
    return Cell({"method": method, **labels}, algorithm, seeds, frames=planned.frames)


def cells(budget: str) -> list[Cell]:
    """Every method at every coupling, 2n rovers and 4 POIs; and coupling 4 as the author coded it:
    half the speed, turns of 90 degrees, his starts and local reward; with and without his
    sensors, that have no upper limit."""
    found = [
        cell(method, rovers(method, coupling=n), {"coupling": n}, budget, PLANS[budget])
        for n in COUPLINGS.get(budget, range(1, 8))
        for method in COMPARED
    ]
    for dynamics, fields in DYNAMICS.items():
        labels = {"coupling": 4, "dynamics": dynamics}
        for method in ("merl", "ea", "td3 local"):
            env = rovers(method, coupling=4, **fields)
            found.append(cell(method, env, labels, budget, PLANS[budget]))
    return found


SHARE = "share of POIs"
MEASURES = (
    measures.final(SHARE, episodes=100, digits=3, each=False),
    measures.scores(digits=3),
    measures.effort,
    measures.of_task(measures.rover_baselines),
)
LEVELS = {"random": known("random"), "greedy script": known("greedy")}
COLUMNS = {
    "baseline: random": known("random"),
    "baseline: greedy script": known("greedy"),
    "published": published(SHARE),
    "final champion": mean(SHARE),
    "median": plain(SHARE, of=np.median),
    "planner reached": known("scripted"),
    "upper bound": known("bound"),
    "frames": plain("frames"),
    "updates per frame": plain("updates per frame"),
}


def curves(*panel: str) -> Curves:
    """The champions' tests of every method, a figure for each of these labels."""
    label = "share of POIs, champion"
    return Curves("test score", "frames", ["method"], panel, y_label=label, levels=LEVELS)


def table(*rows: str) -> Table:
    """Every cell beside baselines, what was published, and an upper bound."""
    return Table(
        "Share of POIs that the final champion observes",
        rows,
        COLUMNS,
        caption="Final champion: 100 fresh worlds without noise, the same for all. Baselines and "
        "planner: 50 worlds. The greedy script drives to the closest POI that its sensors show; "
        "the planner knows every position.",
    )


EXPERIMENT = Experiment(
    **told("fig-7.4"),
    budgets=tuple(PLANS),
    cells=cells,
    measures=MEASURES,
    views=(
        table("coupling", "dynamics", "method"),
        curves("coupling", "dynamics"),
        notes("rovers", "fig-7.4"),
    ),
)
