"""What the critic of a hybrid's first learner does for its population: it coaches members, says
which offspring are worth playing, and what the rest of an episode is worth that was cut short."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from .. import tree
from ..compilation import jit
from ..evolution.breeder import AbstractBreeder
from ..evolution.selection import rankable
from ..learners.base import act, scaled
from ..learners.surrogate import AbstractSurrogate
from ..normalization import behind, seen
from ..rollout import collect
from ..types import Batch, Metrics
from .hybrid import Fitness, Hybrid, HybridState, Key, Played, Result, breed, stored


def coached(hybrid: Hybrid, state: HybridState, metrics: Metrics, *, key: Key) -> Result:
    """Some of the next population, neither elites nor learners' actors and drawn anew each time,
    moved by the gradient of the first learner's critic, by the number of its `updates`.

    **Returns:** the state, and with the metrics `coach_updates`, the gradient steps of all members.
    They are not among the `updates`, which are the learners'.
    """
    assert hybrid.coach is not None
    size, choose_key = hybrid.population_size, jax.random.fold_in(key, 0)
    n, steps = hybrid.coach.count(size), hybrid.coach.steps(metrics["updates"], size)
    told = metrics | {"coach_updates": n * steps}
    if not isinstance(steps, jax.core.Tracer) and steps == 0:
        return state, told  # nothing need be compiled for it yet
    free = offspring(hybrid.breeder, size) & (state.lineage.guest < 0)
    order = jax.random.uniform(choose_key, (size,)) + jnp.where(free, 0.0, 1.0)
    chosen = jnp.argsort(order)[:n]
    members = tree.take(state.population, chosen)
    given = (hybrid.learners[0], state.learners[0], members, state.replay, steps)
    moved = hybrid.coach(*given, **_of(hybrid, state), key=jax.random.fold_in(key, 1))
    population = tree.put(state.population, chosen, moved)
    lineage = state.lineage.coached(chosen, steps > 0)
    return replace(state, population=population, lineage=lineage), told


def preselect(hybrid: Hybrid, state: HybridState, fitness: Fitness, *, key: Key) -> Result:
    """`breed`, with each offspring the most promising of several, once the learner has learned.

    **Returns:** the state, and beside the metrics of `breed` the `surrogate_agreement`: the rank
    correlation, in [-1, 1], of a real fitness and of what the surrogate says of the same members.
    """
    assert hybrid.surrogate is not None
    key, judge_key = jax.random.fold_in(key, 0), jax.random.fold_in(key, 1)
    about = (hybrid.learners[0], state.learners[0], state.replay, _of(hybrid, state), judge_key)
    breeder = Preselecting(hybrid.breeder, hybrid.surrogate, about, state.learned)
    after, metrics = breed(replace(hybrid, breeder=breeder), state, fitness, key=key)
    values = _judged(hybrid.surrogate, about, state.population)
    return after, metrics | {"surrogate_agreement": agreement(values, rankable(fitness))}


def play_ahead(
    hybrid: Hybrid, state: HybridState, policies: PyTree, episodes: int, *, key: Key
) -> Played:
    """`play` for as many steps as the hybrid's `horizon` says, once the learner has learned and
    unless the task pays late. To the returns of episodes that were cut short is added what the rest
    is worth."""
    assert hybrid.horizon is not None
    most = jnp.int32(hybrid.env.max_steps)
    short = state.learned & ~state.late
    limit = jnp.where(short, jnp.minimum(hybrid.horizon.steps, most), most)
    acting = behind(state.moments, policies)
    played, new = collect(hybrid.env, acting, episodes, limit=limit, key=key)
    cut = (played.steps == limit) & (limit < most)
    learner = hybrid.learners[0]
    if learner.reward_scale is None:  # by the buffer that the critic has learned from
        learner = scaled(learner, state.replay, hybrid.reward)
    about = (learner, state.learners[0], state.moments)
    late = state.late & jnp.all(new.late(played, hybrid.reward))
    after = stored(hybrid, replace(state, late=late), played, new)
    whole = hybrid.horizon.steps >= hybrid.env.max_steps
    if whole or not len(new.transitions.terminated):  # nothing is cut, or every episode was lost
        return after, played
    rows, last = new.transitions, new.last(played)
    met = new.first((rows.obs, rows.rewards[hybrid.reward]), played, hybrid.horizon.steps)
    rest = _rest(about, policies, played.steps, met, (last.next_obs, last.terminated), most - limit)
    rest = jnp.where(cut, rest, 0.0)
    returns = played.returns | {hybrid.reward: played.of(hybrid.reward) + rest}
    return after, replace(played, returns=returns)


@jit
def _rest(
    about: PyTree,
    policies: PyTree,
    steps: Int[Array, "pop episodes"],
    met: tuple[Array, Array],
    last: tuple[Array, Array],
    left: Int[Array, ""],
) -> Float[Array, "pop episodes"]:
    """What the steps that are `left` of episodes that were cut are worth, in units of the reward; 0
    of those that terminated just then. `met`: their observations and rewards, of as many steps as
    are played at most. `last`: the observation behind the last one, and whether they terminated."""
    learner, state, moments = about
    obs, rewards = (jnp.asarray(x).reshape(*steps.shape, *x.shape[1:]) for x in met)
    final, over = (jnp.asarray(x).reshape(*steps.shape, *x.shape[1:]) for x in last)
    arrays, static = eqx.partition(policies, eqx.is_array)

    def one(given: tuple[PyTree, Array, Array]) -> Array:
        arrays, before, final = given
        member = eqx.combine(arrays, static)
        obs = jnp.concatenate([before, final[:, None]], axis=1)
        rows = seen(moments, obs.reshape(-1, *obs.shape[2:]))
        none = jnp.zeros(rows.shape[:-1])
        off = none.astype(bool)
        batch = Batch(rows, act(member, rows), none, rows, off, off)
        return learner.value(state, member, batch).reshape(*obs.shape[:2], -1).mean(axis=-1)

    values = jax.lax.map(one, (arrays, obs, final)) / jnp.maximum(learner.reward_scale, 1e-8)
    value, before = values[..., -1], values[..., :-1]
    room, rewards = before.shape[-1], rewards.reshape(*before.shape, -1).mean(axis=-1)
    count, at = jnp.minimum(jnp.asarray(steps), room)[..., None], jnp.arange(room)[None, None]
    gain = _mean(rewards, (at < count) & (at >= count // 2))
    further = jnp.minimum(left.astype(jnp.float32), 1.0 / (1.0 - learner.gamma))
    earned = gain * further + value - _mean(before, at < count)
    over = over.reshape(*steps.shape, -1).all(axis=-1)
    return jnp.where(over, 0.0, jnp.minimum(value, earned))


def _mean(x: Array, there: Bool[Array, "pop episodes steps"]) -> Float[Array, "pop episodes"]:
    """Over the steps that are there; 0 of none."""
    number = jnp.sum(there, axis=-1, dtype=jnp.float32)
    return jnp.sum(x, axis=-1, where=there) / jnp.maximum(number, 1.0)


class Preselecting(AbstractBreeder):
    """A breeder whose offspring are chosen by a surrogate."""

    inner: AbstractBreeder
    surrogate: AbstractSurrogate
    about: PyTree  # what the surrogate asks
    ready: Bool[Array, ""]  # whether that can be believed; else the first offspring is taken

    def check(self, population, network, least=1, learners=0):
        self.inner.check(population, network, least, learners)

    def elites(self, population):
        return self.inner.elites(population)

    def first(self, population, *, key):
        return self.inner.first(population, key=key)

    def warm(self, memory, population, policy):
        return self.inner.warm(memory, population, policy)

    def next(self, memory, population, fitness, draw, *, key):
        keys = jax.random.split(key, self.surrogate.candidates)
        bred = [self.inner.next(memory, population, fitness, draw, key=one) for one in keys]
        values = jnp.stack([_judged(self.surrogate, self.about, each) for each, *_ in bred])
        free = self.ready & offspring(self.inner, tree.size(population))
        best = jnp.where(free, jnp.argmax(rankable(values), axis=0), 0)
        pick: Callable[..., Array] = partial(_picked, best)
        arrays, rest = eqx.partition([(each, descent) for each, descent, _ in bred], eqx.is_array)
        return *eqx.combine(jax.tree.map(pick, *arrays), rest[0]), bred[0][2]


def _picked(best: Int[Array, " pop"], *candidates: Array) -> Array:
    """Of each member the row of the candidate that is best."""
    return jnp.stack(candidates)[best, jnp.arange(len(best))]


@jit
def _judged(surrogate: AbstractSurrogate, about: PyTree, members: PyTree) -> Float[Array, " pop"]:
    learner, state, replay, how, key = about
    return surrogate(learner, state, members, replay, **how, key=key)


@jit
def agreement(a: Float[Array, " n"], b: Float[Array, " n"]) -> Float[Array, ""]:
    """Rank correlation (Spearman 1904); 0 of a single pair."""
    ranks = [jnp.argsort(jnp.argsort(x)).astype(jnp.float32) for x in (a, b)]
    x, y = (rank - jnp.mean(rank) for rank in ranks)
    return jnp.sum(x * y) / jnp.maximum(jnp.sum(x * x), 1e-6)


def _of(hybrid: Hybrid, state: HybridState) -> dict[str, Any]:
    """How the first learner draws minibatches."""
    how = {"signal": hybrid.learners[0].signal or hybrid.reward, "moments": state.moments}
    return how | {"sampling": hybrid.sampling}


def offspring(breeder: AbstractBreeder, population: int) -> Bool[np.ndarray, " pop"]:
    """Which slots are not those of elites, which stand first, on every island."""
    islands = getattr(breeder, "islands", None)
    n = islands.number if islands else 1
    return np.arange(population) % (population // n) >= breeder.elites(population) // n
