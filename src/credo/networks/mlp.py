"""Feed-forward policy: the memoryless baseline."""

import itertools
from typing import ClassVar, Literal

import equinox as eqx
from jaxtyping import Array, Float, PRNGKeyArray

from .. import require
from .base import (
    ACTIVATIONS,
    INITIALIZERS,
    AbstractNetwork,
    AbstractPolicy,
    draw,
    matvec,
    to_action,
)


class MLP(AbstractNetwork):
    """Config of a multi-layer perceptron."""

    width: int = eqx.field(static=True, default=20)  # units per hidden layer
    depth: int = eqx.field(static=True, default=1)  # hidden layers, at least 1
    activation: str = eqx.field(static=True, default="tanh")  # of the hidden layers
    output_activation: Literal["sigmoid", "tanh"] = eqx.field(static=True, default="tanh")
    initializer: str = eqx.field(static=True, default="normal")  # normal, fan_in or kaiming

    def __check_init__(self):
        require.at_least("width", self.width, 1)
        require.at_least("depth", self.depth, 1)
        require.choice("activation", self.activation, ACTIVATIONS)
        require.choice("output_activation", self.output_activation, ("sigmoid", "tanh"))
        require.choice("initializer", self.initializer, INITIALIZERS)

    def init(self, obs_size: int, action_size: int, *, key: PRNGKeyArray) -> "MLPPolicy":
        sizes = (obs_size, *[self.width] * self.depth, action_size)
        shapes: dict[str, tuple[int, ...]] = {}
        for layer, (fan_in, fan_out) in enumerate(itertools.pairwise(sizes)):
            shapes |= {f"W_{layer}": (fan_out, fan_in), f"b_{layer}": (fan_out,)}
        return MLPPolicy(draw(shapes, self.initializer, key=key), self)


class MLPPolicy(AbstractPolicy):
    """Weights by name: `W_l` and `b_l` of each layer l. The carry is empty."""

    features_first: ClassVar[bool] = True

    weights: dict[str, Float[Array, "..."]]
    config: MLP = eqx.field(static=True)

    def start(self, *, key: PRNGKeyArray | None = None) -> tuple[()]:
        return ()

    def __call__(self, obs, carry):
        x = obs
        for layer in range(self.config.depth + 1):
            last = layer == self.config.depth
            φ = ACTIVATIONS[self.config.output_activation if last else self.config.activation]
            x = φ(matvec(self.weights[f"W_{layer}"], x) + self.weights[f"b_{layer}"])
        return to_action(x, self.config.output_activation), carry
