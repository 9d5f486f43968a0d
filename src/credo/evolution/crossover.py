"""Crossover: a child of two genomes of one structure."""

import abc
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray, PyTree

from .. import require, tree


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
        require.choice("part", self.part, ("matrix", "row", "entry"))
        require.within("probability", self.probability, 0, 1)

    def __call__(self, a: PyTree, b: PyTree, *, key: PRNGKeyArray) -> PyTree:
        mine, unravel, layout = tree.ravel(a)
        yours, _, _ = tree.ravel(b)
        part, parts = {
            "matrix": (layout.leaf, len(layout.sizes)),
            "row": (layout.row, layout.rows),
            "entry": (slice(None), len(layout.leaf)),
        }[self.part]
        from_b = jax.random.bernoulli(key, self.probability, (parts,))
        return unravel(jnp.where(from_b[part], yours, mine))
