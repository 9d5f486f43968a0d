"""Resource managers: which learner of a portfolio gets how many rollout workers.

Source: Khadka (2019), section 6.2, equation 6.1 and Algorithm 10; `Progress` is learning within the
manager, named as future work in section 6.4.
"""

import abc
from dataclasses import replace
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .. import require
from ..compilation import jit


class Ledger(eqx.Module):
    """What is known about each of `q` learners."""

    value: Float[Array, " q"]  # running mean v of its returns
    square: Float[Array, " q"]  # running mean of their squares
    count: Int[Array, " q"]  # returns so far, y; their sum is H
    known: Bool[Array, " q"]  # whether any of them was a number
    before: Float[Array, " q"] | None = None  # a slower running mean; 0 unless a manager keeps it

    @classmethod
    def empty(cls, q: int) -> "Ledger":
        none = jnp.zeros(q)
        return cls(none, none, none.astype(jnp.int32), none.astype(bool), none)

    @property
    def comparable(self) -> Float[Array, " q"]:
        """Values; of a learner without one, the least of the others."""
        least = jnp.min(jnp.where(self.known, self.value, jnp.inf))
        return jnp.where(self.known, self.value, jnp.where(jnp.isfinite(least), least, 0.0))


class AbstractManager(eqx.Module):
    """Allocates workers by the returns learners had. The published rule and its rivals."""

    memory: eqx.AbstractVar[float]  # α: weight of the newest return, in (0, 1]

    def __check_init__(self):
        if isinstance(self.memory, int | float) and not 0.0 < self.memory <= 1.0:
            raise ValueError(f"memory is {self.memory}: it must lie in (0, 1]")

    @jit
    def observe(self, ledger: Ledger, i: int, returns: Array, played: Array) -> Ledger:
        """With learner `i`'s new returns, one after the other: v ← α·return + (1-α)·v. The first
        return of all is v; as printed v would start at 0 and be wrong for long.

        **Arguments:** `returns` `[n]`, of which those count that were `played`.
        """

        def one(ledger, new):
            value, counts = new
            # A learner that returned NaN has had its turn, but no value that could be compared.
            good = jnp.isfinite(value)
            value = jnp.where(good, value, 0.0)
            α = jnp.where(ledger.known[i], self.memory, 1.0) * good.astype(jnp.float32)
            mean = α * value + (1.0 - α) * ledger.value[i]
            square = α * value**2 + (1.0 - α) * ledger.square[i]
            means = (ledger.value.at[i].set(mean), ledger.square.at[i].set(square))
            known = ledger.known.at[i].set(ledger.known[i] | good)
            after = Ledger(*means, ledger.count.at[i].add(1), known, ledger.before)
            return jax.tree.map(lambda a, b: jnp.where(counts, a, b), after, ledger), None

        return jax.lax.scan(one, ledger, (returns, played))[0]

    @abc.abstractmethod
    def allocate(self, ledger: Ledger, workers: int, *, key: PRNGKeyArray) -> Int[Array, " b"]:
        """The learner of each worker."""


class UCB(AbstractManager):
    """Upper confidence bounds (equation 6.1), normalised to chances that workers are drawn from."""

    exploration: float = 0.9  # c: weight of the bonus for learners that played little, ≥ 0
    memory: float = 0.2  # α: weight of the newest return, in (0, 1]; the author's

    def __check_init__(self):
        require.at_least("exploration", self.exploration, 0)

    def allocate(self, ledger, workers, *, key):
        bounds = self.bounds(ledger)
        chance = bounds / jnp.sum(bounds)
        return jax.random.choice(key, ledger.value.shape[0], (workers,), p=chance)

    def bounds(self, ledger: Ledger) -> Float[Array, " q"]:
        """U_i = v̂_i + c √(ln H / y_i), v̂ the values normalised to [0, 1). A learner that was never
        tried counts as tried once."""
        above = ledger.comparable - jnp.min(ledger.comparable)
        # The author's 0.1 keeps equal values from a division by 0.
        value = above / (jnp.sum(above) + 0.1)
        total = jnp.maximum(jnp.sum(ledger.count), 1).astype(jnp.float32)
        tried = jnp.maximum(ledger.count, 1).astype(jnp.float32)
        # A least share, so that c = 0 and equal values still are a distribution.
        return value + self.exploration * jnp.sqrt(jnp.log(total) / tried) + 1e-6


class Uniform(AbstractManager):
    """The same chance for every learner: what a manager is measured against."""

    memory: float = 0.2  # α: weight of the newest return, in (0, 1]; for metrics alone

    def allocate(self, ledger, workers, *, key):
        return jax.random.randint(key, (workers,), 0, ledger.value.shape[0])


class Thompson(AbstractManager):
    """Each worker goes to the learner with the highest return imagined: a draw from the normal
    distribution of its mean (Thompson 1933)."""

    memory: float = 0.2  # α: weight of the newest return, in (0, 1]

    def allocate(self, ledger, workers, *, key):
        variance = jnp.maximum(ledger.square - ledger.value**2, 0.0)
        # A running mean with weight α rests on (2 - α)/α returns, at most.
        most = (2.0 - self.memory) / self.memory
        rests_on = jnp.clip(ledger.count.astype(jnp.float32), 1.0, most)
        spread = jnp.sqrt(variance / rests_on) + 1e-3 * (1.0 + jnp.abs(ledger.value))
        drawn = jax.random.normal(key, (workers, ledger.value.shape[0]))
        imagined = ledger.comparable[None] + spread[None] * drawn
        # Nothing is known of a learner that never played: it is the next to.
        return jnp.argmax(jnp.where(ledger.count[None] == 0, jnp.inf, imagined), axis=1)


class Progress(AbstractManager):
    """Workers by learning progress: the part of each learner is in proportion to the change of its
    returns, whichever learner has the highest.

    Progress is the difference of two running means, a fast and a slow one, of which the slow one
    lies about 1/`slow` returns back: how steeply a learner's returns rise, in units of the reward.
    Graves et al. (2017), "Automated curriculum learning for neural networks", section 3, pay a
    bandit by learning progress. Departures: their gain is that of the loss on one sample, rescaled
    by its quantiles, and the bandit is Exp3.S; here returns of one task are compared, which have
    one scale, and chances follow progress itself. Noise in the returns of a learner that stands
    still counts as progress too: of both means the noisier learner has the larger difference.
    """

    kind: Literal["rise", "change"] = eqx.field(static=True, default="rise")
    """Whether progress is a rise of returns alone, or any change: a learner that gets worse is then
    given as many frames as one that gets better."""
    exploration: float = 0.2  # share of chances that all learners have alike, in [0, 1]
    slow: float = 0.05  # weight of the newest return in the slow mean, in (0, memory)
    memory: float = 0.2  # α: weight of the newest return in the fast mean, in (0, 1]

    def __check_init__(self):
        require.literals(self)
        require.within("exploration", self.exploration, 0, 1)
        floats = isinstance(self.slow, int | float) and isinstance(self.memory, int | float)
        floats = floats and self.memory > 0.0  # else it is said what is wrong with the memory
        if floats and not 0.0 < self.slow < self.memory:
            raise ValueError(
                f"slow is {self.slow}: it must lie above 0 and below memory, {self.memory}"
            )

    @jit
    def observe(self, ledger, i, returns, played):
        """And the slow mean, likewise."""

        def one(loop, new):
            slow, known = loop
            counts = new[1] & jnp.isfinite(new[0])
            weight = jnp.where(known, self.slow, 1.0)
            mean = weight * new[0] + (1.0 - weight) * slow
            return (jnp.where(counts, mean, slow), known | counts), None

        assert ledger.before is not None
        (slow, _), _ = jax.lax.scan(one, (ledger.before[i], ledger.known[i]), (returns, played))
        after = AbstractManager.observe(self, ledger, i, returns, played)
        return replace(after, before=ledger.before.at[i].set(slow))

    def allocate(self, ledger, workers, *, key):
        return jax.random.choice(key, ledger.value.shape[0], (workers,), p=self.chances(ledger))

    def chances(self, ledger: Ledger) -> Float[Array, " q"]:
        """Of each learner to get a worker. One that never played counts as the one with the most
        progress."""
        assert ledger.before is not None
        rise = ledger.value - ledger.before
        progress = jnp.maximum(rise, 0.0) if self.kind == "rise" else jnp.abs(rise)
        progress = jnp.where(ledger.known, progress, jnp.max(progress)) + 1e-6
        even = self.exploration / progress.shape[0]
        return even + (1.0 - self.exploration) * progress / jnp.sum(progress)


def even(workers: int, q: int) -> Int[Array, " b"]:
    """Workers in turn, as at the start: learner i mod q."""
    return jnp.arange(workers) % q
