"""SAC: Haarnoja et al. (2018), "Soft Actor-Critic Algorithms and Applications", Algorithm 1, with
the temperature learned.

Departure: the actor that joins a population is the mean of the policy, squashed; the head for
the standard deviation stays in the learner's state.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from .. import require
from ..networks.base import AbstractNetwork, AbstractPolicy
from ..networks.history import remembering
from ..networks.mlp import (
    MLP,
    AbstractCritic,
    AbstractCriticNetwork,
    Critic,
    draw_layers,
    linear,
)
from ..networks.values import Histogram
from ..types import Batch, Metrics
from .base import (
    AbstractLearner,
    Returns,
    Value,
    acts,
    adam,
    adam_state,
    adam_steps,
    bellman,
    descend,
    mean,
    output_layer,
    polyak,
    spoken,
)

HYBRID_NETWORK = MLP(hidden=(256, 256), activation="tanh", initializer="uniform")
"""An actor for mutation as well as for gradients: weights of a tanh network change what it does
little by little. Swimmer, 500,000 frames of evolution alone: 353 and 346 with tanh, 294 and 81 with
relu."""

Key = PRNGKeyArray
Scalar = Float[Array, ""]
Critics = tuple[AbstractCriticNetwork, ...]
LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0  # of the authors' code


class StochasticActor(eqx.Module):
    """A squashed Gaussian: its mean is the actor, its spread a head on the actor's features.

    What is squashed is the action's inverse tanh. An actor that ends in a sigmoid σ(u), which an
    MMU does, so has 2 σ(u) - 1 = tanh(u / 2) for its mean.
    """

    mean: AbstractPolicy
    head: dict[str, Float[Array, "..."]]  # W_0, b_0: features to log standard deviation
    steepness: float = eqx.field(static=True, default=1.0)  # of the actor's output: 1, σ: 1/2

    def sample(
        self, batch: Batch, later: bool = False, *, key: PRNGKeyArray
    ) -> tuple[Float[Array, "act batch"], Float[Array, " batch"]]:
        """Actions in the rows of a batch, or in what follows them, and their log probability
        density."""
        return self.drawn(*spoken(self.mean, batch, later), key=key)

    def drawn(
        self, features: Float[Array, "units *batch"], output: Float[Array, "act *batch"], *, key
    ) -> tuple[Float[Array, "act *batch"], Float[Array, "*batch"]]:
        """Actions and their log probability density, of what the actor spoke."""
        mean = self.steepness * output
        log_std = jnp.clip(linear(self.head, 0, features), LOG_STD_MIN, LOG_STD_MAX)
        noise = jax.random.normal(key, mean.shape)
        u = mean + jnp.exp(log_std) * noise
        # log N(u) - log |d tanh / du|, the latter as 2 (log 2 - u - softplus(-2u)).
        log_p = -0.5 * jnp.square(noise) - log_std - 0.5 * jnp.log(2.0 * jnp.pi)
        log_p = log_p - 2.0 * (jnp.log(2.0) - u - jax.nn.softplus(-2.0 * u))
        return jnp.tanh(u), jnp.sum(log_p, axis=0)


class Sampler(AbstractPolicy):
    """Explores by drawing from the policy itself."""

    actor: StochasticActor
    random: Bool[Array, ""]  # draw actions uniformly from [-1, 1]
    features_first: ClassVar[bool] = False

    def start(self, *, key: PRNGKeyArray) -> PyTree:
        return self.actor.mean.start(key=key), key

    def remembered(self, carry):
        return self.actor.mean.remembered(carry[0])

    def __call__(self, obs, carry):
        key, sample_key, random_key = jax.random.split(carry[1], 3)
        features, output, memory = self.actor.mean.spoken(obs, carry[0])
        action, _ = self.actor.drawn(features, output, key=sample_key)
        drawn = jax.random.uniform(random_key, action.shape, minval=-1.0, maxval=1.0)
        return jnp.where(self.random, drawn, action), (memory, key)


class SACState(eqx.Module):
    """Networks, the critics' targets, the temperature, and the states of Adam."""

    actor: StochasticActor
    critics: Critics
    target_critics: Critics
    log_alpha: Float[Array, ""]
    actor_opt: optax.OptState
    critic_opt: optax.OptState
    alpha_opt: optax.OptState


class SAC(AbstractLearner):
    """Soft actor-critic: maximises reward and the policy's entropy."""

    metrics: ClassVar[tuple[str, ...]] = ("critic_loss", "actor_loss", "alpha")

    critic: AbstractCritic = Critic()  # network of the action values
    gamma: float = 0.99  # γ: discount per step, in [0, 1]
    actor_lr: float = 3e-4  # learning rate of the actor's Adam, ≥ 0
    critic_lr: float = 3e-4  # learning rate of the critics' Adam, ≥ 0
    alpha_lr: float = 3e-4  # learning rate of the temperature's Adam, ≥ 0
    tau: float = 5e-3  # share of the new weights in the target networks per update, in [0, 1]
    temperature: float = 1.0
    """α before the first update, above 0: small where `reward_scale` makes returns of about 1."""
    target_entropy: float = -1.0  # of the policy, in nats per action dimension
    reward_scale: float | None = 1.0
    """Factor of all rewards that critics see, ≥ 0; None: as in TD3."""
    critics: int = eqx.field(static=True, default=2)  # number; the target is their minimum, ≥ 1
    policy_delay: int = eqx.field(static=True, default=1)
    """Updates of the critics per update of the actor and the temperature, at least 1."""
    batch_size: int = eqx.field(static=True, default=256)  # transitions per update, ≥ 1
    signal: str | None = eqx.field(static=True, default=None)
    """Name of the reward that it maximises; None: that of its algorithm."""

    def __check_init__(self):
        require.within("gamma", self.gamma, 0, 1)
        require.within("tau", self.tau, 0, 1)
        for name in ("actor_lr", "critic_lr", "alpha_lr", "reward_scale"):
            require.at_least(name, getattr(self, name), 0)
        for name in ("critics", "policy_delay", "batch_size"):
            require.at_least(name, getattr(self, name), 1)
        require.at_least("temperature", self.temperature, 1e-8)

    def init(self, network: AbstractNetwork, *sizes: int, key: PRNGKeyArray) -> SACState:
        obs_size, action_size = sizes
        actor_key, head_key, critic_key = jax.random.split(key, 3)
        mean = network.init(obs_size, action_size, key=actor_key)
        steepness = _steepness(network)
        units = output_layer(network, mean, obs_size, "SAC")
        initializer = getattr(network, "initializer", "uniform")
        head = draw_layers((units, action_size), initializer, key=head_key)
        actor = StochasticActor(mean, head, steepness)
        critic = self.critic if mean.first() is None else remembering(self.critic)
        critics = tuple(
            critic.init(obs_size, action_size, key=key)
            for key in jax.random.split(critic_key, self.critics)
        )
        log_alpha = jnp.log(jnp.float32(self.temperature))
        opts = (adam_state(actor), adam_state(critics), adam_state(log_alpha))
        return SACState(actor, critics, critics, log_alpha, *opts)

    def update(self, state: SACState, batch: Batch, *, key: Key) -> tuple[SACState, Metrics]:
        target_key, actor_key = jax.random.split(key)
        alpha = jnp.exp(state.log_alpha)

        target = self.soft_target(state, batch, alpha, key=target_key)
        given = (state.critics, batch, target)
        critics, critic_opt, (critic_loss, _) = descend(
            soft_critic_error, given, state.critic_opt, self.critic_lr
        )

        def moved():
            given = (state.actor, critics, batch, alpha, actor_key)
            rate = (state.actor_opt, self.actor_lr)
            actor, opt, (loss, log_p) = descend(soft_actor_loss, given, *rate)
            # The temperature rises while the entropy -log_p is below its target.
            entropy = self.target_entropy * batch.action.shape[1]
            short = -mean(log_p + entropy, batch.active)
            rate = (state.alpha_opt, self.alpha_lr)
            # Counted for the updates without one too, so that means over many updates are right.
            return actor, opt, *adam(state.log_alpha, short, *rate), self.policy_delay * loss

        before = (state.actor, state.actor_opt, state.log_alpha, state.alpha_opt, jnp.float32(0.0))
        due = adam_steps(state.critic_opt) % self.policy_delay == 0
        after = jax.lax.cond(due, moved, lambda: before) if self.policy_delay > 1 else moved()
        actor, actor_opt, log_alpha, alpha_opt, actor_loss = after
        targets = polyak(state.target_critics, critics, self.tau)
        state = SACState(actor, critics, targets, log_alpha, actor_opt, critic_opt, alpha_opt)
        return state, {"critic_loss": critic_loss, "actor_loss": actor_loss, "alpha": alpha}

    def soft_target(self, state: SACState, batch: Batch, alpha: Scalar, *, key: Key) -> Returns:
        """y = r + γ (min_i Q'_i(s', a') - α log π(a'|s')), a' drawn from the policy; what the
        critics' `values` say in place of the minimum."""
        action, log_p = state.actor.sample(batch, later=True, key=key)
        targets = state.target_critics
        atoms = jnp.stack([one.atoms(one.sees(batch, later=True), action) for one in targets])
        soft = state.target_critics[0].values.cautious(atoms) - alpha * log_p[None]
        return bellman(self, batch, soft, batch.terminated)

    def actor(self, state: SACState) -> AbstractPolicy:
        return state.actor.mean

    def explorer(self, state: SACState, random: Bool[Array, ""]) -> AbstractPolicy:
        return Sampler(state.actor, random)

    def value(self, state: SACState, policy: AbstractPolicy, batch: Batch) -> Value:
        """By the lesser of the critics, without the policy's entropy."""
        action = acts(policy, batch).T
        return jnp.min(jnp.stack([one(one.sees(batch), action) for one in state.critics]), axis=0)

    def warm(self, state: SACState, actor: AbstractPolicy) -> SACState:
        return eqx.tree_at(lambda s: s.actor.mean, state, actor)


def modern(**fields: Any) -> SAC:
    """SAC with what later work found to matter and a CPU affords: LayerNorm in critics (Nauman et
    al. 2024), a distribution of the return (Farebrother et al. 2024), rewards scaled to what the
    buffer holds (Lee et al. 2025, "Hyperspherical Normalization", scale them to returns), and a
    first temperature that fits them. Half the batch and every second update of the actor cost two
    fifths of the time. Measured: docs, hybrid."""
    critic = Critic(normalization="before", values=Histogram())
    settings: dict[str, Any] = {"critic": critic, "reward_scale": None, "temperature": 0.01}
    settings |= {"policy_delay": 2, "batch_size": 128}
    return SAC(**settings | fields)


def soft_critic_error(critics: Critics, batch: Batch, target: Returns) -> tuple[Scalar, None]:
    """Half the sum over critics of the mean Bellman error, squared unless their `values` say
    otherwise."""
    atoms = [(one.values, one.atoms(one.sees(batch), batch.action.T)) for one in critics]
    errors = jnp.stack([values.error(x, target) for values, x in atoms])
    return 0.5 * jnp.sum(jax.vmap(lambda error: mean(error, batch.active))(errors)), None


def soft_actor_loss(
    actor: StochasticActor, critics: Critics, batch: Batch, alpha: Scalar, key: Key
) -> tuple[Scalar, Float[Array, " batch"]]:
    """E[α log π(a|s) - min_i Q_i(s, a)] and log π(a|s), with actions a drawn from the policy.

    SAC minimises the first, and needs the second for the temperature.
    """
    action, log_p = actor.sample(batch, key=key)
    q = jnp.min(jnp.stack([one(one.sees(batch), action) for one in critics]), axis=0)
    return mean(alpha * log_p - q, batch.active), log_p


def _steepness(network: AbstractNetwork) -> float:
    """The slope of a network's output activation at 0, beside tanh's. Raises `TypeError` if it is
    neither tanh nor a sigmoid."""
    slope = {"tanh": 1.0, "sigmoid": 0.5}.get(getattr(network, "output_activation", ""))
    if slope is None:
        raise TypeError(
            f"SAC draws actions around what a network's output layer says, and {network} has none "
            "that ends in tanh or sigmoid: give MLP, RNN, GRU, LSTM, MMU, NTM or DNC, or train it "
            "by TD3"
        )
    return slope
