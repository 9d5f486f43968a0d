"""Species of NEAT: who competes with whom, and how many offspring each species has.

Source: Stanley & Miikkulainen (2002), sections 3.3 and 4.1.

Departures:

- There is room for a number of species. Who would found one more joins the nearest.
- Where fitness can be negative, all of it is raised so that the lowest is 0: it is shared out in
  proportion, and the paper's tasks have none below 0. NaN counts as the lowest.
- The species of the fittest genome reproduces, stagnant or not, or the best would be lost.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from .. import tree
from .genome import Compatibility, Genome, by_length, shortened

Fitness = Float[Array, " pop"]
LEAST = np.float32(np.finfo(np.float32).min)  # where there is no fitness yet


class Species(eqx.Module):
    """What is remembered of species from one generation to the next."""

    representative: PyTree  # a genome of each, leaves [species, genes]
    alive: Bool[Array, " species"]  # False: this place is empty
    best: Float[Array, " species"]  # highest fitness of a member so far
    waited: Int[Array, " species"]  # generations since that was reached

    @classmethod
    def none(cls, genome: Genome, room: int) -> "Species":
        """Before there is any."""
        empty = jax.tree.map(lambda x: jnp.broadcast_to(x, (room, *x.shape)), genome)
        waited = jnp.zeros(room, jnp.int32)
        return cls(empty, jnp.zeros(room, bool), jnp.full(room, LEAST), waited)


def speciate(
    distance: Compatibility, threshold: float, species: Species, population: PyTree
) -> tuple[Int[Array, " pop"], Species]:
    """The species of each genome, one after the other: the first whose representative is nearer
    than `threshold`, or a new one, which it represents. Without members a species is no more."""
    away, founder = by_length(
        _longest(species.representative, population),
        population.innovation.shape[1],
        lambda n: _founded(
            distance,
            threshold,
            shortened(species.representative, n),
            species.alive,
            shortened(population, n),
        ),
    )
    near = away < threshold
    joins = jnp.where(jnp.any(near, axis=1), jnp.argmax(near, axis=1), jnp.argmin(away, axis=1))
    member, new = joins.astype(jnp.int32), founder >= 0
    fresh = Species(
        tree.take(population, jnp.maximum(founder, 0)),
        new,
        jnp.full(new.shape, LEAST),
        jnp.zeros(new.shape, jnp.int32),
    )
    species = jax.vmap(tree.where)(new, fresh, species)
    return member, eqx.tree_at(lambda s: s.alive, species, sizes(species, member) > 0)


def _longest(*genomes: PyTree) -> Int[Array, ""]:
    """The most genes that any has."""
    return jnp.max(jnp.concatenate([jnp.sum(g.used, axis=1, dtype=jnp.int32) for g in genomes]))


def _founded(
    distance: Compatibility,
    threshold: float,
    representative: PyTree,
    alive: Bool[Array, " species"],
    population: PyTree,
) -> tuple[Float[Array, "pop species"], Int[Array, " species"]]:
    """How far each genome is from each species that there is when its turn comes, infinitely from
    others; and the genome that founds a species, -1: it is an old one, or none."""
    turn = jnp.arange(population.weight.shape[0], dtype=jnp.int32)
    from_all = jax.vmap(distance, in_axes=(0, None))
    places = jnp.argsort(~alive, stable=True)  # of those that there are, then the empty ones

    def measured(i: Array, away: Array) -> Array:
        one = tree.take(representative, places[i])
        return away.at[:, places[i]].set(from_all(population, one))

    away = jnp.full((len(turn), len(alive)), jnp.inf)
    away = jax.lax.fori_loop(0, jnp.sum(alive, dtype=jnp.int32), measured, away)

    def alone(away: Array) -> Bool[Array, " pop"]:
        return ~jnp.any(away < threshold, axis=1)

    def due(state: tuple[Array, ...]) -> Bool[Array, ""]:
        alive, away, _ = state
        return jnp.any(alone(away)) & ~jnp.all(alive)

    def found(state: tuple[Array, ...]) -> tuple[Array, ...]:
        alive, away, founder = state
        first, slot = jnp.argmax(alone(away)), jnp.argmin(alive)
        here = jnp.where(turn >= first, from_all(population, tree.take(population, first)), jnp.inf)
        founder = founder.at[slot].set(first.astype(jnp.int32))
        return alive.at[slot].set(True), away.at[:, slot].set(here), founder

    none = jnp.full(alive.shape, -1, jnp.int32)
    _, away, founder = jax.lax.while_loop(due, found, (alive, away, none))
    return away, founder


def sizes(species: Species, member: Int[Array, " pop"]) -> Int[Array, " species"]:
    """How many members each species has."""
    return jnp.zeros(species.alive.shape, jnp.int32).at[member].add(1)


def aged(species: Species, member: Int[Array, " pop"], fitness: Fitness) -> Species:
    """One generation older, with the best fitness of each; -inf counts as the lowest number."""
    now = jnp.full(species.best.shape, LEAST).at[member].max(jnp.maximum(fitness, LEAST))
    waited = jnp.where(now > species.best, 0, species.waited + 1)
    best = (jnp.maximum(now, species.best), waited)
    return eqx.tree_at(lambda s: (s.best, s.waited), species, best)


def shared(
    species: Species,
    member: Int[Array, " pop"],
    fitness: Fitness,
    allowed: Bool[Array, " species"],
) -> Float[Array, " species"]:
    """Explicit fitness sharing (equation 2): the part of the next population that is each species'
    own, in proportion to the sum of its members' fitness, each divided by their number. `allowed`:
    which may reproduce."""
    finite = jnp.isfinite(fitness)
    lowest = jnp.min(jnp.where(finite, fitness, jnp.inf))
    raised = jnp.where(finite, fitness - jnp.minimum(lowest, 0.0), 0.0)
    count = sizes(species, member)
    adjusted = raised / count[member].astype(jnp.float32)
    total = jnp.zeros(allowed.shape).at[member].add(adjusted)
    total = jnp.where(allowed, total, 0.0)
    # Where nobody has more than the lowest fitness, all have the same part but those without any.
    played = allowed & (
        jnp.zeros(allowed.shape, jnp.int32).at[member].max(finite.astype(jnp.int32)) > 0
    )
    equal = jnp.where(jnp.any(played), played, allowed).astype(jnp.float32)
    total = jnp.where(jnp.sum(total) > 0.0, total, equal)
    return total / jnp.sum(total)


def seats(share: Float[Array, " species"], n: int) -> Int[Array, " species"]:
    """`n` offspring by largest remainder: each species gets the whole part of its due, and those
    with the largest rest one more. Of equals the first."""
    due = share * n
    whole = jnp.floor(due).astype(jnp.int32)
    rest = jnp.where(share > 0.0, due - jnp.floor(due), -1.0)
    rank = jnp.argsort(jnp.argsort(-rest, stable=True), stable=True).astype(jnp.int32)
    return whole + (rank < n - jnp.sum(whole)).astype(jnp.int32)
