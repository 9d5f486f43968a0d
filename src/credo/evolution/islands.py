"""Islands: parts of a population that breed apart."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .. import require, tree
from .selection import rankable


class Islands(eqx.Module):
    """Several lineages in the room of one: members of an island are selected and crossed among
    themselves, and now and then the island whose best member is the worst is re-initialised.

    The island model (Whitley, Rana & Heckendorn 1999) without migration. It is for tasks on which
    a population soon agrees on one solution, and no mutation of that one is better: fresh members
    beside elites die out, on an island of their own they have time. 1/`renewal` generations on
    average: it is mostly the newest island that is the weakest. That of the best member stays.
    """

    number: int = eqx.field(static=True, default=4)  # islands of one size, ≥ 2
    renewal: float = 0.002
    """Chance per generation that the weakest island is re-initialised, in [0, 1]."""

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
        self, breed: Callable[..., PyTree], fresh: Callable[[], PyTree], population, fitness, *, key
    ) -> PyTree:
        """The next population.

        **Arguments:** `breed(island, fitness, key=)` makes the next generation of an island;
        `fresh()` a new one, and is called only if one dies (under `vmap`, as in CCEA, always).
        `population` `[pop, ...]`, `fitness` `[pop]`.
        """
        event_key, *keys = jax.random.split(key, 1 + self.number)
        fitness = rankable(fitness).reshape(self.number, -1)
        arrays, rest = eqx.partition(population, eqx.is_array)
        arrays = jax.tree.map(lambda x: x.reshape(*fitness.shape, *x.shape[1:]), arrays)
        bred = eqx.filter_vmap(lambda x, f, key: breed(eqx.combine(x, rest), f, key=key))(
            arrays, fitness, jnp.stack(keys)
        )
        best = jnp.max(fitness, axis=1)
        weakest = jnp.argmin(best.at[jnp.argmax(best)].set(jnp.inf))
        bred, rest = eqx.partition(bred, eqx.is_array)

        def renewed():
            return tree.put(bred, weakest, eqx.filter(fresh(), eqx.is_array))

        event = jax.random.bernoulli(event_key, jnp.float32(self.renewal))
        bred = jax.lax.cond(event, renewed, lambda: bred)
        return eqx.combine(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), bred), rest)
