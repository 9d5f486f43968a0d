"""Neuroevolution: Khadka (2019), Algorithm 2; and Algorithm 5, the evolution of teams with a DMMU,
as its preset `dmmu`.

Departures from the printed boxes:

- The box leaves the mutation probability and the share of perturbed weights open; the defaults
  are 0.9 and 0.1, the values of the dissertation's later chapters.
- Crossover, extinction and a curriculum are fields that the box does not have; all are off by
  default. `as_coded` switches on what the author's program did.
- Elites are never mutated. The author's program mutated them and kept an untouched copy.
- Algorithm 5 draws a member of S for each operator k - e times; here every member of S is mutated
  once, and crossed once by each operator with a random other one as its mate.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from .. import require, tree
from ..compilation import float32, jit
from ..environments.base import AbstractSequenceTask
from ..environments.curriculum import Curriculum
from ..environments.sequence_classification import SequenceClassification
from ..evolution.agents import AgentCrossover, apart
from ..evolution.breeder import AbstractBreeder, Breeder, draw, evolving, overridden
from ..evolution.crossover import NoCrossover, OnePointCrossover
from ..evolution.extinction import Extinction
from ..evolution.mutation import MatrixMutation
from ..evolution.selection import rankable, ranking
from ..evolution.strategies import Strategy
from ..networks.base import AbstractNetwork
from ..networks.choosing import Choosing
from ..networks.mmu import MMU
from ..normalization import Moments, frozen, play
from ..rollout import Environment, score
from ..types import Evaluation, Metrics
from .fitness import Parsimony, objective
from .infomax import InfoMax


def author_mutation(**fields: Any) -> MatrixMutation:
    """The author's of 2017, with some fields changed."""
    coded: dict[str, Any] = {"gate": "genome", "fraction": 0.2, "up_to_fraction": True}
    coded |= {"strength": 0.2, "super_probability": 0.05, "limit": 1e12}
    return MatrixMutation(**coded | fields)


def _names(signals: str | tuple[str, ...]) -> tuple[str, ...]:
    return (signals,) if isinstance(signals, str) else tuple(signals)


Fitness = Float[Array, " pop"]


class NeuroevolutionState(eqx.Module):
    """What Neuroevolution knows between two generations."""

    population: PyTree  # leaves [pop, ...]; bred, not yet evaluated
    champion: PyTree  # the best of the generation before
    record: Fitness  # running mean of a member's fitness in earlier generations
    age: Int[Array, " pop"]  # how many generations that mean counts for; 0: bred just now
    level: Int[Array, ""]  # of the curriculum
    moments: Moments | None  # of all observations; None: they are not normalised
    breeding: PyTree = None  # what the breeder remembers
    generation: Int[Array, ""] | None = None  # how many there were; None: it does not matter


class Neuroevolution(eqx.Module):
    """Evolve a population of `network` policies on `env`."""

    env: Environment
    network: AbstractNetwork
    population_size: int = eqx.field(static=True, default=100)  # k: members, at least 2
    breeder: AbstractBreeder = Breeder()  # how the next population is made
    episodes: int = eqx.field(static=True, default=10)  # episodes per fitness value, ≥ 1
    test_episodes: int = eqx.field(static=True, default=50)  # episodes of a champion's test, ≥ 1
    elite_memory: int = eqx.field(static=True, default=1)
    """Generations over which an elite's fitness is averaged, ≥ 1; after so many the newest counts
    one such part. 1: the last generation alone."""
    curriculum: Curriculum | None = None  # a shorter task at first; None: all of it from the start
    infomax: InfoMax | None = None
    """In the first generations the fitness is what memory knows of the input; None: never."""
    parsimony: Parsimony | None = None  # bonus for simple networks, times their score; None: none
    fitness: tuple[str, ...] = eqx.field(static=True, default=(), converter=_names)
    """Names of the rewards whose sum is the fitness; none: the task's first."""
    score: str | None = eqx.field(static=True, default=None)
    """Name of the reward by which the champion is tested; None: the one that the task reports."""
    normalize_observations: bool = eqx.field(static=True, default=False)
    """Policies see observations normalised by the running mean and variance of all observations so
    far, which are recorded for it; the champion keeps them."""

    def __check_init__(self):
        for name in ("episodes", "test_episodes", "elite_memory"):
            require.at_least(name, getattr(self, name), 1)
        require.fits(self.env, self.network)
        self.breeder.check(self.population_size, self.network, least=0)
        for name in (*self.fitness, self.score):
            objective(self.env, name)
        if self.infomax:
            self.infomax.check(self.env, self.network, self.normalize_observations)
            if self.elite_memory > 1:
                raise ValueError(
                    f"elite_memory is {self.elite_memory} beside infomax, and bits are not "
                    "averaged with rewards: give elite_memory=1"
                )

    @classmethod
    def as_written(cls, env: Environment, network: AbstractNetwork, **overrides) -> Self:
        """Algorithm 2 as printed. `overrides`: fields of `Neuroevolution`, and of its breeder; this
        holds for all presets."""
        return cls(env, network, **evolving(Breeder(), overrides))

    @classmethod
    def as_coded(cls, env: Environment, network: AbstractNetwork, **overrides) -> Self:
        """The author's program of 2017: one gate per genome, up to 20 % of each matrix hit with
        20 % noise, 5 % of the hits super, repeated survivors replaced by row crossover."""
        breeder = Breeder(mutation=author_mutation(), cross_repeated=True)
        return cls(env, network, **evolving(breeder, overrides))

    @classmethod
    def ours(cls, env: Environment, network: AbstractNetwork, **overrides) -> Self:
        """The best settings found (ablation: docs/algorithms/neuroevolution.md): the author's
        operators with weights clipped to ±40 and a tenth of the hits erasing. On a sequence task
        also a curriculum, the share of right answers as fitness, and parsimony; on Sequence
        Classification the curriculum's signals persist. An MMU starts with saturated gates."""
        limit = 40.0
        mutation = author_mutation(limit=limit, reset_probability=0.1, reset_std=0.0)
        settings: dict[str, Any] = {"mutation": mutation}
        if isinstance(env, AbstractSequenceTask):
            persistent = isinstance(env, SequenceClassification)
            whole = replace(env, persistence=0.8) if persistent else None
            settings |= {
                "curriculum": Curriculum(whole=whole),
                "parsimony": Parsimony(limit=limit),
                "fitness": ("accuracy", "success"),
            }
        if isinstance(network, MMU):
            network = replace(network, start_weights="saturated")
        elif isinstance(network, Choosing) and isinstance(network.network, MMU):
            inner = replace(network.network, start_weights="saturated")
            network = replace(network, network=inner)
        return cls.as_coded(env, network, **overridden(settings, overrides))

    @classmethod
    def dmmu(cls, env: Environment, network: AbstractNetwork, **overrides) -> Self:
        """Algorithm 5 with the settings of section 4.2.1: for teams on the server fleet. Where
        agents share weights they do not change places."""
        breeder = Breeder(
            elite_fraction=0.04,
            mutation=MatrixMutation(one_in=10),  # a fleet has 100,000 weights
            crossover=NoCrossover(),
            mating=(OnePointCrossover(), *((AgentCrossover(),) if apart(network) else ())),
            extinction=Extinction(),
        )
        return cls(env, network, **evolving(breeder, {"test_episodes": 10}, overrides))

    @classmethod
    def es(cls, env: Environment, network: AbstractNetwork, **overrides) -> Self:
        """An evolution strategy in place of a genetic algorithm: `Strategy()`, CMA-ES, or any
        other `breeder`."""
        return cls(env, network, **evolving(Strategy(), overrides))

    @classmethod
    def presets(cls) -> dict[str, Callable[..., Self]]:
        """Settings by name, for the command line."""
        return {
            "as-written": cls.as_written,
            "as-coded": cls.as_coded,
            "ours": cls.ours,
            "dmmu": cls.dmmu,
        }

    @property
    def elites(self) -> int:
        """Members that are kept unchanged: e = int(ψ·k)."""
        return self.breeder.elites(self.population_size)

    @property
    def most_frames(self) -> int:
        """Frames of one generation, if every episode lasts until the time limit."""
        return self.population_size * self.episodes * self.env.max_steps

    @float32()
    def init(self, *, key: PRNGKeyArray) -> NeuroevolutionState:
        """1: Initialize a population of k neural networks."""
        k = self.population_size
        population = draw(self.network, self.env.sizes, k, key=key)
        population, breeding = self.breeder.first(population, key=jax.random.fold_in(key, k))
        level = jnp.int32(self.curriculum.start if self.curriculum else 0)
        moments = Moments.first(self.env, self.network) if self.normalize_observations else None
        champion = frozen(moments, tree.take(population, 0))
        record, age = jnp.zeros(k), jnp.zeros(k, jnp.int32)
        after = (population, champion, record, age, level, moments, breeding)
        return NeuroevolutionState(*after, jnp.int32(0) if self.infomax else None)

    @float32()
    def generation(
        self, state: NeuroevolutionState, *, key: PRNGKeyArray
    ) -> tuple[NeuroevolutionState, Metrics]:
        """Lines 3-12 of Algorithm 2, and the test of the champion that the text describes."""
        evaluate_key, breed_key, test_key = jax.random.split(key, 3)
        population = state.population
        env = self.curriculum.task(self.env, state.level) if self.curriculum else self.env

        # 4-5: for each network, compute fitness.
        evaluation, moments = play(env, population, self.episodes, state.moments, key=evaluate_key)
        frames = jnp.sum(evaluation.steps)
        fitness, returns = assess(self, state, evaluation)
        if self.infomax:  # at first for what its memory knows of the input
            given = (env, population, state.generation, fitness)
            fitness, more = self.infomax(*given, key=jax.random.fold_in(evaluate_key, 1))
            returns, frames = fitness, frames + more  # nothing of earlier ones is mixed in

        # 6-12: rank; keep the elites; select, and mutate the selected.
        order = ranking(fitness)
        bred, record, age, breeding = breed(self, state, fitness, key=breed_key)

        # The network with the highest fitness is tested on fresh episodes of the whole task.
        champion = frozen(state.moments, tree.take(population, order[0]))
        reward, tested = self.score or self.env.reported, {"before": jnp.nan, "key": test_key}
        metrics = {
            "fitness_max": jnp.max(rankable(fitness)),
            "fitness_mean": jnp.nanmean(returns),
            "fitness_nan": jnp.sum(jnp.isnan(returns)),
            "champion_score": score(self.env, champion, self.test_episodes, reward, **tested),
            "frames": frames,
        }
        level = state.level
        if self.curriculum:
            metrics["level"] = level
            later = self.curriculum.next(level, jnp.mean(evaluation.of(reward)[order[0]]))
            level = (
                later
                if self.infomax is None
                else self.infomax.after(state.generation, later, level)
            )
        elapsed = None if state.generation is None else state.generation + 1
        after = (bred, champion, record, age, level, moments, breeding, elapsed)
        return NeuroevolutionState(*after), metrics


@jit
def assess(
    algorithm: Neuroevolution, state: NeuroevolutionState, evaluation: Evaluation
) -> tuple[Fitness, Fitness]:
    """Fitness, with earlier generations of an elite mixed in; and that of this one alone."""
    rewards = algorithm.fitness or (objective(algorithm.env),)
    total = jnp.stack([evaluation.of(name) for name in rewards]).sum(axis=0)
    returns = jnp.mean(total, axis=1)
    if algorithm.parsimony:
        score = evaluation.of(algorithm.score or algorithm.env.reported)
        returns = returns + algorithm.parsimony(state.population) * jnp.mean(score, axis=1)
    age = state.age.astype(jnp.float32)
    mixed = (state.record * age + returns) / (age + 1.0)
    # A member without a record must not meet one that is NaN or infinite.
    return jnp.where(state.age > 0, mixed, returns), returns


@jit
def breed(
    algorithm: Neuroevolution, state: NeuroevolutionState, fitness: Fitness, *, key: PRNGKeyArray
) -> tuple[PyTree, Fitness, Int[Array, " pop"], PyTree]:
    """The next population; record and age of its elites, and none of its offspring; and what the
    breeder remembers."""
    fresh = partial(draw, algorithm.network, algorithm.env.sizes)
    given = (state.breeding, state.population, fitness, fresh)
    population, descent, breeding = algorithm.breeder.next(*given, key=key)
    age = jnp.minimum(state.age[descent.parent] + 1, algorithm.elite_memory - 1)
    record = jnp.where(descent.elite, fitness[descent.parent], 0.0)
    return population, record, jnp.where(descent.elite, age, 0), breeding
