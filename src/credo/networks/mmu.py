"""MMU, the Modular Memory Unit: a feed-forward network beside gated memory.

Source: Khadka (2019), section 3.1, equations 3.1-3.5; Khadka, Chung & Tumer (2017).

The defaults are the instance of Chapter 3: α = 0, identity encoder and decoder. Departures from
the text, which leaves φ and θ open and calls encoder and decoder the identity:

- The encoder keeps a tanh around its identity matrix, so that one write moves a cell by at most
  1; the decoder keeps none. Only so are the published memory states possible (Table 3.2: steps
  of .66, .90, .98, 1.00, and a cell that counts to 10^6).
- φ is the sigmoid, as in the author's code. The output y is fed back as it is, in [0, 1]; the
  action is 2y - 1.
- The memory starts from a leaf of its own, `m_0`, that evolution can move. The author's code
  drew it once and never changed it.
- The block input sees memory (equation 3.1); the author's code fed it the last output.
"""

import dataclasses
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from .. import require
from .base import (
    ACTIVATIONS,
    INITIALIZERS,
    AbstractNetwork,
    AbstractPolicy,
    OutputActivation,
    draw,
    matvec,
    to_action,
)


class MMU(AbstractNetwork):
    """Config of an MMU. All sizes are independent once encoder and decoder are learned."""

    hidden: int = eqx.field(static=True, default=5)  # hidden activations h, at least 1
    memory: int | None = eqx.field(static=True, default=None)
    """Memory cells, at least 1; None: as many as hidden."""
    alpha: float = eqx.field(static=True, default=0.0)
    """In [0, 1]. 0: what is written is added to memory; 1: it takes the place of as much as the
    write gate opens; between: a mixture."""
    encoder: Literal["identity", "learned"] = eqx.field(static=True, default="identity")
    """What writes to memory: the hidden activations, or a learned matrix of them."""
    decoder: Literal["identity", "learned"] = eqx.field(static=True, default="identity")
    """What is read: memory cells, or a learned matrix of them."""
    block_activation: str = eqx.field(static=True, default="sigmoid")
    """Activation φ of equation 3.1: hidden activations."""
    decoder_activation: str = eqx.field(static=True, default="identity")
    """Activation θ of equation 3.2: what is read."""
    encoder_activation: str = eqx.field(static=True, default="tanh")
    """Activation θ of equation 3.4: what is written."""
    output_activation: OutputActivation = eqx.field(static=True, default="sigmoid")
    """Activation of the output layer."""
    start_memory: Literal["learned", "zero"] = eqx.field(static=True, default="learned")
    """Memory at the first step: learned, or zeros."""
    initializer: str = eqx.field(static=True, default="normal")
    """Fresh weights: normal, fan_in or kaiming."""
    start_weights: Literal["drawn", "saturated", "closed", "latched", "open"] = eqx.field(
        static=True, default="drawn"
    )
    """`open`: gates follow what is observed, and memory saturates none of them. Input weights (K)
    are drawn 3.7 times as large, output feedback (R) 0.4 times, weights on memory (N, a
    learned decoder's too) 0.16 times, but N_p 0.6 times, and b_p 2.5 times; b_i and b_w are raised
    by 2.7 and 1.2, b_r is lowered by 2.3. Found by trial: docs/notes/team-memory.md.
    `closed`: the write gate's bias is lowered by 4, so that memory hardly moves before a gate
    has learned to open, and gradients reach back through it (compare an LSTM's forget bias).
    `latched`: the write gate is opened by what is observed alone, and else shut so tightly that
    memory stays for 10,000 steps; gradients still reach the other gates. K_w is drawn 40 times as
    large, N_w and R_w 0.01 times, and b_w is lowered by 17. Where observations are 0 most of the
    time, as in a T-maze.
    `saturated`: at first every gate is open or shut by the input alone, and memory is read but
    not written at distractors. Input weights are drawn 30 times as large, output weights 75 times
    and clipped to ±40, output feedback 0.1 times; the write gate's bias is lowered and the read
    gate's raised by 20."""

    def __check_init__(self):
        require.at_least("hidden", self.hidden, 1)
        require.at_least("memory", self.cells, 1)
        require.within("alpha", self.alpha, 0, 1)
        require.literals(self)
        for name in ("block_activation", "decoder_activation", "encoder_activation"):
            require.choice(name, getattr(self, name), ACTIVATIONS)
        require.choice("initializer", self.initializer, INITIALIZERS)
        if "identity" in (self.encoder, self.decoder) and self.cells != self.hidden:
            raise ValueError(
                f"hidden is {self.hidden} and memory is {self.cells}: an identity encoder or "
                "decoder needs them equal; give both encoder='learned' and decoder='learned' "
                "for memory of another size"
            )

    @property
    def cells(self) -> int:
        return self.hidden if self.memory is None else self.memory

    def init(self, obs_size: int, action_size: int, *, key: PRNGKeyArray) -> "MMUPolicy":
        x, y, h, m = obs_size, action_size, self.hidden, self.cells
        shapes: dict[str, tuple[int, ...]] = {}
        for gate, size in (("i", h), ("r", h), ("w", m)):
            shapes |= {f"K_{gate}": (size, x), f"R_{gate}": (size, y), f"N_{gate}": (size, m)}
            shapes |= {f"b_{gate}": (size,)}
        shapes |= {"K_p": (h, x), "N_p": (h, m), "b_p": (h,), "Z_y": (y, h), "b_y": (y,)}
        if self.decoder == "learned":
            shapes |= {"N_d": (h, m), "b_d": (h,)}
        if self.encoder == "learned":
            shapes |= {"Z_f": (m, h), "b_f": (m,)}
        if self.start_memory == "learned":
            shapes |= {"m_0": (m,)}
        weights: dict[str, Any] = draw(shapes, self.initializer, key=key)
        if self.start_weights == "closed":
            weights["b_w"] = weights["b_w"] - 4.0
        if self.start_weights == "latched":
            weights |= {"K_w": 40.0 * weights["K_w"], "b_w": weights["b_w"] - 17.0}
            weights |= {name: 0.01 * weights[name] for name in ("N_w", "R_w")}
        if self.start_weights == "open":
            scale = {"K": 3.7, "R": 0.4, "N": 0.16, "N_p": 0.6, "b_p": 2.5}
            weights = {n: scale.get(n, scale.get(n[0], 1.0)) * w for n, w in weights.items()}
            for gate, raised in (("b_i", 2.7), ("b_r", -2.3), ("b_w", 1.2)):
                weights[gate] = weights[gate] + raised
        if self.start_weights == "saturated":
            scale = {"K": 30.0, "R": 0.1}
            weights = {name: scale.get(name[0], 1.0) * w for name, w in weights.items()}
            weights["Z_y"] = jnp.clip(75.0 * weights["Z_y"], -40.0, 40.0)
            weights |= {"b_w": weights["b_w"] - 20.0, "b_r": weights["b_r"] + 20.0}
        return MMUPolicy(config=self, **weights)


class MMUPolicy(AbstractPolicy):
    """The weights of an MMU, named as in equations 3.1-3.5. Frozen ones are `None`."""

    features_first: ClassVar[bool] = True

    config: MMU = eqx.field(static=True)
    K_i: Float[Array, "h x"]
    R_i: Float[Array, "h y"]
    N_i: Float[Array, "h m"]
    b_i: Float[Array, " h"]
    K_p: Float[Array, "h x"]
    N_p: Float[Array, "h m"]
    b_p: Float[Array, " h"]
    K_r: Float[Array, "h x"]
    R_r: Float[Array, "h y"]
    N_r: Float[Array, "h m"]
    b_r: Float[Array, " h"]
    K_w: Float[Array, "m x"]
    R_w: Float[Array, "m y"]
    N_w: Float[Array, "m m"]
    b_w: Float[Array, " m"]
    Z_y: Float[Array, "y h"]
    b_y: Float[Array, " y"]
    N_d: Float[Array, "h m"] | None = None
    b_d: Float[Array, " h"] | None = None
    Z_f: Float[Array, "m h"] | None = None
    b_f: Float[Array, " m"] | None = None
    m_0: Float[Array, " m"] | None = None
    joined: tuple[Array, Array] | None = None
    """All gates' and the block input's weights on (x, y, m) as one matrix `[in, out]`, and their
    biases. Of `arranged` policies alone: else the genome would hold everything twice."""

    def arranged(self) -> "MMUPolicy":
        no_feedback = jnp.zeros_like(self.R_i)
        rows = (
            (self.K_i, self.R_i, self.N_i, self.b_i),
            (self.K_p, no_feedback, self.N_p, self.b_p),
            (self.K_r, self.R_r, self.N_r, self.b_r),
            (self.K_w, self.R_w, self.N_w, self.b_w),
        )
        weights = jnp.concatenate([jnp.concatenate(row[:3], axis=1) for row in rows])
        joined = (weights.T, jnp.concatenate([row[3] for row in rows]))
        return dataclasses.replace(self, joined=joined)

    def start(self, *, key: PRNGKeyArray | None = None):
        y = jnp.zeros_like(self.b_y)
        return y, (jnp.zeros_like(self.b_w) if self.m_0 is None else self.m_0)

    def __call__(self, obs, carry):
        _, _, (y, m) = self.spoken(obs, carry)
        return to_action(y, self.config.output_activation), (y, m)

    def spoken(self, obs, carry):
        x, (y, m), c = obs, carry, self.config
        σ = ACTIVATIONS["sigmoid"]
        φ, θ_d, θ_f = (
            ACTIVATIONS[name]
            for name in (c.block_activation, c.decoder_activation, c.encoder_activation)
        )
        at_i, at_p, at_r, at_w = self._inputs(x, y, m)
        i, p, r, w = σ(at_i), φ(at_p), σ(at_r), σ(at_w)  # (3.1), gates
        d = θ_d(_affine(self.N_d, m, self.b_d))  # (3.2)
        h = r * d + p * i  # (3.3)
        f = θ_f(_affine(self.Z_f, h, self.b_f))
        if c.alpha == 0.0:
            m = m + w * f
        else:
            m = (1.0 - c.alpha) * (m + w * f) + c.alpha * (w * f + (1.0 - w) * m)  # (3.4)
        u = matvec(self.Z_y, h) + self.b_y
        return h, u, (ACTIVATIONS[c.output_activation](u), m)  # (3.5)

    def _inputs(self, x, y, m):
        """What the input gate, the block input, the read gate and the write gate are fed."""
        if self.joined is not None:
            h, weights = self.config.hidden, self.joined[0]
            fed = jnp.concatenate([x, y, m]) @ weights + self.joined[1]
            return jnp.split(fed, (h, 2 * h, 3 * h))
        return (
            matvec(self.K_i, x) + matvec(self.R_i, y) + matvec(self.N_i, m) + self.b_i,
            matvec(self.K_p, x) + matvec(self.N_p, m) + self.b_p,
            matvec(self.K_r, x) + matvec(self.R_r, y) + matvec(self.N_r, m) + self.b_r,
            matvec(self.K_w, x) + matvec(self.R_w, y) + matvec(self.N_w, m) + self.b_w,
        )


def _affine(w: Array | None, x: Array, b: Array | None) -> Array:
    """`w x + b`, or `x` where both are frozen to the identity."""
    return x if w is None or b is None else matvec(w, x) + b
