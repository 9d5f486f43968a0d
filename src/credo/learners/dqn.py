"""DQN: Mnih et al. (2015), "Human-level control through deep reinforcement learning", Algorithm 1,
for discrete actions; with double Q-learning (van Hasselt et al. 2016), dueling values (Wang et al.
2016, equation 9) and returns of n steps (`sampling.steps`). The agents of a team learn each for
itself (Tan 1993, "Multi-agent reinforcement learning: independent vs. cooperative agents").

Departures:

- The value of an action is what a policy says before its output activation, so that the network
  that learns is one that a population can hold, and evolution moves what the gradient learned.
- ε falls with updates, not with frames; beside a population most frames are not the learner's.
- Targets follow by Polyak averaging, where the paper copies weights now and then.
- Dueling networks share all layers but the last.
- Actions that a task does not allow have no value, in targets as in what is played.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from .. import require
from ..networks.base import AbstractNetwork, AbstractPolicy
from ..networks.choosing import BARRED
from ..networks.exploration import EpsilonGreedy
from ..networks.mlp import MLP, draw_layers, linear
from ..types import Batch, Metrics
from .base import (
    AbstractLearner,
    Returns,
    Value,
    acts,
    adam_state,
    adam_steps,
    bellman,
    descend,
    mean,
    output_layer,
    polyak,
    spoken,
    valued,
)

DQN_NETWORK = MLP(hidden=(256, 256), activation="relu", initializer="uniform")


class ActionValues(eqx.Module):
    """Q(s, ·): what a policy says, or with a dueling head how that differs from its own mean,
    beside the value of the state."""

    policy: AbstractPolicy
    head: dict[str, Float[Array, "..."]] | None  # W_0, b_0: features to V(s); None: not dueling

    def __call__(self, batch: Batch, later: bool = False) -> Float[Array, "act batch *agents"]:
        """In the rows of a batch, or in what follows them; `BARRED` of what is not allowed."""
        features, q = spoken(self.policy, batch, later)
        if self.head is None:
            return q
        allowed = q != BARRED
        average = jnp.mean(q, axis=0, keepdims=True, where=allowed)
        return jnp.where(allowed, linear(self.head, 0, features) + q - average, BARRED)


class DQNState(eqx.Module):
    """What DQN knows between two updates."""

    values: ActionValues
    target: ActionValues
    opt: optax.OptState
    begun: Float[Array, ""]  # updates that exploration is ahead of those that were made


class DQN(AbstractLearner):
    """Q-learning of discrete actions. Its actor takes the action of the largest value."""

    metrics: ClassVar[tuple[str, ...]] = ("critic_loss", "q")
    teams: ClassVar[bool] = True
    discrete: ClassVar[bool] = True

    gamma: float = 0.99  # γ: discount per step, in [0, 1]
    learning_rate: float = 5e-4  # of Adam, at least 0
    tau: float = 5e-3  # share of the new weights in the target network per update, in [0, 1]
    double: bool = eqx.field(static=True, default=True)
    """The network chooses the next action and its target values it; else the target does both."""
    dueling: bool = eqx.field(static=True, default=False)
    """Values of actions are differences from a value of the state."""
    epsilon: float = 0.05  # ε in the end: share of steps of any action, in [0, 1]
    exploration: int = 10_000  # updates in which ε falls from 1 to that, at least 1
    reward_scale: float | None = 1.0
    """Factor of all rewards that values see, ≥ 0; None: as in TD3."""
    batch_size: int = eqx.field(static=True, default=128)  # transitions per update, at least 1
    signal: str | None = eqx.field(static=True, default=None)
    """Name of the reward that it maximises; None: that of its algorithm."""

    def __check_init__(self):
        for name in ("gamma", "tau", "epsilon"):
            require.within(name, getattr(self, name), 0, 1)
        for name in ("learning_rate", "reward_scale"):
            require.at_least(name, getattr(self, name), 0)
        for name in ("exploration", "batch_size"):
            require.at_least(name, getattr(self, name), 1)

    def init(self, network: AbstractNetwork, *sizes: int, key: PRNGKeyArray) -> DQNState:
        obs_size, _, *agents = sizes
        policy_key, head_key = jax.random.split(key)
        policy, head = network.init(*sizes, key=policy_key), None
        units = output_layer(network, policy, obs_size, "DQN", *agents)
        if self.dueling:
            initializer = getattr(network, "initializer", "uniform")
            head = draw_layers((units, 1), initializer, key=head_key)
        values = ActionValues(policy, head)
        return DQNState(values, values, adam_state(values), jnp.float32(0.0))

    def update(self, state: DQNState, batch: Batch, *, key: Any) -> tuple[DQNState, Metrics]:
        given = (state.values, batch, self.target(state, batch))
        values, opt, (loss, q) = descend(error, given, state.opt, self.learning_rate)
        state = DQNState(values, polyak(state.target, values, self.tau), opt, state.begun)
        return state, {"critic_loss": loss, "q": q}

    def target(self, state: DQNState, batch: Batch) -> Returns:
        """y = r + γ Q'(s', argmax Q(s', ·)), of the target alone unless `double`."""
        after = state.target(batch, later=True)
        chooses = state.values(batch, later=True) if self.double else after
        best = jnp.argmax(chooses, axis=0, keepdims=True)
        return bellman(self, batch, jnp.take_along_axis(after, best, axis=0), batch.terminated)

    def actor(self, state: DQNState) -> AbstractPolicy:
        return state.values.policy

    def explorer(self, state: DQNState, random: Bool[Array, ""]) -> AbstractPolicy:
        done = (state.begun + adam_steps(state.opt).astype(jnp.float32)) / self.exploration
        ε = jnp.maximum(self.epsilon, 1.0 - (1.0 - self.epsilon) * done)
        return EpsilonGreedy(state.values.policy, ε, random)

    def value(self, state: DQNState, policy: AbstractPolicy, batch: Batch) -> Value:
        """Of the actions that the policy takes."""
        return valued(state.values(batch), acts(policy, batch))

    def warm(self, state: DQNState, actor: AbstractPolicy) -> DQNState:
        """Also without the exploration of one who knows nothing."""
        places = lambda s: (s.values.policy, s.target.policy, s.begun)  # noqa: E731
        return eqx.tree_at(places, state, (actor, actor, jnp.float32(self.exploration)))


def error(values: ActionValues, batch: Batch, target: Returns) -> tuple[Array, Array]:
    """The mean Huber loss of the values of what was done, and their mean."""
    q = valued(values(batch), batch.action)
    return mean(optax.huber_loss(q, target[0]), batch.active), mean(q, batch.active)
