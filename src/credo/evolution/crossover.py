"""Crossover: a child of two genomes of one structure."""

import abc
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray, PyTree

from .. import tree


class AbstractCrossover(eqx.Module):
    @abc.abstractmethod
    def __call__(self, a: PyTree, b: PyTree, *, key: PRNGKeyArray) -> PyTree:
        """A child whose weights come from `a` or `b`."""


class MaskedCrossover(AbstractCrossover):
    """The child is `a` with parts of `b` in it, each with chance `probability`.

    A part is one matrix, one row of a matrix (what one unit receives: the author's choice), or
    one entry. A vector is a matrix of one column.
    """

    part: Literal["matrix", "row", "entry"] = eqx.field(static=True, default="row")
    probability: float = 0.5  # chance that a part is from `b`, in [0, 1]

    def __check_init__(self):
        if self.part not in ("matrix", "row", "entry"):
            raise ValueError(f"part is {self.part!r}: it must be 'matrix', 'row' or 'entry'")

    def __call__(self, a: PyTree, b: PyTree, *, key: PRNGKeyArray) -> PyTree:
        mine, rest = eqx.partition(a, eqx.is_inexact_array)
        yours = eqx.filter(b, eqx.is_inexact_array)

        def cross(a, b, u):
            if self.part == "matrix":
                u = u.reshape(-1)[:1].reshape((1,) * a.ndim)
            elif self.part == "row":
                u = u.reshape(u.shape[0], -1)[:, 0].reshape(-1, *(1,) * (a.ndim - 1))
            return jnp.where(u < self.probability, b, a)

        uniform = tree.uniform_like(mine, key=key)
        return eqx.combine(jax.tree.map(cross, mine, yours, uniform), rest)
