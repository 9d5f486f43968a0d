"""Beyond chapter 7: when the reward of each agent misleads, and when there is none.

beyond-7-decoys: near the rovers lie decoys, POIs of low value that one rover observes; farther away
lie POIs of high value that need `coupling` rovers. A share of the local reward, the dial, pays a
rover to stay beside a decoy that is not observed yet; the rest pays for coming closer to others.
MERL by its preset `hybrid`, one of its learners alone, its evolution alone and MATD3 with three
rewards, all with one policy for all rovers, at equal frames and as many updates as MERL's three
learners make together.

beyond-7-critics: 15 rovers, four POIs worth 1, 2, 3 and 4 that need four rovers each, paid by the
global reward alone: CCEA with and without a fitness critic (published, Rockefeller et al. 2020: a
median of 0 without, 6.27 of 10 with), MERL by its preset `hybrid` on the team's return, spread or
by a fitness critic, and its evolution alone.

Designs and settings were chosen on seeds from 1,000 on; reported runs have those from 0 on.
"""

import dataclasses
from typing import Any

from ..algorithms.ccea import CCEA
from ..algorithms.merl import LOCAL, MERL
from ..analysis.factoredness import factoredness
from ..environments.rover import Rover
from ..learners.fitness_critic import Criticised, FitnessCritic
from ..networks.mlp import MLP
from ..networks.team import Team
from . import measures
from .base import Cell, Experiment
from .plans import Plan, planned
from .rovers import MEASURES, SHARE, build, curves, rewards, table
from .views import Curves, Improvement, Table, known

HYBRID = "merl"
METHODS = (HYBRID, "ea", "td3 local", "matd3 local", "matd3 mixed", "matd3 global")
BLIND = ("ea", "matd3 global")  # to the local reward
DIAL = {"smoke": (0.5,), "quick": (0.0, 0.5)}
COUPLINGS = {"smoke": (3,), "quick": (3,)}
PLANS = {
    "smoke": Plan(1_500, 2, 0.05),
    "quick": Plan(60_000, 2, 0.05),
    "full": Plan(200_000, 3, 0.2),
}
FACTORED = "factoredness of the local reward"


def decoys(budget: str) -> list[Cell]:
    """Every method at every share of misleading steps; those that never see the local reward at the
    ends of the dial, where they have the same numbers."""
    dial = DIAL.get(budget, (0.0, 0.3, 0.6, 0.8))
    return [
        planned({"method": method, "coupling": n, "mislead": share}, algorithm, plan, budget)
        for n in COUPLINGS.get(budget, (3, 4))
        for share in dial
        for method in METHODS
        if method not in BLIND or share in (dial[0], dial[-1])
        for algorithm, plan in [of(method, Rover.misleading(n, share), PLANS[budget])]
    ]


def of(method: str, env: Rover, plan: Plan) -> tuple[Any, Plan]:
    """A method with one policy for all rovers, and its plan."""
    if method in (HYBRID, "ea"):
        changes: dict[str, Any] = {"learners": ()} if method == "ea" else {}
        return MERL.hybrid(env, **changes), plan
    alone: Any = build(method, dataclasses.replace(env, rewards=rewards(method)))
    learners = MERL.hybrid(env).learners
    learner = dataclasses.replace(alone.learner, batch_size=learners[0].batch_size)
    as_many = round(plan.updates_per_frame * len(learners), 9)
    alone = dataclasses.replace(alone, network=ALIKE, learner=learner)
    return alone, plan._replace(updates_per_frame=as_many)


def agreement(env: Rover) -> dict[str, float]:
    """How often the local reward agrees with the global one, of untrained teams."""
    return {FACTORED: round(factoredness(env)["local"].share, 3)}


OVER_DIAL = Curves(
    SHARE,
    "mislead",
    ["method"],
    ["coupling"],
    title="Coupling {coupling}: final champions by the share of the local reward that misleads",
    y_label="share of the POIs' value",
    levels={"random": known("random"), "greedy script": known("greedy")},
    y_range=(0.0, 1.0),
)
AGREEMENT = Table(
    "How often the local reward agrees with the global one",
    ["coupling", "mislead"],
    {FACTORED: known(FACTORED)},
    caption="Of changes of one rover's policy that alter the global return of a team of untrained "
    "networks, the share in which its own reward changes in the same direction; 0.5 is chance.",
)

BETTER = Improvement(HYBRID, SHARE, ["coupling", "mislead"], "Is MERL better than its parts?")

# ------------------------------------------------------------------------ from the team's reward

WORTH = (1.0, 2.0, 3.0, 4.0)
CRITIC_PLANS = {
    "smoke": Plan(1_500, 2, 0.05),
    "quick": Plan(300_000, 2, 0.01),
    "full": Plan(2_000_000, 3, 0.01),
}
ALIKE = Team(sharing="everything")
RETURN = dataclasses.replace(LOCAL, batch_size=32, signal="global", reward_scale=50.0)
"""What an episode paid in all stands for a return of 1."""
UNSHAPED: dict[str, dict[str, Any]] = {
    "ea": {"learners": ()},
    "ea, heads": {"learners": (), "network": Team()},
    "merl, return spread": {"learners": 3 * (RETURN,)},
    "merl, fitness critic": {
        "learners": 3 * (Criticised(RETURN),),  # pyright: ignore[reportCallIssue]
    },
}


def critics(budget: str) -> list[Cell]:
    """Methods that see the global reward alone."""
    env = Rover(rovers=15, coupling=4, poi_values=WORTH, rewards=("global",))
    plan, labels = CRITIC_PLANS[budget], {"coupling": 4, "task": "15 rovers"}
    found = [
        planned({"method": x, **labels}, MERL.hybrid(env, **fields), plan, budget)
        for x, fields in UNSHAPED.items()
    ]
    alone = {"teams": 1, "episodes": 1, "population_size": 50}
    for method, critic in (("ccea", None), ("ccea, fitness critic", FitnessCritic())):
        algorithm = CCEA.ccea(env, MLP(hidden=(20,)), critic=critic, **alone)
        of_method = {"method": method, **labels}
        found.append(Cell(of_method, algorithm, range(plan.runs), frames=plan.frames))
    return found


EXPERIMENTS = {
    "beyond-7-decoys": Experiment(
        decoys,
        (*MEASURES, measures.where(measures.of_task(agreement), method="td3 local")),
        (OVER_DIAL, BETTER, AGREEMENT, table("coupling", "mislead", "method")),
        PLANS,
    ),
    "beyond-7-critics": Experiment(
        critics, MEASURES, (table("method"), curves("task")), CRITIC_PLANS
    ),
}
