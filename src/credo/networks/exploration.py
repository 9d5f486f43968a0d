"""Exploration: a policy around another one, whose carry holds the noise and its key."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from .. import require
from .base import AbstractPolicy
from .choosing import chosen


class AbstractNoise(eqx.Module):
    """Noise of one episode, in units of actions, which lie in [-1, 1]."""

    @abc.abstractmethod
    def __call__(
        self, before: Float[Array, " act"], *, key: PRNGKeyArray
    ) -> tuple[Float[Array, " act"], Float[Array, " act"]]:
        """What is added to this action, and what the next call gets as `before` (at first 0)."""


class GaussianNoise(AbstractNoise):
    """Independent N(0, std), as TD3 explores."""

    std: float = 0.1  # standard deviation, in units of actions, at least 0

    def __check_init__(self):
        require.at_least("std", self.std, 0)

    def __call__(self, before, *, key):
        return self.std * jax.random.normal(key, before.shape), before


class OrnsteinUhlenbeck(AbstractNoise):
    """Correlated noise, as DDPG explores (Uhlenbeck & Ornstein 1930, in discrete time), from 0 at
    the start of each episode. The author's code never reset it, and scaled it by 0.3."""

    theta: float = 0.15  # share of the way back to 0 per step, in [0, 1]
    sigma: float = 0.2  # standard deviation of what each step adds, at least 0
    scale: float = 0.3  # factor of the whole noise, in units of actions

    def __check_init__(self):
        require.within("theta", self.theta, 0, 1)
        require.at_least("sigma", self.sigma, 0)
        require.at_least("scale", self.scale, 0)

    def __call__(self, before, *, key):
        x = before - self.theta * before + self.sigma * jax.random.normal(key, before.shape)
        return self.scale * x, x


class Explorer(AbstractPolicy):
    """A policy with noise on its actions, or actions drawn uniformly while it knows nothing."""

    policy: AbstractPolicy
    noise: AbstractNoise
    random: Bool[Array, ""]  # draw actions uniformly from [-1, 1]
    shape: int | tuple[int, ...] = eqx.field(static=True)  # of an action; of a team (agents, act)
    clipped: bool = eqx.field(static=True, default=True)
    """Clip actions to [-1, 1] here; else the rollout does, and the transition has what was said."""
    features_first: ClassVar[bool] = False

    def start(self, *, key: PRNGKeyArray) -> PyTree:
        policy_key, noise_key = jax.random.split(key)
        return self.policy.start(key=policy_key), jnp.zeros(self.shape), noise_key

    def remembered(self, carry):
        return self.policy.remembered(carry[0])

    def __call__(self, obs, carry):
        carry, before, key = carry
        key, noise_key, random_key = jax.random.split(key, 3)
        action, carry = self.policy(obs, carry)
        noise, before = self.noise(before, key=noise_key)
        drawn = jax.random.uniform(random_key, action.shape, minval=-1.0, maxval=1.0)
        action = jnp.clip(action + noise, -1.0, 1.0) if self.clipped else action + noise
        return jnp.where(self.random, drawn, action), (carry, before, key)


class AbstractDrawing(AbstractPolicy):
    """A policy of discrete actions around another one. The carry is that one's, and a key."""

    policy: eqx.AbstractVar[AbstractPolicy]
    features_first: ClassVar[bool] = False

    def start(self, *, key: PRNGKeyArray) -> PyTree:
        policy_key, drawn_key = jax.random.split(key)
        return self.policy.start(key=policy_key), drawn_key

    def remembered(self, carry):
        return self.policy.remembered(carry[0])


class EpsilonGreedy(AbstractDrawing):
    """A policy that chooses, of which every option that is allowed has an equal chance in a share ε
    of the steps (Mnih et al. 2015)."""

    policy: AbstractPolicy
    epsilon: Float[Array, ""]  # ε: that share, in [0, 1]; all of it while `random`
    random: Bool[Array, ""]

    def __call__(self, obs, carry):
        carry, key = carry
        key, when_key, which_key = jax.random.split(key, 3)
        action, carry = self.policy(obs, carry)
        drawn = jax.random.uniform(which_key, action.shape, minval=-1.0, maxval=1.0)
        drawn = chosen(self.policy).allowed(drawn, obs, barred=-1.0)
        strays = self.random | (jax.random.uniform(when_key, action.shape[:-1]) < self.epsilon)
        return jnp.where(strays[..., None], drawn, action), (carry, key)


class Categorical(AbstractDrawing):
    """Options drawn, of each choice, with the probabilities softmax(u) of what a policy says before
    its output activation: 1 for the one that is drawn, -1 for the others."""

    policy: AbstractPolicy

    def __call__(self, obs, carry):
        carry, key = carry
        key, drawn_key = jax.random.split(key)
        _, u, carry = self.policy.spoken(obs, carry)
        drawn = []
        for i, part in enumerate(chosen(self.policy).parts(u)):
            part_key = jax.random.fold_in(drawn_key, i) if i else drawn_key
            taken = jax.random.categorical(part_key, part)[..., None]
            options = jnp.broadcast_to(jnp.arange(part.shape[-1]), part.shape)
            drawn.append(jnp.where(options == taken, 1.0, -1.0))
        return jnp.concatenate(drawn, axis=-1), (carry, key)
