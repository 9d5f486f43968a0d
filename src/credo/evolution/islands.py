"""Islands: parts of a population that breed apart."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .. import require, tree
from .selection import rankable


class Islands(eqx.Module):
    """Several lineages in the room of one: members of an island are selected and crossed among
    themselves, and now and then the island whose best member is the worst is settled anew.

    The island model (Whitley, Rana & Heckendorn 1999) without migration. It is for tasks on which
    a population soon agrees on one solution, and no mutation of that one is better: fresh members
    beside elites die out, on an island of their own they have time. 1/`renewal` generations on
    average: it is mostly the newest island that is the weakest. That of the best member stays.
    """

    number: int = eqx.field(static=True, default=4)  # of one size; must divide the population
    renewal: float = 0.002  # chance per generation that the weakest is settled anew, in [0, 1]

    def __check_init__(self):
        if not isinstance(self.number, int):
            raise TypeError(f"number is {self.number!r}: give how many islands, as in Islands(4)")
        require.at_least("number", self.number, 2)
        require.within("renewal", self.renewal, 0, 1)

    def size(self, population: int) -> int:
        """Members of an island."""
        if population % self.number or population < 2 * self.number:
            raise ValueError(
                f"{self.number} islands for a population of {population}: it must be a multiple "
                "of their number, two members an island at least"
            )
        return population // self.number

    def __call__(
        self,
        breed: Callable[..., PyTree],
        fresh: Callable[[], PyTree],
        population: PyTree,
        fitness: Float[Array, " pop"],
        *,
        key: PRNGKeyArray,
    ) -> PyTree:
        """The next population.

        **Arguments:** `breed(island, fitness, key=)` makes the next generation of an island;
        `fresh` a new island, and is asked when one dies alone (under `vmap`, as in CCEA, always).
        """
        event_key, *keys = jax.random.split(key, 1 + self.number)
        fitness = rankable(fitness).reshape(self.number, -1)
        arrays, rest = eqx.partition(population, eqx.is_array)
        arrays = jax.tree.map(lambda x: x.reshape(*fitness.shape, *x.shape[1:]), arrays)

        def one(arrays, fitness, key):
            bred = breed(eqx.combine(arrays, rest), fitness, key=key)
            return eqx.filter(bred, eqx.is_array)

        bred = jax.vmap(one)(arrays, fitness, jnp.stack(keys))
        best = jnp.max(fitness, axis=1)
        weakest = jnp.argmin(best.at[jnp.argmax(best)].set(jnp.inf))

        def renewed():
            return tree.put(bred, weakest, eqx.filter(fresh(), eqx.is_array))

        event = jax.random.bernoulli(event_key, jnp.float32(self.renewal))
        bred = jax.lax.cond(event, renewed, lambda: bred)
        bred = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), bred)
        return eqx.combine(bred, rest)
