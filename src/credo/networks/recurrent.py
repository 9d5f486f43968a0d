"""The recurrent baselines on the MMU's contract: Elman RNN, GRU and LSTM with a linear readout.

Sources: Elman (1990); Cho et al. (2014), equations 5-8 (the variant that resets before the matrix
product); Hochreiter & Schmidhuber (1997) with the forget gate of Gers et al. (2000).
States start at zero. One leaf per matrix, so that evolution treats them as it treats an MMU.
"""

from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from .. import require
from .base import (
    ACTIVATIONS,
    INITIALIZERS,
    AbstractNetwork,
    AbstractPolicy,
    OutputActivation,
    acted,
    draw,
    matvec,
)

GATES = {"rnn": ("h",), "gru": ("z", "r", "h"), "lstm": ("i", "f", "o", "c")}


class Recurrent(AbstractNetwork):
    """Config of a recurrent network with one layer."""

    cell: Literal["rnn", "gru", "lstm"] = eqx.field(static=True, default="lstm")
    """Rnn (Elman), gru, or lstm."""
    hidden: int = eqx.field(static=True, default=5)  # units (of an LSTM cells), at least 1
    output_activation: OutputActivation = eqx.field(static=True, default="sigmoid")
    """Activation of the output layer."""
    initializer: str = eqx.field(static=True, default="normal")
    """Fresh weights: normal, fan_in or kaiming."""
    span: int = eqx.field(static=True, default=0)
    """Steps for which fresh units of a gru or lstm keep their state, from 1 to nearly so many; at
    least 3. Chrono initialization (Tallec & Ollivier 2018, "Can recurrent neural networks warp
    time?", equation 16). 0: gates are as drawn, and keep it for a few steps."""

    def __check_init__(self):
        require.literals(self)
        require.at_least("hidden", self.hidden, 1)
        if self.span != 0:
            require.at_least("span", self.span, 3)
            if self.cell == "rnn":
                raise ValueError("span is for gru and lstm: an rnn has no gates, give span=0")
        require.choice("initializer", self.initializer, INITIALIZERS)

    def init(self, obs_size: int, action_size: int, *, key: PRNGKeyArray) -> "RecurrentPolicy":
        h = self.hidden
        shapes: dict[str, tuple[int, ...]] = {}
        for gate in GATES[self.cell]:
            shapes |= {f"W_{gate}": (h, obs_size), f"U_{gate}": (h, h), f"b_{gate}": (h,)}
        shapes |= {"Z_y": (action_size, h), "b_y": (action_size,)}
        weights = draw(shapes, self.initializer, key=key)
        if self.span:
            u = jax.random.uniform(jax.random.fold_in(key, 1), (h,))
            kept = jnp.log(1.0 + u * (self.span - 2))  # log U([1, span - 1])
            weights |= {"b_z": kept} if self.cell == "gru" else {"b_f": kept, "b_i": -kept}
        return RecurrentPolicy(weights, self)


class RecurrentPolicy(AbstractPolicy):
    """Weights by name: `W_g` on the input, `U_g` on the last state, `b_g`, for each gate g."""

    features_first: ClassVar[bool] = True

    weights: dict[str, Float[Array, "..."]]
    config: Recurrent = eqx.field(static=True)

    def start(self, *, key: PRNGKeyArray | None = None):
        zeros = jnp.zeros_like(self.weights[f"b_{GATES[self.config.cell][0]}"])
        return (zeros, zeros) if self.config.cell == "lstm" else zeros

    def __call__(self, obs, carry):
        _, u, carry = self.spoken(obs, carry)
        return acted(u, self.config.output_activation), carry

    def spoken(self, obs, carry):
        h, carry = getattr(self, f"_{self.config.cell}")(obs, carry)
        return h, matvec(self.weights["Z_y"], h) + self.weights["b_y"], carry

    def _gate(self, gate, x, h):
        weights = self.weights
        return (
            matvec(weights[f"W_{gate}"], x)
            + matvec(weights[f"U_{gate}"], h)
            + (weights[f"b_{gate}"])
        )

    def _rnn(self, x, h):
        h = jnp.tanh(self._gate("h", x, h))
        return h, h

    def _gru(self, x, h):
        σ = ACTIVATIONS["sigmoid"]
        z, r = σ(self._gate("z", x, h)), σ(self._gate("r", x, h))
        h = z * h + (1.0 - z) * jnp.tanh(self._gate("h", x, r * h))
        return h, h

    def _lstm(self, x, carry):
        h, c = carry
        σ = ACTIVATIONS["sigmoid"]
        i, f, o = (σ(self._gate(gate, x, h)) for gate in "ifo")
        c = f * c + i * jnp.tanh(self._gate("c", x, h))
        h = o * jnp.tanh(c)
        return h, (h, c)
