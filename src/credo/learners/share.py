"""Who gets the frames: what part of a hybrid's experience its learners collect, and what part its
population.

A generation of the population has a fixed number of episodes. The learners then play and learn, one
round of episodes after the other, until they have had their share of all frames. At a large share
that is most of a generation, so it ends early where a run's budget does: `until`.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .. import require


class AbstractShare(eqx.Module):
    """The learners' share of all frames, from generation to generation."""

    until: eqx.AbstractVar[float | None]
    """Frames of the run after which a generation has one round of the learners; None: none. It must
    be a field: a run puts its budget here where that is less."""

    @property
    @abc.abstractmethod
    def most(self) -> float:
        """No share is larger, below 1."""

    @abc.abstractmethod
    def first(self) -> float:
        """The share in the first generation."""

    @abc.abstractmethod
    def after(
        self,
        share: Float[Array, ""],
        fitness: Float[Array, " pop"],
        guests: Bool[Array, " pop"],
        bred: Bool[Array, " pop"],
    ) -> Float[Array, ""]:
        """The next share, once a population has a `fitness` (of numbers) in which `guests` are
        actors of learners that joined it just before. `bred`: what evolution has drawn or changed;
        the others are actors of learners as they once joined, or were moved by a critic."""


class Fixed(AbstractShare):
    """The same share in every generation."""

    learners: float = eqx.field(static=True, default=0.5)  # of all frames, in [0, 1)
    until: float | None = None  # frames of the run after which learners play one round; None: none

    def __check_init__(self):
        require.within("learners", self.learners, 0, 0.99)
        require.at_least("until", self.until, 0)

    @property
    def most(self) -> float:
        return self.learners

    def first(self) -> float:
        return self.learners

    def after(self, share, fitness, guests, bred):
        return share


class Earned(AbstractShare):
    """As many frames as the learners' actors have earned: their share tends to the most as long as
    no member that evolution has made is better than the best of those that just joined, and
    halves, down to the least, with each that is. An actor of an earlier generation that was not
    changed since is still the learners' work."""

    least: float = eqx.field(static=True, default=0.1)  # no share is smaller, in [0, most]
    most: float = eqx.field(static=True, default=0.9)  # no share is larger, in [least, 1)
    memory: float = 0.5  # weight of the newest generation, in (0, 1]
    until: float | None = None  # frames of the run after which learners play one round; None: none

    def __check_init__(self):
        require.within("most", self.most, 0, 0.99)
        require.within("least", self.least, 0, self.most)
        require.within("memory", self.memory, 0, 1, without=0)
        require.at_least("until", self.until, 0)

    def first(self) -> float:
        return 0.5 * (self.least + self.most)

    def after(self, share, fitness, guests, bred):
        best = jnp.max(fitness, initial=-jnp.inf, where=guests)
        better = jnp.sum((fitness > best) & bred)
        aim = self.least + (self.most - self.least) * jnp.exp2(-better.astype(jnp.float32))
        told = jnp.any(guests) & jnp.any(fitness > -jnp.inf)
        return jnp.where(told, share + self.memory * (aim - share), share)
