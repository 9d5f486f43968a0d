"""Fitness: the reward that an algorithm maximises, and a bonus for simple networks."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .. import require, tree
from ..compilation import when
from ..networks.base import AbstractPolicy
from ..rollout import Environment, score


def objective(env: Environment, named: str | None = None) -> str:
    """The reward that is maximised: the one that is named, or else the task's first. All algorithms
    keep this rule; a learner that names no reward maximises that of its algorithm.

    **Raises:** `ValueError` if the task has no such reward.
    """
    require.signal(named, env.signals)
    return named or env.signals[0]


def retested(env, champion: AbstractPolicy, episodes: int, due, before, *, key) -> Array:
    """The champion's mean return on fresh episodes if a test is `due`, else the score from
    `before`. No decision of a generation may depend on it (see `rollout.score`)."""
    return when(due, lambda: score(env, champion, episodes, before=before, key=key), lambda: before)


class Parsimony(eqx.Module):
    """A bonus for simple networks: the share of a genome's weights that are exactly 0 or ±`limit`.

    A mutation that erases weights (`reset_std=0`) and clips them (`limit`) makes such genomes. They
    generalise beyond the training length: a gate that ignores memory does so however much has been
    counted, and two weights at the limit are equal to the last bit.
    """

    weight: float = 0.3
    """Fitness added for a genome of such weights alone on a solved task, at least 0, in units of
    the reward."""
    limit: float = 40.0  # magnitude at which the mutation clips weights, at least 0

    def __check_init__(self):
        require.at_least("weight", self.weight, 0)
        require.at_least("limit", self.limit, 0)

    def __call__(self, population: PyTree) -> Float[Array, " pop"]:
        """The bonus of each member on a solved task."""

        def share(genome: PyTree) -> Float[Array, ""]:
            w, _, _ = tree.ravel(genome)
            return jnp.mean(((w == 0.0) | (jnp.abs(w) == self.limit)).astype(jnp.float32))

        return self.weight * eqx.filter_vmap(share)(population)
