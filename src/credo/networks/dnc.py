"""DNC, the Differentiable Neural Computer: an NTM that knows which rows are free, and in which
order they were written.

Source: Graves et al. (2016), "Hybrid computing using a neural network with dynamic external
memory", Nature 538, Methods. Everything an episode starts from is 0, as there.

Departures from the paper, and what it leaves open:

- The defaults are those of DeepMind's published program, small beside the paper's experiments.
- The controller is one LSTM layer, or one of tanh; the paper also stacks LSTM layers.
- Cosine similarity has 10⁻⁶ within the square root of each length, so that rows of zeros, which
  all are at first, have a gradient.
- Rows are sorted by usage, and no gradient passes through their order (as in the paper); equal
  rows keep the order they are stored in, which the paper leaves open.
"""

import functools
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
)
from .external_memory import Weights, by_content, control, controller_shapes


class DNC(AbstractNetwork):
    """Config of a Differentiable Neural Computer with one head that writes."""

    controller: Literal["feedforward", "lstm"] = eqx.field(static=True, default="lstm")
    """Feedforward (one layer of tanh), or lstm."""
    hidden: int = eqx.field(static=True, default=64)  # units of the controller, at least 1
    rows: int = eqx.field(static=True, default=16)  # memory locations N, at least 1
    width: int = eqx.field(static=True, default=16)  # numbers in a memory location W, at least 1
    read_heads: int = eqx.field(static=True, default=4)  # heads that read, R, at least 1
    output_activation: OutputActivation = eqx.field(static=True, default="sigmoid")
    """Activation of the output layer."""
    initializer: str = eqx.field(static=True, default="normal")
    """Fresh weights: normal, fan_in or kaiming."""

    def __check_init__(self):
        require.literals(self)
        for name in ("hidden", "rows", "width", "read_heads"):
            require.at_least(name, getattr(self, name), 1)
        require.choice("initializer", self.initializer, INITIALIZERS)

    def init(self, obs_size: int, action_size: int, *, key: PRNGKeyArray) -> "DNCPolicy":
        h, y, read = self.hidden, action_size, self.read_heads * self.width
        shapes = controller_shapes(self.controller, obs_size + read, h)
        for name, size in self._interface().items():
            shapes |= {f"W_{name}": (size, h), f"b_{name}": (size,)}
        shapes |= {"Z_y": (y, h), "Z_r": (y, read), "b_y": (y,)}
        return DNCPolicy(draw(shapes, self.initializer, key=key), self)

    def _interface(self) -> dict[str, int]:
        """Parts of the interface vector ξ: of reading heads keys, strengths, free gates and modes;
        of the writing head key, strength, erase and write vector, allocation and write gate."""
        r, w = self.read_heads, self.width
        parts = {"k_r": r * w, "beta_r": r, "f_r": r, "pi_r": 3 * r}
        return parts | {"k_w": w, "beta_w": 1, "e_w": w, "v_w": w, "ga_w": 1, "gw_w": 1}


class DNCPolicy(AbstractPolicy):
    """Weights by name: those of the controller, as an NTM has them; `W_q`, `b_q` for each part q of
    the interface vector, all reading heads in one matrix; `Z_y`, `Z_r`, `b_y` of the output.

    The carry: the controller's state; what was read `[read_heads·width]`; the weightings of the
    reading heads `[read_heads, rows]` and of the writing head `[rows]`; usage `[rows]`, precedence
    `[rows]`, the links `[rows, rows]`, and the memory `[rows, width]`.
    """

    features_first: ClassVar[bool] = False

    weights: Weights
    config: DNC = eqx.field(static=True)

    def start(self, *, key: PRNGKeyArray | None = None):
        c, zeros = self.config, functools.partial(jnp.zeros, dtype=jnp.float32)
        state = (zeros(c.hidden), zeros(c.hidden)) if c.controller == "lstm" else ()
        read, at_read = zeros(c.read_heads * c.width), zeros((c.read_heads, c.rows))
        rows, links = zeros(c.rows), zeros((c.rows, c.rows))
        return state, read, at_read, rows, rows, rows, links, zeros((c.rows, c.width))

    def __call__(self, obs, carry):
        _, u, carry = self.spoken(obs, carry)
        return acted(u, self.config.output_activation), carry

    def spoken(self, obs, carry):
        state, read, at_read, at_write, used, last, links, memory = carry
        w, c, σ = self.weights, self.config, ACTIVATIONS["sigmoid"]
        h, state = control(w, c.controller, jnp.concatenate([obs, read]), state)

        free = σ(self._emitted("f_r", h))
        used = usage(used, at_write, at_read, free[:, None])
        at_write = self._where_to_write(h, used, memory)
        erase, added = σ(self._emitted("e_w", h)), self._emitted("v_w", h)
        memory = memory * (1.0 - jnp.outer(at_write, erase)) + jnp.outer(at_write, added)

        links = linked(links, at_write, last)
        last = (1.0 - jnp.sum(at_write)) * last + at_write  # precedence
        at_read = self._where_to_read(h, at_read, links, memory)
        read = (at_read @ memory).ravel()
        y = w["Z_y"] @ h + w["Z_r"] @ read + w["b_y"]
        carry = state, read, at_read, at_write, used, last, links, memory
        return jnp.concatenate([h, read]), y, carry

    def _emitted(self, name: str, h: Array) -> Array:
        """A part of the interface vector, before its activation."""
        return self.weights[f"W_{name}"] @ h + self.weights[f"b_{name}"]

    def _where_to_write(self, h: Array, used: Array, memory: Array) -> Float[Array, " rows"]:
        """The write weighting: rows by content, or the least used ones, or none."""
        key, strength = self._emitted("k_w", h)[None], oneplus(self._emitted("beta_w", h))
        found = by_content(memory, key, strength)[0]
        σ = ACTIVATIONS["sigmoid"]
        g_a, g_w = σ(self._emitted("ga_w", h)), σ(self._emitted("gw_w", h))
        return g_w * (g_a * allocation(used) + (1.0 - g_a) * found)

    def _where_to_read(
        self, h: Array, before: Float[Array, "heads rows"], links: Array, memory: Array
    ) -> Float[Array, "heads rows"]:
        """The read weightings: what was written before the rows read last, rows by content, or
        what was written after."""
        n = self.config.read_heads
        keys = self._emitted("k_r", h).reshape(n, -1)
        mode = jax.nn.softmax(self._emitted("pi_r", h).reshape(n, 3), axis=1)
        backward, forward = before @ links, before @ links.T
        found = by_content(memory, keys, oneplus(self._emitted("beta_r", h)))
        return mode[:, :1] * backward + mode[:, 1:2] * found + mode[:, 2:] * forward


def oneplus(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """1 + log(1 + eˣ), at least 1."""
    return 1.0 + jax.nn.softplus(x)


def usage(
    used: Float[Array, " rows"],
    at_write: Float[Array, " rows"],
    at_read: Float[Array, "heads rows"],
    free: Float[Array, "heads 1"],
) -> Float[Array, " rows"]:
    """How much each row is used, in [0, 1], after what the last step wrote, and after rows that it
    read were freed by the free gates."""
    retained = jnp.prod(1.0 - free * at_read, axis=0)  # ψ
    return (used + at_write - used * at_write) * retained


def allocation(used: Float[Array, " rows"]) -> Float[Array, " rows"]:
    """Weights of rows to be written to, the least used first: with φ the rows in order of usage u,
    a[φ_j] = (1 - u[φ_j]) ∏ u[φ_i] over i < j. They sum to 1 at most."""
    order = jnp.argsort(jax.lax.stop_gradient(used))  # stable: of equal rows the first
    u = used[order]
    before = jnp.concatenate([jnp.ones_like(u[:1]), jnp.cumprod(u)[:-1]])
    return jnp.zeros_like(used).at[order].set((1.0 - u) * before)


def linked(
    links: Float[Array, "rows rows"], at_write: Float[Array, " rows"], last: Float[Array, " rows"]
) -> Float[Array, "rows rows"]:
    """The temporal links after a write: `[i, j]` is how much row i was written right after j, of
    which `last` says how much they were written last before this."""
    kept = 1.0 - at_write[:, None] - at_write[None]
    links = kept * links + jnp.outer(at_write, last)
    return links * (1.0 - jnp.eye(len(last), dtype=links.dtype))
