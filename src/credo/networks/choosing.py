"""Networks that choose: policies of tasks with discrete actions.

Of an action vector each choice has one number for every option, of which the largest is taken. A
network's outputs, before their activation, are what it thinks of the options: logits for PPO,
values for DQN. As an action each is told by how far it is below the largest of its choice,
tanh(u - max u): the largest is found again whatever its size, where other activations saturate at
numbers above 9, and all are alike.

Options that a task does not allow, which the first numbers of an observation say, are never chosen:
their outputs count as `BARRED`, for who acts and for who learns alike (Huang & Ontañón 2022, "A
closer look at invalid action masking in policy gradient algorithms").
"""

import itertools
from dataclasses import replace
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .base import AbstractNetwork, AbstractPolicy

BARRED = -1e9  # the output of an option that is not allowed: nothing comes near, nothing overflows


class Choosing(AbstractNetwork):
    """Config of a network that chooses."""

    flags_of: ClassVar[str] = "network"  # the command line has the settings of that alone

    network: AbstractNetwork  # what it thinks of each option
    choices: tuple[int, ...] = eqx.field(static=True)  # options of each choice; Boxes come behind
    masked: bool = eqx.field(static=True, default=False)
    """Whether an observation begins with what is allowed, a number above 1/2 for each option."""

    @property
    def team(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.network.team

    def fitted(self, env: Any) -> Self:
        return replace(self, network=self.network.fitted(env))

    @property
    def least(self) -> tuple[int, ...]:
        return self.network.least

    @property
    def remembers(self) -> bool:
        return self.network.remembers

    @property
    def speaks(self) -> bool:
        return self.network.speaks

    def init(self, obs_size: int, action_size: int, *agents: int, key: PRNGKeyArray):
        return ChoosingPolicy(self.network.init(obs_size, action_size, *agents, key=key), self)

    @property
    def axis(self) -> int:
        """That of an observation's numbers, and of an action's: the first; of a team the last."""
        return -1 if self.team else 0

    def parts(self, u: Array) -> list[Array]:
        """Of an action its numbers by choice, and those of its Boxes."""
        cuts = list(itertools.accumulate(self.choices))
        boxes = u.shape[self.axis] > cuts[-1]
        return jnp.split(u, cuts if boxes else cuts[:-1], axis=self.axis)

    def allowed(self, u: Array, obs: Array, barred: float = BARRED) -> Array:
        """Outputs, or an action, with `barred` where an option is not allowed."""
        if not self.masked:
            return u
        n, axis = sum(self.choices), self.axis % u.ndim
        mask = jax.lax.slice_in_dim(obs, 0, n, axis=axis) > 0.5
        # Where nothing is allowed, as tasks may say at an episode's end, there is nothing to tell.
        parts = [part | ~jnp.any(part, axis, keepdims=True) for part in self.parts(mask)]
        boxes = jnp.ones_like(jax.lax.slice_in_dim(u, n, u.shape[axis], axis=axis), bool)
        return jnp.where(jnp.concatenate([*parts, boxes], axis=axis), u, barred)

    def action(self, u: Array) -> Array:
        """Outputs as an action in [-1, 1]."""
        below = [part - jnp.max(part, self.axis, keepdims=True) for part in self.parts(u)]
        n = len(self.choices)
        return jnp.tanh(jnp.concatenate([*below[:n], *self.parts(u)[n:]], axis=self.axis))


class ChoosingPolicy(AbstractPolicy):
    """The policy of `Choosing`. Its memory is that of the network within."""

    policy: AbstractPolicy
    config: Choosing = eqx.field(static=True)

    @property
    def features_first(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.policy.features_first

    @property
    def together(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.policy.together

    @property
    def members(self) -> tuple[PyTree, ...] | None:
        """As `TeamPolicy.members`."""
        return getattr(self.policy, "members", None)

    def with_members(self, members: tuple[PyTree, ...]) -> "ChoosingPolicy":
        """As `TeamPolicy.with_members`."""
        inner: Any = self.policy
        return ChoosingPolicy(inner.with_members(members), self.config)

    def start(self, *, key: PRNGKeyArray) -> PyTree:
        return self.policy.start(key=key)

    def remembered(self, carry):
        return self.policy.remembered(carry)

    def recalled(self, memory, *, key):
        return self.policy.recalled(memory, key=key)

    def arranged(self) -> "ChoosingPolicy":
        return ChoosingPolicy(self.policy.arranged(), self.config)

    def __call__(self, obs, carry):
        _, u, carry = self.spoken(obs, carry)
        return self.config.action(u), carry

    def spoken(self, obs: Float[Array, "..."], carry: PyTree) -> tuple[Array, Array, PyTree]:
        """Its outputs are `BARRED` where an option is not allowed."""
        features, u, carry = self.policy.spoken(obs, carry)
        return features, self.config.allowed(u, obs), carry


def choosing(env: Any, network: AbstractNetwork) -> AbstractNetwork:
    """The network as one that chooses, if the task has choices and the network tells its outputs
    apart. It opens a task outside JAX."""
    if not env.choices or isinstance(network, Choosing) or not network.speaks:
        return network
    return Choosing(network, tuple(env.choices), env.masked)


def chosen(policy: AbstractPolicy) -> Choosing:
    """How a policy, or the one within it, chooses. Raises `TypeError` if it does not."""
    if not isinstance(policy, ChoosingPolicy):
        if isinstance(within := getattr(policy, "policy", None), AbstractPolicy):
            return chosen(within)
        name = type(policy).__name__
        raise TypeError(f"{name} does not choose: give choosing(task, network) of its network")
    return policy.config
