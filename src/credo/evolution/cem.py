"""CEM: the cross-entropy method as a breeder, a distribution in place of parents and offspring.

Source: Pourchot & Sigaud (2019), "CEM-RL: combining evolutionary and gradient-based methods for
policy search", section 4.1. A population is a sample of a normal distribution with a diagonal
covariance. Its best half makes the next distribution,

    μ' = Σ λ_i z_i,   Σ' = Σ λ_i (z_i - μ)² + ε,   λ_i ∝ log((1 + K) / i),

with z_i the i-th best of K parents, weighted as in CMA-ES (Hansen 2016), and noise ε that decays
from generation to generation. The deviations are taken from the old mean, so that a move of the
mean widens the distribution along it.

Departures: actors of learners, and members that a critic's gradient has moved, count as members of
the sample like all others. A run's champion is the fittest member of a generation, not the mean.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .. import require, tree
from .breeder import AbstractBreeder
from .descent import Descent
from .selection import ranking


class Distribution(eqx.Module):
    """What is remembered of the distribution that a population was drawn from."""

    mean: Float[Array, " weights"]  # μ
    noise: Float[Array, ""]  # ε, that the next variances get


class CEM(AbstractBreeder):
    """Draw the next population from a normal distribution around the weighted mean of the best."""

    parents: float = eqx.field(static=True, default=0.5)
    """Share of the population, the best, that makes the next distribution, in (0, 1]; rounded down,
    two members at least."""
    start_variance: float = 1e-3
    """Variance of every weight in the first population, and at first the noise ε that is added to
    all later ones, ≥ 0."""
    least_noise: float = 1e-5  # what the noise decays to, a variance, ≥ 0
    decay: float = 0.95  # share of the noise that is left after each generation, in [0, 1]

    def __check_init__(self):
        require.within("parents", self.parents, 0, 1, without=0)
        require.within("decay", self.decay, 0, 1)
        for name in ("start_variance", "least_noise"):
            require.at_least(name, getattr(self, name), 0)

    def check(self, population, network, least=1, learners=0):
        require.at_least("population_size", population, max(2, 1 + learners))
        if self.count(population) < 2:
            raise ValueError(
                f"parents is {self.parents} of {population} members: that must be two at least, "
                f"give {2 / population:g} or more, or a larger population"
            )

    def elites(self, population):
        """None: every member is drawn anew."""
        return 0

    def count(self, population: int) -> int:
        """K: number of parents among `population` members."""
        return int(self.parents * population)

    def first(self, population, *, key):
        """The first member is the mean."""
        (rows, rest), _, unpack = tree.packed(population)
        noise = jnp.float32(self.start_variance)
        drawn = _drawn(rows[0], jnp.full_like(rows[0], noise), len(rows), key=key)
        return unpack((drawn, rest)), Distribution(rows[0], noise)

    def next(self, memory, population, fitness, draw, *, key):
        (rows, rest), _, unpack = tree.packed(population)
        best = ranking(fitness)[: self.count(len(rows))]
        weight = weights(len(best))
        away = rows[best] - memory.mean[None]
        mean = memory.mean + weight @ away
        drawn = _drawn(mean, weight @ jnp.square(away) + memory.noise, len(rows), key=key)
        parent = jnp.full(len(rows), best[0])
        parts = jnp.zeros_like(rows, shape=(len(rows), len(rows))).at[:, best].set(weight[None])
        descent = eqx.tree_at(
            lambda d: d.parts, Descent.unchanged(parent, False, 0), parts, is_leaf=_none
        )
        noise = self.decay * memory.noise + (1.0 - self.decay) * self.least_noise
        return unpack((drawn, tree.take(rest, parent))), descent, Distribution(mean, noise)

    def warm(self, memory, population, policy):
        """The same sample around the policy."""
        (rows, rest), _, unpack = tree.packed(population)
        (row, _), _, _ = tree.packed(tree.single(policy))
        moved = rows + (row - memory.mean[None])
        return unpack((moved, rest)), Distribution(row[0], memory.noise)


def weights(n: int) -> Float[Array, " n"]:
    """λ: of the best of `n` parents to the last one; their sum is 1."""
    rank = jnp.arange(1, n + 1, dtype=jnp.float32)
    weight = jnp.log((1.0 + n) / rank)
    return weight / jnp.sum(weight)


def _drawn(mean: Array, variance: Array, n: int, *, key) -> Float[Array, "n weights"]:
    noise = jax.random.normal(key, (n, *mean.shape))
    return mean[None] + jnp.sqrt(variance)[None] * noise


def _none(x: PyTree) -> bool:
    return x is None
