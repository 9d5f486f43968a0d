"""NTM, the Neural Turing Machine: a controller that reads and writes the rows of a memory.

Source: Graves, Wayne & Danihelka (2014), arXiv:1410.5401, equations 1-9 of section 3. What starts
an episode is learned, as in section 4: memory, read vectors and the state of an LSTM.

Departures from the paper, and what it leaves open:

- Order: writing heads address the memory of the step before, then reading heads the one that was
  written, as in equations 2-4 taken with their indices, and as in DNC.
- Ranges, which section 3.3 gives in words: key and add vector are free, β is softplus, g and the
  erase vector are sigmoids, s is a softmax over shifts, γ is 1 + softplus.
- The output sees what was just read, beside the controller. The paper does not print this layer.
- A feed-forward controller has one layer of tanh; the LSTM has no peepholes.
- The weightings before the first step are learned too: a softmax of free numbers.
- Cosine similarity has 10⁻⁶ within the square root of each length. Sharpening (equation 9) is a
  softmax of γ·log(w + 10⁻¹²): the same numbers, without NaN in the gradient where a weight is 0.
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
)
from .external_memory import Weights, by_content, control, controller_shapes

LEAST = 1e-12  # added to a weight before its logarithm
CONSTANT = 1e-6  # every entry of a memory that is not learned
FIRST = 10.0  # how much more of every head such a memory's first row has: before the softmax


class NTM(AbstractNetwork):
    """Config of a Neural Turing Machine. The defaults are the paper's for Copy (Table 1)."""

    controller: Literal["feedforward", "lstm"] = eqx.field(static=True, default="feedforward")
    """Feedforward (one layer of tanh), or lstm, with which Copy took longer to learn
    (docs/algorithms/ntm.md)."""
    hidden: int = eqx.field(static=True, default=100)  # units of the controller, at least 1
    rows: int = eqx.field(static=True, default=128)  # memory locations N, at least 1
    width: int = eqx.field(static=True, default=20)  # numbers in a memory location M, at least 1
    read_heads: int = eqx.field(static=True, default=1)  # heads that read, at least 1
    write_heads: int = eqx.field(static=True, default=1)  # heads that write, at least 1
    shift: int = eqx.field(static=True, default=1)
    """Rows that a head can move at most in one step, in either direction, at least 0; 2·shift + 1
    is at most `rows`."""
    start_memory: Literal["learned", "constant"] = eqx.field(static=True, default="learned")
    """Memory at the first step: learned, or 10⁻⁶ everywhere (Collier & Beel 2018). In that case
    fresh heads start at the first row: equal rows that are looked at equally stay equal."""
    output_activation: OutputActivation = eqx.field(static=True, default="sigmoid")
    """Activation of the output layer."""
    initializer: str = eqx.field(static=True, default="normal")
    """Fresh weights: normal, fan_in or kaiming."""

    def __check_init__(self):
        require.literals(self)
        for name in ("hidden", "rows", "width", "read_heads", "write_heads"):
            require.at_least(name, getattr(self, name), 1)
        require.at_least("shift", self.shift, 0)
        if 2 * self.shift + 1 > self.rows:
            raise ValueError(
                f"shift is {self.shift} and rows is {self.rows}: needs 2·shift + 1 <= rows, or "
                "two shifts lead to one row"
            )
        require.choice("initializer", self.initializer, INITIALIZERS)

    def init(self, obs_size: int, action_size: int, *, key: PRNGKeyArray) -> "NTMPolicy":
        shapes = self._controller(obs_size, action_size) | self._heads() | self._start()
        weights = draw(shapes, self.initializer, key=key)
        if self.start_memory == "constant":
            for name in ("w_r_0", "w_w_0"):
                weights[name] = weights[name].at[:: self.rows].add(FIRST)
        return NTMPolicy(weights, self)

    def _controller(self, x: int, y: int) -> dict[str, tuple[int, ...]]:
        h, read = self.hidden, self.read_heads * self.width
        shapes = controller_shapes(self.controller, x + read, h)
        return shapes | {"Z_y": (y, h), "Z_r": (y, read), "b_y": (y,)}

    def _heads(self) -> dict[str, tuple[int, ...]]:
        """What the controller emits for the heads of each kind: keys k, strengths beta, gates g,
        shifts s, exponents gamma; to write also erase vectors e and add vectors a."""
        shapes: dict[str, tuple[int, ...]] = {}
        for kind, heads in (("r", self.read_heads), ("w", self.write_heads)):
            sizes = {"k": self.width, "beta": 1, "g": 1, "s": 2 * self.shift + 1, "gamma": 1}
            if kind == "w":
                sizes |= {"e": self.width, "a": self.width}
            for name, size in sizes.items():
                shapes |= {f"W_{name}_{kind}": (heads * size, self.hidden)}
                shapes |= {f"b_{name}_{kind}": (heads * size,)}
        return shapes

    def _start(self) -> dict[str, tuple[int, ...]]:
        """What an episode starts from."""
        reads, writes = self.read_heads, self.write_heads
        shapes: dict[str, tuple[int, ...]] = {"r_0": (reads * self.width,)}
        shapes |= {"w_r_0": (reads * self.rows,), "w_w_0": (writes * self.rows,)}
        if self.controller == "lstm":
            shapes |= {"h_0": (self.hidden,), "c_0": (self.hidden,)}
        if self.start_memory == "learned":
            shapes |= {"M_0": (self.rows, self.width)}
        return shapes


class NTMPolicy(AbstractPolicy):
    """Weights by name: the controller's `W_h`, `b_h`, or `W_g`, `U_g`, `b_g` for each gate g of an
    LSTM, on the input and what was read; `W_q_r`, `b_q_r` for each quantity q of reading heads, all
    heads in one matrix, `W_q_w`, `b_q_w` of writing heads; `Z_y`, `Z_r`, `b_y` of the output; and
    what an episode starts from.

    The carry: the controller's state; what was read `[read_heads·width]`; the weightings of the
    reading and of the writing heads, `[heads, rows]`; the memory `[rows, width]`.
    """

    features_first: ClassVar[bool] = False

    weights: Weights
    config: NTM = eqx.field(static=True)

    def start(self, *, key: PRNGKeyArray | None = None):
        w, c = self.weights, self.config
        state = (w["h_0"], w["c_0"]) if c.controller == "lstm" else ()
        at = [jax.nn.softmax(w[name].reshape(-1, c.rows), axis=1) for name in ("w_r_0", "w_w_0")]
        memory = w["M_0"] if "M_0" in w else jnp.full((c.rows, c.width), CONSTANT, jnp.float32)
        return state, w["r_0"], *at, memory

    def __call__(self, obs, carry):
        _, u, carry = self.spoken(obs, carry)
        return acted(u, self.config.output_activation), carry

    def spoken(self, obs, carry):
        (state, read, at_read, at_write, memory), w = carry, self.weights
        c = self.config
        h, state = control(w, c.controller, jnp.concatenate([obs, read]), state)
        at_write = self._address("w", h, at_write, memory)
        erase = ACTIVATIONS["sigmoid"](self._emitted("e", "w", h))
        kept = jnp.prod(1.0 - at_write[:, :, None] * erase[:, None], axis=0)
        memory = memory * kept + at_write.T @ self._emitted("a", "w", h)  # (3), (4)
        at_read = self._address("r", h, at_read, memory)
        read = (at_read @ memory).ravel()  # (2)
        y = w["Z_y"] @ h + w["Z_r"] @ read + w["b_y"]
        return jnp.concatenate([h, read]), y, (state, read, at_read, at_write, memory)

    def _emitted(self, name: str, kind: str, h: Array) -> Float[Array, "heads size"]:
        """A quantity of the heads of one kind, before its activation."""
        heads = self.config.read_heads if kind == "r" else self.config.write_heads
        w = self.weights
        return (w[f"W_{name}_{kind}"] @ h + w[f"b_{name}_{kind}"]).reshape(heads, -1)

    def _address(
        self, kind: str, h: Array, before: Float[Array, "heads rows"], memory: Array
    ) -> Float[Array, "heads rows"]:
        """Where the heads of one kind look, after they looked at `before`."""
        k, beta, g, s, gamma = (
            self._emitted(name, kind, h) for name in ("k", "beta", "g", "s", "gamma")
        )
        found = by_content(memory, k, jax.nn.softplus(beta[:, 0]))  # (5), (6)
        g = ACTIVATIONS["sigmoid"](g)
        w = g * found + (1.0 - g) * before  # (7)
        w = shifted(w, jax.nn.softmax(s, axis=1))
        return sharpened(w, 1.0 + jax.nn.softplus(gamma))


def shifted(
    w: Float[Array, "heads rows"], shifts: Float[Array, "heads shifts"]
) -> Float[Array, "heads rows"]:
    """Equation 8: every weight moves along the rows, which form a circle, by -n..n, as much of it
    as `shifts` says for each of these 2n + 1."""
    n = shifts.shape[1] // 2
    moved = [shifts[:, i, None] * jnp.roll(w, i - n, axis=1) for i in range(2 * n + 1)]
    return sum(moved[1:], moved[0])


def sharpened(
    w: Float[Array, "heads rows"], exponents: Float[Array, "heads 1"]
) -> Float[Array, "heads rows"]:
    """Equation 9: weights of at least 0, raised to a power of at least 1, as shares of their
    sum."""
    return jax.nn.softmax(exponents * jnp.log(w + LEAST), axis=1)
