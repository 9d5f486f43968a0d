"""Crossover: a child of two genomes of one structure."""

import abc
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray, PyTree

from .. import require, tree


class AbstractCrossover(eqx.Module):
    @abc.abstractmethod
    def __call__(self, a: PyTree, b: PyTree, *, key: PRNGKeyArray) -> PyTree:
        """A child whose weights come from `a` or `b`."""


class NoCrossover(AbstractCrossover):
    """No crossover: the child is `b`, the offspring that was to have a second parent."""

    def __call__(self, a: PyTree, b: PyTree, *, key: PRNGKeyArray) -> PyTree:
        return b


class MaskedCrossover(AbstractCrossover):
    """The child is `a` with parts of `b` in it, each with chance `probability`.

    A row of a matrix is what one unit receives: the author's choice. A vector is a matrix of one
    column.
    """

    part: Literal["matrix", "row", "entry"] = eqx.field(static=True, default="row")
    """What is taken as a whole: a matrix, a row of one, or a single entry."""
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


class OnePointCrossover(AbstractCrossover):
    """Of each matrix, with chance `probability`, the child has the rows of `b` from a random one
    on, and those of `a` above (Khadka 2019, Algorithm 5, line 19).

    A vector is a matrix of one column.
    """

    probability: float = 0.05  # chance that a matrix is crossed, in [0, 1]
    taken: Literal["rest", "row"] = eqx.field(static=True, default="rest")
    """All rows from the random one on (`rest`), or that `row` alone, as the text around the box has
    it: "akin to exchanging a randomly sampled neuron"."""

    def __check_init__(self):
        require.choice("taken", self.taken, ("rest", "row"))
        require.within("probability", self.probability, 0, 1)

    def __call__(self, a: PyTree, b: PyTree, *, key: PRNGKeyArray) -> PyTree:
        gate_key, point_key = jax.random.split(key)
        mine, unravel, layout = tree.ravel(a)
        yours, _, _ = tree.ravel(b)
        n = len(layout.sizes)
        first = layout.row[np.searchsorted(layout.leaf, np.arange(n))]
        rows = np.diff(np.append(first, layout.rows))
        gate = jax.random.bernoulli(gate_key, self.probability, (n,))
        point = first + jax.random.randint(point_key, (n,), 0, rows)
        # Written down: XLA would repeat the division behind `randint` for every entry.
        point = jnp.zeros(n, point.dtype).at[jnp.arange(n)].set(point)
        reached = layout.row >= point[layout.leaf]
        if self.taken == "row":
            reached = layout.row == point[layout.leaf]
        return unravel(jnp.where(gate[layout.leaf] & reached, yours, mine))
