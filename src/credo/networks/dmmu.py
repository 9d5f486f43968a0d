"""DMMU, the Distributed Modular Memory Unit: several MMUs around one shared memory.

Source: Khadka (2019), section 4.2.1, which gives no equations of its own: each agent is an MMU of
Chapter 3 (equations 3.1-3.5) with its own input, read and write gates and its own output y, and m
is one memory for all. Reads and writes happen once per agent and step, in an `order`.

The defaults are those of the author's published code ("as coded"): memory of zeros at the start
of an episode, tanh outputs, agents in the order of their index, weights N(0, 1/fan-in) and biases
N(0, 0.1²). Departures from that code, which are those of our MMU: the block input sees memory
(equation 3.1) where the code fed it the last output, and the output has a bias.

`cell` puts other networks in the place of the MMUs, the baselines "with shared memory" of section
4.2.3: LSTMs whose cell is the memory of all (LSTMSM), or GRUs and Elman networks whose state is.

Who takes part is read from the observation: its last number is 1 for an agent that acts, 0 for one
that is busy, and -1 for one that is away, as `ServerFleet` has it. So it passes through everything
that handles observations (rollouts, recordings, exported policies), any other network may be
compared on the same task, and the contract of policies stays `(obs, carry)`.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from .. import require, tree
from .base import INITIALIZERS, AbstractNetwork, AbstractPolicy
from .mmu import MMU, MMUPolicy
from .recurrent import Recurrent, RecurrentPolicy


class DMMU(AbstractNetwork):
    """Config of a team of MMUs with one memory.

    `init` takes the number of agents behind the sizes of one agent's observation and action.
    """

    team: ClassVar[bool] = True

    cell: Literal["mmu", "lstm", "gru", "rnn"] = eqx.field(static=True, default="mmu")
    """What an agent is. All but MMUs have exactly one unit for each memory cell."""
    hidden: int | tuple[int, ...] = eqx.field(static=True, default=30)
    """Hidden activations h: of every agent, or one number for each. An agent whose number is not
    that of the memory cells learns an encoder and a decoder; for the others both are the identity.
    """
    memory: int | None = eqx.field(static=True, default=None)
    """Shared memory cells, at least 1; None: the most hidden."""
    order: Literal["sequential", "simultaneous", "random"] = eqx.field(
        static=True, default="sequential"
    )
    """`sequential`: by index, and each agent reads what those before it wrote in this step.
    `simultaneous`: all read the memory of the last step, and their writes are summed. `random`: as
    sequential, in an order drawn anew for each step."""
    access: Literal["everyone", "present", "acting"] = eqx.field(static=True, default="present")
    """Who reads and writes. `present`: who is not away, so also who is busy (as coded). `acting`:
    only who can act. `everyone`: always all; then observations end without a status."""
    initializer: str = eqx.field(static=True, default="fan_in")
    """Fresh weights: normal, fan_in or kaiming."""
    bias_std: float = eqx.field(static=True, default=0.1)
    """Standard deviation of fresh biases, times that of weights."""
    start_weights: Literal["drawn", "shut"] = eqx.field(static=True, default="drawn")
    """`shut`: MMUs' write gates start with biases lowered by 20. Else what all agents write at
    random drowns what an agent is told itself. Evolution may open them; an MMU that starts
    `closed`, by 4, is one for gradients, and with large inputs not shut."""

    def __check_init__(self):
        sizes = self.hidden if isinstance(self.hidden, tuple) else (self.hidden,)
        for size in sizes:
            require.at_least("hidden", size, 1)
        require.at_least("memory", self.cells, 1)
        require.literals(self)
        if self.cell != "mmu" and any(size != self.cells for size in sizes):
            raise ValueError(
                f"hidden is {self.hidden} and memory is {self.cells}: agents of cell "
                f"{self.cell!r} have one unit for each memory cell; give one number for both, or "
                "cell='mmu'"
            )
        require.choice("initializer", self.initializer, INITIALIZERS)
        require.at_least("bias_std", self.bias_std, 0)
        if self.start_weights == "shut" and self.cell != "mmu":
            raise ValueError(
                f"start_weights is 'shut' and cell is {self.cell!r}: only MMUs have write gates; "
                "give start_weights='drawn', or cell='mmu'"
            )

    @property
    def least(self) -> tuple[int, ...]:
        return (2, 1, len(self.hidden) if isinstance(self.hidden, tuple) else 2)

    @property
    def remembers(self) -> bool:
        return True

    @property
    def cells(self) -> int:
        if self.memory is not None:
            return self.memory
        return max(self.hidden) if isinstance(self.hidden, tuple) else self.hidden

    def init(
        self, obs_size: int, action_size: int, agents: int = 1, *, key: PRNGKeyArray
    ) -> "DMMUPolicy":
        if isinstance(self.hidden, tuple) and len(self.hidden) != agents:
            raise ValueError(
                f"hidden has {len(self.hidden)} sizes for {agents} agents: give one number for "
                "all, or one for each"
            )
        sizes = self.hidden if isinstance(self.hidden, tuple) else (self.hidden,) * agents
        inputs = obs_size - int(self.access != "everyone")
        require.at_least("inputs beside the status", inputs, 1)
        keys = jax.random.split(key, agents)

        def agent(size, key):
            fresh = self._cell(size).init(inputs, action_size, key=key)
            fresh = jax.tree.map(lambda w: w if w.ndim == 2 else self.bias_std * w, fresh)
            if self.start_weights == "shut":
                fresh = dataclasses.replace(fresh, b_w=fresh.b_w - 20.0)
            return fresh

        if len(set(sizes)) > 1:
            return DMMUPolicy(tuple(map(agent, sizes, keys)), self)
        alike = eqx.filter_vmap(lambda key: agent(sizes[0], key))(keys)  # one program for all
        return DMMUPolicy(tuple(tree.take(alike, i) for i in range(agents)), self)

    def _cell(self, hidden: int) -> AbstractNetwork:
        if self.cell != "mmu":
            return Recurrent(self.cell, hidden, "tanh", self.initializer)
        coder = "identity" if hidden == self.cells else "learned"
        return MMU(
            hidden,
            self.cells,
            encoder=coder,
            decoder=coder,
            output_activation="tanh",
            start_memory="zero",
            initializer=self.initializer,
        )


class DMMUCarry(eqx.Module):
    """What a team keeps between two steps."""

    private: Float[Array, "agents size"]
    """What an agent alone knows: an MMU's last output y, that it feeds back to its own gates; an
    LSTM's h; nothing of other cells (size 0)."""
    memory: Float[Array, " cells"]  # m, shared
    key: Any = None  # of the orders to come, if they are random


class DMMUPolicy(AbstractPolicy):
    """One MMU per agent. A leaf is a matrix of one agent, so that operators on genomes see what is
    published."""

    together: ClassVar[bool] = True

    agents: tuple[MMUPolicy | RecurrentPolicy, ...]
    config: DMMU = eqx.field(static=True)

    @property
    def members(self) -> tuple[PyTree, ...]:
        """The weights of each agent."""
        return self.agents

    def with_members(self, members: tuple[PyTree, ...]) -> "DMMUPolicy":
        """The team of these agents, as many as it has."""
        return DMMUPolicy(members, self.config)

    def arranged(self) -> "DMMUPolicy":
        return self.with_members(tuple(agent.arranged() for agent in self.agents))

    def start(self, *, key: PRNGKeyArray) -> DMMUCarry:
        own, m = _apart(self.agents[0].start())
        private = jnp.zeros((len(self.agents), *own.shape))
        return DMMUCarry(private, m, key if self.config.order == "random" else None)

    def remembered(self, carry: DMMUCarry) -> Float[Array, "agents memory"]:
        shared = jnp.broadcast_to(carry.memory, (len(self.agents), carry.memory.size))
        return jnp.concatenate([carry.private, shared], axis=1)

    def recalled(self, memory, *, key):
        own = self.start(key=key).private.shape[1]
        key = key if self.config.order == "random" else None
        return DMMUCarry(memory[:, :own], memory[0, own:], key)

    def __call__(
        self, obs: Float[Array, "agents obs"], carry: DMMUCarry
    ) -> tuple[Float[Array, "agents act"], DMMUCarry]:
        action, carry, _ = self.access(obs, carry)
        return action, carry

    def access(
        self, obs: Float[Array, "agents obs"], carry: DMMUCarry
    ) -> tuple[Float[Array, "agents act"], DMMUCarry, Float[Array, "agents cells"]]:
        """One step, and what each agent added to the memory in it.

        Who takes no part adds nothing, keeps its last output for later, and acts 0.
        """
        takes_part, inputs = self._split(obs)
        step = self._in_random_order if self.config.order == "random" else self._by_index
        return step(inputs, takes_part, carry)

    def without(self, agents: Sequence[int]) -> "DMMUPolicy":
        """The team that is left when those at these indices go, in the same order.

        Also of a population. ValueError if there is no such agent, or none would be left.
        """
        self._check(agents)
        left = [i for i in range(len(self.agents)) if i not in set(agents)]
        if not left:
            raise ValueError(f"without agents {sorted(set(agents))} no agent is left: keep one")
        return self._of(left)

    def with_clones(self, agents: Sequence[int]) -> "DMMUPolicy":
        """The team and behind it a copy of each agent at these indices (one may occur twice).

        Also of a population. ValueError if there is no such agent.
        """
        self._check(agents)
        return self._of([*range(len(self.agents)), *agents])

    def _check(self, agents: Sequence[int]) -> None:
        for i in agents:
            if not 0 <= i < len(self.agents):
                raise ValueError(f"no agent {i}: this team has 0..{len(self.agents) - 1}")

    def _of(self, index: list[int]) -> "DMMUPolicy":
        c = self.config
        if isinstance(c.hidden, tuple):
            sizes = tuple(c.hidden[i] for i in index)
            c = dataclasses.replace(c, hidden=sizes, memory=c.cells)
        return DMMUPolicy(tuple(self.agents[i] for i in index), c)

    def _split(self, obs: Float[Array, "agents obs"]):
        """Who takes part, and what the networks see."""
        access = self.config.access
        if access == "everyone":
            return jnp.ones(len(self.agents), bool), obs
        # 1, 0 and -1, apart also under some noise.
        return obs[:, -1] > (-0.5 if access == "present" else 0.5), obs[:, :-1]

    def _one(self, agent, x, own, m, takes_part: Bool[Array, ""]):
        """Action, what is private, and memory after one agent's access; 0 and as before if it
        takes no part."""
        action, carry = agent(x, (own, m) if own.size else m)
        after = (action, *_apart(carry))
        return tree.where(takes_part, after, (jnp.zeros_like(action), own, m))

    def _by_index(self, inputs, takes_part, carry: DMMUCarry) -> tuple[Array, DMMUCarry, Array]:
        at_once = self.config.order == "simultaneous"
        m, actions, private, writes = carry.memory, [], [], []
        # Written out: a loop would copy the weights of every agent at every step.
        for i, agent in enumerate(self.agents):
            read = carry.memory if at_once else m
            action, own, after = self._one(agent, inputs[i], carry.private[i], read, takes_part[i])
            actions.append(action)
            private.append(own)
            writes.append(after - read)
            m = m + writes[i] if at_once else after
        carry = DMMUCarry(jnp.stack(private), m, None)
        return jnp.stack(actions), carry, jnp.stack(writes)

    def _in_random_order(
        self, inputs, takes_part, carry: DMMUCarry
    ) -> tuple[Array, DMMUCarry, Array]:
        n = len(self.agents)
        key, order_key = jax.random.split(carry.key)
        order = jax.random.permutation(order_key, n)
        play = self._any_agent()

        def turn(k, loop):
            actions, private, m, writes = loop
            i = order[k]
            action, own, after = play(i, inputs[i], private[i], m, takes_part[i])
            written = writes.at[i].set(after - m)
            return actions.at[i].set(action), private.at[i].set(own), after, written

        action, _, _ = jax.eval_shape(
            self._one, self.agents[0], inputs[0], carry.private[0], carry.memory, takes_part[0]
        )
        nothing = (jnp.zeros((n, *action.shape)), jnp.zeros((n, *carry.memory.shape)))
        start = (nothing[0], carry.private, carry.memory, nothing[1])
        actions, private, memory, writes = jax.lax.fori_loop(0, n, turn, start)
        return actions, DMMUCarry(private, memory, key), writes

    def _any_agent(self):
        """`_one` of an agent that is known by a traced index."""
        if all(agent.config == self.agents[0].config for agent in self.agents):
            team = tree.stack(*self.agents)
            return lambda i, *seen: self._one(tree.take(team, i), *seen)
        # Weights of different sizes are no rows of one array.
        branches = [functools.partial(self._one, agent) for agent in self.agents]
        return lambda i, *seen: jax.lax.switch(i, branches, *seen)


def _apart(carry: PyTree) -> tuple[Array, Array]:
    """What is private of an agent's carry, perhaps nothing, and what becomes the memory of all."""
    return carry if isinstance(carry, tuple) else (jnp.zeros(0), carry)
