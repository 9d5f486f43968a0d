"""NEAT, neuroevolution of augmenting topologies: Stanley & Miikkulainen (2002); with LSTM cells in
its networks NEAT-LSTM, Rawal & Miikkulainen (2016).

Departures from the paper:

- Fitness is a mean over episodes, fresh ones in every generation. The paper's tasks do not vary.
- Of each species the best fifth, and one more, can be parents (`survival`); the paper gives no
  number, and this is what the authors' program does.
- Crossover is followed by mutation, as in most of what that program does.
- The whole population is never cut down to its best two species, which the paper does after 20
  generations without a better fitness (`patience`): on XOR it then stayed where it stood.
- A mate from another species is the fittest of one drawn at random.
- What genomes, mutations and species depart in is said in `credo.evolution.genome`, `augment` and
  `species`.
"""

from collections.abc import Callable
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .. import require, tree
from ..compilation import float32, jit
from ..evolution import genome as genomes
from ..evolution.augment import Augmentation
from ..evolution.genome import Compatibility, Form, Innovations
from ..evolution.selection import rankable, ranking
from ..evolution.species import LEAST, Species, aged, seats, shared, speciate
from ..networks.base import AbstractPolicy
from ..networks.graph import Graph
from ..normalization import Moments, frozen, play
from ..rollout import Environment, score
from ..types import Metrics
from .fitness import objective
from .infomax import InfoMax

Fitness = Float[Array, " pop"]


class Phase(eqx.Module):
    """How far a run with Info-max is."""

    generation: Int[Array, ""]  # how many there were
    bits: Bool[Array, ""]  # whether the fitness of the last one was information


class NEATState(eqx.Module):
    """What NEAT knows between two generations."""

    population: PyTree  # genomes, leaves [pop, genes]; bred, not yet evaluated
    champion: AbstractPolicy  # the network of the best of the generation before
    species: Species
    innovations: Innovations
    best: Float[Array, ""]  # highest fitness so far
    waited: Int[Array, ""]  # generations since that was reached
    moments: Moments | None  # of all observations; None: they are not normalised
    phase: Phase | None = None  # of Info-max; None: there is none


class NEAT(eqx.Module):
    """Evolve weights and topology together, from networks without hidden units on."""

    env: Environment
    network: Graph = Graph()  # what genomes are expressed as
    population_size: int = eqx.field(static=True, default=150)  # genomes, at least 2
    connections: int = eqx.field(static=True, default=100)
    """Most connections that a genome can get beyond those of its inputs with its outputs, at
    least 2."""
    episodes: int = eqx.field(static=True, default=10)  # episodes per fitness value, ≥ 1
    test_episodes: int = eqx.field(static=True, default=50)  # episodes of a champion's test, ≥ 1
    compatibility: Compatibility = Compatibility()  # how far apart two genomes are
    threshold: float = 3.0  # δ: genomes of a species are nearer to its representative, above 0
    species: int = eqx.field(static=True, default=30)  # most species at once, at least 2
    survival: float = 0.2  # share of a species that can be parents, its best, in [0, 1]
    dropoff: int = eqx.field(static=True, default=15)
    """Generations without a better fitness after which a species does not reproduce, ≥ 1."""
    patience: int | None = eqx.field(static=True, default=None)
    """The same of the whole population, of which then only the best two species reproduce, ≥ 1; the
    paper's is 20. None: that never happens."""
    champions: int = eqx.field(static=True, default=5)
    """Members above which a species keeps its fittest unchanged, at least 0."""
    crossover: float = 0.75  # probability that an offspring has two parents, in [0, 1]
    elsewhere: float = 0.001  # probability that the second is of another species, in [0, 1]
    disabled: float = 0.75
    """Probability that a gene which is disabled in either parent is in the offspring, in [0, 1]."""
    mutation: Augmentation = Augmentation()  # how offspring are mutated
    infomax: InfoMax | None = None
    """In the first generations the fitness is what memory knows of the input; None: never."""
    fitness: str | None = eqx.field(static=True, default=None)
    """Name of the reward that is the fitness; None: the task's first."""
    score: str | None = eqx.field(static=True, default=None)
    """Name of the reward by which the champion is tested; None: the one that the task reports."""
    normalize_observations: bool = eqx.field(static=True, default=False)
    """Networks see observations normalised by the running mean and variance of all observations so
    far, which are recorded for it; the champion keeps them."""

    def __check_init__(self):
        if not isinstance(self.network, Graph):
            name = type(self.network).__name__
            raise ValueError(
                f"NEAT evolves the topology of a Graph, and {name} has one of its own: give "
                'network=Graph(), or Graph(cells="lstm")'
            )
        if self.env.agents is not None:
            raise ValueError(
                f"{type(self.env).__name__} has {self.env.agents} agents and NEAT evolves networks "
                "of one: train neuroevolution, ccea or merl"
            )
        for name in ("episodes", "test_episodes", "dropoff"):
            require.at_least(name, getattr(self, name), 1)
        require.at_least("patience", 1 if self.patience is None else self.patience, 1)
        for name in ("population_size", "connections", "species"):
            require.at_least(name, getattr(self, name), 2)
        require.at_least("champions", self.champions, 0)
        require.above("threshold", self.threshold, 0)
        for name in ("survival", "crossover", "elsewhere", "disabled"):
            require.within(name, getattr(self, name), 0, 1)
        for name in (self.fitness, self.score):
            objective(self.env, name)
        if self.infomax:
            self.infomax.check(self.env, self.network, self.normalize_observations)

    @classmethod
    def neat(cls, env: Environment, network: Graph | None = None, **overrides) -> Self:
        """The settings of the paper, section 4.1. `overrides`: fields of `NEAT`."""
        return cls(env, network or Graph(), **overrides)

    @classmethod
    def presets(cls) -> dict[str, Callable[..., Self]]:
        """Settings by name, for the command line."""
        return {"neat": cls.neat}

    @property
    def form(self) -> Form:
        """What all genomes have in common."""
        return Form.of(self.network, self.env.obs_size, self.env.action_size)

    @property
    def most_frames(self) -> int:
        """Frames of one generation, if every episode lasts until the time limit."""
        return self.population_size * self.episodes * self.env.max_steps

    @float32()
    def init(self, *, key: PRNGKeyArray) -> NEATState:
        """A population without hidden units."""
        return begin(self, key=key)

    @float32()
    def generation(self, state: NEATState, *, key: PRNGKeyArray) -> tuple[NEATState, Metrics]:
        """Evaluate all genomes, divide them into species, let these share the next population by
        their fitness, and breed it."""
        evaluate_key, breed_key, choose_key, test_key = jax.random.split(key, 4)

        # The network of each genome plays for its fitness.
        networks = expressed(self, state.population)
        given = (self.env, networks, self.episodes, state.moments)
        evaluation, moments = play(*given, key=evaluate_key)
        fitness = jnp.mean(evaluation.of(self.fitness or objective(self.env)), axis=1)
        frames = jnp.sum(evaluation.steps)
        if self.infomax:  # at first for what it knows of the input
            assert state.phase is not None
            given = (self.env, networks, state.phase.generation, fitness)
            fitness, more = self.infomax(*given, key=jax.random.fold_in(evaluate_key, 1))
            state, frames = refreshed(self, state), frames + more

        # Genomes join the species whose representative they are compatible with.
        member, species = divided(self, state, fitness)

        # Species share the offspring by their members' adjusted fitness; stagnant ones get none.
        offspring, species, best, waited = apportioned(self, state, species, member, fitness)

        # The best of each species mate and mutate; large ones keep their champion.
        bred, innovations = breed(self, state, member, fitness, offspring, key=breed_key)
        species = represented(species, state.population, member, key=choose_key)

        # The network with the highest fitness is tested on fresh episodes.
        champion = frozen(state.moments, tree.take(networks, ranking(fitness)[0]))
        reward, tested = self.score or self.env.reported, {"before": jnp.nan, "key": test_key}
        metrics = {
            "fitness_max": jnp.max(rankable(fitness)),
            "fitness_mean": jnp.nanmean(fitness),
            "fitness_nan": jnp.sum(jnp.isnan(fitness)),
            "champion_score": score(self.env, champion, self.test_episodes, reward, **tested),
            "frames": frames,
            **described(state.population, species),
        }
        after = (bred, champion, species, innovations, best, waited, moments, state.phase)
        return NEATState(*after), metrics


@jit
def begin(neat: NEAT, *, key: PRNGKeyArray) -> NEATState:
    """The first population, all of the same topology."""
    form, n = neat.form, neat.population_size
    first = jax.vmap(lambda key: genomes.first(form, neat.connections, key=key))
    population = first(jax.random.split(key, n))
    genome = tree.take(population, 0)
    moments = Moments.first(neat.env, neat.network) if neat.normalize_observations else None
    return NEATState(
        population=population,
        champion=frozen(moments, genomes.express(form, genome)),
        species=Species.none(genome, neat.species),
        innovations=Innovations(genome.count, jnp.int32(form.fixed)),
        best=jnp.float32(LEAST),
        waited=jnp.int32(0),
        moments=moments,
        phase=Phase(jnp.int32(0), jnp.bool_(True)) if neat.infomax else None,
    )


@jit
def refreshed(neat: NEAT, state: NEATState) -> NEATState:
    """The state of a population whose fitness may be of another kind than a generation before: then
    what was reached does not count, and nothing has waited yet."""
    assert neat.infomax is not None
    assert state.phase is not None
    bits = state.phase.generation < neat.infomax.generations
    new = bits != state.phase.bits
    reached = (state.species.best, state.species.waited, state.best, state.waited)
    kept = [jnp.where(new, start, x) for start, x in zip((LEAST, 0) * 2, reached, strict=True)]
    phase = Phase(state.phase.generation + 1, bits)
    return eqx.tree_at(
        lambda s: (s.species.best, s.species.waited, s.best, s.waited, s.phase),
        state,
        (*kept, phase),
    )


@jit
def expressed(neat: NEAT, population: PyTree) -> PyTree:
    """The networks of a population."""
    return jax.vmap(lambda genome: genomes.express(neat.form, genome))(population)


@jit
def divided(neat: NEAT, state: NEATState, fitness: Fitness) -> tuple[Int[Array, " pop"], Species]:
    """The species of each genome; and all species, older by a generation."""
    given = (neat.compatibility, neat.threshold, state.species, state.population)
    member, species = speciate(*given)
    return member, aged(species, member, rankable(fitness))


@jit
def apportioned(
    neat: NEAT,
    state: NEATState,
    species: Species,
    member: Int[Array, " pop"],
    fitness: Fitness,
) -> tuple[Int[Array, " species"], Species, Float[Array, ""], Int[Array, ""]]:
    """Offspring of each species, the species, and the best fitness and how long it has stood.

    If that is too long, all but the best two species end, and these get as long again.
    """
    fittest = jnp.maximum(jnp.max(rankable(fitness)), LEAST)
    waited = jnp.where(fittest > state.best, 0, state.waited + 1)
    refocus = jnp.bool_(False) if neat.patience is None else waited > neat.patience
    now = jnp.full(species.best.shape, -jnp.inf).at[member].max(rankable(fitness))
    rank = jnp.argsort(jnp.argsort(-jnp.where(species.alive, now, -jnp.inf)))
    allowed = jnp.where(refocus, rank < 2, (species.waited < neat.dropoff) | (rank == 0))
    share = shared(species, member, fitness, allowed & species.alive)
    rested = jnp.where(refocus, 0, species.waited)
    species = eqx.tree_at(lambda s: s.waited, species, rested)
    best = (jnp.maximum(fittest, state.best), jnp.where(refocus, 0, waited))
    return seats(share, neat.population_size), species, *best


@jit
def breed(
    neat: NEAT,
    state: NEATState,
    member: Int[Array, " pop"],
    fitness: Fitness,
    offspring: Int[Array, " species"],
    *,
    key: PRNGKeyArray,
) -> tuple[PyTree, Innovations]:
    """The next population, species by species, and the next innovation numbers."""
    pair_key, cross_key, mutate_key = jax.random.split(key, 3)
    mother, father, kept = parents(neat, member, fitness, offspring, key=pair_key)
    a, b = (tree.take(state.population, who) for who in (mother, father))
    finite = jnp.maximum(rankable(fitness), LEAST)
    lead = jnp.sign(finite[mother] - finite[father])
    keys = jax.random.split(cross_key, neat.population_size)
    born = jax.vmap(tree.where)(mother == father, a, crossed(neat, a, b, lead, keys))
    born, innovations = neat.mutation(neat.form, born, state.innovations, key=mutate_key)
    return jax.vmap(tree.where)(kept, a, born), innovations


def crossed(neat: NEAT, a: PyTree, b: PyTree, lead: Fitness, keys: PRNGKeyArray) -> PyTree:
    """A child of each pair of parents."""
    cross = jax.vmap(lambda a, b, x, k: genomes.cross(neat.form, a, b, x, neat.disabled, key=k))
    room = a.innovation.shape[1]

    def within(n: int) -> PyTree:
        children = cross(genomes.shortened(a, n), genomes.shortened(b, n), lead, keys)
        return genomes.lengthened(children, room)

    used = (jnp.sum(parent.used, axis=1, dtype=jnp.int32) for parent in (a, b))
    return genomes.by_length(jnp.max(sum(used)), room, within)


def parents(
    neat: NEAT,
    member: Int[Array, " pop"],
    fitness: Fitness,
    offspring: Int[Array, " species"],
    *,
    key: PRNGKeyArray,
) -> tuple[Int[Array, " pop"], Int[Array, " pop"], Bool[Array, " pop"]]:
    """For each offspring its parents, the same one twice where there is no crossover; and whether
    it is that parent unchanged."""
    draw_key, cross_key, away_key, other_key = jax.random.split(key, 4)
    n, (order, start, size, able) = neat.population_size, able_parents(neat, member, fitness)
    slot, last = jnp.arange(n, dtype=jnp.int32), jnp.cumsum(offspring)
    own = jnp.minimum(jnp.searchsorted(last, slot, side="right"), len(size) - 1)
    drawn = jax.random.uniform(draw_key, (2, n)) * able[own].astype(jnp.float32)[None]
    drawn = jnp.minimum(drawn.astype(jnp.int32), able[own][None] - 1)
    mother, father = order[start[own][None] + drawn]
    luck = jax.random.uniform(other_key, (n, len(size)))
    other = jnp.argmax(jnp.where(size[None] > 0, luck, -1.0), axis=1)
    away = jax.random.bernoulli(away_key, neat.elsewhere, (n,))
    father = jnp.where(away, order[start[other]], father)
    father = jnp.where(jax.random.bernoulli(cross_key, neat.crossover, (n,)), father, mother)
    kept = (slot == last[own] - offspring[own]) & (size[own] > neat.champions)
    mother = jnp.where(kept, order[start[own]], mother)
    return mother, jnp.where(kept, mother, father), kept


def able_parents(
    neat: NEAT, member: Int[Array, " pop"], fitness: Fitness
) -> tuple[Int[Array, " pop"], *tuple[Int[Array, " species"], ...]]:
    """All genomes, species by species, the best of each first; and of each species where it begins
    there, how many members it has, and how many of these can be parents."""
    count = jnp.zeros(neat.species, jnp.int32).at[member]
    size, sound = count.add(1), count.add(jnp.isfinite(fitness).astype(jnp.int32))
    able = (neat.survival * size.astype(jnp.float32)).astype(jnp.int32) + 1
    able = jnp.maximum(jnp.minimum(able, sound), 1)
    return jnp.lexsort((-rankable(fitness), member)), jnp.cumsum(size) - size, size, able


@jit
def represented(
    species: Species, population: PyTree, member: Int[Array, " pop"], *, key: PRNGKeyArray
) -> Species:
    """Species with a random member of this generation as representative in the next."""
    luck = jax.random.uniform(key, member.shape)
    mine = member[None] == jnp.arange(len(species.alive))[:, None]
    chosen = jnp.argmax(jnp.where(mine, luck[None], -1.0), axis=1)
    return eqx.tree_at(lambda s: s.representative, species, tree.take(population, chosen))


@jit
def described(population: PyTree, species: Species) -> dict[str, Any]:
    """Numbers about a population: of its species, and the means of its expressed genes and hidden
    units."""
    nodes = population.node != genomes.NONE
    return {
        "species": jnp.sum(species.alive, dtype=jnp.int32),
        "genes": jnp.mean(jnp.sum(population.enabled, axis=1, dtype=jnp.float32)),
        "hidden": jnp.mean(jnp.sum(nodes, axis=1, dtype=jnp.float32)),
    }
