"""Breeding: which members stay, which have offspring, and how offspring are changed.

Neuroevolution, CCEA, ERL, CERL and MERL each hold one breeder: mostly a `Breeder`, a genetic
algorithm, of which they differ in the fields. `evolution/cem.py` has another one.
"""

import abc
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

Key = PRNGKeyArray
Fitness = Float[Array, " pop"]
Draw = Callable[..., Any]  # (n, key=key) -> n fresh members
Rows = PyTree  # a population as few arrays, see `tree.packed`
Each = Callable[..., Rows]  # (operator, *parents, key=key) -> children, all of them packed


Bred = tuple[PyTree, Descent]


class AbstractBreeder(eqx.Module):
    """Makes each population from the one before it and its fitness. What it has to know beside
    these, its memory, is part of a run's state: any pytree of arrays, None if there is nothing."""

    @abc.abstractmethod
    def check(self, population: int, network: AbstractNetwork, least: int = 1, learners: int = 0):
        """Raise `ValueError` unless this breeds `population` members with `least` elites or more,
        and leaves a slot to the actor of each of some learners."""

    @abc.abstractmethod
    def elites(self, population: int) -> int:
        """Number of elites among `population` members."""

    @abc.abstractmethod
    def first(self, population: PyTree, *, key: Key) -> tuple[PyTree, PyTree]:
        """The first population, out of one that was newly drawn, and the memory."""

    @abc.abstractmethod
    def next(
        self, memory: PyTree, population: PyTree, fitness: Fitness, draw: Draw, *, key: Key
    ) -> tuple[PyTree, Descent, PyTree]:
        """The next population, of the same size, where each member comes from, and the memory.

        **Arguments:** `fitness` is maximised; NaN ranks last. `draw(n, key=key)` makes `n` fresh
        members.
        """

    @abc.abstractmethod
    def warm(self, memory: PyTree, population: PyTree, policy: PyTree) -> tuple[PyTree, PyTree]:
        """A first population and the memory that go on from a saved policy."""


class Breeder(AbstractBreeder):
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
        require.within("elite_fraction", self.elite_fraction, 0, 1, without=1)
        require.within("crossover_probability", self.crossover_probability, 0, 1)
        if isinstance(self.crossover, NoCrossover) and self.cross_repeated:
            raise ValueError(
                "crossover is NoCrossover and cross_repeated is set: nothing would be crossed; "
                "give crossover=MaskedCrossover(), or leave cross_repeated out"
            )
        if not isinstance(self.islands, Islands | None):
            raise TypeError(f"islands is {self.islands!r}: give Islands(number=4), or None")

    def check(self, population, network, least=1, learners=0):
        require.at_least("population_size", population, 2)
        size = self.islands.size(population) if self.islands else population
        of = "members of an island" if self.islands else "members"
        require.room(self.elite_fraction, size, learners, of, least)
        if any(isinstance(x, AgentCrossover) for x in self.mating) and not apart(network):
            raise ValueError(
                f"mating has AgentCrossover, and agents of {type(network).__name__} have no "
                "weights of their own: give DMMU or Team(sharing='nothing'), or leave it out"
            )

    def elites(self, population):
        """Those of all islands."""
        n = self.islands.number if self.islands else 1
        return n * int(self.elite_fraction * (population // n))

    def first(self, population, *, key):
        return population, None

    def warm(self, memory, population, policy):
        return tree.put(population, 0, policy), None

    def next(self, memory, population, fitness, draw, *, key):
        """It remembers nothing. Fresh members are for extinctions and new islands. Call it inside a
        `jit`, which leaves out what nothing reads of the descent."""
        rows, each, unpack = tree.packed(population)
        breed = partial(self._breed_apart, self.islands) if self.islands else self._breed
        rows, descent = breed(rows, each, partial(self._fresh, draw), fitness, key=key)
        return unpack(rows), descent, None

    def _breed(self, rows: Rows, each: Each, fresh: Draw, fitness: Fitness, *, key: Key) -> Bred:
        """The next generation of a population that is not in islands."""
        k = fitness.shape[0]
        n = k - (e := int(self.elite_fraction * k))
        keys = self._keys(key)
        # Rank the population, keep the elites, select the parents of the others.
        order = ranking(fitness)
        if not self.selection.sees_fitness:
            order = jax.random.permutation(keys["order"], k)
        parent = self.selection(fitness, n, key=keys["select"])
        if self.ordered:
            parent = parent[jnp.argsort(jnp.argsort(order)[parent], stable=True)]
        # Cross some offspring with an elite; mutate all.
        mate = order[jax.random.randint(keys["mate"], (n,), 0, max(e, 1))]
        crossed = self._crossed(parent, e, key=keys["chance"])
        first, second = tree.take(rows, mate), tree.take(rows, parent)
        children = each(self.crossover, first, second, key=keys["cross"])
        offspring = jax.vmap(tree.where)(crossed, children, second)
        mutants = each(self.mutation, offspring, key=keys["mutate"])
        changed = jnp.any(mutants[0] != offspring[0], axis=1)
        taken = _taken(offspring, first, second)[:, None]
        descent = Descent(parent, jnp.zeros(n, bool), crossed, changed, mate[:, None], taken)
        # Cross all with each other; now and then some die.
        if self.mating:
            mutants, descent = self._mated(mutants, each, descent, e, keys["mating"])
        if self.extinction is not None:
            anew = partial(fresh, n, key=keys["fresh"])
            mutants, descent = self.extinction((mutants, descent), anew, key=keys["extinct"])
        elites = tree.take(rows, order[:e]), self._unchanged(order[:e], True)
        return tree.concat(elites, (mutants, descent))

    def _breed_apart(
        self, islands: Islands, rows: Rows, each: Each, fresh: Draw, fitness: Fitness, *, key: Key
    ) -> Bred:
        """The next generation of each island; the descent has indices of the whole population."""
        breed_key, fresh_key = jax.random.split(key)
        k = fitness.shape[0]
        size = islands.size(k)

        def breed(rows: Rows, fitness: Fitness, *, key: Key) -> Bred:
            return self._breed(rows, each, fresh, fitness, key=key)

        anew = partial(fresh, size, key=fresh_key)
        rows, descent = islands(breed, anew, rows, fitness, key=breed_key)
        return rows, descent.shifted(jnp.arange(k) // size * size)

    def _mated(self, rows: Rows, each: Each, descent: Descent, elites: int, keys) -> Bred:
        """Every offspring crossed with a random other one, by each operator of `mating`."""
        n = tree.size(rows)
        for operator, mate_key in zip(self.mating, keys, strict=True):
            next_key, cross_key = jax.random.split(mate_key)
            mate = (jnp.arange(n) + jax.random.randint(next_key, (n,), 1, max(n, 2))) % n
            mates = tree.take(rows, mate)
            children = each(operator, rows, mates, key=cross_key)
            descent = descent.crossed_with(elites + mate, _taken(children, mates, rows))
            rows = children
        return rows, descent

    def _fresh(self, draw: Draw, n: int, *, key: Key) -> Bred:
        """Members that are newly drawn."""
        return tree.packed(draw(n, key=key))[0], self._unchanged(jnp.full(n, -1), False)

    def _keys(self, key: Key) -> dict[str, Any]:
        """A key by use; of `mating` one for each operator. Their order depends on `ordered`: there
        were two programs once, and seeds keep giving the runs that they gave."""
        names, m = "select chance mate cross order mutate extinct fresh", len(self.mating)
        if self.ordered:
            names = "order select mate chance cross mutate extinct fresh"
            keys = [*jax.random.split(key, 8 + m)]
        else:
            select, crossing, *later = jax.random.split(key, 5 + m)
            keys = [select, *jax.random.split(crossing, 4), *later]
        return dict(zip([*names.split(), "mating"], [*keys[:8], keys[8:]], strict=True))

    def _crossed(self, parent: Int[Array, " n"], elites: int, *, key: Key) -> Bool[Array, " n"]:
        """Which offspring have an elite as a second parent."""
        if elites == 0 or isinstance(self.crossover, NoCrossover):
            return jnp.zeros(parent.shape, bool)
        chosen = jax.random.bernoulli(key, self.crossover_probability, parent.shape)
        return chosen | (repeated(parent) & self.cross_repeated)

    def _unchanged(self, parent: Int[Array, " n"], elite: bool) -> Descent:
        return Descent.unchanged(parent, elite, 1 + len(self.mating))


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


def evolving(
    breeder: AbstractBreeder, settings: dict[str, Any], overrides: Any = None
) -> dict[str, Any]:
    """An algorithm's settings, of which those that are fields of a breeder are put into one: for
    `mutation=…` a `breeder=…`. Presets take both.

    **Raises:** `ValueError` if a given breeder is no `Breeder` and has no such fields.
    """
    settings = overridden(settings, overrides or {})
    own = {name: value for name, value in settings.items() if name in FIELDS}
    rest = {name: value for name, value in settings.items() if name not in FIELDS}
    given = rest.get("breeder", breeder)
    if not isinstance(given, Breeder) and own:
        raise ValueError(
            f"{type(given).__name__} has no {', '.join(own)}: leave that out, or breed by Breeder()"
        )
    return rest | {"breeder": replace(given, **own)}


def overridden(settings: dict[str, Any], overrides: dict[str, Any]) -> dict[str, Any]:
    """A preset's settings and what overrides them: a whole `breeder` all that are fields of one."""
    if "breeder" in overrides:
        settings = {name: value for name, value in settings.items() if name not in FIELDS}
    return settings | overrides


def altered(algorithm: Any, **changes: Any) -> Any:
    """An algorithm with other settings, of which those that are fields of its breeder change the
    breeder."""
    return replace(algorithm, **evolving(algorithm.breeder, changes))


FIELDS = frozenset(field.name for field in fields(Breeder))
