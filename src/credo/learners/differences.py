"""Differences of predicted returns: a network with memory reads an episode and says at every step
what its return will be; each step is paid by how much it changed that.

Source: Arjona-Medina et al. (2019), "RUDDER: Return Decomposition for Delayed Rewards", section 3:
the main and the continuous loss of its appendix, and the correction that keeps returns equal.

Departures: the network is any of Credo's with memory, with the last action beside the observation,
and no LSTM without forget gates; it reads an episode in at most `pieces` parts, the mean of the
frames of each, and a difference is paid in equal parts within its piece; episodes are drawn by
their lengths from the last ones, without priority, and none is left out where the prediction is
bad.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import require
from ..networks.base import AbstractNetwork, AbstractPolicy
from ..networks.recurrent import Recurrent
from .predicted import AbstractPrediction, Part

LIMIT = 4.0  # standard deviations of returns that a network of outputs in [-1, 1] can say
GRU = Recurrent("gru", hidden=32, output_activation="tanh", initializer="fan_in")


class Differences(AbstractPrediction):
    """Pays the differences of the returns that a network with memory predicts (RUDDER)."""

    network: AbstractNetwork = GRU  # reads an episode, and says its return
    pieces: int = eqx.field(static=True, default=100)
    """Parts that an episode is read in, at most, at least 1."""
    continuous: float = 0.5
    """Weight of the error at every step beside that at the last one, at least 0."""
    batch_size: int = eqx.field(static=True, default=8)  # episodes per update, at least 1
    learning_rate: float = 1e-3  # step size of Adam, at least 0
    updates_per_frame: float = 0.05  # updates of the network per frame played, at least 0
    refresh: int = eqx.field(static=True, default=4)
    """Past episodes that are paid anew for each new one, at least 0."""
    memory: int = eqx.field(static=True, default=4096)
    """Episodes that the network learns from, at least 1: the last of those in the replay buffer."""
    signal: str | None = eqx.field(static=True, default=None)
    """Name of the reward that is redistributed; None: the task's first."""
    late_only: bool = eqx.field(static=True, default=True)
    """Episodes that are paid anything before their last step keep their rewards."""

    def __check_init__(self):
        require.at_least("pieces", self.pieces, 1)
        require.at_least("continuous", self.continuous, 0)
        if self.network.team:
            raise ValueError(
                f"{type(self.network).__name__} acts for a team: give a network of one, such as "
                "Recurrent('gru'), which is shown the observations of all agents as one"
            )

    def model(self, obs_size, action_size, *, key):
        return self.network.init(obs_size + action_size, 1, key=key)

    def target(self, value, length):
        return value

    def loss(self, model, part, target, key):
        whose, read = _pieces(part, self.pieces)
        error = jnp.square(_said(model, part, whose) - target[:, None])
        steps = jnp.where(jnp.arange(error.shape[1])[None] < read[:, None], error, 0.0)
        last = jnp.take_along_axis(error, read[:, None] - 1, axis=1)[:, 0]
        steps = jnp.sum(steps, axis=1) / read.astype(jnp.float32)
        return jnp.mean(last + self.continuous * steps), None

    def rewards(self, model, part):
        whose, _ = _pieces(part, self.pieces)
        said = jnp.pad(_said(model, part, whose), ((0, 0), (1, 0)))  # 0 is the mean return
        each = (said[:, 1:] - said[:, :-1]) / jnp.maximum(jnp.sum(whose, axis=1), 1.0)
        return jnp.einsum("etp,ep->et", whose, each)


def _pieces(part: Part, most: int) -> tuple[Float[Array, "episodes steps pieces"], Array]:
    """1 where a step belongs to a piece; and how many pieces each episode has."""
    length, steps = jnp.maximum(part.length, 1)[:, None], jnp.arange(part.steps)[None]
    read = jnp.minimum(length, most)
    piece = jnp.where(steps < length, steps * read // length, most)
    return jax.nn.one_hot(piece, min(most, part.steps)), read[:, 0]


def _said(model: AbstractPolicy, part: Part, whose: Array) -> Float[Array, "episodes pieces"]:
    """The return that the network predicts behind each piece, in standard deviations."""
    x = jnp.concatenate(part.every()[:2], axis=-1)
    share = whose / jnp.maximum(jnp.sum(whose, axis=1, keepdims=True), 1.0)
    x = jnp.einsum("etp,etx->epx", share, x)

    def step(carry, x):
        said, carry = model(x, carry)
        return carry, said[0]

    def read(pieces):
        return jax.lax.scan(step, model.start(key=jax.random.key(0)), pieces)[1]

    return LIMIT * jax.vmap(read)(x)
