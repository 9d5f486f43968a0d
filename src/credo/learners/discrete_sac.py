"""SAC of discrete actions: Christodoulou (2019), "Soft Actor-Critic for Discrete Action Settings",
Algorithm 1. What is expected of an action is summed over all of them, where SAC draws one.

Departures:

- Critics are networks of the actor's form, with memory of their own where it has memory, so that
  one setting makes all of them.
- The target entropy is half of log n, of as many options as are allowed: the paper's 0.98 log n
  keeps the policy nearly uniform where most actions are wrong.
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
from ..networks.exploration import Categorical, EpsilonGreedy
from ..types import Batch, Metrics
from .base import (
    AbstractLearner,
    Returns,
    Value,
    acts,
    adam,
    adam_state,
    bellman,
    descend,
    mean,
    output_layer,
    polyak,
    spoken,
    valued,
)

Options = Float[Array, "act batch *agents"]


class DiscreteSACState(eqx.Module):
    """Networks, the critics' targets, the temperature, and the states of Adam."""

    actor: AbstractPolicy
    critics: tuple[AbstractPolicy, ...]
    targets: tuple[AbstractPolicy, ...]
    log_alpha: Float[Array, ""]
    actor_opt: optax.OptState
    critic_opt: optax.OptState
    alpha_opt: optax.OptState


class DiscreteSAC(AbstractLearner):
    """Soft actor-critic of discrete actions. Its actor takes the likeliest one."""

    metrics: ClassVar[tuple[str, ...]] = ("critic_loss", "q", "actor_loss", "alpha")
    teams: ClassVar[bool] = True
    discrete: ClassVar[bool] = True

    gamma: float = 0.99  # γ: discount per step, in [0, 1]
    actor_lr: float = 3e-4  # learning rate of the actor's Adam, ≥ 0
    critic_lr: float = 3e-4  # learning rate of the critics' Adam, ≥ 0
    alpha_lr: float = 3e-4  # learning rate of the temperature's Adam, ≥ 0
    tau: float = 5e-3  # share of the new weights in the target networks per update, in [0, 1]
    temperature: float = 1.0
    """α before the first update, above 0: small where `reward_scale` makes returns of about 1."""
    target_entropy: float = 0.5  # of the policy, as a share of the largest there is, in [0, 1]
    reward_scale: float | None = 1.0
    """Factor of all rewards that critics see, ≥ 0; None: as in TD3."""
    critics: int = eqx.field(static=True, default=2)  # number; the target is their minimum, ≥ 1
    batch_size: int = eqx.field(static=True, default=256)  # transitions per update, ≥ 1
    signal: str | None = eqx.field(static=True, default=None)
    """Name of the reward that it maximises; None: that of its algorithm."""

    def __check_init__(self):
        for name in ("gamma", "tau", "target_entropy"):
            require.within(name, getattr(self, name), 0, 1)
        for name in ("actor_lr", "critic_lr", "alpha_lr", "reward_scale"):
            require.at_least(name, getattr(self, name), 0)
        for name in ("critics", "batch_size"):
            require.at_least(name, getattr(self, name), 1)
        require.at_least("temperature", self.temperature, 1e-8)

    def init(self, network: AbstractNetwork, *sizes: int, key: PRNGKeyArray) -> DiscreteSACState:
        obs_size, _, *agents = sizes
        actor_key, critic_key = jax.random.split(key)
        actor = network.init(*sizes, key=actor_key)
        output_layer(network, actor, obs_size, "DiscreteSAC", *agents)
        keys = jax.random.split(critic_key, self.critics)
        critics = tuple(network.init(*sizes, key=key) for key in keys)
        log_alpha = jnp.log(jnp.float32(self.temperature))
        opts = (adam_state(actor), adam_state(critics), adam_state(log_alpha))
        return DiscreteSACState(actor, critics, critics, log_alpha, *opts)

    def update(self, state: DiscreteSACState, batch: Batch, *, key: Any):
        alpha = jnp.exp(state.log_alpha)
        given = (state.critics, batch, self.soft_target(state, batch, alpha))
        rate = (state.critic_opt, self.critic_lr)
        critics, critic_opt, (critic_loss, q) = descend(critic_error, given, *rate)
        given = (state.actor, lesser(critics, batch), batch, alpha)
        rate = (state.actor_opt, self.actor_lr)
        actor, actor_opt, (loss, told) = descend(actor_loss, given, *rate)
        # The temperature rises while the entropy is below its target.
        entropy, most = told
        short = mean(entropy - self.target_entropy * most, batch.active)
        log_alpha, alpha_opt = adam(state.log_alpha, short, state.alpha_opt, self.alpha_lr)
        targets = polyak(state.targets, critics, self.tau)
        opts = (actor_opt, critic_opt, alpha_opt)
        metrics: Metrics = {"critic_loss": critic_loss, "q": q, "actor_loss": loss, "alpha": alpha}
        return DiscreteSACState(actor, critics, targets, log_alpha, *opts), metrics

    def soft_target(self, state: DiscreteSACState, batch: Batch, alpha: Array) -> Returns:
        """y = r + γ Σ_a π(a|s') (min_i Q'_i(s', a) - α log π(a|s')), equation 10."""
        log_p = jax.nn.log_softmax(spoken(state.actor, batch, later=True)[1], axis=0)
        q = lesser(state.targets, batch, later=True)
        return bellman(self, batch, expected(log_p, q - alpha * log_p)[None], batch.terminated)

    def actor(self, state: DiscreteSACState) -> AbstractPolicy:
        return state.actor

    def explorer(self, state: DiscreteSACState, random: Bool[Array, ""]) -> AbstractPolicy:
        return EpsilonGreedy(Categorical(state.actor), jnp.float32(0.0), random)

    def value(self, state: DiscreteSACState, policy: AbstractPolicy, batch: Batch) -> Value:
        """Of the actions that the policy takes, without its entropy."""
        return valued(lesser(state.critics, batch), acts(policy, batch))

    def warm(self, state: DiscreteSACState, actor: AbstractPolicy) -> DiscreteSACState:
        return eqx.tree_at(lambda s: s.actor, state, actor)


def lesser(critics: tuple[AbstractPolicy, ...], batch: Batch, later: bool = False) -> Options:
    """min_i Q_i(s, ·), in the rows of a batch or behind them."""
    values = [spoken(one, batch, later, stored=False)[1] for one in critics]
    return jnp.min(jnp.stack(values), axis=0)


def expected(log_p: Options, x: Options) -> Value:
    """Σ_a π(a) x(a). What is not allowed has no chance, and its x is no number to count on."""
    return jnp.sum(jnp.where(log_p > 0.5 * BARRED, jnp.exp(log_p) * x, 0.0), axis=0)


def critic_error(critics: tuple[AbstractPolicy, ...], batch: Batch, target: Returns):
    """Half the sum over critics of the mean squared error of what was done, equation 9, and the
    mean value of that."""
    values = [valued(spoken(one, batch, stored=False)[1], batch.action) for one in critics]
    errors = [mean(jnp.square(q - target[0]), batch.active) for q in values]
    return 0.5 * jnp.sum(jnp.stack(errors)), mean(jnp.mean(jnp.stack(values), axis=0), batch.active)


def actor_loss(actor: AbstractPolicy, q: Options, batch: Batch, alpha: Array):
    """The mean of Σ_a π(a|s) (α log π(a|s) - min_i Q_i(s, a)), equation 12; and the policy's
    entropy, beside the largest that it could have."""
    u = spoken(actor, batch)[1]
    log_p = jax.nn.log_softmax(u, axis=0)
    loss = mean(expected(log_p, alpha * log_p - q), batch.active)
    most = jnp.log(jnp.sum((u != BARRED).astype(jnp.float32), axis=0))
    return loss, (expected(log_p, -log_p), most)
