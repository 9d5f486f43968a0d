"""How long cells with gradient learners are trained, and any of them made small enough to end in
seconds (budget `smoke`).

Chapters 5 to 7 count training in frames, environment steps of the whole population and of learners
together, as the dissertation does (sections 5.5 and 7.5); tests are not counted. A `Plan` also has
the updates per frame: the author's programs make one, and a plan with fewer is that much cheaper.
"""

import dataclasses
from typing import Any, NamedTuple

from ..learners.fitness_critic import Criticised
from ..networks.mlp import Critic, ResidualCritic
from ..networks.team import JointCritic, Team
from ..report.rows import Labels
from .base import Cell

FIELDS = {
    "replay_capacity": 10_000,
    "sync_period": 1,
    "warmup_frames": 50,
    "start_frames": 200,
    "test_episodes": 2,
    "test_every": 200,
}
"""What `shrunk` sets in an algorithm that has such a field, so that learning, migration and a test
can happen within the 600 to 1,500 frames of a smoke run."""
TEAM_FIELDS = {
    "replay_capacity": 5_000,
    "population_size": 5,
    "warmup_frames": 100,
    "start_frames": 100,
    "test_every": 300,
}
"""The same of teams, in place of or beside `FIELDS`."""


class Plan(NamedTuple):
    """The runs of a cell: environment steps of each (of a team: joint steps), how many runs, and
    gradient updates of each learner for each of these steps."""

    frames: int
    runs: int
    updates_per_frame: float = 1.0


def planned(
    labels: Labels, algorithm: Any, plan: Plan, budget: str, first_seed: int = 0, **ends: Any
) -> Cell:
    """A cell by plan; shrunk at smoke.

    **Arguments:** `first_seed`: of consecutive ones, as many as the plan has runs; above 0 where
    settings were chosen by looking at lower seeds. `ends`: limits of a run other than frames, as
    `Cell` has them. `updates_per_frame` of the plan replaces that of the algorithm, where it has
    the field.
    """
    if hasattr(algorithm, "updates_per_frame"):
        algorithm = dataclasses.replace(algorithm, updates_per_frame=plan.updates_per_frame)
    if budget == "smoke":
        algorithm = shrunk(algorithm)
    seeds = range(first_seed, first_seed + plan.runs)
    return Cell(labels, algorithm, seeds, frames=plan.frames, **ends)


def shrunk(algorithm: Any) -> Any:
    """The same with tiny networks, batches and tests: it shows that all runs, and learns nothing.
    A team keeps its heads and what its members share."""
    network, evolves = algorithm.network, hasattr(algorithm, "population_size")
    fields: dict[str, Any] = dict(FIELDS)
    if isinstance(network, Team):
        fields |= TEAM_FIELDS | {"episodes": 1 if evolves else 2}
        fields["workers"] = max(2, len(algorithm.learners) if evolves else 0)
        fields["network"] = dataclasses.replace(network, trunk=(8,) if network.trunk else ())
    else:
        fields["network"] = dataclasses.replace(network, hidden=(8,))
    if evolves:
        del fields["test_every"]  # counts generations there, frames elsewhere
        fields["learners"] = tuple(map(_learner, algorithm.learners))
    elif hasattr(algorithm, "learner"):
        fields["learner"] = _learner(algorithm.learner)
    known = {field.name for field in dataclasses.fields(algorithm)}
    return dataclasses.replace(algorithm, **{k: x for k, x in fields.items() if k in known})


def _learner(learner: Any) -> Any:
    if isinstance(learner, Criticised):
        return dataclasses.replace(learner, learner=_learner(learner.learner))
    return dataclasses.replace(learner, critic=_critic(learner.critic), batch_size=16)


def _critic(critic: Any) -> Any:
    if isinstance(critic, JointCritic):
        return JointCritic(Critic(hidden=(8,)))
    if isinstance(critic, ResidualCritic):
        return dataclasses.replace(critic, width=8)
    return dataclasses.replace(critic, hidden=(8,), branches=(4, 4) if critic.branches else ())
