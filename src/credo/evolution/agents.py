"""Operators on teams whose agents have weights of their own: whole agents change places."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, PRNGKeyArray, PyTree

from .. import require, tree
from ..networks.base import AbstractNetwork
from ..networks.choosing import Choosing
from ..networks.dmmu import DMMU
from ..networks.team import Team
from .crossover import AbstractCrossover
from .mutation import AbstractMutation


class AgentCrossover(AbstractCrossover):
    """Each agent of the team `a` is replaced, with chance `probability`, by one of `b`: a copy in
    one direction (Khadka 2019, Algorithm 5, line 23).

    The genomes are policies of teams whose agents have weights of their own.
    """

    probability: float = 0.05  # chance that an agent is replaced, in [0, 1]
    source: Literal["same", "any"] = eqx.field(static=True, default="same")
    """By which agent of the other team: the one with the `same` index, or `any` (as coded)."""

    def __check_init__(self):
        require.choice("source", self.source, ("same", "any"))
        require.within("probability", self.probability, 0, 1)

    def __call__(self, a: PyTree, b: PyTree, *, key: PRNGKeyArray) -> PyTree:
        chance_key, source_key = jax.random.split(key)
        n = len(members(a))
        if self.source == "any":
            pool = tree.stack(*alike(b, "AgentCrossover(source='any')"))
            index = jax.random.randint(source_key, (n,), 0, n)
            b = b.with_members(tuple(tree.take(pool, index[i]) for i in range(n)))
        replaced = jax.random.bernoulli(chance_key, self.probability, (n,))
        return exchanged(a, b, replaced)


class Homogenize(AbstractMutation):
    """With chance `probability` a random agent of a team overwrites each other one with chance
    `share`, which spreads what one agent has found. From the author's code for DMMU; the
    dissertation does not mention it. The genome is a policy whose agents have their own weights."""

    probability: float = 0.005  # chance per genome that it happens, in [0, 1]
    share: float = 0.5  # chance that another agent is then overwritten, in [0, 1]

    def __check_init__(self):
        require.within("probability", self.probability, 0, 1)
        require.within("share", self.share, 0, 1)

    def __call__(self, genome: PyTree, *, key: PRNGKeyArray) -> PyTree:
        event_key, model_key, share_key = jax.random.split(key, 3)
        found = alike(genome, "Homogenize")
        n = len(found)
        model = tree.take(tree.stack(*found), jax.random.randint(model_key, (), 0, n))
        event = jax.random.bernoulli(event_key, self.probability)
        replaced = event & jax.random.bernoulli(share_key, self.share, (n,))
        return exchanged(genome, genome.with_members((model,) * n), replaced)


def members(team: PyTree) -> tuple[PyTree, ...]:
    """The genome of each agent; TypeError unless they have weights of their own."""
    own = getattr(team, "members", None)
    if own is None:
        raise TypeError(
            f"{type(team).__name__} has no agents with weights of their own: give DMMU or "
            "Team(sharing='nothing'), or leave out the operators that exchange agents"
        )
    return own


def apart(network: AbstractNetwork) -> bool:
    """Whether each agent of a team has weights of its own."""
    network = network.network if isinstance(network, Choosing) else network
    return isinstance(network, DMMU) or (isinstance(network, Team) and network.sharing == "nothing")


def alike(team: PyTree, operator: str) -> tuple[PyTree, ...]:
    """`members`, of one size; ValueError if they differ."""
    found = members(team)
    if len({jax.tree.structure(one) for one in found}) > 1:
        raise ValueError(
            f"{operator} puts any agent in the place of any other, and these differ in size: give "
            "agents of one size, or AgentCrossover(source='same')"
        )
    return found


def exchanged(team: PyTree, other: PyTree, replaced: Bool[Array, " agents"]) -> PyTree:
    """The team with some of its agents replaced by those of the other in the same places."""
    numbered = team.with_members(
        tuple(
            jax.tree.map(lambda x, i=i: np.full(x.shape, i) if eqx.is_inexact_array(x) else x, one)
            for i, one in enumerate(members(team))
        )
    )
    mine, unravel, _ = tree.ravel(team)
    yours, _, _ = tree.ravel(other)
    numbers = [x.reshape(-1) for x in jax.tree.leaves(numbered) if isinstance(x, np.ndarray)]
    return unravel(jnp.where(replaced[np.concatenate(numbers)], yours, mine))
