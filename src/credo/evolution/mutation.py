"""Mutation: one genome in, one out. Any pytree is a genome; `jax.vmap` makes it act on many."""

import abc
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from .. import require, tree

Key = PRNGKeyArray
Weights = Float[Array, " entries"]  # of a genome, see `tree.ravel`
Hits = Bool[Array, " entries"]
FRACTION = 0.1  # the share of a matrix that is hit unless said


class AbstractMutation(eqx.Module):
    @abc.abstractmethod
    def __call__(self, genome: PyTree, *, key: PRNGKeyArray) -> PyTree:
        """A changed copy, of the same structure, shapes and dtypes."""


class MatrixMutation(AbstractMutation):
    """Perturb a sample of the entries of each weight matrix (Khadka 2019, Algorithms 2 and 8).

    A gate with `probability` decides per matrix (Algorithm 2) or once per genome (the author's
    sequence code). A gated matrix has `fraction` of its entries hit; each hit draws one of
    three: *super* adds N(0, super_strength·|w|), *reset* draws N(0, reset_std) anew, otherwise
    N(0, strength·|w|) is added. Results are clipped to ±`limit`.

    Departure: the printed pseudo-code of Algorithms 8 and 12 multiplies, w·N(0, strength), which
    would erase the weight; noise proportional to the weight is added, as the author's code does.
    """

    probability: float = 0.9  # chance that a matrix or genome is mutated, in [0, 1]
    gate: Literal["matrix", "genome"] = eqx.field(static=True, default="matrix")
    """Whether that chance decides for each matrix or for a whole genome."""
    fraction: float = FRACTION  # share of a matrix's entries that is hit, in [0, 1]
    up_to_fraction: bool = eqx.field(static=True, default=False)
    """Draw the share anew for each matrix, uniformly up to `fraction` and at least one entry."""
    one_in: int | None = eqx.field(static=True, default=None)
    """Instead of `fraction`: of so many entries in a row one is hit, drawn at random, ≥ 1; faster
    for genomes of very many weights. None: `fraction` of all."""
    vectors: bool = eqx.field(static=True, default=True)  # mutate biases and start memory too
    strength: float = 0.1  # std of the noise, relative to the weight, ≥ 0
    floor: float = 0.0  # std of further noise, absolute, ≥ 0, so that small weights can move
    super_probability: float = 0.0  # share of hits that are super, in [0, 1]
    super_strength: float = 10.0  # std of the super noise, relative to the weight, ≥ 0
    reset_probability: float = 0.0  # share of hits that are resets, in [0, 1]
    reset_std: float = 1.0  # std of a reset weight, ≥ 0; 0 erases it
    limit: float = 1e6  # weights are clipped to plus and minus this, ≥ 0

    def __check_init__(self):
        for name in ("probability", "fraction", "super_probability", "reset_probability"):
            require.within(name, getattr(self, name), 0, 1)
        for name in ("strength", "floor", "super_strength", "reset_std", "limit"):
            require.at_least(name, getattr(self, name), 0)
        require.choice("gate", self.gate, ("matrix", "genome"))
        if self.one_in is not None:
            require.at_least("one_in", self.one_in, 1)
            if self.up_to_fraction:
                raise ValueError(f"one_in is {self.one_in} and up_to_fraction is set: give one")
            if isinstance(self.fraction, float) and self.fraction != FRACTION:
                raise ValueError(
                    f"one_in is {self.one_in} and fraction is {self.fraction}: one hit in "
                    f"{self.one_in} leaves no fraction to choose; give one of them (one_in=None)"
                )

    def __call__(self, genome: PyTree, *, key: PRNGKeyArray) -> PyTree:
        gate_key, hit_key, move_key = jax.random.split(key, 3)
        w, unravel, layout = tree.ravel(genome)
        gates = jax.random.bernoulli(gate_key, self.probability, layout.sizes.shape)
        gate = gates[0] if self.gate == "genome" else gates[layout.leaf]
        if not self.vectors:
            gate = gate & layout.matrix
        if self.one_in is not None:
            return unravel(self.one_of_each(w, gate, hit_key, move_key))
        hit = gate & self.hits(layout, key=hit_key)
        return unravel(jnp.where(hit, self.moved(w, key=move_key), w))

    def one_of_each(self, w: Weights, gate: Hits, hit_key: Key, move_key: Key) -> Weights:
        """The weights when of every `one_in` in a row one is hit, where its gate is open."""
        size, width = w.shape[0], self.one_in or 1
        first = jnp.arange(0, size, width)
        index = first + jax.random.randint(hit_key, first.shape, 0, width)
        seen = jnp.minimum(index, size - 1)
        old = w[seen]
        opened = jnp.broadcast_to(gate, w.shape)[seen]
        new = jnp.where(opened, self.moved(old, key=move_key), old)
        # Of a last row that is shorter perhaps none is hit: each entry has the same chance.
        return w.at[index].set(new, mode="drop", unique_indices=True)

    def hits(self, layout: tree.Layout, *, key: Key) -> Hits:
        """Which entries a mutation hits in the matrices whose gate is open."""
        entry_key, *share_keys = jax.random.split(key, 3)
        u = jax.random.uniform(entry_key, layout.leaf.shape)
        return self.up_to(u, layout, *share_keys) if self.up_to_fraction else u < self.fraction

    def up_to(self, u: Weights, layout: tree.Layout, count_key: Key, sure_key: Key) -> Hits:
        """Of each matrix a share drawn anew, at least one entry."""
        sizes = jnp.asarray(layout.sizes, jnp.float32)
        most = jnp.ceil(self.fraction * sizes)
        count = jnp.minimum(
            1.0 + jnp.floor(most * jax.random.uniform(count_key, sizes.shape)), most
        )
        sure = jnp.floor(sizes * jax.random.uniform(sure_key, sizes.shape)).astype(jnp.int32)
        # One entry for sure, the others by chance: `count` on average.
        others = (count - 1.0) / jnp.maximum(sizes - 1.0, 1.0)
        hit = (u < others[layout.leaf]) | (layout.place == sure[layout.leaf])
        return hit & (most > 0.0)[layout.leaf]

    def moved(self, w: Weights, *, key: Key) -> Weights:
        """Every weight as it is after a hit."""
        kind_key, noise_key, extra_key = jax.random.split(key, 3)
        kind = jax.random.uniform(kind_key, w.shape)
        noise = jax.random.normal(noise_key, w.shape)
        extra = jax.random.normal(extra_key, w.shape)
        is_super = kind < self.super_probability
        is_reset = ~is_super & (kind < self.super_probability + self.reset_probability)
        strength = jnp.where(is_super, self.super_strength, self.strength)
        hit = w + strength * jnp.abs(w) * noise + self.floor * extra
        hit = jnp.where(is_reset, self.reset_std * extra, hit)
        return jnp.clip(hit, -self.limit, self.limit)


class GaussianMutation(AbstractMutation):
    """Add N(0, std) to every weight: the plain mutation of evolution strategies."""

    std: float = 0.1  # of the noise on every weight, absolute

    def __call__(self, genome: PyTree, *, key: PRNGKeyArray) -> PyTree:
        w, unravel, _ = tree.ravel(genome)
        return unravel(w + self.std * jax.random.normal(key, w.shape))


class Mutations(AbstractMutation):
    """Several, one behind the other."""

    each: tuple[AbstractMutation, ...]  # applied in this order

    def __call__(self, genome: PyTree, *, key: PRNGKeyArray) -> PyTree:
        for mutation, mutation_key in zip(
            self.each, jax.random.split(key, len(self.each)), strict=True
        ):
            genome = mutation(genome, key=mutation_key)
        return genome
