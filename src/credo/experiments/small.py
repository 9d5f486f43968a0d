"""Any algorithm with gradient learners, made small enough to end in seconds (budget `smoke`)."""

import dataclasses
from typing import Any

from ..networks.mlp import Critic, ResidualCritic
from ..networks.team import JointCritic, Team

FIELDS = {
    "replay_capacity": 10_000,
    "sync_period": 1,
    "warmup_frames": 50,
    "start_frames": 200,
    "test_episodes": 2,
    "test_every": 200,
}
TEAM_FIELDS = {
    "replay_capacity": 5_000,
    "population_size": 5,
    "workers": 2,
    "warmup_frames": 100,
    "start_frames": 100,
    "test_every": 300,
}


def shrunk(algorithm: Any, **changes: Any) -> Any:
    """The same with tiny networks, batches, teams and tests: it shows that all runs, and learns
    nothing. `changes`: fields that are to be otherwise; those that it does not have are left out.
    """
    team = isinstance(algorithm.network, Team)
    evolves = hasattr(algorithm, "population_size")
    network = Team(trunk=(8,)) if team else dataclasses.replace(algorithm.network, hidden=(8,))
    fields: dict[str, Any] = FIELDS | {"network": network}
    if team:
        fields |= TEAM_FIELDS | {"episodes": 1 if evolves else 2}
    if evolves:
        del fields["test_every"]  # counts generations there, frames elsewhere
        fields["learners"] = tuple(map(_learner, algorithm.learners))
    elif hasattr(algorithm, "learner"):
        fields["learner"] = _learner(algorithm.learner)
    known = {field.name for field in dataclasses.fields(algorithm)}
    fields = {name: value for name, value in (fields | changes).items() if name in known}
    return dataclasses.replace(algorithm, **fields)


def _learner(learner: Any) -> Any:
    return dataclasses.replace(learner, critic=_critic(learner.critic), batch_size=16)


def _critic(critic: Any) -> Any:
    if isinstance(critic, JointCritic):
        return JointCritic(Critic(hidden=(8,)))
    if isinstance(critic, ResidualCritic):
        return dataclasses.replace(critic, width=8)
    return dataclasses.replace(critic, hidden=(8,), branches=(4, 4) if critic.branches else ())
