"""Mutations of NEAT: weights, new nodes and new connections.

Source: Stanley & Miikkulainen (2002), sections 3.1, 3.2 and 4.1. A structural change gets new
innovation numbers, and the same change in the same generation the same ones.

Departures: a new connection is drawn among all pairs of nodes that have none, where the authors'
program draws pairs and gives up after some that have one. Connections from the bias are not split:
the new node would be a constant. The paper gives no size of perturbations and of new weights:
`strength` and `fresh` are one of the pairs by which XOR was solved soon (docs/algorithms/neat.md).
"""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .. import require
from .genome import NONE, Form, Genome, Innovations, connected, paths


class Augmentation(eqx.Module):
    """Mutates a whole population: only together can its members share innovations."""

    weights: float = 0.8  # probability that a genome's weights are mutated, in [0, 1]
    replaced: float = 0.1
    """Probability that one of these weights is replaced by a new one, and not perturbed, in
    [0, 1]."""
    strength: float = 2.5  # perturbations are uniform between plus and minus this, at least 0
    fresh: float = 4.0  # new weights are uniform between plus and minus this, at least 0
    node: float = 0.03  # probability that a connection is split by a new node, in [0, 1]
    connection: float = 0.05  # probability of a connection between two places without, in [0, 1]

    def __check_init__(self):
        for name in ("weights", "replaced", "node", "connection"):
            require.within(name, getattr(self, name), 0, 1)
        for name in ("strength", "fresh"):
            require.at_least(name, getattr(self, name), 0)

    def __call__(
        self, form: Form, population: PyTree, innovations: Innovations, *, key: PRNGKeyArray
    ) -> tuple[PyTree, Innovations]:
        """A population of genomes, leaves `[pop, genes]`, after its mutations, and the next numbers
        of innovations."""
        weight_key, node_key, link_key = jax.random.split(key, 3)
        population = self.perturbed(population, key=weight_key)
        population, innovations = self.split(form, population, innovations, key=node_key)
        return self.linked(form, population, innovations, key=link_key)

    def perturbed(self, population: PyTree, *, key: PRNGKeyArray) -> PyTree:
        """With other weights."""
        hit_key, new_key, noise_key = jax.random.split(key, 3)
        shape = population.weight.shape
        hit = jax.random.bernoulli(hit_key, self.weights, (shape[0], 1)) & population.used
        new = jax.random.bernoulli(new_key, self.replaced, shape)
        noise = jax.random.uniform(noise_key, shape, minval=-1.0, maxval=1.0)
        moved = population.weight + self.strength * noise
        weight = jnp.where(hit, jnp.where(new, self.fresh * noise, moved), population.weight)
        return eqx.tree_at(lambda g: g.weight, population, weight)

    def split(
        self, form: Form, population: PyTree, innovations: Innovations, *, key: PRNGKeyArray
    ) -> tuple[PyTree, Innovations]:
        """Add node: a connection is disabled, one of weight 1 leads from its beginning to a new
        hidden node, and one of its own weight from there to its end."""
        due_key, gene_key = jax.random.split(key)
        n = population.weight.shape[0]
        due = jax.random.bernoulli(due_key, self.node, (n,))
        some = partial(_splittable, form)
        open_, gene = jax.vmap(some)(population, jax.random.split(gene_key, n))
        due = due & open_
        old = jax.vmap(_gene)(population, gene)
        rank, made = numbered(due, old[4][:, None])
        node, link = innovations.node + rank, innovations.connection + 2 * rank
        here = gene[:, None] == jnp.arange(population.enabled.shape[1])[None]
        enabled = population.enabled & ~(here & due[:, None])
        population = eqx.tree_at(lambda g: g.enabled, population, enabled)
        place = jax.vmap(lambda g, due, node: _appended(g.node, due, node))
        nodes = place(population, due, node)
        population = eqx.tree_at(lambda g: g.node, population, nodes)
        add, zeros = jax.vmap(added), jnp.zeros(n, jnp.int32)
        population = add(population, due, old[0], node, zeros, jnp.ones(n), link)
        population = add(population, due, node, old[1], old[2], old[3], link + 1)
        return population, Innovations(innovations.connection + 2 * made, innovations.node + made)

    def linked(
        self, form: Form, population: PyTree, innovations: Innovations, *, key: PRNGKeyArray
    ) -> tuple[PyTree, Innovations]:
        """Add connection: between two places that have none, with a new weight."""
        due_key, pair_key, weight_key = jax.random.split(key, 3)
        n = population.weight.shape[0]
        due = jax.random.bernoulli(due_key, self.connection, (n,))
        open_, source, target, port = jax.vmap(lambda g, key: _unconnected(form, g, key))(
            population, jax.random.split(pair_key, n)
        )
        due = due & open_
        weight = self.fresh * jax.random.uniform(weight_key, (n,), minval=-1.0, maxval=1.0)
        rank, number = numbered(due, jnp.stack([source, target, port], axis=1))
        link = innovations.connection + rank
        population = jax.vmap(added)(population, due, source, target, port, weight, link)
        return population, eqx.tree_at(
            lambda i: i.connection, innovations, innovations.connection + number
        )


def numbered(
    due: Bool[Array, " pop"], change: Int[Array, "pop parts"]
) -> tuple[Int[Array, " pop"], Int[Array, ""]]:
    """Numbers from 0 on for the changes that are due, the same for the same change, and how many
    there are; 0 where none is due."""
    same = jnp.all(change[:, None] == change[None], axis=2) & due[None] & due[:, None]
    first = jnp.argmax(same, axis=1)
    new = due & (first == jnp.arange(len(due)))
    rank = jnp.cumsum(new.astype(jnp.int32)) - 1
    return jnp.where(due, rank[first], 0), jnp.sum(new, dtype=jnp.int32)


def added(
    genome: Genome,
    due: Bool[Array, ""],
    source: Int[Array, ""],
    target: Int[Array, ""],
    port: Int[Array, ""],
    weight: Float[Array, ""],
    innovation: Int[Array, ""],
) -> Genome:
    """With one more gene, if it is due. Its number must be higher than all before, and there must
    be room."""
    at = jnp.where(due, genome.count, NONE)
    gene = (source, target, port, weight, jnp.bool_(True), innovation)
    old = [getattr(genome, f.name) for f in dataclasses.fields(genome)[1:]]
    new = (xs.at[at].set(x, mode="drop") for xs, x in zip(old, gene, strict=True))
    return Genome(genome.node, *new)


def _appended(
    numbers: Int[Array, " n"], due: Bool[Array, ""], number: Int[Array, ""]
) -> Int[Array, " n"]:
    """With one more behind the last, if it is due."""
    at = jnp.where(due, jnp.sum(numbers != NONE, dtype=jnp.int32), NONE)
    return numbers.at[at].set(number, mode="drop")


def _gene(genome: Genome, i: Int[Array, ""]) -> tuple[Array, ...]:
    """Source, target, port, weight and innovation number of a gene."""
    parts = (genome.source, genome.target, genome.port, genome.weight, genome.innovation)
    return tuple(part[i] for part in parts)


def _splittable(
    form: Form, genome: Genome, key: PRNGKeyArray
) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    """A random gene that is expressed and does not begin at the bias; and whether there is one, and
    room to split it."""
    room = (genome.count + 2 <= genome.innovation.shape[0]) & (genome.node[-1] == NONE)
    these = genome.enabled & (genome.source != form.inputs - 1)
    drawn = jax.random.uniform(key, these.shape)
    return room & jnp.any(these), jnp.argmax(jnp.where(these, drawn, -1.0))


def _unconnected(
    form: Form, genome: Genome, key: PRNGKeyArray
) -> tuple[Bool[Array, ""], Int[Array, ""], Int[Array, ""], Int[Array, ""]]:
    """Whether there is room for a connection; and a node, and another with a port, that have none
    yet."""
    n, y, h = form.inputs, form.outputs, form.network.hidden
    units = jnp.concatenate([jnp.ones(y, bool), genome.node != NONE])
    rows = np.concatenate([np.arange(y), y + np.tile(np.arange(h), form.network.ports)])
    sources = jnp.concatenate([jnp.ones(n, bool), units])
    free = units[rows][:, None] & sources[None] & ~connected(form, genome)
    if not form.network.recurrent:  # no way back from the end to the beginning
        free = free.at[:, n:].set(free[:, n:] & ~paths(form, genome)[rows])
    drawn = jnp.where(free, jax.random.uniform(key, free.shape), -1.0)
    row, column = jnp.unravel_index(jnp.argmax(drawn), free.shape)
    numbers = jnp.concatenate([jnp.arange(form.fixed, dtype=jnp.int32), genome.node])
    port = jnp.maximum(row - y, 0).astype(jnp.int32) // h
    open_ = jnp.any(free) & (genome.count < genome.innovation.shape[0])
    return open_, numbers[column], numbers[n + jnp.asarray(rows)[row]], port
