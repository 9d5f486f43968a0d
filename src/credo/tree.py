"""A population is a pytree whose array leaves carry a leading axis `[pop]`."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

CACHED = 250_000  # numbers that stay in a core's cache


def size(population: PyTree) -> int:
    """How many members."""
    return jax.tree.leaves(eqx.filter(population, eqx.is_array))[0].shape[0]


def take(population: PyTree, index: Any) -> PyTree:
    """The members at `index`, in that order; a scalar index gives one member."""
    return jax.tree.map(lambda x: x[index] if eqx.is_array(x) else x, population)


def put(population: PyTree, index: Int[Array, ""] | int, member: PyTree) -> PyTree:
    """`population` with `member` written over slot `index`."""
    return jax.tree.map(
        lambda xs, x: xs.at[index].set(x) if eqx.is_array(xs) else xs, population, member
    )


def concat(*populations: PyTree) -> PyTree:
    """One population out of several, along `[pop]`."""
    return jax.tree.map(
        lambda *xs: jnp.concatenate(xs) if eqx.is_array(xs[0]) else xs[0], *populations
    )


def stack(*members: PyTree) -> PyTree:
    """A population of the given members. Python floats become arrays, so that members that
    differ in a hyper-parameter (γ, say) are one program; everything else must be equal."""

    def join(*xs):
        if eqx.is_array(xs[0]) or eqx.is_inexact_array_like(xs[0]):
            return jnp.stack([jnp.asarray(x) for x in xs])
        if any(x != xs[0] for x in xs):
            raise ValueError(f"cannot stack members that differ in {xs}: make it a float or equal")
        return xs[0]

    if len({jax.tree.structure(member) for member in members}) > 1:
        raise ValueError(
            "cannot stack members of different structure: only arrays and floats may differ, "
            "every other field (sizes, names) must be equal"
        )
    return jax.tree.map(join, *members)


def where(pred: Bool[Array, ""], a: PyTree, b: PyTree) -> PyTree:
    """`a` if `pred` else `b`, leaf by leaf."""
    return jax.tree.map(lambda x, y: jnp.where(pred, x, y) if eqx.is_array(x) else x, a, b)


def packing(population: PyTree) -> tuple[Callable[[PyTree], PyTree], Callable[[PyTree], PyTree]]:
    """How to write a member of this population as few arrays, its weights as one, and back.

    What is then done to a whole population is a few operations. For each leaf on its own it would
    be some per matrix, and a team of ten has a hundred and thirty: a minute of compiling.
    """
    _, unravel, _ = ravel(take(population, 0))
    static = eqx.filter(population, eqx.is_array, inverse=True)

    def pack(member: PyTree) -> PyTree:
        weights, rest = eqx.partition(member, eqx.is_inexact_array)
        return jax.flatten_util.ravel_pytree(weights)[0], eqx.filter(rest, eqx.is_array)

    def unpack(packed: PyTree) -> PyTree:
        vector, arrays = packed
        return eqx.combine(eqx.filter(unravel(vector), eqx.is_inexact_array), arrays, static)

    return pack, unpack


def batch(members: PyTree) -> int:
    """How many members have their weights in the cache of a core together: all of them elsewhere
    than on a CPU."""
    n, weights = size(members), jax.tree.leaves(eqx.filter(members, eqx.is_inexact_array))
    fit = max(CACHED * n // max(sum(x.size for x in weights), 1), 1)
    return n if jax.default_backend() != "cpu" else math.ceil(n / math.ceil(n / fit))


def in_batches(function: Callable[[PyTree], PyTree], members: PyTree) -> PyTree:
    """`function` of a population, which must treat every member alike, called for one `batch` after
    the other; under `vmap` for one of each population.

    Large genomes would go through memory once per operation; and XLA would merge what is done to
    all of them into few programs that take minutes to compile.
    """
    n, some = size(members), batch(members)
    if some == n:
        return function(members)
    if n % some:  # the last one again fills the last batch
        members = take(members, jnp.minimum(jnp.arange(math.ceil(n / some) * some), n - 1))
    arrays, rest = eqx.partition(members, eqx.is_array)
    split = jax.tree.map(lambda x: x.reshape(-1, some, *x.shape[1:]), arrays)
    done = jax.lax.map(lambda x: function(eqx.combine(x, rest)), split)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:n], done)


class Layout(eqx.Module):
    """Where the entries of a flattened genome come from: static numbers, one per entry."""

    leaf: Int[np.ndarray, " entries"]  # which leaf
    row: Int[np.ndarray, " entries"]  # which row of all rows; a vector has one entry per row
    place: Int[np.ndarray, " entries"]  # position within its leaf
    matrix: Bool[np.ndarray, " entries"]  # whether that leaf is a matrix, not a vector
    sizes: Int[np.ndarray, " leaves"]

    @property
    def rows(self) -> int:
        return int(self.row[-1]) + 1


def ravel(
    genome: PyTree,
) -> tuple[Float[Array, " entries"], Callable[[Array], PyTree], Layout]:
    """All inexact array leaves of one genome as a vector, the way back, and the layout.

    Operators work on the vector: leaf by leaf they would be one program per matrix, and an MMU
    has seventeen.
    """
    weights, rest = eqx.partition(genome, eqx.is_inexact_array)
    vector, unravel = jax.flatten_util.ravel_pytree(weights)
    leaves = [np.zeros(leaf.shape) for leaf in jax.tree.leaves(weights)]
    rows = list(itertools.accumulate((len(np.atleast_1d(x)) for x in leaves), initial=0))
    layout = Layout(
        leaf=np.concatenate([np.full(x.size, i) for i, x in enumerate(leaves)]),
        row=np.concatenate(
            [
                first + np.repeat(np.arange(count), x.size // count)
                for first, x in zip(rows, leaves, strict=False)
                for count in (len(np.atleast_1d(x)),)
            ]
        ),
        place=np.concatenate([np.arange(x.size) for x in leaves]),
        matrix=np.concatenate([np.full(x.size, x.ndim > 1) for x in leaves]),
        sizes=np.array([x.size for x in leaves]),
    )
    return vector, lambda vector: eqx.combine(unravel(vector), rest), layout
