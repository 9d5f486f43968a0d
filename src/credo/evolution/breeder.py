"""Breeding: which members stay, which have offspring, and how offspring are changed.

Neuroevolution, CCEA, ERL, CERL and MERL each hold one `Breeder` and differ in its fields.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .. import require, tree
from ..networks.base import AbstractNetwork
from .agents import AgentCrossover, apart
from .crossover import AbstractCrossover, MaskedCrossover, NoCrossover
from .descent import Descent
from .extinction import Extinction
from .islands import Islands
from .mutation import AbstractMutation, MatrixMutation
from .selection import AbstractSelection, Tournament, ranking, repeated

Rows = PyTree
"""A population as few arrays, see `tree.packed`."""


class Breeder(eqx.Module):
    """Makes the next population: elites first, best to worst, then the offspring.

    An offspring is a copy of a selected parent. Some are crossed with a random elite, all are
    mutated, and all are crossed by each operator of `mating` with another offspring.
    """

    elite_fraction: float = eqx.field(static=True, default=0.1)
    """ψ: share of the population that is kept unchanged, in [0, 1). The number of elites is
    rounded down."""
    selection: AbstractSelection = Tournament()
    """How parents are drawn. If it ignores fitness, elites are drawn at random too."""
    crossover: AbstractCrossover = MaskedCrossover()
    """How an offspring is crossed with a random elite, its first parent."""
    crossover_probability: float = 0.0
    """Chance that an offspring is crossed with an elite, in [0, 1]."""
    cross_repeated: bool = eqx.field(static=True, default=False)
    """Cross every offspring whose parent was drawn before, so that no two are clones."""
    mutation: AbstractMutation = MatrixMutation()
    """How offspring are mutated. Elites never are."""
    mating: tuple[AbstractCrossover, ...] = ()
    """Operators that cross every offspring with another one, in turn, after mutation (Khadka 2019,
    Algorithm 5, lines 15-23)."""
    ordered: bool = eqx.field(static=True, default=False)
    """Offspring are ordered by the rank of their parents, best first, so that the last slots are
    those of the weakest parents."""
    extinction: Extinction | None = None
    """Now and then offspring die and are drawn anew; None: never. Elites survive."""
    islands: Islands | None = None
    """Parts of the population that breed apart, each with its share of the elites and with its own
    tournaments, mates and extinctions; None: one population."""

    def __check_init__(self):
        require.within("elite_fraction", self.elite_fraction, 0, 1)
        require.within("crossover_probability", self.crossover_probability, 0, 1)
        if isinstance(self.crossover, NoCrossover) and self.cross_repeated:
            raise ValueError(
                "crossover is NoCrossover and cross_repeated is set: nothing would be crossed; "
                "give crossover=MaskedCrossover(), or leave cross_repeated out"
            )
        if not isinstance(self.islands, Islands | None):
            raise TypeError(f"islands is {self.islands!r}: give Islands(number=4), or None")

    def check(self, population: int, network: AbstractNetwork, least: int = 1, learners: int = 0):
        """Raise `ValueError` unless this breeds `population` members with `least` elites or more,
        and leaves a slot to the actor of each of some learners."""
        require.at_least("population_size", population, 2)
        size = self.islands.size(population) if self.islands else population
        of = "members of an island" if self.islands else "members"
        require.room(self.elite_fraction, size, learners, of, least)
        if any(isinstance(x, AgentCrossover) for x in self.mating) and not apart(network):
            raise ValueError(
                f"mating has AgentCrossover, and agents of {type(network).__name__} have no "
                "weights of their own: give DMMU or Team(sharing='nothing'), or leave it out"
            )

    def elites(self, population: int) -> int:
        """Number of elites among `population` members, those of all islands."""
        n = self.islands.number if self.islands else 1
        return n * int(self.elite_fraction * (population // n))

    def __call__(
        self,
        population: PyTree,
        fitness: Float[Array, " pop"],
        draw: Callable[..., PyTree],
        *,
        key: PRNGKeyArray,
    ) -> tuple[PyTree, Descent]:
        """The next population, of the same size, and where each member comes from.

        **Arguments:** `fitness` is maximised; NaN ranks last. `draw(n, key=key)` makes `n` fresh
        members, for extinctions and new islands. Call it inside a `jit`, which leaves out what
        nothing reads of the descent.
        """
        rows, each, unpack = tree.packed(population)

        def fresh(n: int, key: PRNGKeyArray) -> tuple[Rows, Descent]:
            return tree.packed(draw(n, key=key))[0], self._unchanged(jnp.full(n, -1), False)

        breed = partial(self._breed, each, fresh)
        if self.islands is None:
            rows, descent = breed(rows, fitness, key=key)
            return unpack(rows), descent
        breed_key, fresh_key = jax.random.split(key)
        size = self.islands.size(k := fitness.shape[0])
        anew = partial(fresh, size, fresh_key)
        rows, descent = self.islands(breed, anew, rows, fitness, key=breed_key)
        return unpack(rows), descent.shifted(jnp.arange(k) // size * size)

    def _breed(
        self, each: Callable[..., Rows], fresh: Callable[..., Any], rows: Rows, fitness, *, key
    ) -> tuple[Rows, Descent]:
        """The next generation of one island."""
        k = fitness.shape[0]
        n = k - (e := int(self.elite_fraction * k))
        keys, mating_keys = self._keys(key)
        # Rank the population, keep the elites, select the parents of the others.
        order = ranking(fitness)
        if not self.selection.sees_fitness:
            order = jax.random.permutation(keys["order"], k)
        parent = self.selection(fitness, n, key=keys["select"])
        if self.ordered:
            parent = parent[jnp.argsort(jnp.argsort(order)[parent], stable=True)]
        # Cross some offspring with an elite; mutate all; cross all with each other.
        mate = order[jax.random.randint(keys["mate"], (n,), 0, max(e, 1))]
        crossed = self._crossed(parent, e, key=keys["chance"])
        first, second = tree.take(rows, mate), tree.take(rows, parent)
        children = each(self.crossover, first, second, key=keys["cross"])
        offspring = jax.vmap(tree.where)(crossed, children, second)
        crossings = [(mate, _taken(offspring, first, second))]
        mutants = each(self.mutation, offspring, key=keys["mutate"])
        mutated = jnp.any(mutants[0] != offspring[0], axis=1)
        for operator, mating_key in zip(self.mating, mating_keys, strict=True):
            mutants, mate, taken = _mated(each, operator, mutants, key=mating_key)
            crossings.append((e + mate, taken))
            crossed = crossed | (taken > 0.0)
        mates, taken = (jnp.stack(x, axis=1) for x in zip(*crossings, strict=True))
        bred = mutants, Descent(parent, jnp.zeros(n, bool), crossed, mutated, mates, taken)
        # Now and then some offspring die.
        if self.extinction is not None:
            anew = partial(fresh, n, keys["fresh"])
            bred = self.extinction(bred, anew, key=keys["extinct"])
        elites = order[:e]
        return tree.concat((tree.take(rows, elites), self._unchanged(elites, True)), bred)

    def _keys(self, key: PRNGKeyArray) -> tuple[dict[str, PRNGKeyArray], list[PRNGKeyArray]]:
        """A key by use, and one for each operator of `mating`. Their order depends on `ordered`:
        there were two programs once, and seeds keep giving the runs that they gave."""
        names, m = "select chance mate cross order mutate extinct fresh", len(self.mating)
        if self.ordered:
            names = "order select mate chance cross mutate extinct fresh"
            keys = [*jax.random.split(key, 8 + m)]
        else:
            select, crossing, *later = jax.random.split(key, 5 + m)
            keys = [select, *jax.random.split(crossing, 4), *later]
        return dict(zip(names.split(), keys, strict=False)), keys[8:]

    def _crossed(
        self, parent: Int[Array, " n"], elites: int, *, key: PRNGKeyArray
    ) -> Bool[Array, " n"]:
        """Which offspring have an elite as a second parent."""
        if elites == 0 or isinstance(self.crossover, NoCrossover):
            return jnp.zeros(parent.shape, bool)
        chosen = jax.random.bernoulli(key, self.crossover_probability, parent.shape)
        return chosen | (repeated(parent) & self.cross_repeated)

    def _unchanged(self, parent: Int[Array, " n"], elite: bool) -> Descent:
        return Descent.unchanged(parent, elite, 1 + len(self.mating))


def _mated(
    each: Callable[..., Rows], operator: AbstractCrossover, rows: Rows, *, key: PRNGKeyArray
) -> tuple[Rows, Int[Array, " n"], Float[Array, " n"]]:
    """Every member crossed with a random other one, which one that is, and the share from it."""
    next_key, cross_key = jax.random.split(key)
    n = tree.size(rows)
    mate = (jnp.arange(n) + jax.random.randint(next_key, (n,), 1, max(n, 2))) % n
    mates = tree.take(rows, mate)
    children = each(operator, rows, mates, key=cross_key)
    return children, mate, _taken(children, mates, rows)


def _taken(children: Rows, mates: Rows, others: Rows) -> Float[Array, " n"]:
    """The share of each child's weights that are its mate's, of those in which its parents
    differ."""
    c, m, o = (rows[0] for rows in (children, mates, others))
    differ = m != o
    count = jnp.sum(differ, axis=1, dtype=jnp.float32)
    return jnp.sum(differ & (c == m), axis=1, dtype=jnp.float32) / jnp.maximum(count, 1.0)


def draw(network: AbstractNetwork, sizes: tuple[int, ...], n: int, *, key: PRNGKeyArray) -> PyTree:
    """A population of `n` fresh policies for a task of these `sizes` (`env.sizes`)."""
    keys = jax.random.split(key, n)
    return eqx.filter_vmap(lambda key: network.init(*sizes, key=key))(keys)


def evolving(breeder: Breeder, settings: dict[str, Any]) -> dict[str, Any]:
    """An algorithm's settings, of which those that are fields of a breeder are put into one: for
    `mutation=…` a `breeder=…`. Presets take both."""
    settings = {"breeder": breeder} | settings
    own = {f.name: settings.pop(f.name) for f in fields(Breeder) if f.name in settings}
    return settings | {"breeder": replace(settings["breeder"], **own)}
