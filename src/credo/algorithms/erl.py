"""ERL and CERL: Khadka (2019), Algorithms 6 and 10 (Khadka & Tumer 2018; Khadka et al. 2019).

A population evolves on whole returns, a portfolio of learners descends gradients, and all share
one replay buffer. ERL is the portfolio of one without a resource manager, EA the empty portfolio.

Departures from the printed boxes:

- A generation makes as many updates as frames were played (line 21 of Algorithm 10); Algorithm 6
  prints a single one. `updates_per_frame` scales it, and nothing is learned in the generation in
  which the buffer reaches `warmup_frames`.
- The box selects k-e members and then fills up to k-e: of a member that was drawn repeatedly,
  the repetitions are crossed with an elite, as in the author's code.
- The new population is ordered: elites, then offspring by the rank of their parents. A learner's
  actor takes the last slots, never an elite's; the author's could overwrite one.
- Line 23 weighs up the weakest of a population just bred, of which none has a fitness yet; it is
  the offspring of the weakest parent here.
- Mutation adds noise in proportion to a weight and hits matrices alone, as the author's code.
- All members of a generation play in the same worlds; crossover draws rows independently.
- A learner's first return is its value, and returns that are no numbers leave it as it is.
- Time limits bootstrap, both gradients are clipped, and OU noise starts anew with each episode.
- No actor is injected in a generation without updates, and episodes in which somebody says NaN
  are not remembered.
"""

from collections.abc import Callable
from typing import Any, ClassVar, Protocol, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .. import require, rollout, tree
from ..compilation import float32, jit, when
from ..evolution.crossover import AbstractCrossover, MaskedCrossover
from ..evolution.lineage import Lineage
from ..evolution.mutation import AbstractMutation, MatrixMutation
from ..evolution.selection import AbstractSelection, Tournament, rankable, ranking, repeated
from ..learners.base import AbstractLearner, learn
from ..learners.manager import UCB, AbstractManager, Ledger, even
from ..learners.td3 import ERL_NETWORK, TD3, TD3_NETWORK, ddpg
from ..networks.base import AbstractNetwork, AbstractPolicy
from ..networks.mlp import MLP, Critic
from ..networks.team import Team
from ..normalization import Moments, behind, frozen, warmed, watched
from ..replay import Replay, extend
from ..rollout import Environment, Experience, blank, collect
from ..types import Evaluation, Metrics

TABLE_5_1 = {  # task: (ψ, ξ, ω)
    "HalfCheetah": (0.1, 1, 10),
    "Swimmer": (0.1, 1, 10),
    "Reacher": (0.2, 5, 10),
    "Ant": (0.3, 1, 1),
    "Hopper": (0.3, 5, 1),
    "Walker2d": (0.2, 3, 10),
}
MUTATION = MatrixMutation(
    gate="genome", super_probability=0.05, reset_probability=0.05, vectors=False
)


class ERLState(eqx.Module):
    population: PyTree  # leaves [k, ...]; bred, not yet evaluated
    lineage: Lineage
    learners: tuple[PyTree, ...]
    replay: Any  # a Replay, or None where nobody learns
    ledger: Ledger
    allocation: Int[Array, " b"]  # the learner of each rollout worker
    champion: AbstractPolicy  # the fittest of the last generation
    score: Float[Array, ""]  # of the champion that was tested last
    frames: Int[Array, ""]
    episodes: Int[Array, ""]
    generation: Int[Array, ""]
    moments: Moments | None  # of what was seen; None: observations are as they are


class ERL(eqx.Module):
    """Evolve `network` policies on `env` beside a portfolio of learners."""

    default_budget: ClassVar[dict[str, int]] = {"frames": 1_000_000}

    env: Environment
    network: AbstractNetwork = ERL_NETWORK
    learners: tuple[AbstractLearner, ...] = (ddpg(),)
    population_size: int = eqx.field(static=True, default=10)  # k
    elite_fraction: float = eqx.field(static=True, default=0.1)  # ψ
    episodes: int = eqx.field(static=True, default=1)  # ξ: per fitness
    remember: bool = eqx.field(static=True, default=False)
    """Judge an elite by all the episodes it ever played, not by the last ξ alone."""
    redistribute: bool = eqx.field(static=True, default=False)
    """Learners see each episode's return in equal parts over its frames, however late it came."""
    selection: AbstractSelection = Tournament()
    crossover: AbstractCrossover = MaskedCrossover()
    crossover_probability: float = 0.0  # chance to cross an offspring drawn once
    mutation: AbstractMutation = MUTATION
    workers: int = eqx.field(static=True, default=1)  # b: episodes that learners play
    manager: AbstractManager | None = None  # None: workers in turn
    sync_period: int = eqx.field(static=True, default=10)  # ω, in generations
    updates_per_frame: float = 1.0  # of each learner
    warmup_frames: int = eqx.field(static=True, default=1_000)  # stored before anybody learns
    replay_capacity: int = eqx.field(static=True, default=1_000_000)  # transitions
    test_episodes: int = eqx.field(static=True, default=5)  # of the champion; not counted
    test_every: int = eqx.field(static=True, default=1)  # generations between tests
    fitness: str | None = eqx.field(static=True, default=None)  # signal; None: the task's first
    normalize_observations: bool = eqx.field(static=True, default=False)
    """Policies see observations by the running mean and variance of all that was seen; the champion
    keeps them."""

    def __check_init__(self):
        for name, least in (("population_size", 2), ("episodes", 1), ("workers", 1)):
            require.at_least(name, getattr(self, name), least)
        for name in ("sync_period", "replay_capacity", "test_episodes", "test_every"):
            require.at_least(name, getattr(self, name), 1)
        require.fits(self.env, self.network, *self.learners)
        require.within("crossover_probability", self.crossover_probability, 0, 1)
        require.at_least("updates_per_frame", self.updates_per_frame, 0)
        for signal in (self.fitness, *(learner.signal for learner in self.learners)):
            require.signal(signal, self.env.signals)
        turns = self.workers if self.manager is None else len(self.learners)
        require.room(self.elite_fraction, self.population_size, len(self.learners), turns)

    @classmethod
    def erl(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """Section 5.4, with the task's column of Table 5.1; HalfCheetah's where it has none."""
        inner = getattr(env, "env", env)  # a delayed task is still that task
        name = str(getattr(inner, "id", "")).partition("-v")[0]
        ψ, ξ, ω = TABLE_5_1.get(name, TABLE_5_1["HalfCheetah"])
        settings: dict[str, Any] = {"elite_fraction": ψ, "episodes": ξ, "sync_period": ω}
        network = network or (ERL_NETWORK if env.agents is None else Team())
        return cls(env, network, **settings | overrides)

    @classmethod
    def ours(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """ERL for a reward that comes late, in thousands: a TD3 learner with a long horizon that
        sees returns spread over their episodes and joins the population every generation, and many
        elites, which are judged by all they ever did. Chosen by looking at the hard double
        pendulum, seeds 0, 100 to 103 and 200 to 202."""
        network = network or MLP(hidden=(64, 64), activation="relu", initializer="uniform")
        learner = TD3(
            critic=Critic(hidden=(128, 128)),
            gamma=0.999,
            actor_lr=1e-3,
            critic_lr=1e-3,
            reward_scale=0.01,
            batch_size=128,
        )
        settings = {"learners": (learner,), "elite_fraction": 0.4, "sync_period": 1}
        settings |= {"remember": True, "redistribute": True, "updates_per_frame": 2.0}
        return cls.erl(env, network, **settings | overrides)

    @classmethod
    def ea(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """The same evolution without a learner."""
        return cls.erl(env, network, **{"learners": ()} | overrides)

    @classmethod
    def cerl(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """Chapter 6: TD3 at four discounts, ten workers, UCB. What the text leaves open is the
        author's: ω = 5, a fifth are elites."""
        settings = {
            "learners": tuple(TD3(gamma=γ) for γ in (0.9, 0.99, 0.997, 0.9995)),
            "workers": 10,
            "manager": UCB(),
            "elite_fraction": 0.2,
            "sync_period": 5,
            "test_episodes": 10,
            "test_every": 5,
        }
        return cls(env, network or TD3_NETWORK, **settings | overrides)

    @classmethod
    def presets(cls) -> dict[str, Callable[..., Self]]:
        """Settings by name, for the command line."""
        return {"erl": cls.erl, "ours": cls.ours, "ea": cls.ea, "cerl": cls.cerl}

    @property
    def elites(self) -> int:
        """e = int(ψ·k)"""
        return int(self.elite_fraction * self.population_size)

    @property
    def most_frames(self) -> int:
        """Frames of one generation, at most."""
        return most_frames(self)

    @float32()
    def init(self, *, key: PRNGKeyArray) -> ERLState:
        return begin(self, key=key)

    def warm(self, state: ERLState, policy: AbstractPolicy) -> ERLState:
        return warm(self, state, policy)

    @float32()
    def generation(self, state: ERLState, *, key: PRNGKeyArray) -> tuple[ERLState, Metrics]:
        """One pass of the outer loop of Algorithms 6 and 10."""
        play_key, breed_key, explore_key, learn_key, manage_key, test_key = jax.random.split(key, 6)
        # 6-7: for actor in pop: fitness, R = Evaluate(actor, R, noise=None, ξ)
        population = behind(state.moments, state.population)
        played, experience = collect(self.env, population, self.episodes, key=play_key)
        fitness = jnp.mean(played.of(self.signal), axis=1)
        memory = stored(self, (state.replay, state.moments), played, experience)

        # 8-15: rank, keep the elites, select, cross and mutate.
        lineage, standing = state.lineage, fitness
        if self.remember:
            lineage, standing = lineage.judged(fitness)
        population, lineage, fittest, bred = breed(
            self, state.population, lineage, standing, key=breed_key
        )
        # 16-20: learners play too, with noise; what they earn is their value.
        memory, ledger, counts, explored = explore(self, state, memory, key=explore_key)
        frames, episodes = jnp.sum(played.steps) + counts[0], played.steps.size + counts[1]

        # 21-29: as many updates as frames, each learner on minibatches of its own.
        learners, learned = improve(self, state, memory, frames, key=learn_key)

        # 30-33: allocate the workers of the next generation.
        allocation = state.allocation
        if self.manager is not None and learners:
            allocation = self.manager.allocate(ledger, self.workers, key=manage_key)

        # 34-36: every ω generations, copy each learner's actor over the weakest.
        generation = state.generation + 1
        sync = (generation % self.sync_period == 0) & (learned["updates"] > 0)
        actors = [learner.actor(s) for learner, s in zip(self.learners, learners, strict=True)]
        population, lineage = inject(population, lineage, actors, sync)

        fittest = frozen(state.moments, fittest)
        after = (population, lineage, learners, memory[0], ledger, allocation, fittest, state.score)
        counted = (state.frames + frames, state.episodes + episodes, generation, memory[1])
        metrics = {"frames": frames} | bred | explored | learned
        return tested(self, ERLState(*after, *counted), fitness, metrics, key=test_key)

    @property
    def signal(self) -> str:
        """The reward that fitness and, unless they name another, learners optimise."""
        return self.fitness or self.env.signals[0]


class Hybrid(Protocol):
    """What the phases below need of an algorithm with a population and learners."""

    env: Any
    network: Any
    learners: Any
    population_size: Any
    selection: Any
    crossover: Any
    crossover_probability: Any
    mutation: Any
    workers: Any
    redistribute: Any
    updates_per_frame: Any
    warmup_frames: Any
    replay_capacity: Any
    normalize_observations: Any
    test_episodes: Any
    test_every: Any

    @property
    def manager(self) -> AbstractManager | None: ...
    @property
    def elites(self) -> int: ...
    @property
    def signal(self) -> str: ...


def begin(hybrid: Hybrid, *, key: PRNGKeyArray) -> ERLState:
    """1-4: Initialize learners, a population of k actors, and an empty cyclic replay buffer."""
    env, network, k, q = hybrid.env, hybrid.network, hybrid.population_size, len(hybrid.learners)
    require.continuous(env, *hybrid.learners)
    population_key, *learner_keys = jax.random.split(key, 1 + q)
    learners = tuple(
        learner.init(network, *env.sizes, key=learner_key)
        for learner, learner_key in zip(hybrid.learners, learner_keys, strict=True)
    )
    population = eqx.filter_vmap(lambda key: network.init(*env.sizes, key=key))(
        jax.random.split(population_key, k)
    )
    moments = Moments.first(env, network) if hybrid.normalize_observations else None
    return ERLState(
        population,
        Lineage.first(k, q),
        learners,
        Replay.empty(blank(env), hybrid.replay_capacity) if learners else None,
        Ledger.empty(q),
        even(hybrid.workers, max(q, 1)),
        frozen(moments, tree.take(population, 0)),
        jnp.float32(-jnp.inf),  # never tested
        *(jnp.int32(0) for _ in range(3)),
        moments=moments,
    )


def most_frames(hybrid: Any) -> int:
    """Frames of one generation, if every episode lasts until the clock ends it."""
    played = hybrid.population_size * hybrid.episodes
    return (played + (hybrid.workers if hybrid.learners else 0)) * hybrid.env.max_steps


def warm(hybrid: Hybrid, state: ERLState, policy: AbstractPolicy) -> ERLState:
    """`state` that goes on from a saved policy: the first member, and every learner; all see by its
    statistics."""
    policy, moments = warmed(policy, state.moments)
    learners = tuple(
        learner.warm(s, policy) for learner, s in zip(hybrid.learners, state.learners, strict=True)
    )
    population = tree.put(state.population, 0, policy)
    parts = (population, learners, moments, frozen(moments, policy))
    return eqx.tree_at(
        lambda s: (s.population, s.learners, s.moments, s.champion), state, parts, is_leaf=none
    )


def none(x: Any) -> bool:
    return x is None


def stored(hybrid: Hybrid, memory: Any, played: Evaluation, experience: Experience) -> Any:
    """The buffer, and the moments of observations, with what was played."""
    replay, moments = memory[0], watched(memory[1], experience)
    experience = experience.spread(played) if hybrid.redistribute else experience
    if hybrid.learners:
        replay = extend(replay, experience.transitions, experience.valid)
    return replay, moments


def explore(
    hybrid: Hybrid, state: ERLState, memory: Any, *, key: PRNGKeyArray
) -> tuple[Any, Ledger, tuple[Int[Array, ""], Int[Array, ""]], Metrics]:
    """Lines 16-20 of Algorithm 10: each learner's workers play an episode with noise.

    **Returns:** buffer and moments, the ledger, frames and episodes played, who played how much.
    """
    ledger, metrics, workers = state.ledger, {}, hybrid.workers
    frames = episodes = jnp.int32(0)
    for i, learner in enumerate(hybrid.learners):
        mine = jnp.sum((state.allocation == i).astype(jnp.int32))
        team = tree.stack(learner.explorer(state.learners[i], jnp.bool_(False)))
        team = behind(state.moments, team)
        own = jax.random.fold_in(key, i)
        played, experience = collect(hybrid.env, team, workers, wanted=mine, common=False, key=own)
        memory = stored(hybrid, memory, played, experience)
        returns, theirs = played.of(hybrid.signal)[0], jnp.arange(workers) < mine
        ledger = (hybrid.manager or UCB()).observe(ledger, i, returns, theirs)
        frames, episodes = frames + jnp.sum(played.steps), episodes + mine
        metrics |= {f"workers_{i}": mine, f"value_{i}": ledger.value[i]}
    return memory, ledger, (frames, episodes), metrics


def improve(
    hybrid: Hybrid, state: ERLState, memory: Any, frames: Int[Array, ""], *, key: PRNGKeyArray
) -> tuple[tuple[PyTree, ...], Metrics]:
    """Lines 21-29 of Algorithm 10: each learner makes `updates_per_frame` steps for each of
    `frames` on the common buffer."""
    ready = (state.frames >= hybrid.warmup_frames) & bool(hybrid.learners)
    updates = jnp.where(ready, frames.astype(jnp.float32) * hybrid.updates_per_frame, 0.0)
    updates = updates.astype(jnp.int32)
    learned, metrics = [], {"updates": updates}
    for i, learner in enumerate(hybrid.learners):
        step_key = jax.random.fold_in(key, i)
        given = {"signal": hybrid.signal, "moments": memory[1], "key": step_key}
        after, report = learn(learner, state.learners[i], memory[0], updates, **given)
        learned.append(after)
        metrics |= {f"{name}_{i}": value for name, value in report.items()}
    return tuple(learned), metrics


def tested(
    hybrid: Hybrid, state: ERLState, fitness: Array, metrics: Metrics, *, key: PRNGKeyArray
) -> tuple[ERLState, Metrics]:
    """The champion on fresh episodes, every `test_every` generations; and what there is to say."""
    score = when(
        (state.generation - 1) % hybrid.test_every == 0,
        lambda: rollout.score(hybrid.env, state.champion, hybrid.test_episodes, key=key),
        lambda: state.score,
    )
    metrics = {
        "fitness_max": jnp.max(rankable(fitness)),
        "fitness_mean": jnp.nanmean(fitness),
        "fitness_nan": jnp.sum(jnp.isnan(fitness)),
        "champion_score": score,
        "episodes": state.episodes,
    } | metrics
    return eqx.tree_at(lambda s: s.score, state, score), metrics


@jit
def breed(
    hybrid: Hybrid, population: PyTree, lineage: Lineage, fitness: Array, *, key: PRNGKeyArray
) -> tuple[PyTree, Lineage, AbstractPolicy, Metrics]:
    """The next population with its lineage, elites first; the champion; where it came from and
    what became of the learners' actors."""
    order_key, select_key, mate_key, chance_key, cross_key, mutate_key = jax.random.split(key, 6)
    k, n = hybrid.population_size, hybrid.population_size - hybrid.elites

    # 8-9: Rank the population; select the first e as elites. Without selection all are equal.
    blind = jax.random.permutation(order_key, k)
    order = ranking(fitness) if hybrid.selection.sees_fitness else blind
    elites = order[: hybrid.elites]
    # 10: Select (k - e) actors, to form set S; the offspring of better parents come first.
    parents = hybrid.selection(fitness, n, key=select_key)
    parents = parents[jnp.argsort(jnp.argsort(order)[parents], stable=True)]
    # 11-12: Crossover between a random elite and a member of S.
    mates = elites[jax.random.randint(mate_key, (n,), 0, hybrid.elites)]
    crossed = jax.random.bernoulli(chance_key, hybrid.crossover_probability, (n,))
    crossed = crossed | repeated(parents)
    survivors = tree.take(population, parents)
    children = eqx.filter_vmap(lambda a, b, key: hybrid.crossover(a, b, key=key))(
        tree.take(population, mates), survivors, jax.random.split(cross_key, n)
    )
    offspring = eqx.filter_vmap(tree.where)(crossed, children, survivors)
    # 13-15: Mutate set S.
    taken = eqx.filter_vmap(share_of)(offspring, tree.take(population, mates), survivors)
    mutants = eqx.filter_vmap(lambda genome, key: hybrid.mutation(genome, key=key))(
        offspring, jax.random.split(mutate_key, n)
    )
    mutated = eqx.filter_vmap(differ)(mutants, offspring)

    champion = ranking(fitness)[0]
    fittest, metrics = tree.take(population, champion), {"champion_maker": lineage.maker[champion]}
    fates = lineage.fates(elites, parents)
    for i in range(len(hybrid.learners)):
        metrics[f"champion_share_{i}"] = lineage.share[champion, 1 + i]
        metrics |= {f"{fate}_{i}": count[i] for fate, count in fates.items()}
    lineage = lineage.children(elites, parents, mates, crossed, taken, mutated)
    return tree.concat(tree.take(population, elites), mutants), lineage, fittest, metrics


@jit
def inject(
    population: PyTree, lineage: Lineage, actors: list[AbstractPolicy], sync: Bool[Array, ""]
) -> tuple[PyTree, Lineage]:
    """If `sync`, the learners' actors take the last slots, those of the weakest's offspring."""
    for i, actor in enumerate(actors):
        slot = tree.size(population) - 1 - i
        population = tree.where(sync, tree.put(population, slot, actor), population)
        lineage = tree.where(sync, lineage.inject(slot, i), lineage)
    return population, lineage


def share_of(child: PyTree, mate: PyTree, survivor: PyTree) -> Float[Array, ""]:
    """The share of a child's weights that are its mate's, of those in which its parents differ."""
    c, m, s = (tree.ravel(genome)[0] for genome in (child, mate, survivor))
    differ = (m != s).astype(jnp.float32)
    return jnp.sum(differ * (c == m).astype(jnp.float32)) / jnp.maximum(jnp.sum(differ), 1.0)


def differ(a: PyTree, b: PyTree) -> Array:
    """Whether two genomes differ anywhere."""
    return jnp.any(tree.ravel(a)[0] != tree.ravel(b)[0])
