"""Extinction: now and then most of a population dies out and is seeded anew."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray, PyTree

from .. import require, tree


class Extinction(eqx.Module):
    """With `probability` per generation each member is replaced by a fresh one with chance
    `magnitude` (Khadka 2019, Algorithms 4 and 5)."""

    probability: float = 0.004  # chance of an extinction per generation, in [0, 1]
    magnitude: float = 0.5  # chance that a member then dies, in [0, 1]

    def __check_init__(self):
        require.within("probability", self.probability, 0, 1)
        require.within("magnitude", self.magnitude, 0, 1)

    def __call__(
        self, population: PyTree, fresh: Callable[[], PyTree], *, key: PRNGKeyArray
    ) -> PyTree:
        """**Arguments:** `population` `[pop, ...]`; spare the elites by not passing them. `fresh`
        makes another one like it, and is asked when there is an event alone (under `vmap`
        always)."""
        event_key, member_key = jax.random.split(key)
        event = jax.random.bernoulli(event_key, jnp.float32(self.probability))
        dies = jax.random.bernoulli(
            member_key, jnp.float32(self.magnitude), (tree.size(population),)
        )
        arrays, rest = eqx.partition(population, eqx.is_array)

        def seeded():
            return eqx.filter(eqx.filter_vmap(tree.where)(dies, fresh(), population), eqx.is_array)

        return eqx.combine(jax.lax.cond(event, seeded, lambda: arrays), rest)
