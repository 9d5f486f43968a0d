"""Lineage: which operator made each member of a population, how much of it goes back to a learner,
and what became of the learners' actors."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .. import tree
from ..evolution.descent import Descent
from ..types import Metrics

DRAWN, MUTATED, CROSSED, CROSSED_AND_MUTATED, INJECTED = range(5)  # of two the sum is both
SAMPLED, COACHED = 5, 6
MAKERS = ("drawn", "mutation", "crossover", "crossover and mutation", "learner")
MAKERS = (*MAKERS, "distribution", "gradient steps")


class Lineage(eqx.Module):
    """Of each member of a population, beside `q` learners."""

    maker: Int[Array, " pop"]  # index into `MAKERS`: the last operator that changed it
    share: Float[Array, "pop 1+q"]
    """Share of its weights that go back to the first draw and to each learner's actor, mutated
    since or not; after a crossover expected, as if the parents' shares lay everywhere alike."""
    guest: Int[Array, " pop"]  # learner whose actor was put here and not evaluated yet, else -1
    earned: Float[Array, " pop"]  # sum of its fitness over the generations that it lived through
    times: Float[Array, " pop"]  # number of these generations

    @classmethod
    def first(cls, pop: int, q: int) -> "Lineage":
        """Of a population that was just drawn."""
        share = jnp.zeros((pop, 1 + q)).at[:, 0].set(1.0)
        nowhere, none = jnp.full(pop, -1, jnp.int32), jnp.zeros(pop)
        return cls(jnp.full(pop, DRAWN, jnp.int32), share, nowhere, none, none)

    def averaged(self, fitness: Float[Array, " pop"]) -> tuple["Lineage", Float[Array, " pop"]]:
        """With one more fitness of every member; and the mean of all fitness that each had and of
        one that is the population's mean, which halves the luck of a first evaluation."""
        earned, times = self.earned + fitness, self.times + 1.0
        after = Lineage(self.maker, self.share, self.guest, earned, times)
        return after, (earned + jnp.nanmean(fitness)) / (times + 1.0)

    def after(self, descent: Descent) -> "Lineage":
        """Of the next population."""
        parent, elite, before = descent.parent, descent.elite, self.share
        share = before[parent] if descent.parts is None else descent.parts @ before
        for mate, taken in zip(descent.mate.T, descent.taken.T[..., None], strict=True):
            share = (1.0 - taken) * share + taken * before[mate]
            before = share  # later mates are members of the new population
        mutated, crossed = (x.astype(jnp.int32) for x in (descent.mutated, descent.crossed))
        made = MUTATED * mutated + CROSSED * crossed
        made = jnp.where(made > 0, made, self.maker[parent] if descent.parts is None else SAMPLED)
        lived = (jnp.where(elite, x[parent], 0.0) for x in (self.earned, self.times))
        bred = Lineage(made, share, jnp.full_like(self.guest, -1), *lived)
        drawn = Lineage.first(len(parent), share.shape[1] - 1)
        return jax.vmap(tree.where)(parent < 0, drawn, bred)

    def inject(self, slot: int, learner: int) -> "Lineage":
        """With a learner's actor in a slot."""
        own = jnp.eye(self.share.shape[1])[1 + learner]
        parts = (jnp.int32(INJECTED), own, jnp.int32(learner), jnp.zeros(()), jnp.zeros(()))
        return tree.put(self, slot, Lineage(*parts))

    def coached(self, members: Int[Array, " n"], done: Bool[Array, ""]) -> "Lineage":
        """If it is `done`, with members that were moved by a critic's gradient. Their weights stay
        those of their parents, as after a mutation."""
        made = jnp.where(done, COACHED, self.maker[members])
        return replace(self, maker=self.maker.at[members].set(made))

    def report(self, champion: Int[Array, ""], descent: Descent) -> Metrics:
        """What made the champion, how much of it is each learner's, and each learner's fates."""
        metrics, fates = {"champion_maker": self.maker[champion]}, self.fates(descent)
        for i in range(self.share.shape[1] - 1):
            metrics[f"champion_share_{i}"] = self.share[champion, 1 + i]
            metrics |= {f"{fate}_{i}": count[i] for fate, count in fates.items()}
        return metrics

    def fates(self, descent: Descent) -> dict[str, Int[Array, " q"]]:
        """How many of each learner's guests became elite, were selected as a parent, or neither
        (Table 5.2)."""
        heirs = jnp.arange(self.guest.shape[0])[:, None] == descent.parent[None]
        heirs = heirs if descent.parts is None else descent.parts.T > 0.0
        elite = jnp.any(heirs & descent.elite[None], axis=1)
        selected = jnp.any(heirs, axis=1) & ~elite
        mine = self.guest[:, None] == jnp.arange(self.share.shape[1] - 1)[None]
        fates = {"elite": elite, "selected": selected, "discarded": ~elite & ~selected}
        count = partial(jnp.sum, axis=0, dtype=jnp.int32)
        return {name: count(mine & which[:, None]) for name, which in fates.items()}
