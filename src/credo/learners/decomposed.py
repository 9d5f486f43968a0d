"""Decomposed returns: a reward of single frames whose sum over an episode is the return, fitted on
a random part of each episode.

Source: Ren et al. (2022), "Learning Long-Term Reward Redistribution via Randomized Return
Decomposition" (RRD), equations 6 and 7, with subsets drawn with replacement.

Departures: the loss is that of the mean reward per frame, standardised over all episodes known, and
episodes are drawn by their lengths, so that short and long ones weigh alike by frame; what the
model leaves of a return is paid in equal parts; learners see rewards of a model that is a little
older than they are (`refresh`) in place of today's.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import require
from ..networks.base import features_first
from ..networks.mlp import AbstractCritic, AbstractCriticNetwork, Critic
from .predicted import AbstractPrediction, Frames


class Decomposed(AbstractPrediction):
    """Pays r(s, a, s'), whose sum over an episode predicts its return (RRD)."""

    network: AbstractCritic = Critic(hidden=(128, 128))  # r(s, a, s')
    steps: int = eqx.field(static=True, default=64)
    """K: frames of each episode that an update looks at, at least 1."""
    batch_size: int = eqx.field(static=True, default=4)  # M: episodes per update, at least 1
    learning_rate: float = 3e-4  # step size of Adam, at least 0
    updates_per_frame: float = 0.25  # updates of r per frame played, at least 0
    refresh: int = eqx.field(static=True, default=20)
    """Past episodes that are paid anew for each new one, at least 0."""
    memory: int = eqx.field(static=True, default=4096)
    """Episodes that r is fitted on, at least 1: the last of those in the replay buffer."""
    signal: str | None = eqx.field(static=True, default=None)
    """Name of the reward that is redistributed; None: the task's first."""
    late_only: bool = eqx.field(static=True, default=True)
    """Episodes that are paid anything before their last step keep their rewards."""

    def __check_init__(self):
        require.at_least("steps", self.steps, 1)
        if self.network.joint:
            raise ValueError(
                f"{type(self.network).__name__} sees a team: give Critic(...), which is shown the "
                "observations of all agents as one"
            )

    def model(self, obs_size, action_size, *, key):
        return self.network.init(2 * obs_size, action_size, key=key)

    def target(self, value, length):
        return value / length

    def loss(self, model, part, target, key):
        # R / T against the mean of K of the T rewards.
        length = part.length[:, None]
        drawn = jax.random.uniform(key, (len(length), self.steps)) * length.astype(jnp.float32)
        some = jnp.minimum(jnp.floor(drawn).astype(jnp.int32), length - 1)
        mean = jnp.mean(_reward(model, part.at(some)), axis=1)
        return jnp.mean(jnp.square(mean - target)), None

    def rewards(self, model, part):
        return _reward(model, part.every())


def _reward(model: AbstractCriticNetwork, frames: Frames) -> Float[Array, "episodes steps"]:
    """r(s, a, s')."""
    obs, action, after = frames
    return model(features_first(jnp.concatenate([obs, after], axis=-1)), features_first(action))
