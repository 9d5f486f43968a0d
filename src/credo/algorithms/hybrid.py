"""Hybrids of evolution and gradient: what ERL, CERL and MERL share beside the breeder.

A population and learners play into one replay buffer. A generation is a sequence of phases: `play`
(the population), `breed`, `explore` (the learners), `improve` (the learners), `inject` (their
actors into the population) and `tested` (the champion). Each takes a state and returns the next.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .. import require, tree
from ..compilation import float32, jit, repeat
from ..evolution.breeder import AbstractBreeder, draw
from ..evolution.selection import rankable, ranking
from ..learners.base import AbstractLearner, learn, require_windows
from ..learners.coach import AbstractCoach
from ..learners.credit import AbstractRedistribution
from ..learners.horizon import AbstractHorizon
from ..learners.manager import UCB, AbstractManager, Ledger, even
from ..learners.share import AbstractShare
from ..learners.surrogate import AbstractSurrogate
from ..networks.base import AbstractNetwork, AbstractPolicy
from ..normalization import Moments, behind, frozen, warmed, watched
from ..replay import Replay, Sampling, extend
from ..rollout import Environment, Experience, blank, collect
from ..types import Evaluation, Metrics
from .fitness import objective, retested
from .lineage import COACHED, INJECTED, Lineage


def _field(start: float, dtype: Callable[..., Any]) -> Any:
    """A field of a state that starts with this number."""
    return eqx.field(default_factory=lambda: dtype(start))


class HybridState(eqx.Module):
    """What a hybrid knows between two generations."""

    population: PyTree  # leaves [k, ...]; bred, not yet evaluated
    lineage: Lineage
    learners: tuple[PyTree, ...]
    replay: Any  # a Replay; None if there are no learners
    ledger: Ledger
    allocation: Int[Array, " b"]  # the learner of each rollout worker
    champion: AbstractPolicy  # the fittest of the last generation
    moments: Moments | None  # of all observations; None: they are not normalised
    seen: Moments | None  # the same with what was seen in this generation, in the midst of one
    score: Float[Array, ""] = _field(-jnp.inf, jnp.float32)
    """Of the champion that was tested last; -inf: none was."""
    share: Float[Array, ""] = _field(0.0, jnp.float32)  # of the frames that the learners get
    known: PyTree = None  # what a redistribution knows
    late: Bool[Array, ""] = _field(True, jnp.bool_)  # whether all was paid at last steps, if asked
    frames: Int[Array, ""] = _field(0, jnp.int32)
    episodes: Int[Array, ""] = _field(0, jnp.int32)
    generation: Int[Array, ""] = _field(0, jnp.int32)
    learned: Bool[Array, ""] = _field(False, jnp.bool_)  # whether the learners ever did
    breeding: PyTree = None  # what the breeder remembers
    owed: Any = None  # frames of the last generation that nobody learned from yet, with `overlap`


class Hybrid(eqx.Module):
    """An algorithm that evolves a population beside learners."""

    env: eqx.AbstractVar[Environment]
    network: eqx.AbstractVar[AbstractNetwork]
    learners: eqx.AbstractVar[tuple[AbstractLearner, ...]]
    population_size: eqx.AbstractVar[int]
    breeder: eqx.AbstractVar[AbstractBreeder]
    episodes: eqx.AbstractVar[int]
    workers: eqx.AbstractVar[int]
    manager: eqx.AbstractVar[AbstractManager | None]
    share: eqx.AbstractVar[AbstractShare | None]
    coach: eqx.AbstractVar[AbstractCoach | None]
    surrogate: eqx.AbstractVar[AbstractSurrogate | None]
    horizon: eqx.AbstractVar[AbstractHorizon | None]
    redistribute: eqx.AbstractVar[AbstractRedistribution | None]
    sampling: eqx.AbstractVar[Sampling]
    updates_per_frame: eqx.AbstractVar[float]
    warmup_frames: eqx.AbstractVar[int]
    replay_capacity: eqx.AbstractVar[int]
    test_episodes: eqx.AbstractVar[int]
    test_every: eqx.AbstractVar[int]
    fitness: eqx.AbstractVar[str | None]
    remember: eqx.AbstractVar[bool]
    normalize_observations: eqx.AbstractVar[bool]
    overlap: eqx.AbstractVar[bool]

    def __check_init__(self):
        for name in ("episodes", "workers", "replay_capacity", "test_episodes", "test_every"):
            require.at_least(name, getattr(self, name), 1)
        for name in ("updates_per_frame", "warmup_frames"):
            require.at_least(name, getattr(self, name), 0)
        require.fits(self.env, self.network, *self.learners)
        if self.learners:
            require_windows(self.network, self.sampling, self.replay_capacity, *self.learners)
        for reward in (self.fitness, *(learner.signal for learner in self.learners)):
            objective(self.env, reward)
        q = len(self.learners)
        self.breeder.check(self.population_size, self.network, learners=q)
        if self.coach is not None:
            self.coach.check(self.population_size, self.elites, self.learners)
        if self.surrogate is not None:
            self.surrogate.check(self.breeder, self.learners)
        if self.horizon is not None and self.network.remembers:
            raise ValueError(
                "a horizon asks the critic about single steps, and "
                f"{require.named(self.network)} has memory: give horizon=None"
            )
        if self.horizon is not None:
            self.horizon.check(self.reward, self.redistribute, self.learners)
        if self.overlap and (not q or self.share is not None or self.horizon is not None):
            raise ValueError("overlap is for hybrids with learners, without a share and a horizon")
        if self.manager is None and self.workers < q:
            raise ValueError(
                f"{self.workers} workers for {q} learners: some would never play; give at least as "
                "many"
            )

    @property
    def elites(self) -> int:
        """Members that are kept unchanged: e = int(ψ·k)."""
        return self.breeder.elites(self.population_size)

    @property
    def reward(self) -> str:
        """The reward that evolution maximises, and learners that name no other one."""
        return objective(self.env, self.fitness)

    @property
    def rounds(self) -> int:
        """Episodes of one generation."""
        return self.population_size * self.episodes + bool(self.learners) * self.workers

    @property
    def most_frames(self) -> int:
        """Frames of one generation, if every episode lasts until the time limit."""
        rounds = self.rounds
        if self.share is not None and self.learners:  # the last round may begin just before the end
            rounds += int(self.population_size * self.episodes / (1.0 - self.share.most))
        return rounds * self.env.max_steps

    @float32()
    def init(self, *, key: PRNGKeyArray) -> HybridState:
        """1-4: Initialize learners, a population of k actors, and an empty cyclic replay buffer."""
        env, network, k, q = self.env, self.network, self.population_size, len(self.learners)
        require.actions(env, network, *self.learners)
        draw_key, *keys = jax.random.split(key, 1 + q)
        pairs = zip(self.learners, keys, strict=True)
        population = draw(network, env.sizes, k, key=draw_key)
        population, breeding = self.breeder.first(population, key=jax.random.fold_in(draw_key, k))
        moments = Moments.first(env, network) if self.normalize_observations else None
        return HybridState(
            population=population,
            lineage=Lineage.first(k, q),
            learners=tuple(one.init(network, *env.sizes, key=key) for one, key in pairs),
            replay=Replay.empty(blank(env, tree.take(population, 0)), self.replay_capacity)
            if q
            else None,
            ledger=Ledger.empty(q),
            allocation=even(self.workers, max(q, 1)),
            champion=frozen(moments, tree.take(population, 0)),
            moments=moments,
            seen=moments,
            share=jnp.float32(self.share.first() if self.share else 0.0),
            breeding=breeding,
            known=self.redistribute and self._known(key=jax.random.fold_in(key, 1 + q)),
            owed=jnp.int32(0) if self.overlap else None,
        )

    def _known(self, *, key: PRNGKeyArray) -> PyTree:
        """What a redistribution knows at the start; None if there are no learners."""
        how, given = self.redistribute, (self.env, self.rounds, self.replay_capacity)
        return how.init(*given, key=key) if how is not None and self.learners else None

    def warm(self, state: HybridState, policy: AbstractPolicy) -> HybridState:
        """`state` that goes on from a saved policy: it becomes the first member and the actor of
        every learner, and all see observations by its statistics."""
        policy, moments = warmed(policy, state.moments)
        population, breeding = self.breeder.warm(state.breeding, state.population, policy)
        pairs = zip(self.learners, state.learners, strict=True)
        return replace(
            state,
            population=population,
            breeding=breeding,
            learners=tuple(learner.warm(own, policy) for learner, own in pairs),
            champion=frozen(moments, policy),
            moments=moments,
            seen=moments,
        )


Key = PRNGKeyArray
Fitness = Float[Array, " pop"]
Frames = Int[Array, ""]
Result = tuple[HybridState, Metrics]
Played = tuple[HybridState, Evaluation]
UNMANAGED = UCB()  # keeps the ledger of learners that play in turn


def play(hybrid: Hybrid, state: HybridState, policies, episodes: int, **how) -> Played:
    """Play, and store every transition in the replay buffer. `how`: arguments of `collect`.

    All of a generation act by the moments of those before; learners learn by those with what was
    `seen` since.
    """
    played, new = collect(hybrid.env, behind(state.moments, policies), episodes, **how)
    return stored(hybrid, state, played, new), played


def stored(hybrid: Hybrid, state: HybridState, played: Evaluation, new: Experience) -> HybridState:
    """With what was met, in the replay buffer and in the moments."""
    state = replace(state, seen=watched(state.seen, new))
    if state.replay is not None and hybrid.redistribute is not None:
        return _noted(hybrid.redistribute, state, new, played)
    if state.replay is not None:
        state = replace(state, replay=extend(state.replay, new.transitions, new.valid))
    return state


def _noted(how: AbstractRedistribution, state: HybridState, experience, played) -> HybridState:
    """With a rollout in the replay buffer, and its episodes known to the redistribution."""
    new = how.stored(experience, played)
    replay = extend(state.replay, new.transitions, new.valid)
    return replace(state, replay=replay, known=how.noted(state.known, replay, experience, played))


def breed(hybrid: Hybrid, state: HybridState, fitness: Fitness, *, key: Key) -> Result:
    """The next population with its lineage, and the champion of this one. Members that `remember`
    are ranked by the fitness of every generation that they lived through."""
    if hybrid.remember:
        lineage, fitness = state.lineage.averaged(fitness)
        state = replace(state, lineage=lineage)
    given = (state.breeding, state.population, state.lineage, fitness)
    population, lineage, breeding, champion, metrics = bred(hybrid, *given, key=key)
    after = {"breeding": breeding, "generation": state.generation + 1}
    state = replace(state, population=population, lineage=lineage, **after)
    return replace(state, champion=frozen(state.moments, champion)), metrics


@jit
def bred(hybrid: Hybrid, memory, population: PyTree, lineage: Lineage, fitness, *, key: Key):
    """`breed` of what it needs, so that the replay buffer is not copied."""
    fresh = partial(draw, hybrid.network, hybrid.env.sizes)
    offspring, descent, memory = hybrid.breeder.next(memory, population, fitness, fresh, key=key)
    best = ranking(fitness)[0]
    metrics = lineage.report(best, descent)
    return offspring, lineage.after(descent), memory, tree.take(population, best), metrics


def explore(hybrid: Hybrid, state: HybridState, frames: Frames, *, key: Key) -> Result:
    """Each learner's workers play an episode with noise; the ledger gets their returns.

    **Returns:** the state, and as metrics which learner played how many episodes, its value, and
    the `frames` that were given and those that were played here.
    """
    metrics = {}
    for i in range(len(hybrid.learners)):
        team, how = exploring(hybrid, state, i, key=key)
        state, played = play(hybrid, state, team, hybrid.workers, **how)
        state, told = observed(hybrid, state, i, how["wanted"], played)
        frames, metrics = frames + jnp.sum(played.steps), metrics | told
    return state, {"frames": frames} | metrics


def exploring(hybrid: Hybrid, state: HybridState, i: int, *, key: Key):
    """The exploration policy of learner i, and how its workers play."""
    mine = jnp.sum((state.allocation == i).astype(jnp.int32))
    team = tree.single(hybrid.learners[i].explorer(state.learners[i], jnp.bool_(False)))
    return team, {"wanted": mine, "common": False, "key": jax.random.fold_in(key, i)}


def observed(hybrid: Hybrid, state: HybridState, i: int, mine, played: Evaluation) -> Result:
    """With what the first `mine` of the workers' episodes returned in the ledger."""
    returns, theirs = played.of(hybrid.reward)[0], jnp.arange(hybrid.workers) < mine
    ledger = (hybrid.manager or UNMANAGED).observe(state.ledger, i, returns, theirs)
    return replace(state, ledger=ledger), {f"workers_{i}": mine, f"value_{i}": ledger.value[i]}


def balance(hybrid: Hybrid, state: HybridState, fitness: Fitness) -> HybridState:
    """With the share of frames that learners get in this generation."""
    assert hybrid.share is not None
    guests, maker = state.lineage.guest >= 0, state.lineage.maker
    bred = (maker != INJECTED) & (maker != COACHED)  # both are a learner's work
    return replace(state, share=hybrid.share.after(state.share, rankable(fitness), guests, bred))


def teach(hybrid: Hybrid, state: HybridState, frames: Frames, *, keys: tuple[Key, Key]) -> Result:
    """The learners play, and improve by what they and the population played (its `frames`); with a
    `share` of the hybrid again and again, until they have had it."""
    state, explored = explore(hybrid, state, frames, key=keys[0])
    state, learned = improve(hybrid, state, explored["frames"], hybrid.rounds, key=keys[1])
    if hybrid.share is None or not hybrid.learners:
        return state, explored | learned
    return _until_shared(hybrid, state, explored | learned, frames, keys=keys)


def _until_shared(hybrid: Hybrid, state: HybridState, metrics: Metrics, frames: Frames, *, keys):
    """`teach` from its second round on."""
    assert hybrid.share is not None
    wanted = state.share / (1.0 - state.share) * frames.astype(jnp.float32)
    until = jnp.inf if hybrid.share.until is None else hybrid.share.until

    def due(loop) -> Bool[Array, ""]:
        mine = (loop[1]["frames"] - frames).astype(jnp.float32)
        return (mine < wanted) & (loop[0].frames.astype(jnp.float32) < until)

    def again(loop):
        state, before, turn = loop
        fresh = [jax.random.fold_in(key, len(hybrid.learners) + turn) for key in keys]
        state, explored = explore(hybrid, state, jnp.int32(0), key=fresh[0])
        state, learned = improve(hybrid, state, explored["frames"], hybrid.workers, key=fresh[1])
        metrics = before | explored | learned
        summed = {name: before[name] + metrics[name] for name in ("frames", "updates")}
        return state, metrics | summed, turn + 1

    state, metrics, rounds = repeat(due, again, (state, metrics, jnp.int32(1)))
    return state, metrics | {"learner_share": state.share, "learner_rounds": rounds}


def improve(hybrid, state: HybridState, frames: Frames, episodes: int, *, key: Key) -> Result:
    """Each learner makes `updates_per_frame` updates for each of some new `frames`, on minibatches
    of its own from the common buffer. The state counts these frames, and their `episodes`."""
    ready = (state.frames >= hybrid.warmup_frames) & bool(hybrid.learners)
    due = jnp.int32(jnp.where(ready, frames.astype(jnp.float32) * hybrid.updates_per_frame, 0.0))
    learned, metrics, replay = [], {"updates": due}, state.replay
    if hybrid.redistribute is not None and hybrid.learners:
        state, replay, metrics = _paid(hybrid, state, frames, metrics, key=key)
    how = {"signal": hybrid.reward, "moments": state.seen, "sampling": hybrid.sampling}
    for i, (learner, own) in enumerate(zip(hybrid.learners, state.learners, strict=True)):
        after, report = learn(learner, own, replay, due, key=jax.random.fold_in(key, i), **how)
        learned.append(after)
        metrics |= {f"{name}_{i}": value for name, value in report.items()}
    counted = {"frames": state.frames + frames, "episodes": state.episodes + episodes}
    counted |= {"learned": state.learned | (due > 0), "moments": state.seen}
    return replace(state, learners=tuple(learned), **counted), metrics


def _paid(hybrid, state: HybridState, frames: Frames, metrics: Metrics, *, key: Key):
    """What the redistribution knows with new `frames`, the buffer as it pays learners, and
    `metrics` with its own."""
    given = (state.known, state.replay, state.seen, frames)
    fresh = jax.random.fold_in(key, len(hybrid.learners))
    known, replay, told = hybrid.redistribute.taught(*given, key=fresh)
    return replace(state, known=known), replay, metrics | told


def inject(hybrid: Hybrid, state: HybridState, due: Bool[Array, ""]) -> HybridState:
    """If `due`, the learners' actors take the last slots: the offspring of the weakest parents."""
    actors = [x.actor(own) for x, own in zip(hybrid.learners, state.learners, strict=True)]
    population, lineage = _injected(state.population, state.lineage, actors, due)
    return replace(state, population=population, lineage=lineage)


@jit
def _injected(population: PyTree, lineage: Lineage, actors: list[PyTree], due: Bool[Array, ""]):
    before = population, lineage
    for i, actor in enumerate(actors):
        slot = tree.size(population) - 1 - i
        population, lineage = tree.put(population, slot, actor), lineage.inject(slot, i)
    return tree.where(due, (population, lineage), before)


def tested(hybrid: Hybrid, state: HybridState, fitness, metrics: Metrics, *, key: Key) -> Result:
    """The champion on fresh episodes, every `test_every` generations. **Returns:** the state with
    the score of the last test, and all metrics of the generation."""
    due = (state.generation - 1) % hybrid.test_every == 0
    score = retested(hybrid.env, state.champion, hybrid.test_episodes, due, state.score, key=key)
    return replace(state, score=score), {
        "fitness_max": jnp.max(rankable(fitness)),
        "fitness_mean": jnp.nanmean(fitness),
        "fitness_nan": jnp.sum(jnp.isnan(fitness)),
        "champion_score": score,
        "episodes": state.episodes,
    } | metrics
