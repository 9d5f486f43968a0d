"""What a finished team does in one episode of the Extended T-Maze, trial by trial."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from ..environments.extended_tmaze import ExtendedTMaze
from ..networks.base import AbstractPolicy
from ..networks.team import TeamPolicy
from ..rollout import record
from .memory import known_memory


class MazeTrace(eqx.Module):
    """An episode of T-maze robots. A robot is told of a trial at the start of the next one."""

    goal: Int[np.ndarray, " trials"]  # the endpoint with the reward
    observed: Bool[np.ndarray, " trials"]  # whether the team observed it
    endpoint: Int[np.ndarray, "trials robots"]  # of those that learn
    partner: Int[np.ndarray, " trials"] | None  # that of the static robot; None: there is none
    company: Bool[np.ndarray, "trials robots"]  # as told, by the rule of the task's `presence`
    reward: Bool[np.ndarray, "trials robots"]  # as told, by the rule of its `feedback`
    memory: Float[np.ndarray, "trials robots cells"] | None
    """With which each robot ends the trial, not yet told of it; None: the policy is no `Team`, or
    its carry is not one that `known_memory` knows."""

    def plain(self, env: ExtendedTMaze) -> dict[str, Any]:
        """As JSON can hold it: 0 and 1 for no and yes, lists `[trials]`, of robots
        `[robots][trials]`, and of memory `[robots][cells][trials]`."""
        numbers = {
            name: None if x is None else np.asarray(x).astype(int).T.tolist()
            for name, x in vars(self).items()
            if name != "memory"
        }
        memory = self.memory
        if memory is not None:
            memory = np.round(np.asarray(memory, np.float64), 2).transpose(1, 2, 0).tolist()
        return {"depth": env.depth, **numbers, "memory": memory}


def trace_maze(env: ExtendedTMaze, policy: AbstractPolicy, *, key: PRNGKeyArray) -> MazeTrace:
    """The episode that `evaluate(env, tree.single(policy), 1, key=key)` plays, trial by trial."""
    played = record(env, policy, key=key)
    shown = env.shown(played)
    ends = np.flatnonzero(np.diff(played.states.trial)) + 1  # the moments at which a trial is over
    cells = known_memory(played.carries) if isinstance(policy, TeamPolicy) else None
    return MazeTrace(
        goal=shown["goal"],
        observed=shown["observed"],
        endpoint=shown["endpoint"],
        partner=shown.get("static"),
        company=shown["company"],
        reward=shown["reward"],
        memory=None if cells is None else cells[ends],
    )
