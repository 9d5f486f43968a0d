"""Copy and Repeat Copy: hear bit vectors, then write them down, once or several times.

Source: Graves, Wayne & Danihelka (2014), arXiv:1410.5401, sections 4.1 and 4.2. A sequence of
random bit vectors is shown, then a delimiter, then nothing while the vectors are to be put out in
their order. Repeat Copy also says how often, and wants an end marker behind the last copy.

Inputs are the bits, 0 or 1, and channels of their own for what is not a bit; outputs are one
answer in [-1, 1] for each bit, right if its sign is that of the bit (+1 for 1, -1 for 0).

The reward of a step is minus the cross-entropy of its answers in bits, with (1 + answer) / 2 read
as the probability of a 1: minus the return is the paper's "cost per sequence (bits)". An answer of
½ costs 1 bit, and a wrong one at most 20: probabilities are kept 10⁻⁶ away from 0 and 1.

Departures from the paper:

- Repeat Copy has a delimiter channel beside that of the number of repeats. Normalised as the paper
  says, that number can be 0, which nobody could tell from silence.
- While the end marker is asked for, all bits are asked to be 0, and before that the marker is.
"""

import dataclasses
import math
from typing import ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .. import require
from ..types import Sequence
from .base import AbstractSequenceTask, cross_entropy


class SequenceCopy(AbstractSequenceTask):
    """Copy: `n` vectors of bits, a delimiter, then `n` steps in which the vectors are asked for.

    The return is minus the cost per sequence in bits: 0 at best, -bits·n for answers of 0. A
    sequence has 2n + 1 steps, with n drawn from `min_length`..`max_length`, all equally likely.
    """

    obs_range: ClassVar[tuple[float, float]] = (0.0, 1.0)

    bits: int = eqx.field(static=True, default=8)  # of a vector, at least 1
    min_length: int = eqx.field(static=True, default=1)  # vectors per sequence, at least 1
    max_length: int = eqx.field(static=True, default=20)
    """Vectors per sequence, at most, `min_length` or more."""

    def __check_init__(self):
        require.at_least("bits", self.bits, 1)
        _require_range("length", self.min_length, self.max_length)

    @property
    def obs_size(self) -> int:
        """The bits, and the delimiter."""
        return self.bits + 1

    @property
    def action_size(self) -> int:
        """The bits."""
        return self.bits

    @property
    def inputs(self) -> tuple[str, ...]:
        return (*_bit_names(self.bits), "delimiter")

    @property
    def max_steps(self) -> int:
        return 2 * self.max_length + 1

    def longer(self, times: int) -> Self:
        """More vectors in a sequence."""
        low, high = times * self.min_length, times * self.max_length
        return dataclasses.replace(self, min_length=low, max_length=high)

    def sample(self, *, key: PRNGKeyArray) -> Sequence:
        bit_key, length_key = jax.random.split(key)
        vectors = _vectors(self.max_length, self.bits, key=bit_key)
        n = jax.random.randint(length_key, (), self.min_length, self.max_length + 1)
        return self.lay_out(vectors, n)

    def lay_out(self, vectors: Float[Array, "max_length bits"], n: Int[Array, ""]) -> Sequence:
        """The sequence of the first `n` of these vectors of 0 and 1."""
        step = jnp.arange(self.max_steps)
        shown, delimiter = _shown(vectors, n, step)
        inputs = jnp.concatenate([shown, delimiter[:, None]], axis=1)
        scored = (step > n) & (step <= 2 * n)
        return Sequence(inputs, _asked(vectors, step - n - 1, scored), scored, 2 * n + 1)

    def reward(self, answer, target, scored, perfect):
        return _reward(answer, target, scored)


class RepeatCopy(AbstractSequenceTask):
    """Repeat Copy: `n` vectors of bits, a delimiter with a number r, then r copies of the vectors
    and an end marker.

    The number is normalised over the range it is drawn from, uniformly, to mean 0 and variance 1
    (0 where only one number is possible). The last of the `bits + 1` answers is the end marker. The
    return is minus the cost per sequence in bits: 0 at best, -(bits + 1)·(r·n + 1) for answers of
    0. A sequence has n + 1 + r·n + 1 steps.
    """

    bits: int = eqx.field(static=True, default=8)  # of a vector, at least 1
    min_length: int = eqx.field(static=True, default=1)  # vectors per sequence, at least 1
    max_length: int = eqx.field(static=True, default=10)
    """Vectors per sequence, at most, `min_length` or more."""
    min_repeats: int = eqx.field(static=True, default=1)  # copies of a sequence, at least 1
    max_repeats: int = eqx.field(static=True, default=10)
    """Copies of a sequence, at most, `min_repeats` or more."""

    def __check_init__(self):
        require.at_least("bits", self.bits, 1)
        _require_range("length", self.min_length, self.max_length)
        _require_range("repeats", self.min_repeats, self.max_repeats)

    @property
    def obs_size(self) -> int:
        """The bits, the delimiter, and the number of repeats."""
        return self.bits + 2

    @property
    def action_size(self) -> int:
        """The bits, and the end marker."""
        return self.bits + 1

    @property
    def obs_range(self) -> tuple[float, float]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return min(0.0, self._normal(self.min_repeats)), max(1.0, self._normal(self.max_repeats))

    @property
    def inputs(self) -> tuple[str, ...]:
        return (*_bit_names(self.bits), "delimiter", "repeats")

    @property
    def max_steps(self) -> int:
        return self.max_length * (1 + self.max_repeats) + 2

    def longer(self, times: int) -> Self:
        """More vectors in a sequence."""
        low, high = times * self.min_length, times * self.max_length
        return dataclasses.replace(self, min_length=low, max_length=high)

    def sample(self, *, key: PRNGKeyArray) -> Sequence:
        bit_key, length_key, repeat_key = jax.random.split(key, 3)
        vectors = _vectors(self.max_length, self.bits, key=bit_key)
        n = jax.random.randint(length_key, (), self.min_length, self.max_length + 1)
        r = jax.random.randint(repeat_key, (), self.min_repeats, self.max_repeats + 1)
        return self.lay_out(vectors, n, r)

    def lay_out(
        self, vectors: Float[Array, "max_length bits"], n: Int[Array, ""], r: Int[Array, ""]
    ) -> Sequence:
        """The sequence of the first `n` of these vectors of 0 and 1, to be repeated `r` times."""
        step, last = jnp.arange(self.max_steps), n + 1 + r * n
        shown, delimiter = _shown(vectors, n, step)
        repeats = jnp.where(step == n, self._normal(r.astype(jnp.float32)), 0.0)
        inputs = jnp.concatenate([shown, jnp.stack([delimiter, repeats], axis=1)], axis=1)
        scored = (step > n) & (step <= last)
        bits = _asked(vectors, jnp.mod(step - n - 1, n), scored & (step < last))
        bits = jnp.where((step == last)[:, None], -1.0, bits)
        marker = jnp.where(scored, jnp.where(step == last, 1.0, -1.0), 0.0)
        targets = jnp.concatenate([bits, marker[:, None]], axis=1)
        return Sequence(inputs, targets, scored, last + 1)

    def reward(self, answer, target, scored, perfect):
        return _reward(answer, target, scored)

    def _normal(self, r):
        """A number of repeats, normalised: of a uniform draw from k integers the variance is
        (k² - 1) / 12."""
        k = self.max_repeats - self.min_repeats + 1
        std = math.sqrt((k * k - 1) / 12) or 1.0
        return (r - 0.5 * (self.min_repeats + self.max_repeats)) / std


def _require_range(name: str, low: int, high: int) -> None:
    if not 1 <= low <= high:
        raise ValueError(
            f"min_{name} is {low} and max_{name} is {high}: needs 1 <= min_{name} <= max_{name}"
        )


def _bit_names(bits: int) -> list[str]:
    return [f"bit {i + 1}" for i in range(bits)]


def _vectors(n: int, bits: int, *, key: PRNGKeyArray) -> Float[Array, "n bits"]:
    return jax.random.bernoulli(key, 0.5, (n, bits)).astype(jnp.float32)


def _shown(vectors: Array, n: Array, step: Array) -> tuple[Array, Array]:
    """At each step the vector, zeros from the `n`-th on; and the delimiter."""
    vector = vectors[jnp.minimum(step, len(vectors) - 1)]
    return jnp.where((step < n)[:, None], vector, 0.0), (step == n).astype(jnp.float32)


def _asked(vectors: Array, which: Array, where: Array) -> Float[Array, "time bits"]:
    """The bits of one vector at each step as ±1, and 0 where none is asked for."""
    vector = vectors[jnp.clip(which, 0, len(vectors) - 1)]
    return jnp.where(where[:, None], 2.0 * vector - 1.0, 0.0)


def _reward(answer: Array, target: Array, scored: Array) -> Array:
    """Minus the cross-entropy of all answers of a step, in bits."""
    cost = jnp.sum(cross_entropy(answer, target), axis=0) / math.log(2)
    return jnp.where(scored, -cost, 0.0)
