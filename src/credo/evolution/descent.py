"""Descent: which members of a population the next one was bred from."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class Descent(eqx.Module):
    """Where each member of a new population comes from.

    A member starts as a copy of its `parent` and is crossed `c` times: first with a member of the
    old population, then with other members of the new one.
    """

    parent: Int[Array, " pop"]  # index into the old population; -1: the member was newly drawn
    elite: Bool[Array, " pop"]  # the copy was kept unchanged
    crossed: Bool[Array, " pop"]  # it was crossed at least once
    mutated: Bool[Array, " pop"]  # mutation changed at least one weight
    mate: Int[Array, "pop c"]  # the other parent of each crossover
    taken: Float[Array, "pop c"]
    """The share of weights that came from that mate, in [0, 1], among those in which the two
    parents differed; 0 without a crossover."""
    parts: Float[Array, "pop old"] | None = None
    """Of members drawn from a distribution: the weight in its mean of each old member, of which
    `parent` is the heaviest. None: they come from parents and mates."""

    @classmethod
    def unchanged(cls, parent: Int[Array, " pop"], elite: bool, crossings: int) -> "Descent":
        """Of copies that are not changed, or, with parent -1, of members that are newly drawn."""
        no, none = jnp.zeros(len(parent), bool), jnp.zeros((len(parent), crossings))
        return cls(parent, no | elite, no, no, none.astype(jnp.int32), none)

    def shifted(self, by: Int[Array, " pop"]) -> "Descent":
        """With indices counted from a start that lies `by` members earlier."""
        parent = jnp.where(self.parent < 0, self.parent, self.parent + by)
        return replace(self, parent=parent, mate=self.mate + by[:, None])

    def crossed_with(self, mate: Int[Array, " pop"], taken: Float[Array, " pop"]) -> "Descent":
        """After one more crossover, from which each member has the share `taken` of its mate."""
        mates = jnp.concatenate([self.mate, mate[:, None]], axis=1)
        shares = jnp.concatenate([self.taken, taken[:, None]], axis=1)
        return replace(self, crossed=self.crossed | (taken > 0.0), mate=mates, taken=shares)
