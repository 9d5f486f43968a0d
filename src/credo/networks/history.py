"""Networks with memory, and critics, on windows of an episode.

A policy in an episode has its memory from the step before. On a window from a replay buffer it
starts from what was stored there, by whoever played then, and the first rows refresh it: stored
state and burn-in of R2D2 (Kapturowski et al. 2019, "Recurrent Experience Replay in Distributed
Reinforcement Learning", section 3).

A critic has a memory of its own, of what was observed and done. The action that it values comes in
behind the memory, so that what an actor would do instead changes no later value (Heess et al. 2015,
"Memory-based control with recurrent neural networks"; Ni et al. 2022, "Recurrent model-free RL can
be a strong baseline for many POMDPs", Figure 2). It starts from nothing on each window: nobody
plays with it, so nothing could be stored.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from .. import require
from ..types import Batch, Windows
from .base import AbstractNetwork, AbstractPolicy, features_first
from .mlp import AbstractCritic, AbstractCriticNetwork, Critic
from .recurrent import Recurrent
from .values import AbstractValues

Step = Callable[[Array, PyTree], tuple[PyTree, PyTree]]


def unrolled(
    policy: AbstractPolicy,
    seen: Float[Array, "windows time *agents obs"],
    windows: Windows,
    stored: bool = True,
    said: Callable[[AbstractPolicy], Step] = lambda policy: policy,
) -> PyTree:
    """What a policy with memory says in windows, moment by moment: leaves `[windows, time, ...]`.

    **Arguments:** `stored`: begin with the memory that windows hold, unless they are fresh; else
    with that of an episode's start. `said(policy)`: what is called in place of the policy, and
    returns what it says and the next carry.
    """
    key = jax.random.key(0)  # for what starts by chance, such as an order of agents
    policy = policy.arranged()
    call = said(policy)
    first = policy.remembered(policy.start(key=key))
    assert first is not None
    memory = jnp.broadcast_to(first, (len(seen), *first.shape))
    if stored:
        memory = jnp.where(windows.fresh[..., None], memory, windows.memory)
    carry = jax.vmap(lambda x: policy.recalled(x, key=key))(memory)

    def advance(carry: PyTree, obs: Array) -> tuple[PyTree, PyTree]:
        told, carry = jax.vmap(call)(obs, carry)
        return carry, told

    moments, n, told = jnp.moveaxis(seen, 1, 0), windows.burn_in, []
    if n:
        carry, early = jax.lax.scan(advance, carry, moments[:n])
        carry = jax.vmap(lambda own, fresh: _cut(policy, own, fresh, key))(carry, windows.fresh)
        told = [early]
    told.append(jax.lax.scan(advance, carry, moments[n:])[1])
    return jax.tree.map(lambda *xs: jnp.moveaxis(jnp.concatenate(xs), 0, 1), *told)


def _cut(policy: AbstractPolicy, carry: PyTree, fresh: Bool[Array, "*agents"], key) -> PyTree:
    """A carry through which no gradient flows, unless the window is fresh."""
    memory: Any = policy.remembered(carry)
    kept = jnp.broadcast_to(fresh[..., None], memory.shape)
    return policy.recalled(jnp.where(kept, memory, jax.lax.stop_gradient(memory)), key=key)


def through(
    policy: AbstractPolicy,
    seen: PyTree,
    begins: Bool[Array, " time"],
    memory: Float[Array, " memory"] | None = None,
    said: Callable[[AbstractPolicy], Step] = lambda policy: policy,
) -> tuple[PyTree, Float[Array, "time memory"]]:
    """What a policy of one agent says in moments that follow each other, in one episode after the
    other, and what it remembered before each.

    **Arguments:** `seen`: leaves `[time, ...]`. `begins`: at which moments an episode does.
    `memory`: what it remembers before the first; None: that of an episode's start.
    """
    key = jax.random.key(0)
    policy = policy.arranged()
    call = said(policy)
    first: Any = policy.remembered(policy.start(key=key))

    def advance(memory: Array, given: tuple[Array, Array]):
        memory = jnp.where(given[1], first, memory)
        told, carry = call(given[0], policy.recalled(memory, key=key))
        return policy.remembered(carry), (told, memory)

    return jax.lax.scan(advance, first if memory is None else memory, (seen, begins))[1]


def moments(batch: Batch, later: bool = False) -> Float[Array, "windows time *agents obs"]:
    """What was observed in the windows of a batch; with what followed the last row if `later`.
    Inside an episode what follows a row is what the next row begins with."""
    assert batch.windows is not None
    obs, after = (by_window(batch, x) for x in (batch.obs, batch.next_obs))
    return jnp.concatenate([obs[:, :1], after], axis=1) if later else obs


def by_window(batch: Batch, x: Float[Array, "batch *agents size"]) -> Array:
    """Rows as `[windows, time, *agents, size]`."""
    assert batch.windows is not None
    return x.reshape(-1, batch.windows.length, *x.shape[1:])


def by_row(x: Float[Array, "windows time *agents size"], later: bool = False) -> Array:
    """What was said at each moment of windows, `[batch, *agents, size]`: at the rows, or at what
    follows them if `later`, of which the first moment is then none."""
    x = x[:, 1:] if later else x
    return x.reshape(-1, *x.shape[2:])


class HistoryCritic(AbstractCritic):
    """Config of a critic with a memory of what was observed and done."""

    critic: AbstractCritic = Critic()  # what values memory, observation and action
    memory: AbstractNetwork = Recurrent("gru", 64, "tanh", "fan_in", span=128)
    """The network that remembers: any with memory, for one agent. Of a team there is one for all,
    and each agent's memory is of its own history."""
    units: int = eqx.field(static=True, default=32)
    """Numbers that it tells the critic at each step, at least 1."""

    def __check_init__(self):
        require.at_least("units", self.units, 1)
        if self.memory.team or not self.memory.remembers:
            name = type(self.memory).__name__
            raise ValueError(f"memory is {name}: give a network with memory for one agent, GRU")

    @property
    def joint(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.critic.joint

    def init(self, obs_size, action_size, *team, key):
        critic_key, memory_key = jax.random.split(key)
        critic = self.critic.init(obs_size + self.units, action_size, *team, key=critic_key)
        memory = self.memory.init(obs_size + action_size, self.units, key=memory_key)
        made = {"values": critic.values, "action_size": action_size}
        return HistoryCriticNetwork(critic=critic, memory=memory, **made)


class HistoryCriticNetwork(AbstractCriticNetwork):
    """A critic that is told, beside each observation, what another network remembers."""

    critic: AbstractCriticNetwork
    memory: AbstractPolicy
    values: AbstractValues
    action_size: int = eqx.field(static=True)

    def sees(self, batch, later=False):
        windows = batch.windows
        if windows is None:
            raise TypeError(
                "HistoryCritic values windows of an episode, which networks with memory learn "
                "from: give such a network (--network gru), or a critic without memory, Critic()"
            )
        seen, done = moments(batch, later), by_window(batch, batch.action)
        done = jnp.concatenate([jnp.zeros_like(done[:, :1]), done], axis=1)[:, : seen.shape[1]]
        inputs = jnp.concatenate([seen, done], axis=-1)

        def remember(inputs, fresh):
            return unrolled(self.memory, inputs, replace(windows, fresh=fresh), stored=False)

        each = jax.vmap(remember, (2, 1), 2) if inputs.ndim > 3 else remember
        told = each(inputs, windows.fresh)
        known = jnp.concatenate([told, seen], axis=-1)
        return features_first(by_row(known, later))

    def atoms(self, obs, action):
        return self.critic.atoms(obs, action)

    def own(self, obs, action, done):
        return self.critic.own(obs, action, done)


def remembering(critic: AbstractCritic) -> AbstractCritic:
    """A critic for actors with memory: this one, or this one with a memory before it."""
    return critic if isinstance(critic, HistoryCritic) else HistoryCritic(critic)
