"""Factoredness: how often what serves an agent's own reward serves the whole team.

Source: Agogino & Tumer (2004, 2008), "Analyzing and Visualizing Multiagent Rewards in Dynamic and
Stochastic Domains": the share of changes in what one agent does, all else equal, at which its own
reward and the global one change in the same direction. 1: whoever improves its own reward improves
that of the team; 0.5: no better than chance.

Departures: a change is another policy for the whole episode, in the same world, so that rewards are
returns; and only changes that alter the global return are counted, since of the many that do not
nothing can be said. A change that alters the global return and leaves an agent's own as it was
counts as a half: it says nothing to that agent. How many changes were counted is told beside.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from .. import tree
from ..environments.base import AbstractEnvironment, AbstractTask
from ..networks.base import AbstractPolicy
from ..networks.team import Team
from ..rollout import evaluate

TEAMS, CHANGES, WORLDS, SEED = 32, 16, 8, 22_000
EQUAL = 1e-6  # of the largest return: what rounding may change


class Agreement(NamedTuple):
    """How often a reward agrees with the global one."""

    share: float  # factoredness, in [0, 1]; NaN if no change could be counted
    counted: int  # changes that altered the global return
    tried: int  # changes


class Changed(AbstractPolicy):
    """A team in which one agent acts by another team's policy."""

    team: AbstractPolicy
    other: AbstractPolicy
    agent: Int[Array, ""]  # who is changed; -1: none

    def start(self, *, key: PRNGKeyArray) -> PyTree:
        return self.team.start(key=key), self.other.start(key=key)

    def __call__(self, obs: Float[Array, "agents obs"], carry: PyTree):
        action, first = self.team(obs, carry[0])
        instead, second = self.other(obs, carry[1])
        mine = jnp.arange(len(action)) == self.agent
        return jnp.where(mine[:, None], instead, action), (first, second)


def factoredness(
    env: AbstractEnvironment,
    teams: PyTree | None = None,
    *,
    to: str | None = None,
    changes: int = CHANGES,
    worlds: int = WORLDS,
    key: PRNGKeyArray | None = None,
) -> dict[str, Agreement]:
    """How often each named reward of a JAX team environment agrees with the reward `to`.

    **Arguments:** `teams`: a population of two policies or more, whose agents are exchanged; None:
    32 teams of fresh networks. `to`: the reward of the team; None: what the task reports.
    `changes`: of each team, each of one agent. `worlds`: in which every change is played.

    **Raises:** `ValueError` for a task of one agent.
    """
    if env.agents is None:
        raise ValueError(f"{type(env).__name__} has one agent: factoredness is that of a team")
    draw_key, play_key = jax.random.split(jax.random.key(SEED) if key is None else key)
    teams = _fresh(env, draw_key) if teams is None else teams
    n, agents = tree.size(teams), env.agents
    # Team t at [t, 0]; behind it itself with agent (t + c) % agents of the team c + 1 further on.
    team, change = np.meshgrid(np.arange(n), np.arange(changes + 1), indexing="ij")
    agent = np.where(change == 0, -1, (team + change) % agents)
    other = (team + 1 + (change % (n - 1))) % n
    mine, theirs = (tree.take(teams, jnp.asarray(x.reshape(-1))) for x in (team, other))
    changed = Changed(mine, theirs, jnp.asarray(agent.reshape(-1)))
    played = evaluate(env, changed, worlds, key=play_key)
    shape = (n, changes + 1, worlds)
    returns = {k: np.asarray(x).reshape(*shape, -1) for k, x in played.returns.items()}
    whole = returns[to or env.reported].mean(axis=3)
    return {name: _agreement(returns[name], whole, agent[:, 1:]) for name in env.signals}


def _agreement(own: np.ndarray, whole: np.ndarray, agent: np.ndarray) -> Agreement:
    """Of the changed agent's returns `[teams, 1 + changes, worlds, agents or 1]` with those of the
    whole team; the first of axis 1 is without a change."""
    better = _direction(whole[:, 1:] - whole[:, :1], whole)
    change = own[:, 1:] - own[:, :1]
    if own.shape[3] > 1:
        change = np.take_along_axis(change, agent[:, :, None, None], axis=3)
    product = better * _direction(change[..., 0], own)
    counted = better != 0
    share = (0.5 * (1 + product[counted])).mean() if counted.any() else float("nan")
    return Agreement(float(share), int(counted.sum()), counted.size)


def _direction(change: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """-1, 0 or 1."""
    return np.sign(np.where(np.abs(change) <= EQUAL * np.abs(returns).max(), 0.0, change))


def _fresh(env: AbstractEnvironment, key: PRNGKeyArray) -> PyTree:
    """Teams of untrained networks, each agent its own."""
    network, keys = Team(sharing="nothing"), jax.random.split(key, TEAMS)
    return eqx.filter_vmap(lambda key: network.init(*env.sizes, key=key))(keys)


def lines(env: AbstractTask) -> list[str]:
    """What `credo check` says of a team's rewards; nothing where there is no choice of them, or the
    task is outside JAX."""
    if not isinstance(env, AbstractEnvironment) or env.agents is None or len(env.signals) < 2:
        return []
    found = factoredness(env)
    told = [
        f"factoredness: how often a reward agrees with {env.reported!r} about a change of one "
        "agent's policy; 0.50 is chance"
    ]
    width = max(map(len, found))
    for name, (share, counted, tried) in found.items():
        said = f"{share:.2f}" if counted else "unknown: the team's reward never changed"
        told.append(f"  {name:<{width}}  {said}  ({counted} of {tried} changes count)")
    return told
