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
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .. import require, tree
from ..compilation import float32, jit
from ..environments.base import AbstractSequenceTask
from ..environments.sequence_classification import SequenceClassification
from ..evolution.agents import AgentCrossover
from ..evolution.crossover import AbstractCrossover, MaskedCrossover, NoCrossover, OnePointCrossover
from ..evolution.curriculum import Curriculum
from ..evolution.extinction import Extinction
from ..evolution.mutation import AbstractMutation, MatrixMutation
from ..evolution.parsimony import Parsimony
from ..evolution.selection import AbstractSelection, Tournament, rankable, ranking, repeated
from ..networks.base import AbstractNetwork
from ..networks.dmmu import DMMU
from ..networks.mmu import MMU
from ..networks.team import Team
from ..normalization import Moments, behind, frozen, play
from ..rollout import Environment, evaluate
from ..types import Evaluation, Metrics


def author_mutation(**fields: Any) -> MatrixMutation:
    """The author's of 2017, with some fields changed."""
    coded: dict[str, Any] = {"gate": "genome", "fraction": 0.2, "up_to_fraction": True}
    coded |= {"strength": 0.2, "super_probability": 0.05, "limit": 1e12}
    return MatrixMutation(**coded | fields)


def _names(signals: str | tuple[str, ...]) -> tuple[str, ...]:
    return (signals,) if isinstance(signals, str) else tuple(signals)


def _apart(network: AbstractNetwork) -> bool:
    """Whether each agent has weights of its own."""
    return isinstance(network, DMMU) or (isinstance(network, Team) and network.sharing == "nothing")


class NeuroevolutionState(eqx.Module):
    population: PyTree  # leaves [pop, ...]; bred, not yet evaluated
    champion: PyTree  # the best of the generation before
    record: Float[Array, " pop"]  # running mean of a member's fitness in earlier generations
    age: Int[Array, " pop"]  # how many generations that mean counts for; 0: bred just now
    level: Int[Array, ""]  # of the curriculum
    moments: Moments | None  # of what was seen; None: observations are as they are


class Neuroevolution(eqx.Module):
    """Evolve a population of `network` policies on `env`."""

    env: Environment
    network: AbstractNetwork
    population_size: int = eqx.field(static=True, default=100)  # k
    elite_fraction: float = eqx.field(static=True, default=0.1)  # ψ
    episodes: int = eqx.field(static=True, default=10)  # per fitness, the same for all members
    test_episodes: int = eqx.field(static=True, default=50)  # fresh ones, for the champion
    selection: AbstractSelection = Tournament()
    mutation: AbstractMutation = MatrixMutation()
    crossover: AbstractCrossover = MaskedCrossover()  # with an elite
    crossover_probability: float = 0.0  # chance that an offspring has a second parent, an elite
    cross_repeated: bool = eqx.field(static=True, default=False)
    """Cross every parent that selection drew before, so that no two offspring are clones."""
    mating: tuple[AbstractCrossover, ...] = ()
    """Operators that cross each offspring with another one, in turn, after mutation: Algorithm 5,
    lines 15-23."""
    extinction: Extinction = Extinction(probability=0.0)
    elite_memory: int = eqx.field(static=True, default=1)
    """How many generations of an elite are averaged; from then on the newest counts one such
    part. 1: the last generation alone. A curriculum's earlier levels stay in the record."""
    curriculum: Curriculum | None = None  # None: the whole task from the start
    parsimony: Parsimony | None = None  # bonus for simple genomes, times their score
    fitness: tuple[str, ...] = eqx.field(static=True, default=(), converter=_names)
    """Reward signals whose sum is the fitness; none: the task's first."""
    score: str | None = eqx.field(static=True, default=None)  # signal; None: the task's last
    normalize_observations: bool = eqx.field(static=True, default=False)
    """The population sees observations by the running mean and variance of all that was seen; the
    champion keeps them. A generation's observations are recorded for it."""

    def __check_init__(self):
        for name, minimum in (
            ("population_size", 2),
            ("episodes", 1),
            ("test_episodes", 1),
            ("elite_memory", 1),
        ):
            require.at_least(name, getattr(self, name), minimum)
        require.fits(self.env, self.network)
        require.within("elite_fraction", self.elite_fraction, 0, 1)
        require.within("crossover_probability", self.crossover_probability, 0, 1)
        if self.elites >= self.population_size:
            raise ValueError(
                f"elite_fraction is {self.elite_fraction}: no room is left for offspring; lower it"
            )
        if isinstance(self.crossover, NoCrossover) and self.cross_repeated:
            raise ValueError(
                "crossover is NoCrossover and cross_repeated is set: nobody would be crossed; give "
                "crossover=MaskedCrossover(), or leave cross_repeated out"
            )
        if any(isinstance(x, AgentCrossover) for x in self.mating) and not _apart(self.network):
            raise ValueError(
                f"mating has AgentCrossover, and agents of {type(self.network).__name__} have no "
                "weights of their own: give DMMU or Team(sharing='nothing'), or leave it out"
            )
        for name in (*self.fitness, self.score):
            if name is not None and name not in self.env.signals:
                raise ValueError(
                    f"no reward signal {name!r}: this task has {', '.join(self.env.signals)}"
                )

    @classmethod
    def as_coded(cls, env: Environment, network: AbstractNetwork, **overrides) -> Self:
        """The author's program of 2017: one gate per genome, up to 20 % of each matrix hit with
        20 % noise, 5 % of the hits super, repeated survivors replaced by row crossover."""
        return cls(
            env, network, **{"mutation": author_mutation(), "cross_repeated": True} | overrides
        )

    @classmethod
    def ours(cls, env: Environment, network: AbstractNetwork, **overrides) -> Self:
        """The best settings found, with their ablation in docs/neuroevolution.md: the author's
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
        return cls.as_coded(env, network, **settings | overrides)

    @classmethod
    def dmmu(cls, env: Environment, network: AbstractNetwork, **overrides) -> Self:
        """Algorithm 5 with the settings of section 4.2.1: for teams on the server fleet. Where
        agents share weights they do not change places."""
        mating: tuple[AbstractCrossover, ...] = (OnePointCrossover(),)
        if _apart(network):
            mating = (*mating, AgentCrossover())
        settings: dict[str, Any] = {"elite_fraction": 0.04, "test_episodes": 10}
        settings["mutation"] = MatrixMutation(one_in=10)  # a fleet has 100,000 weights
        settings |= {"crossover": NoCrossover(), "mating": mating, "extinction": Extinction()}
        return cls(env, network, **settings | overrides)

    @classmethod
    def presets(cls) -> dict[str, Callable[..., Self]]:
        """Settings by name, for the command line."""
        return {
            "as-written": cls,
            "as-coded": cls.as_coded,
            "ours": cls.ours,
            "dmmu": cls.dmmu,
        }

    @property
    def elites(self) -> int:
        """e = int(ψ·k)"""
        return int(self.elite_fraction * self.population_size)

    def new_population(self, size: int | None = None, *, key: PRNGKeyArray) -> PyTree:
        """`size` members instead of `population_size`."""
        return eqx.filter_vmap(lambda key: self.network.init(*self.env.sizes, key=key))(
            jax.random.split(key, self.population_size if size is None else size)
        )

    @float32()
    def init(self, *, key: PRNGKeyArray) -> NeuroevolutionState:
        # 1: Initialize a population of k neural networks.
        population = self.new_population(key=key)
        k = self.population_size
        level = jnp.int32(self.curriculum.start if self.curriculum else 0)
        moments = Moments.first(self.env, self.network) if self.normalize_observations else None
        champion = frozen(moments, tree.take(population, 0))
        record, age = jnp.zeros(k), jnp.zeros(k, jnp.int32)
        return NeuroevolutionState(population, champion, record, age, level, moments)

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
        fitness, returns = assess(self, state, evaluation)

        # 6-12: rank; keep the elites; select, and mutate the selected.
        order = ranking(fitness)
        bred = breed(self, population, fitness, key=breed_key)
        record, age = remember(self, state, fitness, order)

        # The network with the highest fitness is tested on fresh episodes of the whole task.
        champion = behind(state.moments, tree.take(population, order[:1]))
        test = evaluate(self.env, champion, self.test_episodes, key=test_key)
        score = self.score or self.env.reported
        metrics = {
            "fitness_max": jnp.max(rankable(fitness)),
            "fitness_mean": jnp.nanmean(returns),
            "fitness_nan": jnp.sum(jnp.isnan(returns)),
            "champion_score": jnp.mean(test.of(score)),
            "frames": jnp.sum(evaluation.steps),
        }
        level = state.level
        if self.curriculum:
            metrics["level"] = level
            level = self.curriculum.next(level, jnp.mean(evaluation.of(score)[order[0]]))
        champion = tree.take(champion, 0)
        return NeuroevolutionState(bred, champion, record, age, level, moments), metrics


@jit
def assess(
    algorithm: Neuroevolution, state: NeuroevolutionState, evaluation: Evaluation
) -> tuple[Float[Array, " pop"], Float[Array, " pop"]]:
    """Fitness, with earlier generations of an elite mixed in; and that of this one alone."""
    signals = algorithm.fitness or algorithm.env.signals[:1]
    total = jnp.stack([evaluation.of(name) for name in signals]).sum(axis=0)
    returns = jnp.mean(total, axis=1)
    if algorithm.parsimony:
        score = evaluation.of(algorithm.score or algorithm.env.reported)
        returns = returns + algorithm.parsimony(state.population) * jnp.mean(score, axis=1)
    age = state.age.astype(jnp.float32)
    mixed = (state.record * age + returns) / (age + 1.0)
    # A member without a record must not meet one that is NaN or infinite.
    return jnp.where(state.age > 0, mixed, returns), returns


@jit
def remember(
    algorithm: Neuroevolution,
    state: NeuroevolutionState,
    fitness: Float[Array, " pop"],
    order: Int[Array, " pop"],
) -> tuple[Float[Array, " pop"], Int[Array, " pop"]]:
    """Record and age of the next population: the elites', then none."""
    elite = jnp.arange(algorithm.population_size) < algorithm.elites
    age = jnp.minimum(state.age[order] + 1, algorithm.elite_memory - 1)
    return jnp.where(elite, fitness[order], 0.0), jnp.where(elite, age, 0)


@jit
def breed(
    algorithm: Neuroevolution,
    population: PyTree,
    fitness: Float[Array, " pop"],
    *,
    key: PRNGKeyArray,
) -> PyTree:
    """The next population: elites first, best to worst, then the offspring. It is as large as this
    one, which may be a part of the algorithm's."""
    select_key, cross_key, mutate_key, extinct_key, fresh_key, *mate_keys = jax.random.split(
        key, 5 + len(algorithm.mating)
    )
    k = tree.size(population)
    e = int(algorithm.elite_fraction * k)
    n = k - e
    pack, unpack = tree.packing(population)
    rows = eqx.filter_vmap(pack)(population)

    def each(operator, *parents: PyTree, key: PRNGKeyArray) -> PyTree:
        """What an operator makes of each of the parents."""

        def one(given):
            key, *genomes = given
            return pack(operator(*map(unpack, genomes), key=key))

        return tree.in_batches(jax.vmap(one), (jax.random.split(key, n), *parents))

    # 6-7: Rank the population; select the first e as elites.
    elites = tree.take(rows, ranking(fitness)[:e])
    # 8: Select (k - e) networks, to form set S.
    selected = algorithm.selection(fitness, n, key=select_key)
    offspring = tree.take(rows, selected)
    offspring = recombine(algorithm, each, elites, offspring, repeated(selected), key=cross_key)
    # 9-12: for each network in S, mutate its matrices.
    offspring = each(algorithm.mutation, offspring, key=mutate_key)
    # Algorithm 5, 15-23: cross it with another one of S.
    for operator, mate_key in zip(algorithm.mating, mate_keys, strict=True):
        next_key, cross_key = jax.random.split(mate_key)
        further = jax.random.randint(next_key, (n,), 1, max(n, 2))
        mates = tree.take(offspring, (jnp.arange(n) + further) % n)
        offspring = each(operator, offspring, mates, key=cross_key)

    def fresh():
        made = algorithm.new_population(k, key=fresh_key)
        return eqx.filter_vmap(pack)(tree.take(made, jnp.arange(n)))

    offspring = algorithm.extinction(offspring, fresh, key=extinct_key)
    return eqx.filter_vmap(unpack)(tree.concat(elites, offspring))


def recombine(
    algorithm: Neuroevolution,
    each: Callable[..., PyTree],
    elites: PyTree,
    offspring: PyTree,
    repeat: Bool[Array, " n"],
    *,
    key: PRNGKeyArray,
) -> PyTree:
    """Give some offspring a random elite as the first parent."""
    chance_key, mate_key, cross_key = jax.random.split(key, 3)
    n, e = tree.size(offspring), tree.size(elites)
    if e == 0 or isinstance(algorithm.crossover, NoCrossover):
        return offspring
    mates = tree.take(elites, jax.random.randint(mate_key, (n,), 0, e))
    children = each(algorithm.crossover, mates, offspring, key=cross_key)
    crossed = jax.random.bernoulli(chance_key, algorithm.crossover_probability, (n,))
    crossed = crossed | (repeat & algorithm.cross_repeated)
    return eqx.filter_vmap(tree.where)(crossed, children, offspring)
