"""What a finished team does in one episode of the Extended T-Maze, trial by trial."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from ..environments.extended_tmaze import ExtendedTMaze
from ..networks.base import AbstractPolicy
from ..networks.team import TeamPolicy
from ..rollout import record
from ..types import Trace
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
    """The episode that `evaluate(env, tree.stack(policy), 1, key=key)` plays."""
    memory = isinstance(policy, TeamPolicy)
    return by_trial(env, record(env, policy, key=key), memory=memory)


def by_trial(env: ExtendedTMaze, played: Trace, *, memory: bool = True) -> MazeTrace:
    """A recorded episode, trial by trial. `memory`: whether the carry is of each robot."""
    state = played.states
    ends = np.flatnonzero(np.diff(state.trial)) + 1  # the moments at which a trial is over
    last = jax.tree.map(lambda x: x[ends], (state, played.observations))
    cells = known_memory(played.carries) if memory else None
    # At its end the static robot is already on its way to the endpoint of the next trial.
    partner = None if state.partner is None else state.partner[ends - 1]
    told = last[1][:, :, 1:] > 0.0
    return MazeTrace(
        last[0].goals[np.arange(env.trials), np.arange(env.trials) >> env.depth],
        np.asarray(played.rewards["score"][ends - 1] > 0.0),
        last[0].endpoint,
        partner,
        told[:, :, 0],
        told[:, :, 1],
        None if cells is None else cells[ends],
    )
