"""Selection: who is a parent. It sees fitness alone and returns indices, so it never needs to
know what a genome is."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .. import require


def rankable(fitness: Float[Array, " pop"]) -> Float[Array, " pop"]:
    """Fitness with NaN as -inf: `argmax` and `argsort` would let NaN win."""
    return jnp.where(jnp.isnan(fitness), -jnp.inf, fitness)


def ranking(fitness: Float[Array, " pop"]) -> Int[Array, " pop"]:
    """Indices from best to worst; of equals the earlier one first."""
    return jnp.argsort(-rankable(fitness), stable=True)


class AbstractSelection(eqx.Module):
    sees_fitness: ClassVar[bool] = True  # False: elites are drawn at random too

    @abc.abstractmethod
    def __call__(
        self, fitness: Float[Array, " pop"], n: int, *, key: PRNGKeyArray
    ) -> Int[Array, " n"]:
        """Indices of `n` parents; fitness is maximised."""


class Tournament(AbstractSelection):
    """The best of `size` members drawn with replacement, `n` times."""

    size: int = eqx.field(static=True, default=3)  # members per tournament, ≥ 1

    def __check_init__(self):
        require.at_least("size", self.size, 1)

    def __call__(self, fitness, n, *, key):
        fitness = rankable(fitness)
        entrants = jax.random.randint(key, (n, self.size), 0, fitness.shape[0])
        winners = jnp.argmax(fitness[entrants], axis=1)
        return jnp.take_along_axis(entrants, winners[:, None], axis=1)[:, 0]


class Truncation(AbstractSelection):
    """Uniformly one of the best `fraction` of the population, `n` times."""

    fraction: float = eqx.field(static=True, default=0.2)  # best share, in (0, 1]

    def __check_init__(self):
        if not 0.0 < self.fraction <= 1.0:
            raise ValueError(f"fraction is {self.fraction}: it must lie in (0, 1]")

    def __call__(self, fitness, n, *, key):
        best = ranking(fitness)[: max(1, round(self.fraction * fitness.shape[0]))]
        return best[jax.random.randint(key, (n,), 0, best.shape[0])]


class Uniform(AbstractSelection):
    """Any member, `n` times: fitness is not looked at. What selection is measured against."""

    sees_fitness: ClassVar[bool] = False

    def __call__(self, fitness, n, *, key):
        return jax.random.randint(key, (n,), 0, fitness.shape[0])


def repeated(index: Int[Array, " n"]) -> Bool[Array, " n"]:
    """Which entries occurred before in `index`."""
    same = index[:, None] == index[None, :]
    return jnp.any(same & jnp.tri(index.shape[0], k=-1, dtype=bool), axis=1)
