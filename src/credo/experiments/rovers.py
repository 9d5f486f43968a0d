"""Figures 7.1 and 7.4, and beyond chapter 7: rover teams that observe POIs together. Also what all
experiments on rovers share: methods, measurements, the table of scores.

Figure 7.1 is the motivating example of section 7.2, two rovers and two POIs; Figure 7.4 (section
7.5) the rover domain at coupling 1 to 7, the number of rovers that must be at a POI at once. The
score is the share of POIs that a team observes. The dissertation compares MERL with EA, MADDPG and
MATD3, the latter two on the global and on a mixed reward; TD3 on the local reward alone is added
here: in the author's logs of an easier domain it was near MERL. The dissertation has five runs,
and tests of 10 worlds.

`published` has the dissertation's 2 million frames and five runs, `full` 300,000 to 500,000 and
three or five, `quick` 100,000 or 150,000 and two; Figure 7.4 has couplings 1, 2, 4 and 7 at quick.
"""

import dataclasses
from typing import Any

import numpy as np

from ..algorithms.merl import LOCAL, MERL
from ..algorithms.off_policy import OffPolicy
from ..environments.rover import Rover
from ..evolution.breeder import altered
from ..evolution.mutation import MatrixMutation
from ..learners.td3 import maddpg, matd3
from ..networks.mmu import MMU
from ..networks.recurrent import Recurrent
from ..networks.team import Team
from ..report.rows import Label
from . import measures
from .base import Cell, Experiment
from .plans import Plan, planned
from .views import Curves, Table, count, each, known, mean, plain, published

METHODS: dict[str, tuple[str, str]] = {  # what learns, and from which reward
    "merl": ("merl", "local"),
    "ea": ("ea", "global"),
    **{f"td3 {reward}": ("td3", reward) for reward in ("local", "mixed", "global")},
    **{f"matd3 {reward}": ("matd3", reward) for reward in ("local", "mixed", "global")},
    **{f"maddpg {reward}": ("maddpg", reward) for reward in ("mixed", "global")},
}
OTHERS = ("td3 mixed", "td3 global", "matd3 local")  # of other figures than 7.4
COMPARED = [method for method in METHODS if method not in OTHERS]
LEARNERS = {"matd3": matd3, "maddpg": maddpg}


PLANS = {
    "smoke": Plan(1_500, 2, 0.05),
    "quick": Plan(150_000, 2, 0.05),
    "full": Plan(300_000, 3, 0.05),
    "published": Plan(2_000_000, 5, 0.1),
}
MOTIVATING = {
    "smoke": Plan(1_000, 2, 0.05),
    "quick": Plan(100_000, 2, 0.05),
    "full": Plan(400_000, 5, 0.05),
    "published": Plan(2_000_000, 5, 0.05),
}
BEYOND = PLANS | {"full": Plan(500_000, 3, 0.05)}
COUPLINGS = {"smoke": (2,), "quick": (1, 2, 4, 7)}
CODED = {"motion": "as-coded", "start": "as-coded", "local": "closeness"}
DYNAMICS = {
    "author's dynamics": CODED,
    "author's dynamics and sensors": CODED | {"observation": "as-coded"},
}


def build(method: str, env: Rover) -> MERL | OffPolicy:
    """A method, all with the same discount, rates, batch and team."""
    kind, reward = METHODS[method]
    if kind in ("merl", "ea"):
        return MERL.merl(env, learners=(LOCAL,) if kind == "merl" else ())
    # What is paid at the last step is not paid again behind it.
    fields: dict[str, Any] = {"signal": reward, "bootstrap_truncated": reward != "global"}
    alone = dataclasses.replace(LOCAL, **fields) if kind == "td3" else LEARNERS[kind](**fields)
    return OffPolicy.matd3(env, replay_capacity=100_000, learner=alone)


def rewards(method: str) -> tuple[str, ...]:
    """The rewards that a method's task has."""
    return ("global", "local", *(["mixed"] if METHODS[method][1] == "mixed" else []))


def rovers(method: str, **fields: Any) -> Rover:
    """The rover domain, with the local reward that was best for MERL and for TD3 alone
    (docs/notes/hybrids.md says what was tried) unless `fields` have another."""
    return Rover(**({"rewards": rewards(method), "local": "progress"} | fields))


def cell(
    method: str, budget: str, plan: Plan, env: Rover, first_seed: int = 0, **labels: Label
) -> Cell:
    """Runs of a method."""
    return planned({"method": method, **labels}, build(method, env), plan, budget, first_seed)


def by_coupling(budget: str) -> list[Cell]:
    """Every method at every coupling, 2n rovers and 4 POIs; and coupling 4 as the author coded it:
    half the speed, turns of 90 degrees, his starts and local reward; with and without his
    sensors, that have no upper limit."""
    plan = PLANS[budget]
    found = [
        cell(method, budget, plan, rovers(method, coupling=n), coupling=n)
        for n in COUPLINGS.get(budget, range(1, 8))
        for method in COMPARED
    ]
    return found + [
        cell(method, budget, plan, env, coupling=4, dynamics=dynamics)
        for dynamics, fields in DYNAMICS.items()
        for method in ("merl", "ea", "td3 local")
        for env in [rovers(method, coupling=4, **fields)]
    ]


# ------------------------------------------------------------------------- the motivating example

# What sets one rover apart from the other must be able to change alone: with a shared trunk and
# mutation of all matrices at once 6 of 17 runs of MERL found both POIs.
MUTATION = MatrixMutation(
    gate="matrix",
    probability=0.2,
    fraction=0.3,
    super_probability=0.2,
    reset_probability=0.05,
    vectors=False,
)
SETTINGS: dict[str, Any] = {"population_size": 50, "episodes": 5, "workers": 10}
FRESH = 200  # chosen by looking at other seeds


def motivating(budget: str) -> list[Cell]:
    """Every method on two rovers and two POIs, with the local reward of fig-7.4, that misleads."""
    found = []
    for method in ("merl", "ea", "td3 mixed", "td3 global", "td3 local"):
        env = Rover.motivating(local="progress", rewards=rewards(method))
        algorithm = dataclasses.replace(build(method, env), network=Team(sharing="nothing"))
        if isinstance(algorithm, MERL):
            algorithm = altered(algorithm, mutation=MUTATION, **SETTINGS)
        labels = {"method": method, "task": "motivating example"}
        found.append(planned(labels, algorithm, MOTIVATING[budget], budget, FRESH))
    return found


# ----------------------------------------------------------------- other rewards, heads and teams

DPP = dataclasses.replace(LOCAL, signal="dpp")
GRU = Recurrent(cell="gru", hidden=10)
TEAMS: dict[str, dict[str, Any]] = {
    "merl": {},
    "merl on D": {"learners": (dataclasses.replace(LOCAL, signal="difference"),)},
    "merl on D++": {"learners": (DPP,)},
    "merl on local and D++": {"learners": (LOCAL, DPP)},
    "merl, one policy for all": {"network": Team(sharing="everything")},
    "merl, nothing shared": {"network": Team(sharing="nothing")},
    "ea": {"learners": ()},
    "ea, fitness D++": {"learners": (), "fitness": "dpp"},
    "ea with MMU heads": {"learners": (), "network": Team(trunk=(), head=MMU(hidden=10))},
    "ea with GRU heads": {"learners": (), "network": Team(trunk=(), head=GRU)},
}


def teams(budget: str) -> list[Cell]:
    """Difference rewards, D++, recurrent heads, and what teams share, at coupling 4."""
    env = rovers("merl", coupling=4, rewards=("global", "local", "difference", "dpp"))
    labels = {"coupling": 4, "task": "all rewards"}
    return [
        planned({"method": x, **labels}, MERL.merl(env, **fields), BEYOND[budget], budget)
        for x, fields in TEAMS.items()
    ]


# ------------------------------------------------------------------------------------ their pages

SHARE = "share of POIs"
MEASURES = (
    measures.final(SHARE, episodes=100, digits=3, each=False),
    measures.scores(digits=3),
    measures.effort,
    measures.of_task(measures.rover_baselines),
)


def curves(*panel: str) -> Curves:
    """The champions' tests of every method, a figure for each of these labels."""
    levels = {"random": known("random"), "greedy script": known("greedy")}
    label = "share of POIs, champion"
    return Curves("test score", "frames", ["method"], panel, y_label=label, levels=levels)


def table(*rows: str) -> Table:
    """Every cell beside baselines, what was published, and an upper bound."""
    return Table(
        "Share of POIs that the final champion observes",
        rows,
        {
            "baseline: random": known("random"),
            "baseline: greedy script": known("greedy"),
            "published": published(SHARE),
            "final champion": mean(SHARE),
            "median": plain(SHARE, of=np.median),
            "planner reached": known("scripted"),
            "upper bound": known("bound"),
            "frames": plain("frames"),
            "updates per frame": plain("updates per frame"),
        },
        caption="Final champion: 100 fresh worlds without noise, the same for all. Baselines and "
        "planner: 50 worlds. The greedy script drives to the closest POI that its sensors show; "
        "the planner knows every position.",
    )


BOTH = Table(
    "Frames until a test found both POIs in at least nine of ten worlds",
    ["method"],
    {
        "runs that did": count("both after", np.isfinite),
        "after frames, each run": each("both after"),
    },
)
FOUND_BOTH = measures.first("both after", 0.95, "frames")
"""0.95 of ten worlds: both POIs in nine of them and one in the tenth."""
EXPERIMENTS = {
    "fig-7.1": Experiment(
        motivating, (FOUND_BOTH, *MEASURES), (BOTH, table("method"), curves("task")), PLANS
    ),
    "fig-7.4": Experiment(
        by_coupling,
        MEASURES,
        (table("coupling", "dynamics", "method"), curves("coupling", "dynamics")),
        PLANS,
    ),
    "beyond-7": Experiment(
        teams, MEASURES, (table("coupling", "method"), curves("coupling")), PLANS
    ),
}
