"""Fitness critics: Rockefeller, Khadka & Tumer (2020), "Multi-level Fitness Critics for Cooperative
Coevolution".

A team is paid once, at the end, and seldom. A fitness critic f predicts from what one agent
observed in one step, and may be from what it did, what the team got in that episode; the fitness of
a policy is the most that its critic said in any step. So an agent that was in the right place is
ranked above the others, although its team got nothing.

Departures: f is fitted to the return in every step of an episode, by its squared error, so that it
is the mean return of the episodes that came by there. One critic serves all agents, unless
`sharing` says otherwise. It reads observations alone by default: actions change from generation to
generation, places do not.

`Criticised` puts a fitness critic into the place of the reward of a gradient learner, which is ours
and not the paper's.
"""

import abc
from dataclasses import replace
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from .. import require
from ..networks.base import AbstractNetwork, AbstractPolicy
from ..networks.mlp import Critic, CriticNetwork
from ..types import Batch, Metrics
from .base import AbstractLearner, adam_state, descend, mean
from .td3 import TD3, TEAM

Rows = Float[Array, "n *agents size"]


class AbstractFitnessCritic(eqx.Module):
    """Predicts from single steps what the whole episode was worth."""

    updates: eqx.AbstractVar[int]  # gradient steps per generation, where it judges for evolution
    batch_size: eqx.AbstractVar[int]  # steps of episodes per gradient step
    capacity: eqx.AbstractVar[int]  # the latest steps of episodes that it learns from

    @abc.abstractmethod
    def init(self, obs_size: int, action_size: int, *team: int, key: PRNGKeyArray) -> PyTree:
        """A fresh critic, of a team with its number of agents behind the sizes."""

    @abc.abstractmethod
    def value(self, state: PyTree, obs: Rows, action: Rows) -> Float[Array, "n *agents"]:
        """The return that each agent's step promises."""

    @abc.abstractmethod
    def update(
        self,
        state: PyTree,
        obs: Rows,
        action: Rows,
        returns: Float[Array, "n *agents"],
        active: Any,
    ) -> tuple[PyTree, Float[Array, ""]]:
        """One gradient step towards the returns of the episodes. **Returns:** also the error."""


class FitnessCriticState(eqx.Module):
    """Networks, leaves `[1 or agents, ...]`, and the state of Adam."""

    networks: CriticNetwork
    opt: optax.OptState


class FitnessCritic(AbstractFitnessCritic):
    """A perceptron for each agent, or one for all."""

    hidden: tuple[int, ...] = eqx.field(static=True, default=(64, 64))
    """Units of each hidden layer, at least 1."""
    learning_rate: float = 1e-3  # step size of its Adam, at least 0
    sharing: Literal["everything", "nothing"] = eqx.field(static=True, default="everything")
    """Whether one critic serves all agents, or each has its own."""
    actions: bool = eqx.field(static=True, default=False)  # whether it sees actions too
    updates: int = eqx.field(static=True, default=100)
    """Gradient steps per generation where it judges for evolution, at least 0; a learner brings its
    own number."""
    batch_size: int = eqx.field(static=True, default=256)
    """Steps of episodes per gradient step, at least 1; a learner brings its own number."""
    capacity: int = eqx.field(static=True, default=50_000)
    """The latest steps of episodes that it learns from, at least 1; a learner brings its own
    buffer."""

    def __check_init__(self):
        require.literals(self)
        for name in ("learning_rate", "updates"):
            require.at_least(name, getattr(self, name), 0)
        for name in ("batch_size", "capacity"):
            require.at_least(name, getattr(self, name), 1)
        for i, units in enumerate(self.hidden):
            require.at_least(f"hidden[{i}]", units, 1)

    def init(self, obs_size, action_size, *team, key):
        heads = team[0] if team and self.sharing == "nothing" else 1
        config, size = Critic(hidden=self.hidden), action_size * self.actions
        keys = jax.random.split(key, heads)
        networks = eqx.filter_vmap(lambda key: config.init(obs_size, size, key=key))(keys)
        return FitnessCriticState(networks, adam_state(networks))

    def value(self, state, obs, action):
        return self._values(state.networks, obs, action)

    def update(self, state, obs, action, returns, active):
        given = (state.networks, (obs, action), returns, active)
        networks, opt, (loss, _) = descend(self._error, given, state.opt, self.learning_rate)
        return FitnessCriticState(networks, opt), loss

    def _values(self, networks, obs: Rows, action: Rows) -> Float[Array, "n *agents"]:
        features = (jnp.moveaxis(x, -1, 0) for x in (obs, action[..., : self._seen(action)]))
        obs, action = features
        if self.sharing == "everything" or obs.ndim == 2:
            return jax.tree.map(lambda x: x[0] if eqx.is_array(x) else x, networks)(obs, action)
        return eqx.filter_vmap(lambda f, o, a: f(o, a), in_axes=(eqx.if_array(0), 2, 2))(
            networks, obs, action
        ).T

    def _seen(self, action: Rows) -> int:
        return action.shape[-1] * self.actions

    def _error(self, networks, seen: tuple[Rows, Rows], returns, active):
        return mean(jnp.square(self._values(networks, *seen) - returns), active), None


class CriticisedState(eqx.Module):
    """A learner's state and that of its fitness critic."""

    learner: PyTree
    critic: PyTree


class Criticised(AbstractLearner):
    """A learner whose reward is what a fitness critic says of the place that a step leads to.

    The critic is fitted to the rewards in the buffer, of the same minibatches: let the algorithm
    have `redistribute=Even()`, so that each frame has its part of the whole episode's return. No
    reward designed for single agents is needed.
    """

    metrics: ClassVar[tuple[str, ...]] = ("critic_loss", "q", "fitness_critic_loss")

    learner: AbstractLearner = TD3(signal="global", reward_scale=50.0, **TEAM)
    """What learns, from the critic's reward; its `signal` is what the critic predicts."""
    critic: AbstractFitnessCritic = FitnessCritic()  # what predicts returns
    gain: bool = eqx.field(static=True, default=False)
    """Whether a step is paid by how much the prediction rose, instead of by the prediction."""

    def __check_init__(self):
        if self.learner.reward_scale is None:
            raise ValueError(
                "the learner's reward_scale is None: it would follow rewards that it does not see; "
                "give it a number, such as 1 over the usual prediction"
            )

    @property
    def signal(self) -> str | None:
        return self.learner.signal

    @property
    def teams(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.learner.teams

    @property
    def discrete(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.learner.discrete

    @property
    def batch_size(self) -> int:
        return self.learner.batch_size

    @property
    def gamma(self) -> float:
        return self.learner.gamma

    @property
    def reward_scale(self) -> float | None:
        return self.learner.reward_scale

    @property
    def together(self) -> bool:
        return self.learner.together

    def init(self, network: AbstractNetwork, *sizes: int, key: PRNGKeyArray) -> CriticisedState:
        learner_key, critic_key = jax.random.split(key)
        learner = self.learner.init(network, *sizes, key=learner_key)
        return CriticisedState(learner, self.critic.init(*sizes, key=critic_key))

    def update(
        self, state: CriticisedState, batch: Batch, *, key: PRNGKeyArray
    ) -> tuple[CriticisedState, Metrics]:
        given = (batch.obs, batch.action, batch.reward, batch.active)
        critic, loss = self.critic.update(state.critic, *given)
        # What will be done there is not known: a critic of actions is asked about what was done.
        reward = self.critic.value(critic, batch.next_obs, batch.action)
        if self.gain:
            reward = reward - self.critic.value(critic, batch.obs, batch.action)
        batch = replace(batch, reward=jax.lax.stop_gradient(reward))
        learner, metrics = self.learner.update(state.learner, batch, key=key)
        metrics = {name: metrics[name] for name in self.metrics[:2]}
        return CriticisedState(learner, critic), metrics | {"fitness_critic_loss": loss}

    def actor(self, state: CriticisedState) -> AbstractPolicy:
        return self.learner.actor(state.learner)

    def explorer(self, state: CriticisedState, random: Bool[Array, ""]) -> AbstractPolicy:
        return self.learner.explorer(state.learner, random)

    def warm(self, state: CriticisedState, actor: AbstractPolicy) -> CriticisedState:
        return replace(state, learner=self.learner.warm(state.learner, actor))
