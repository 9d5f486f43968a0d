"""Lineage: where each member of a population comes from, and what became of injected ones."""

from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

DRAWN, MUTATED, CROSSED, CROSSED_AND_MUTATED, INJECTED = range(5)  # of two the sum is both
MAKERS = ("drawn", "mutation", "crossover", "crossover and mutation", "learner")


class Lineage(eqx.Module):
    """Of each member of a population, beside `q` learners."""

    maker: Int[Array, " pop"]  # index into `MAKERS`: the last that changed it
    share: Float[Array, "pop 1+q"]
    """Share of its weights that go back to the first draw and to each learner's actor, mutated
    since or not; after a crossover expected, as if the parents' shares lay everywhere alike."""
    guest: Int[Array, " pop"]  # learner whose actor was put here and not evaluated yet, else -1
    earned: Float[Array, " pop"]  # sum of what it had in the generations that it lived through
    times: Float[Array, " pop"]  # how many these were

    @classmethod
    def first(cls, pop: int, q: int) -> "Lineage":
        share = jnp.zeros((pop, 1 + q)).at[:, 0].set(1.0)
        nobody, none = jnp.full(pop, -1, jnp.int32), jnp.zeros(pop)
        return cls(jnp.full(pop, DRAWN, jnp.int32), share, nobody, none, none)

    def judged(self, fitness: Float[Array, " pop"]) -> tuple["Lineage", Float[Array, " pop"]]:
        """With one more fitness of every member, and the mean of all that each had and of one that
        is the population's: who was lucky once is believed half."""
        earned, times = self.earned + fitness, self.times + 1.0
        after = Lineage(self.maker, self.share, self.guest, earned, times)
        return after, (earned + jnp.nanmean(fitness)) / (times + 1.0)

    def children(
        self,
        elites: Int[Array, " e"],
        parents: Int[Array, " n"],
        mates: Int[Array, " n"],
        crossed: Bool[Array, " n"],
        taken: Float[Array, " n"],
        mutated: Bool[Array, " n"],
    ) -> "Lineage":
        """Of the next population: elites as they are, then a child of each parent, which has the
        share `taken` of its weights from its mate if it was crossed."""
        from_mate = jnp.where(crossed, taken, 0.0)[:, None]
        share = (1.0 - from_mate) * self.share[parents] + from_mate * self.share[mates]
        made = MUTATED * mutated.astype(jnp.int32) + CROSSED * crossed.astype(jnp.int32)
        made = jnp.where(mutated | crossed, made, self.maker[parents])
        maker = jnp.concatenate([self.maker[elites], made])
        share = jnp.concatenate([self.share[elites], share])
        lived, e = (self.earned, self.times), len(elites)
        lived = (jnp.zeros_like(x).at[:e].set(x[elites]) for x in lived)
        return Lineage(maker, share, jnp.full_like(self.guest, -1), *lived)

    def inject(self, slot: int, learner: int) -> "Lineage":
        """With a learner's actor in a slot."""
        own = jnp.zeros(self.share.shape[1]).at[1 + learner].set(1.0)
        return Lineage(
            self.maker.at[slot].set(INJECTED),
            self.share.at[slot].set(own),
            self.guest.at[slot].set(learner),
            self.earned.at[slot].set(0.0),
            self.times.at[slot].set(0.0),
        )

    def fates(self, elites: Int[Array, " e"], parents: Int[Array, " n"]) -> dict[str, Array]:
        """How many of each learner's guests `[q]` became elite, were selected, or were neither
        (Table 5.2)."""
        members = jnp.arange(self.guest.shape[0])
        elite = jnp.any(members[:, None] == elites[None], axis=1)
        selected = jnp.any(members[:, None] == parents[None], axis=1) & ~elite
        learners = jnp.arange(self.share.shape[1] - 1)
        mine = self.guest[:, None] == learners[None]
        fates = {"elite": elite, "selected": selected, "discarded": ~elite & ~selected}
        count = partial(jnp.sum, axis=0, dtype=jnp.int32)
        return {name: count(mine & which[:, None]) for name, which in fates.items()}
