"""A population is a pytree whose array leaves carry a leading axis `[pop]`."""

import functools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

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


_in_front = functools.partial(jax.lax.expand_dims, dimensions=(0,))  # x[None] takes longer


def single(member: PyTree) -> PyTree:
    """A population of one; Python floats become arrays, as in `stack`."""
    held, rest = eqx.partition(member, lambda x: eqx.is_array(x) or eqx.is_inexact_array_like(x))
    return eqx.combine(jax.tree.map(_in_front, jax.tree.map(jnp.asarray, held)), rest)


def where(pred: Bool[Array, ""], a: PyTree, b: PyTree) -> PyTree:
    """`a` if `pred` else `b`, leaf by leaf."""
    return jax.tree.map(lambda x, y: jnp.where(pred, x, y) if eqx.is_array(x) else x, a, b)


def packed(population: PyTree) -> tuple[PyTree, Callable[..., PyTree], Callable[..., PyTree]]:
    """A population with all weights of a member as one vector, the first part of the result.

    **Returns:** the packed population; `each(operator, *parents, key=key)`, what an operator on
    genomes makes of each of some packed parents; and how a packed population is unpacked.

    Operators are then a few operations for a whole population. For each leaf on its own they would
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

    def each(operator: Callable[..., PyTree], *parents: PyTree, key: PRNGKeyArray) -> PyTree:
        def one(given):
            key, *genomes = given
            return pack(operator(*map(unpack, genomes), key=key))

        return in_batches(jax.vmap(one), (jax.random.split(key, size(parents[0])), *parents))

    return eqx.filter_vmap(pack)(population), each, eqx.filter_vmap(unpack)


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
    return function(members) if batch(members) == size(members) else _in_turn(function, members)


def _in_turn(function: Callable[[PyTree], PyTree], members: PyTree) -> PyTree:
    """`function` of one batch after the other."""
    n, some = size(members), batch(members)
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


def ravel(genome: PyTree) -> tuple[Float[Array, " entries"], Callable[..., PyTree], Layout]:
    """All inexact array leaves of one genome as a vector, the way back, and the layout.

    Operators work on the vector: leaf by leaf they would be one program per matrix, and an MMU
    has seventeen.
    """
    weights, rest = eqx.partition(genome, eqx.is_inexact_array)
    vector, unravel = jax.flatten_util.ravel_pytree(weights)
    shapes = [leaf.shape for leaf in jax.tree.leaves(weights)]
    sizes = np.array([math.prod(shape) for shape in shapes])
    rows = np.array([(*shape, 1)[0] for shape in shapes])  # of each leaf
    layout = Layout(
        leaf=np.repeat(np.arange(len(shapes)), sizes),
        row=np.repeat(np.arange(rows.sum()), np.repeat(sizes // rows, rows)),
        place=np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes),
        matrix=np.repeat([len(shape) > 1 for shape in shapes], sizes),
        sizes=sizes,
    )
    return vector, lambda vector: eqx.combine(unravel(vector), rest), layout
