"""TD3: Fujimoto, van Hoof & Meger (2018), Algorithm 1; and DDPG, which is TD3 with one critic and
without its three additions: Lillicrap et al. (2016), Algorithm 1.

Departures: an update follows whole episodes, as many as frames were collected, as in the
authors' first code. Time limits bootstrap; the author of ERL took them for the end of the task.
The author clipped the gradient of DDPG's critic twice and of its actor never; both are clipped.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from .. import require
from ..networks.base import AbstractNetwork, AbstractPolicy, features_first
from ..networks.exploration import AbstractNoise, Explorer, GaussianNoise, OrnsteinUhlenbeck
from ..networks.history import remembering
from ..networks.mlp import MLP, AbstractCritic, AbstractCriticNetwork, Critic, MLPPolicy
from ..networks.team import JointCritic, TeamPolicy
from ..types import Batch, Metrics
from .base import (
    AbstractLearner,
    Returns,
    Value,
    acts,
    adam_state,
    bellman,
    descend,
    mean,
    polyak,
)

TD3_NETWORK = MLP(hidden=(256, 256), activation="relu", initializer="uniform")
"""The actor of TD3's authors, second version."""
TEAM: dict[str, Any] = {
    "critic": Critic(hidden=(100, 100)),
    "gamma": 0.97,
    "actor_lr": 1e-3,
    "critic_lr": 1e-3,
    "noise": GaussianNoise(0.4),
    "batch_size": 128,
}
"""What every learner of a team has in common; γ and noise of the author, whose rates (5e-5, 1e-5)
hardly move a network."""
ERL_NETWORK = MLP(hidden=(128, 128), normalization="before", initializer="uniform")
"""The actor of ERL (Khadka 2019, section 5.4)."""


Key = PRNGKeyArray
Critics = tuple[AbstractCriticNetwork, ...]


class TD3State(eqx.Module):
    """Networks, their targets, and the states of Adam."""

    actor: AbstractPolicy
    critics: Critics
    target_actor: AbstractPolicy
    target_critics: Critics
    actor_opt: optax.OptState
    critic_opt: optax.OptState
    step: Int[Array, ""]
    shape: tuple[int, ...] = eqx.field(static=True)  # of an action; of a team (agents, act)


class TD3(AbstractLearner):
    """Deterministic actor-critic: twin critics, delayed policy, target policy smoothing."""

    metrics: ClassVar[tuple[str, ...]] = ("critic_loss", "q")
    teams: ClassVar[bool] = True

    critic: AbstractCritic = Critic()  # network of the action values
    gamma: float = 0.99  # γ: discount per step, in [0, 1]
    actor_lr: float = 3e-4  # learning rate of the actor's Adam, ≥ 0
    critic_lr: float = 3e-4  # learning rate of the critics' Adam, ≥ 0
    tau: float = 5e-3  # share of the new weights in the target networks per update, in [0, 1]
    target_noise: float = 0.2  # std of the noise on target actions, ≥ 0, in units of actions
    target_noise_clip: float = 0.5  # largest magnitude of the noise on target actions, ≥ 0
    noise: AbstractNoise = GaussianNoise()  # on the actor's actions while it explores
    critics: int = eqx.field(static=True, default=2)  # number; the target is their minimum, ≥ 1
    policy_delay: int = eqx.field(static=True, default=2)  # critic updates per actor update, ≥ 1
    actor_max_norm: float | None = None  # bound on the norm of the actor's gradient; None: none
    critic_max_norm: float | None = None  # bound on the norm of the critics' gradient; None: none
    actor_scale: float = 1.0  # factor of the weights in the fresh actor's output layer
    bootstrap_truncated: bool = eqx.field(static=True, default=True)
    """A time limit is not the end of the task; False: it counts as one, as in the author's code."""
    reward_scale: float | None = 1.0
    """Factor of all rewards that critics see, ≥ 0. None: so that the root mean square of the
    buffer's rewards, paid at every step, makes a return of 1."""
    batch_size: int = eqx.field(static=True, default=256)  # transitions per update, ≥ 1
    signal: str | None = eqx.field(static=True, default=None)
    """Name of the reward that it maximises; None: that of its algorithm."""

    def __check_init__(self):
        require.within("gamma", self.gamma, 0, 1)
        require.within("tau", self.tau, 0, 1)
        for name in ("actor_lr", "critic_lr", "target_noise", "target_noise_clip", "reward_scale"):
            require.at_least(name, getattr(self, name), 0)
        for name in ("actor_max_norm", "critic_max_norm"):
            require.at_least(name, getattr(self, name), 0)
        for name in ("critics", "policy_delay", "batch_size"):
            require.at_least(name, getattr(self, name), 1)

    @property
    def together(self) -> bool:
        return self.critic.joint

    def init(self, network: AbstractNetwork, *sizes: int, key: Key) -> TD3State:
        actor_key, critic_key = jax.random.split(key)
        actor = network.init(*sizes, key=actor_key)
        critic = self.critic if actor.first() is None else remembering(self.critic)
        if isinstance(actor, MLPPolicy | TeamPolicy):
            actor = actor.scaled(self.actor_scale)
        seen = sizes if self.together else sizes[:2]
        keys = jax.random.split(critic_key, self.critics)
        critics = tuple(critic.init(*seen, key=key) for key in keys)
        opts = (adam_state(actor), adam_state(critics))
        return TD3State(actor, critics, actor, critics, *opts, jnp.int32(0), (*sizes[2:], sizes[1]))

    def update(self, state: TD3State, batch: Batch, *, key: Key) -> tuple[TD3State, Metrics]:
        given = (state.critics, batch, self.bellman_target(state, batch, key=key))
        rate = (self.critic_lr, self.critic_max_norm)
        critics, opts, (loss, q) = descend(critic_error, given, state.critic_opt, *rate)

        def moved():
            given, rate = (state.actor, critics[0], batch), (self.actor_lr, self.actor_max_norm)
            actor, opt, _ = descend(actor_loss, given, state.actor_opt, *rate)
            return actor, opt, *polyak(before[2:], (actor, critics), self.tau)

        before = (state.actor, state.actor_opt, state.target_actor, state.target_critics)
        due = state.step % self.policy_delay == 0
        after = jax.lax.cond(due, moved, lambda: before) if self.policy_delay > 1 else moved()
        actor, opt, target, targets = after
        state = TD3State(actor, critics, target, targets, opt, opts, state.step + 1, state.shape)
        return state, {"critic_loss": loss, "q": q}

    def bellman_target(self, state: TD3State, batch: Batch, *, key: Key) -> Returns:
        """y = r + γ min_i Q'_i(s', π'(s') + clipped noise), or what the critics' `values` say in
        place of the minimum."""
        noise = self.target_noise * jax.random.normal(key, batch.action.shape)
        noise = jnp.clip(noise, -self.target_noise_clip, self.target_noise_clip)
        action = acts(state.target_actor, batch, later=True)
        action = features_first(jnp.clip(action + noise, -1.0, 1.0))
        atoms = jnp.stack(
            [q.atoms(q.sees(batch, later=True), action) for q in state.target_critics]
        )
        ended = batch.terminated | (batch.truncated & (not self.bootstrap_truncated))
        return bellman(self, batch, state.target_critics[0].values.cautious(atoms), ended)

    def actor(self, state: TD3State) -> AbstractPolicy:
        return state.actor

    def explorer(self, state: TD3State, random: Bool[Array, ""]) -> AbstractPolicy:
        return Explorer(state.actor, self.noise, random, state.shape)

    def value(self, state: TD3State, policy: AbstractPolicy, batch: Batch) -> Value:
        """By the first critic, which the actor follows too."""
        actions = map(features_first, (acts(policy, batch), batch.action))
        return state.critics[0].own(state.critics[0].sees(batch), *actions)

    def warm(self, state: TD3State, actor: AbstractPolicy) -> TD3State:
        return eqx.tree_at(lambda s: (s.actor, s.target_actor), state, (actor, actor))


def ddpg(**fields: Any) -> TD3:
    """DDPG as settings of `TD3`, with the constants of ERL (Khadka 2019, section 5.4)."""
    layers: dict[str, Any] = {"hidden": (300,), "branches": (200, 200), "output_scale": 0.1}
    critic = Critic(activation="elu", normalization="before", **layers)
    settings: dict[str, Any] = {"critic": critic, "noise": OrnsteinUhlenbeck()}
    settings |= {"critics": 1, "policy_delay": 1, "target_noise": 0.0}
    settings |= {"actor_lr": 5e-5, "critic_lr": 5e-4, "tau": 1e-3}
    settings |= {"actor_max_norm": 10.0, "critic_max_norm": 10.0, "actor_scale": 0.1}
    settings |= {"batch_size": 128} | fields
    return TD3(**settings)


def matd3(**fields: Any) -> TD3:
    """MATD3 as settings of `TD3`: each agent's twin critics see the whole team."""
    settings: dict[str, Any] = TEAM | {"critic": JointCritic()} | fields
    return TD3(**settings)


def maddpg(**fields: Any) -> TD3:
    """MADDPG (Lowe et al. 2017, Algorithm 1) as settings of `TD3`, with this file's constants."""
    return matd3(**({"critics": 1, "policy_delay": 1, "target_noise": 0.0} | fields))


def critic_error(critics: Critics, batch: Batch, target: Returns) -> tuple[Array, Array]:
    """Sum over critics of the mean Bellman error, squared unless their `values` say otherwise, and
    their mean value."""
    atoms = [(q.values, q.atoms(q.sees(batch), features_first(batch.action))) for q in critics]
    errors = [mean(values.error(x, target), batch.active) for values, x in atoms]
    values = [mean(values.mean(x), batch.active) for values, x in atoms]
    return jnp.sum(jnp.stack(errors)), jnp.mean(jnp.stack(values))


def actor_loss(actor: AbstractPolicy, critic: AbstractCriticNetwork, batch: Batch):
    """Minus the value of what the actor would do (deterministic policy gradient)."""
    actions = (acts(actor, batch), batch.action)
    q = critic.own(critic.sees(batch), *map(features_first, actions))
    return -mean(q, batch.active), None
