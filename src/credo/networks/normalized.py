"""A policy behind an observation normalisation that belongs to it: statistics frozen beside the
weights, so that wherever the policy goes it sees what it was trained on."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .base import AbstractPolicy

LIMIT = 10.0  # normalised observations are clipped to ±this


class Normalized(AbstractPolicy):
    """`policy`, which sees (observation - mean) / std, clipped to ±10. Of a team each agent has
    statistics of its own. They are no genome: operators and learners work on `policy`."""

    policy: AbstractPolicy
    mean: Float[Array, "*agents obs"]
    std: Float[Array, "*agents obs"]  # above 0

    @property
    def features_first(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.policy.features_first

    def start(self, *, key: PRNGKeyArray) -> PyTree:
        return self.policy.start(key=key)

    def remembered(self, carry):
        return self.policy.remembered(carry)

    def __call__(self, obs, carry):
        return self.policy(scaled(obs, self.mean, self.std), carry)

    def arranged(self) -> "Normalized":
        return eqx.tree_at(lambda n: n.policy, self, self.policy.arranged())


def scaled(obs: Array, mean: Array, std: Array) -> Array:
    """An observation as a `Normalized` policy sees it; axes of a batch may stand behind."""
    behind = (1,) * (obs.ndim - mean.ndim)
    mean, std = (x.reshape(*x.shape, *behind) for x in (mean, std))
    return jnp.clip((obs.astype(jnp.float32) - mean) / std, -LIMIT, LIMIT)
