"""What NTM and DNC share: a controller, and rows of a memory that are found by their content.

These policies are written for one network: the memory's own axes are long enough to compute with
in one loop, so nothing is gained by packing a population behind them.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import ACTIVATIONS

NORM = 1e-6  # added to a squared length: vectors of zeros have a direction, and a gradient
GATES = "ifoc"  # of the LSTM, as in `credo.networks.recurrent`

Weights = dict[str, Float[Array, "..."]]


def controller_shapes(controller: str, inputs: int, hidden: int) -> dict[str, tuple[int, ...]]:
    """Of a feed-forward controller `W_h`, `b_h`; of an LSTM `W_g`, `U_g`, `b_g` of each gate g."""
    if controller == "feedforward":
        return {"W_h": (hidden, inputs), "b_h": (hidden,)}
    shapes: dict[str, tuple[int, ...]] = {}
    for gate in GATES:
        shapes |= {f"W_{gate}": (hidden, inputs), f"U_{gate}": (hidden, hidden)}
        shapes |= {f"b_{gate}": (hidden,)}
    return shapes


def control(weights: Weights, controller: str, x: Float[Array, " in"], state: Any):
    """The controller's output `[hidden]` and its state: of an LSTM (h, c), otherwise ()."""
    if controller == "feedforward":
        return jnp.tanh(weights["W_h"] @ x + weights["b_h"]), state
    h, c = state

    def gate(name: str) -> Float[Array, " hidden"]:
        return weights[f"W_{name}"] @ x + weights[f"U_{name}"] @ h + weights[f"b_{name}"]

    σ = ACTIVATIONS["sigmoid"]
    c = σ(gate("f")) * c + σ(gate("i")) * jnp.tanh(gate("c"))
    h = σ(gate("o")) * jnp.tanh(c)
    return h, (h, c)


def by_content(
    memory: Float[Array, "rows width"], keys: Float[Array, "heads width"], strengths: Array
) -> Float[Array, "heads rows"]:
    """Weights of the rows, those nearest in direction to each key first: a softmax of cosine
    similarity times `strengths` `[heads]`. Graves et al. (2014), equations 5 and 6."""
    similarity = (keys @ memory.T) / (_length(keys)[:, None] * _length(memory)[None])
    return jax.nn.softmax(strengths[:, None] * similarity, axis=1)


def _length(x: Float[Array, "n width"]) -> Float[Array, " n"]:
    return jnp.sqrt(jnp.sum(jnp.square(x), axis=1) + NORM)
