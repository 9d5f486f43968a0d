"""Observation normalisation: running mean and variance of what a whole population, and the learners
beside it, have seen while training.

An algorithm with `normalize_observations` keeps `Moments` in its state; without, None, and every
function here gives back what it got. One generation acts behind the statistics of those before it;
tests, and whoever gets the champion, act behind those that are frozen in it.
"""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from .compilation import jit
from .networks.base import AbstractNetwork, AbstractPolicy
from .networks.normalized import Normalized, scaled
from .replay import BLOCK
from .rollout import Environment, Experience, collect, evaluate
from .types import Evaluation

TRUSTED = 100_000  # observations that a saved policy's statistics count for in a new run


class Moments(eqx.Module):
    """Of every number of an observation; of a team for each agent apart, since the same number may
    mean something else to each. Agents that do not act are not counted."""

    count: Int[Array, "*agents"]  # observations so far, at most 2^30 and those of the last rollout
    mean: Float[Array, "*agents obs"]
    variance: Float[Array, "*agents obs"]
    spared: int = eqx.field(static=True, default=0)  # first numbers that stay as they are

    @classmethod
    def first(cls, env: Environment, network: AbstractNetwork | None = None) -> "Moments":
        """Before anything was seen: mean 0, variance 1.

        **Raises:** `ValueError` for a network that reads who takes part from an observation.
        """
        if getattr(network, "access", "everyone") != "everyone":
            raise ValueError(
                f"{type(network).__name__} reads from the last number of an observation who takes "
                "part, which normalisation would change: give normalize_observations=False, or a "
                "network with access='everyone' on a task without that number"
            )
        if getattr(getattr(network, "network", network), "shape", None) is not None:
            raise ValueError(
                "normalize_observations changes every number of an image, which Convolutional "
                "scales as a whole: give normalize_observations=False"
            )
        obs_size, _, *team = env.sizes
        shape = (*team, obs_size)
        ones = jnp.ones(shape, jnp.float32)
        return cls(jnp.zeros(team, jnp.int32), jnp.zeros(shape, jnp.float32), ones, env.barrable)

    @classmethod
    def of_returns(cls, env: Environment) -> "Moments":
        """Before any was paid: as `first`, of one number."""
        _, _, *team = env.sizes
        shape = (*team, 1)
        zeros, ones = jnp.zeros(shape, jnp.float32), jnp.ones(shape, jnp.float32)
        return cls(jnp.zeros(team, jnp.int32), zeros, ones)

    @property
    def std(self) -> Float[Array, "*agents obs"]:
        """Never 0: of a constant it is what float32 cannot resolve."""
        resolved = jnp.maximum(1e-4, 1e-6 * jnp.abs(self.mean))
        return jnp.sqrt(self.variance + jnp.square(resolved))

    @property
    def used(self) -> tuple[Float[Array, "*agents obs"], Float[Array, "*agents obs"]]:
        """Mean and standard deviation by which observations are normalised. What an action may be
        is no quantity: such numbers stay as they are."""
        if not self.spared:
            return self.mean, self.std
        counts = jnp.arange(self.mean.shape[-1]) >= self.spared
        return jnp.where(counts, self.mean, 0.0), jnp.where(counts, self.std, 1.0)

    def frozen(self, policy: AbstractPolicy) -> Normalized:
        return Normalized(policy, *self.used)

    def scaled(self, obs: Float[Array, "*agents obs"]) -> Float[Array, "*agents obs"]:
        return scaled(obs, *self.used)

    def after(self, experience: Experience) -> "Moments":
        """With all that was met in a rollout."""
        rows, valid = experience.transitions, experience.valid
        if valid is not None:
            return with_rows(self, rows.obs, rows.active, valid)
        moments = self
        for start in range(0, len(rows.obs), BLOCK):  # from outside JAX: their number is data
            obs = np.asarray(rows.obs[start : start + BLOCK], np.float64)
            active = None if rows.active is None else rows.active[start : start + BLOCK]
            n, *new = _summary(obs, np.ones(len(obs), bool), active, np)
            moments = _merged(moments, np.asarray(n), *(x.astype(np.float32) for x in new))
        return moments


@jit
def with_rows(moments: Moments, obs: Array, active: Any, valid: Array) -> Moments:
    """With rows `obs[rows, *agents, obs]`, of those that are `valid` and of agents `active` then;
    None: all are."""
    return _merged(moments, *_summary(obs.astype(jnp.float32), valid, active, jnp))


def _summary(obs: Any, valid: Any, active: Any, xp: Any) -> tuple[Any, Any, Any]:
    """How many of the rows count, their mean and variance. The mean is corrected by the mean of
    what is left: a large offset would cost all digits of the variance."""
    counts = valid.reshape(-1, *(1,) * (obs.ndim - 2))
    counts = counts & (xp.ones(obs.shape[:-1], bool) if active is None else active)
    obs = xp.where(counts[..., None], obs, xp.zeros_like(obs))
    n = counts.sum(axis=0, dtype=np.int32)
    weight = (counts.astype(obs.dtype) / xp.maximum(n, 1).astype(obs.dtype)[None])[..., None]
    mean = xp.sum(weight * obs, axis=0)
    mean = mean + xp.sum(weight * (obs - mean[None]), axis=0)
    return n, mean, xp.sum(weight * xp.square(obs - mean[None]), axis=0)


@jit
def _merged(moments: Moments, n: Array, mean: Array, variance: Array) -> Moments:
    """With n more (Chan, Golub & LeVeque 1979). Shares in place of sums: those would outgrow
    float32."""
    # From 2^30 observations on the latest weigh as they did then: 32 bits would overflow.
    count = jnp.minimum(moments.count, 2**30) + n
    share = (n.astype(jnp.float32) / jnp.maximum(count, 1).astype(jnp.float32))[..., None]
    away = mean - moments.mean
    spread = (1.0 - share) * moments.variance + share * variance
    spread = spread + share * (1.0 - share) * jnp.square(away)
    return replace(moments, count=count, mean=moments.mean + share * away, variance=spread)


def frozen(moments: Moments | None, policy: AbstractPolicy) -> AbstractPolicy:
    """A policy as it sees now, for good."""
    return policy if moments is None else moments.frozen(policy)


def behind(moments: Moments | None, population: PyTree) -> PyTree:
    """A population that sees normalised observations."""
    return population if moments is None else eqx.filter_vmap(moments.frozen)(population)


def watched(moments: Moments | None, experience: Experience) -> Moments | None:
    """The statistics after a rollout."""
    return None if moments is None else moments.after(experience)


def seen(moments: Moments | None, obs: Array) -> Float[Array, "rows *agents obs"]:
    """Recorded observations as networks see them: float32, whatever the buffer holds."""
    obs = obs.astype(jnp.float32)
    return obs if moments is None else jax.vmap(moments.scaled)(obs)


def play(
    env: Environment,
    population: PyTree,
    episodes: int,
    moments: Moments | None,
    *,
    key: PRNGKeyArray,
) -> tuple[Evaluation, Moments | None]:
    """`evaluate` behind the statistics, and these afterwards. To have them the observations of a
    whole generation are recorded."""
    if moments is None:
        return evaluate(env, population, episodes, key=key), None
    played, experience = collect(env, behind(moments, population), episodes, key=key)
    return played, moments.after(experience)


def warmed(policy: Any, moments: Moments | None) -> tuple[Any, Moments | None]:
    """A saved policy's network, and the statistics that it came with, which count for 100,000
    observations."""
    if not isinstance(policy, Normalized):
        return policy, moments
    count = jnp.full(policy.mean.shape[:-1], TRUSTED, jnp.int32)
    spared = 0 if moments is None else moments.spared
    return policy.policy, Moments(count, policy.mean, jnp.square(policy.std), spared)
