"""Parsimony: of two networks that do the task equally well, the simpler one is fitter."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .. import require, tree


class Parsimony(eqx.Module):
    """The share of a genome's weights that are exactly 0 or ±`limit`.

    A mutation that erases (`reset_std=0`) and clips (`limit`) makes such weights. They matter
    beyond the training length: a gate that ignores memory stays as it is however much has been
    counted, and two weights at the limit are equal to the last bit.
    """

    weight: float = 0.3  # fitness for a genome of such weights alone, where the task is solved
    limit: float = 40.0  # the mutation's limit

    def __check_init__(self):
        require.at_least("weight", self.weight, 0)
        require.at_least("limit", self.limit, 0)

    def __call__(self, population: PyTree) -> Float[Array, " pop"]:
        def share(genome: PyTree) -> Float[Array, ""]:
            w, _, _ = tree.ravel(genome)
            return jnp.mean(((w == 0.0) | (jnp.abs(w) == self.limit)).astype(jnp.float32))

        return self.weight * eqx.filter_vmap(share)(population)
