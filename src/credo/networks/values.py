"""What a critic says of the return: its mean, or its distribution.

A critic has some outputs, the *atoms*, for each state and action. Its config holds one of these
objects, which says how atoms become a value, what a learner's target makes of the target critics'
atoms, and how far atoms are from that target.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import require

Atoms = Float[Array, "atoms *batch"]


class AbstractValues(eqx.Module):
    """How a critic's atoms stand for the return."""

    atoms: eqx.AbstractVar[int]  # outputs of a critic

    @abc.abstractmethod
    def mean(self, atoms: Atoms) -> Float[Array, "*batch"]:
        """The expected return."""

    @abc.abstractmethod
    def cautious(self, atoms: Float[Array, "critics atoms *batch"]) -> Atoms:
        """What all target critics together say of the next state, less what they overestimate: a
        sample of returns, which reward and discount may change."""

    @abc.abstractmethod
    def error(self, atoms: Atoms, target: Float[Array, "samples *batch"]) -> Float[Array, "*batch"]:
        """How far a critic is from a sample of returns."""


class Mean(AbstractValues):
    """The expected return alone; of several critics the least (Fujimoto et al. 2018)."""

    atoms: ClassVar[int] = 1  # pyright: ignore[reportIncompatibleVariableOverride]

    def mean(self, atoms):
        return atoms[0]

    def cautious(self, atoms):
        return jnp.min(atoms, axis=0)

    def error(self, atoms, target):
        return jnp.square(atoms - target)[0]


class Quantiles(AbstractValues):
    """Quantiles of the return, of which targets leave out the largest: truncated quantile critics
    (Kuznetsov et al. 2020, "Controlling Overestimation Bias", equations 9 to 12)."""

    atoms: int = eqx.field(static=True, default=25)  # quantiles of each critic, at least 1
    dropped: int = eqx.field(static=True, default=2)
    """Quantiles per critic that targets leave out, the largest of all critics together, from 0 to
    below `atoms`."""

    def __check_init__(self):
        require.at_least("atoms", self.atoms, 1)
        if not 0 <= self.dropped < self.atoms:
            raise ValueError(f"dropped is {self.dropped}: it must lie in [0, {self.atoms - 1}]")

    def mean(self, atoms):
        return jnp.mean(atoms, axis=0)

    def cautious(self, atoms):
        together = jnp.sort(atoms.reshape(-1, *atoms.shape[2:]), axis=0)
        return together[: len(together) - self.dropped * atoms.shape[0]]

    def error(self, atoms, target):
        """Quantile regression with Huber's loss: its threshold is 1."""
        level = (jnp.arange(self.atoms, dtype=jnp.float32) + 0.5) / self.atoms
        level = level.reshape(-1, *(1,) * target.ndim)
        away = target[None] - atoms[:, None]
        size = jnp.abs(away)
        huber = jnp.where(size > 1.0, size - 0.5, 0.5 * jnp.square(away))
        weight = jnp.abs(level - (away < 0.0).astype(jnp.float32))
        return jnp.sum(jnp.mean(weight * huber, axis=1), axis=0)


class Histogram(AbstractValues):
    """Chances of returns in equal bins, by cross-entropy with a narrow Gaussian around the target:
    HL-Gauss (Farebrother et al. 2024, "Stop Regressing", section 3.1); of several critics the
    least. Returns outside the bins count as their ends: let the learner scale its rewards."""

    atoms: int = eqx.field(static=True, default=101)  # bins, at least 2
    limit: float = eqx.field(static=True, default=3.0)
    """Bins cover [-limit, limit], above 0, in units of scaled returns."""
    blur: float = eqx.field(static=True, default=0.75)
    """Standard deviation of the Gaussian, above 0, in bins."""

    def __check_init__(self):
        require.at_least("atoms", self.atoms, 2)
        for name in ("limit", "blur"):
            require.above(name, getattr(self, name), 0)

    @property
    def width(self) -> float:
        """Of a bin."""
        return 2.0 * self.limit / self.atoms

    def mean(self, atoms):
        centers = self.width * (jnp.arange(self.atoms, dtype=jnp.float32) - 0.5 * (self.atoms - 1))
        return jnp.tensordot(centers, jax.nn.softmax(atoms, axis=0), 1)

    def cautious(self, atoms):
        return jnp.min(jax.vmap(self.mean)(atoms), axis=0)[None]

    def error(self, atoms, target):
        edges = self.width * (jnp.arange(self.atoms + 1, dtype=jnp.float32) - 0.5 * self.atoms)
        edges = edges.reshape(-1, *(1,) * (target.ndim - 1))
        inside = jnp.clip(target, -self.limit, self.limit)
        below = jax.scipy.special.ndtr((edges - inside) / (self.blur * self.width))
        chances = (below[1:] - below[:-1]) / (below[-1:] - below[:1])
        return -jnp.sum(chances * jax.nn.log_softmax(atoms, axis=0), axis=0)
