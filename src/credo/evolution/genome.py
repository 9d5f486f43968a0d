"""Genomes of NEAT: node genes, and connection genes with historical markings.

Source: Stanley & Miikkulainen (2002), "Evolving neural networks through augmenting topologies",
sections 3.1 to 3.3. A genome is arrays of a fixed length, so that a population is one pytree: its
genes stand in the order of their numbers, and behind the last one everything is `NONE`.

Departures:

- Node genes are listed for hidden nodes alone. Inputs, the bias and outputs, which all genomes
  have, have the first numbers; hidden nodes are numbered as innovations are.
- A genome holds no more genes, and no more hidden nodes, than there is room for. A mutation that
  finds none does nothing; a crossover of equals that would need more takes one parent's genes.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .. import require
from ..networks.graph import Graph, GraphPolicy

NONE = np.int32(np.iinfo(np.int32).max)  # a number behind all others: nothing is here


class Form(NamedTuple):
    """What all genomes of a population have in common."""

    inputs: int  # sensors, and the bias behind them
    outputs: int
    network: Graph  # what they are expressed as

    @classmethod
    def of(cls, network: Graph, obs_size: int, action_size: int) -> "Form":
        return cls(obs_size + 1, action_size, network)

    @property
    def fixed(self) -> int:
        """Nodes that every genome has; hidden nodes have the numbers from here on."""
        return self.inputs + self.outputs

    @property
    def shape(self) -> tuple[int, int]:
        """Sockets and sources of its networks: where connections end and begin."""
        sizes = (self.inputs - 1, self.outputs)
        return self.network.sockets(self.outputs), self.network.sources(*sizes)


class Genome(eqx.Module):
    """Hidden nodes in the order of their numbers, and connection genes in that of their innovation
    numbers."""

    node: Int[Array, " hidden"]  # a hidden node
    source: Int[Array, " genes"]  # node where the connection begins
    target: Int[Array, " genes"]  # node where it ends
    port: Int[Array, " genes"]  # at its block input, 0, or at a gate of an LSTM cell
    weight: Float[Array, " genes"]
    enabled: Bool[Array, " genes"]  # False: it is not expressed
    innovation: Int[Array, " genes"]

    @property
    def used(self) -> Bool[Array, " genes"]:
        """Where there is a gene."""
        return self.innovation != NONE

    @property
    def count(self) -> Int[Array, ""]:
        """How many genes there are."""
        return jnp.sum(self.used, dtype=jnp.int32)


class Innovations(eqx.Module):
    """The next numbers of a run: they are never used twice."""

    connection: Int[Array, ""]
    node: Int[Array, ""]


def first(form: Form, room: int, *, key: PRNGKeyArray) -> Genome:
    """Every input connected to every output, with weights uniform in [-1, 1], and `room` genes
    for what comes."""
    n = form.inputs * form.outputs
    genes = jnp.arange(n + room, dtype=jnp.int32)
    there = genes < n
    weight = jax.random.uniform(key, (n + room,), minval=-1.0, maxval=1.0)
    return Genome(
        node=jnp.full(form.network.hidden, NONE),
        source=jnp.where(there, genes % form.inputs, NONE),
        target=jnp.where(there, form.inputs + genes // form.inputs, NONE),
        port=jnp.zeros(n + room, jnp.int32),
        weight=jnp.where(there, weight, 0.0),
        enabled=there,
        innovation=jnp.where(there, genes, NONE),
    )


def places(form: Form, genome: Genome) -> tuple[Int[Array, " genes"], Int[Array, " genes"]]:
    """Row and column of each gene in the matrix of a `GraphPolicy`; `NONE` where there is no
    gene."""

    def place(node):
        behind = form.fixed + _position(genome.node, node)
        return jnp.where(genome.used, jnp.where(node < form.fixed, node, behind), NONE)

    row = place(genome.target) - form.inputs + genome.port * form.network.hidden
    return jnp.where(genome.used, row, NONE), place(genome.source)


def _position(numbers: Int[Array, " n"], wanted: Int[Array, " m"]) -> Int[Array, " m"]:
    """How many ascending numbers are below each of those wanted."""
    return jnp.sum(numbers[None] < wanted[:, None], axis=1, dtype=jnp.int32)


def express(form: Form, genome: Genome) -> GraphPolicy:
    """The network that a genome describes."""
    weight = jnp.where(genome.enabled, genome.weight, 0.0)
    weights = jnp.zeros(form.shape).at[places(form, genome)].add(weight, mode="drop")
    return GraphPolicy(weights, form.outputs, form.network)


# ------------------------------------------------------------------------- matching up genomes


def by_length(needed: Int[Array, ""], room: int, work: Callable[[int], Any]) -> Any:
    """`work(n)` for the first of some lengths n up to `room` that is at least `needed`: work that
    grows with the square of the length of genomes, most of which are much shorter than there is
    room for."""
    lengths = [n for n in (16, 32, 64, 128, 256) if n < room] + [room]
    longer = jnp.sum(needed > jnp.array(lengths[:-1], jnp.int32), dtype=jnp.int32)
    return jax.lax.switch(longer, [partial(work, n) for n in lengths])


def shortened(genomes: PyTree, n: int) -> PyTree:
    """With the first n genes alone, of leaves `[pop, genes]`."""
    return Genome(genomes.node, *(xs[:, :n] for xs in _genes(genomes)))


def lengthened(genomes: PyTree, n: int) -> PyTree:
    """With room for n genes, of leaves `[pop, genes]`."""
    more = n - genomes.innovation.shape[1]
    empty = (NONE, NONE, 0, 0.0, False, NONE)
    pairs = zip(_genes(genomes), empty, strict=True)
    return Genome(
        genomes.node, *(jnp.pad(xs, ((0, 0), (0, more)), constant_values=x) for xs, x in pairs)
    )


def _genes(genomes: PyTree) -> tuple[Array, ...]:
    parts = (genomes.source, genomes.target, genomes.port, genomes.weight)
    return (*parts, genomes.enabled, genomes.innovation)


def matching(a: Genome, b: Genome) -> tuple[Bool[Array, " genes"], Int[Array, " genes"]]:
    """Which genes of `a` have a gene with the same innovation number in `b`, and where."""
    at = jnp.minimum(_position(b.innovation, a.innovation), b.innovation.shape[0] - 1)
    return a.used & (b.innovation[at] == a.innovation), at


class Compatibility(eqx.Module):
    """Equation 1: how far apart two genomes are."""

    excess: float = 1.0  # c1: weight of excess genes, at least 0
    disjoint: float = 1.0  # c2: weight of disjoint genes, at least 0
    weights: float = 0.4  # c3: weight of the mean difference of matching genes' weights, at least 0
    small: int = eqx.field(static=True, default=20)
    """Genes of the larger genome below which c1 and c2 are not divided by their number, at least
    0."""

    def __check_init__(self):
        for name in ("excess", "disjoint", "weights", "small"):
            require.at_least(name, getattr(self, name), 0)

    def __call__(self, a: Genome, b: Genome) -> Float[Array, ""]:
        match, at = matching(a, b)
        matches = jnp.sum(match, dtype=jnp.int32)
        excess = jnp.int32(0)
        for one, other in ((a, b), (b, a)):
            last = jnp.max(jnp.where(other.used, other.innovation, -1))
            excess += jnp.sum(one.used & (one.innovation > last), dtype=jnp.int32)
        disjoint = a.count + b.count - 2 * matches - excess
        size = jnp.maximum(a.count, b.count)
        size = jnp.where(size < self.small, 1, size).astype(jnp.float32)
        away = jnp.sum(jnp.where(match, jnp.abs(a.weight - b.weight[at]), 0.0))
        apart = self.excess * excess.astype(jnp.float32)
        apart += self.disjoint * disjoint.astype(jnp.float32)
        return apart / size + self.weights * away / jnp.maximum(matches, 1).astype(jnp.float32)


def cross(
    form: Form, a: Genome, b: Genome, lead: Float[Array, ""], stays: float, *, key: PRNGKeyArray
) -> Genome:
    """Figure 4: a child of two genomes.

    Matching genes come from either parent at random, disjoint and excess genes from the fitter one,
    of equals each at random.

    **Arguments:** `lead`: fitness of `a` less that of `b`. `stays`: probability that a gene which
    is disabled in either parent is disabled in the child.
    """
    pick_key, own_key, able_key = jax.random.split(key, 3)
    n = a.innovation.shape[0]
    match, at = matching(a, b)
    lone = b.used & ~matching(b, a)[0]
    theirs = match & jax.random.bernoulli(pick_key, 0.5, (n,))
    weight = jnp.where(theirs, b.weight[at], a.weight)
    enabled = a.enabled & (b.enabled[at] | ~match)
    stay = jax.random.bernoulli(able_key, stays, (2, n))
    a = _with(a, weight, a.used & (enabled | ~stay[0]))
    b = _with(b, b.weight, b.used & (b.enabled | ~stay[1]))

    # What a child of equals has, and what it has if one parent gives all that the other lacks.
    drawn, fitter = jax.random.bernoulli(own_key, 0.5, (2, n)), lead >= 0.0
    of_both = _named(a, b, match | (a.used & drawn[0]), lone & drawn[1])
    of_one = _named(a, b, match | (a.used & fitter), lone & ~fitter)
    equals = (lead == 0.0) & _fits(of_both[:2]) & _fits(of_both[2:])
    if not form.network.recurrent:
        equals = equals & ~loops(form, _merged(a, b, *of_both))
    return _merged(a, b, *(jnp.where(equals, x, y) for x, y in zip(of_both, of_one, strict=True)))


def _named(
    a: Genome, b: Genome, of_a: Bool[Array, " genes"], of_b: Bool[Array, " genes"]
) -> tuple[Array, Array, Array, Array]:
    """Some genes of each of two genomes, and the nodes of each that these name, none of them in
    both."""

    def used(nodes: Int[Array, " hidden"]) -> Bool[Array, " hidden"]:
        named = jnp.zeros(nodes.shape, bool)
        for genome, kept in ((a, of_a), (b, of_b)):
            for end in (genome.source, genome.target):
                named = named | jnp.any((nodes[:, None] == end[None]) & kept[None], axis=1)
        return named

    known = jnp.any(b.node[:, None] == a.node[None], axis=1)
    return of_a, of_b, used(a.node), used(b.node) & ~known


def _with(genome: Genome, weight: Array, enabled: Array) -> Genome:
    return eqx.tree_at(lambda g: (g.weight, g.enabled), genome, (weight, enabled))


def _fits(taken: tuple[Bool[Array, " n"], Bool[Array, " n"]]) -> Bool[Array, ""]:
    """Whether what is taken of two lists is no longer than each."""
    return jnp.sum(jnp.concatenate(taken), dtype=jnp.int32) <= len(taken[0])


def _merged(
    a: Genome,
    b: Genome,
    of_a: Bool[Array, " genes"],
    of_b: Bool[Array, " genes"],
    nodes_of_a: Bool[Array, " hidden"],
    nodes_of_b: Bool[Array, " hidden"],
) -> Genome:
    """Some genes and nodes of each of two genomes, none of them in both."""
    nodes = _places(a.node, b.node, nodes_of_a, nodes_of_b)
    genes = _places(a.innovation, b.innovation, of_a, of_b)

    def placed(name: str, at: Int[Array, " 2n"], empty: Any) -> Array:
        both = jnp.concatenate([getattr(a, name), getattr(b, name)])
        return jnp.full(len(both) // 2, empty, both.dtype).at[at].set(both, mode="drop")

    blank = {"source": NONE, "target": NONE, "port": 0, "weight": 0.0, "enabled": False}
    blank |= {"innovation": NONE}
    parts = {name: placed(name, genes, empty) for name, empty in blank.items()}
    return Genome(placed("node", nodes, NONE), **parts)


def _places(
    a: Int[Array, " n"], b: Int[Array, " n"], of_a: Bool[Array, " n"], of_b: Bool[Array, " n"]
) -> Int[Array, " 2n"]:
    """Where some numbers of two ascending lists stand when they are one list; `NONE` for the
    others."""

    def own(keep: Bool[Array, " n"]) -> Int[Array, " n"]:
        return jnp.cumsum(keep.astype(jnp.int32)) - 1

    def below(numbers, keep, wanted):
        return jnp.sum((numbers[None] < wanted[:, None]) & keep[None], axis=1, dtype=jnp.int32)

    at = jnp.concatenate([own(of_a) + below(b, of_b, a), own(of_b) + below(a, of_a, b)])
    return jnp.where(jnp.concatenate([of_a, of_b]), at, NONE)


def connected(form: Form, genome: Genome) -> Bool[Array, "sockets sources"]:
    """Which pairs of places have a gene, enabled or not."""
    there = jnp.zeros(form.shape, jnp.int32)
    there = there.at[places(form, genome)].max(genome.used.astype(jnp.int32), mode="drop")
    return there > 0


def links(form: Form, genome: Genome) -> Bool[Array, "units units"]:
    """From which unit (its row) a connection leads to which (its column)."""
    ends = connected(form, genome)[:, form.inputs :]
    ports = ends[form.outputs :].reshape(form.network.ports, form.network.hidden, -1)
    return jnp.concatenate([ends[: form.outputs], jnp.any(ports, axis=0)]).T


def paths(form: Form, genome: Genome) -> Bool[Array, "units units"]:
    """From which unit a signal comes to which; to itself in any case."""
    reach = links(form, genome)
    reach = reach | jnp.eye(len(reach), dtype=bool)
    for _ in range(len(reach).bit_length()):  # twice as far each time
        reach = jnp.dot(reach.astype(jnp.float32), reach.astype(jnp.float32)) > 0.0
    return reach


def loops(form: Form, genome: Genome) -> Bool[Array, ""]:
    """Whether some connections close a loop."""
    return jnp.any(links(form, genome) & paths(form, genome).T)
