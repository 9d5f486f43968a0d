"""Teams: Khadka (2019), section 7.3 and Figure 7.2. One policy acts for all agents.

Each agent answers to its own observation with its own head; heads stand on a trunk that they share.
Everything or nothing may be shared instead. And critics that see a whole team.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Literal, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .. import require, tree
from .base import ACTIVATIONS, INITIALIZERS, AbstractNetwork, AbstractPolicy
from .mlp import (
    MLP,
    AbstractCritic,
    AbstractCriticNetwork,
    Critic,
    CriticNetwork,
    MLPPolicy,
    draw_layers,
    hidden_layers,
)
from .values import AbstractValues

UNROLLED = 16  # so many agents are written out one by one; programs grow with their number


class Team(AbstractNetwork):
    """Config of a multi-headed policy.

    `init` takes the number of agents behind the sizes of one agent's observation and action.
    """

    team: ClassVar[bool] = True

    trunk: tuple[int, ...] = eqx.field(static=True, default=(100, 100))
    """Units of each layer that agents share, at least 1."""
    head: AbstractNetwork = MLP(hidden=(), initializer="uniform")
    """What stands on the trunk: MLP, or a network with memory, such as MMU."""
    sharing: Literal["trunk", "everything", "nothing", "groups"] = eqx.field(
        static=True, default="trunk"
    )
    """What agents share: trunk, everything or nothing; or everything with those of their group."""
    groups: tuple[int, ...] = eqx.field(static=True, default=())
    """The group of each agent, counted from 0, where `groups` share; `fitted` asks the task."""
    activation: str = eqx.field(static=True, default="tanh")  # activation of the trunk
    initializer: str = eqx.field(static=True, default="uniform")
    """Fresh weights of the trunk, as in MLP."""

    def __check_init__(self):
        for i, units in enumerate(self.trunk):
            require.at_least(f"trunk[{i}]", units, 1)
        require.literals(self)
        require.choice("activation", self.activation, ACTIVATIONS)
        require.choice("initializer", self.initializer, (*INITIALIZERS, "uniform"))

    def init(
        self, obs_size: int, action_size: int, agents: int = 1, *, key: PRNGKeyArray
    ) -> "TeamPolicy":
        trunk_key, head_key = jax.random.split(key)
        sizes = (obs_size, *self.trunk)
        trunks, heads = self._numbers(agents)
        drawn = eqx.filter_vmap(lambda key: self.head.init(sizes[-1], action_size, key=key))(
            jax.random.split(head_key, heads)
        )
        return TeamPolicy(
            tuple(
                draw_layers(sizes, self.initializer, key=key)
                for key in jax.random.split(trunk_key, trunks)
            ),
            tuple(tree.take(drawn, i) for i in range(heads)),
            self,
            agents,
        )

    @property
    def least(self) -> tuple[int, ...]:
        return (2 if self.trunk else self.head.least[0], 1, len(self.groups) or 2)

    @property
    def remembers(self) -> bool:
        return self.head.remembers

    @property
    def speaks(self) -> bool:
        return self.head.speaks

    def fitted(self, env: Any) -> Self:
        groups = env.groups if self.sharing == "groups" and not self.groups else self.groups
        head = self.head if self.trunk else self.head.fitted(env)
        return replace(self, groups=tuple(groups or ()), head=head)

    def _numbers(self, agents: int) -> tuple[int, int]:
        """Of trunks and of heads. Raises `ValueError` unless every agent has a group."""
        if self.sharing == "groups":
            kinds = set(self.groups)
            if len(self.groups) != agents or kinds != set(range(len(kinds))):
                raise ValueError(
                    f"groups are {self.groups} of {agents} agents: give the group of each, counted "
                    "from 0, or () and Team.fitted(task)"
                )
            return len(kinds), len(kinds)
        return {"nothing": agents}.get(self.sharing, 1), {"everything": 1}.get(self.sharing, agents)


class TeamPolicy(AbstractPolicy):
    """Weights of trunk and heads: one of each for all, or one per agent. A leaf is a matrix of one
    of them, so that operators on genomes see what is published."""

    trunks: tuple[dict[str, Float[Array, "..."]], ...]
    heads: tuple[AbstractPolicy, ...]
    config: Team = eqx.field(static=True)
    agents: int = eqx.field(static=True)
    rows: tuple[PyTree, PyTree] | None = None
    """Trunks and heads as `_each` takes them; of `arranged` policies alone."""
    apart: bool = eqx.field(static=True, default=False)
    """Whether agents are written out one by one, their carries a tuple; of `arranged` policies
    that share nothing. In a population's products an axis of agents would be moved to and fro."""

    def arranged(self) -> "TeamPolicy":
        heads = tuple(head.arranged() for head in self.heads)
        if self.config.sharing == "nothing" and self.agents <= UNROLLED:
            return TeamPolicy(self.trunks, heads, self.config, self.agents, apart=True)
        rows = (self._rows(self.trunks), self._rows(heads))
        return TeamPolicy(self.trunks, self.heads, self.config, self.agents, rows)

    def start(self, *, key: PRNGKeyArray) -> PyTree:
        keys = jax.random.split(key, self.agents)
        if self.apart:
            return tuple(head.start(key=keys[i]) for i, head in enumerate(self.heads))
        return self._each(lambda _, head, key: head.start(key=key), keys)

    def remembered(self, carry):
        if self.apart:
            each = [head.remembered(own) for head, own in zip(self.heads, carry, strict=True)]
            return None if each[0] is None else jnp.stack(each)  # pyright: ignore[reportArgumentType]
        return self._each(lambda _, head, own: head.remembered(own), carry)

    def recalled(self, memory, *, key):
        keys = jax.random.split(key, self.agents)
        if self.apart:
            each = zip(self.heads, memory, keys, strict=True)
            return tuple(head.recalled(own, key=key) for head, own, key in each)
        return self._each(lambda _, head, own, key: head.recalled(own, key=key), memory, keys)

    def __call__(
        self, obs: Float[Array, "agents obs"], carry: PyTree
    ) -> tuple[Float[Array, "agents act"], PyTree]:
        return self._answers(lambda head: head, obs, carry)

    def spoken(self, obs: Float[Array, "agents obs"], carry: PyTree) -> tuple[Array, Array, PyTree]:
        """Of each agent, in rows."""

        def told(head: AbstractPolicy):
            def parts(x, carry):
                features, u, carry = head.spoken(x, carry)
                return (features, u), carry

            return parts

        (features, u), carry = self._answers(told, obs, carry)
        return features, u, carry

    def _answers(self, said: Callable[..., Any], obs: Array, carry: PyTree) -> tuple[Any, PyTree]:
        """What each agent's `said(head)` says, in rows, and the next carry."""

        def one(trunk, head, obs, carry):
            c = self.config
            x = hidden_layers(trunk, obs, len(c.trunk), c.activation, "none")
            return said(head)(x, carry)

        if self.apart:
            each = zip(self.trunks, self.heads, obs, carry, strict=True)
            told, carries = zip(*(one(*agent) for agent in each), strict=True)
            return jax.tree.map(lambda *rows: jnp.stack(rows), *told), carries
        return self._each(one, obs, carry)

    @property
    def members(self) -> tuple[PyTree, ...] | None:
        """The weights of each agent; None if some are shared."""
        if self.config.sharing != "nothing":
            return None
        return tuple(zip(self.trunks, self.heads, strict=True))

    def with_members(self, members: tuple[PyTree, ...]) -> "TeamPolicy":
        """The team of these agents."""
        trunks, heads = zip(*members, strict=True)
        return TeamPolicy(trunks, heads, self.config, self.agents)

    def scaled(self, factor: Float[Array, ""] | float) -> "TeamPolicy":
        """With the output layers' weights times `factor`, where heads are perceptrons."""
        heads = (h.scaled(factor) if isinstance(h, MLPPolicy) else h for h in self.heads)
        return TeamPolicy(self.trunks, tuple(heads), self.config, self.agents)

    def _each(self, function, *rest: PyTree) -> PyTree:
        """`function(trunk, head, *rest)` for every agent. What is shared has no axis of agents, so
        that a layer is one matrix product for all."""
        parts = self.rows or (self._rows(self.trunks), self._rows(self.heads))
        axes = (
            None if len(one_of) == 1 else eqx.if_array(0) for one_of in (self.trunks, self.heads)
        )
        axes = (*axes, *(0 for _ in rest))
        return eqx.filter_vmap(function, in_axes=axes, axis_size=self.agents)(*parts, *rest)

    def _rows(self, one_of: tuple[PyTree, ...]) -> PyTree:
        """What all agents share, or the parts of each with an axis of agents."""
        if len(one_of) == 1:
            return one_of[0]
        if self.config.sharing == "groups":
            one_of = tuple(one_of[group] for group in self.config.groups)
        return tree.stack(*one_of)


class Centralized(AbstractNetwork):
    """Config of one network that sees what all agents observe and acts for all of them: the
    "centralized neural framework" of Khadka (2019), section 4.2.3.

    Departure: every agent's observation is an input of its own; the author's code summed what the
    agents were told, and had one busy flag for all.
    """

    team: ClassVar[bool] = True

    network: AbstractNetwork = MLP(hidden=(300,))  # the network that acts for all agents

    @property
    def least(self) -> tuple[int, ...]:
        return (*self.network.least[:2], 2)

    def init(
        self, obs_size: int, action_size: int, agents: int = 1, *, key: PRNGKeyArray
    ) -> "CentralizedPolicy":
        policy = self.network.init(agents * obs_size, agents * action_size, key=key)
        return CentralizedPolicy(policy, agents)


class CentralizedPolicy(AbstractPolicy):
    together: ClassVar[bool] = True

    policy: AbstractPolicy  # of everybody
    agents: int = eqx.field(static=True)

    def arranged(self) -> "CentralizedPolicy":
        return CentralizedPolicy(self.policy.arranged(), self.agents)

    def start(self, *, key: PRNGKeyArray) -> PyTree:
        return self.policy.start(key=key)

    def remembered(self, carry):
        memory = self.policy.remembered(carry)
        return None if memory is None else jnp.broadcast_to(memory, (self.agents, memory.size))

    def recalled(self, memory, *, key):
        return self.policy.recalled(memory[0], key=key)

    def __call__(
        self, obs: Float[Array, "agents obs"], carry: PyTree
    ) -> tuple[Float[Array, "agents act"], PyTree]:
        action, carry = self.policy(obs.reshape(-1), carry)
        return action.reshape(self.agents, -1), carry


class JointCritic(AbstractCritic):
    """A critic for each agent that sees what all of them observe and do: Lowe et al. (2017),
    "Multi-Agent Actor-Critic for Mixed Cooperative-Competitive Environments", equation 6."""

    joint: ClassVar[bool] = True

    critic: Critic = Critic(hidden=(128, 128))  # the critic of each agent

    def init(self, obs_size, action_size, agents=1, *, key):
        networks = eqx.filter_vmap(
            lambda key: self.critic.init(agents * obs_size, agents * action_size, key=key)
        )(jax.random.split(key, agents))
        return JointCriticNetwork(
            networks=networks, values=self.critic.values, action_size=action_size
        )


class JointCriticNetwork(AbstractCriticNetwork):
    """One network per agent: leaves `[agents, ...]`. Here `*batch` is `n agents`."""

    networks: CriticNetwork
    values: AbstractValues
    action_size: int = eqx.field(static=True)

    def atoms(self, obs, action):
        together = (_join(obs), _join(action))
        atoms = eqx.filter_vmap(lambda q: q.atoms(*together))(self.networks)
        return jnp.moveaxis(atoms, 0, -1)

    def own(self, obs, action, done):
        def value(network, agent):
            mine = jnp.arange(action.shape[2]) == agent
            return network(_join(obs), _join(jnp.where(mine, action, done)))

        return eqx.filter_vmap(value)(self.networks, jnp.arange(action.shape[2])).T


def _join(x: Float[Array, "size n agents"]) -> Float[Array, "size*agents n"]:
    """What all agents of a team have, as one vector."""
    return jnp.moveaxis(x, 2, 0).reshape(-1, x.shape[1])
