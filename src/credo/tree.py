"""A population is a pytree whose array leaves carry a leading axis `[pop]`."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PRNGKeyArray, PyTree


def size(population: PyTree) -> int:
    """How many members."""
    return jax.tree.leaves(eqx.filter(population, eqx.is_array))[0].shape[0]


def take(population: PyTree, index: Int[Array, "..."] | int) -> PyTree:
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
        if eqx.is_inexact_array_like(xs[0]) or eqx.is_array(xs[0]):
            return jnp.stack([jnp.asarray(x) for x in xs])
        if any(x != xs[0] for x in xs):
            raise ValueError(f"cannot stack members that differ in {xs}: make it a float or equal")
        return xs[0]

    first, *rest = (jax.tree.structure(member) for member in members)
    if any(structure != first for structure in rest):
        raise ValueError(
            "cannot stack members of different structure: only arrays and floats may differ, "
            "every other field (sizes, names) must be equal"
        )
    return jax.tree.map(join, *members)


def where(pred: Bool[Array, ""], a: PyTree, b: PyTree) -> PyTree:
    """`a` if `pred` else `b`, leaf by leaf."""
    return jax.tree.map(lambda x, y: jnp.where(pred, x, y) if eqx.is_array(x) else x, a, b)


def uniform_like(tree: PyTree, *, key: PRNGKeyArray) -> PyTree:
    """Uniform [0, 1) numbers of the shape of every inexact array leaf; leaves share none."""
    return _draw_like(jax.random.uniform, tree, key)


def normal_like(tree: PyTree, *, key: PRNGKeyArray) -> PyTree:
    """Standard normal numbers of the shape of every inexact array leaf; leaves share none."""
    return _draw_like(jax.random.normal, tree, key)


def _draw_like(sampler, tree, key):
    # One draw cut into leaves: a draw per leaf inlines the generator per leaf, and an MMU's
    # mutation then takes minutes to compile.
    leaves, treedef = jax.tree.flatten(eqx.filter(tree, eqx.is_inexact_array))
    numbers = sampler(key, (sum(leaf.size for leaf in leaves),))
    cuts = list(itertools.accumulate((leaf.size for leaf in leaves), initial=0))
    return jax.tree.unflatten(
        treedef,
        [
            numbers[i:j].reshape(leaf.shape).astype(leaf.dtype)
            for leaf, i, j in zip(leaves, cuts[:-1], cuts[1:], strict=True)
        ],
    )
