"""Redistribution by a model that learns, while episodes are played, what each frame was worth.

The replay buffer keeps the rewards that were paid. Beside it stand `Episodes`, which rows of it are
an episode, and a second buffer with what the model pays for each row; learners see that in place of
one reward. Rows of new episodes are paid before learners see them. The model goes on
learning, so past episodes are paid anew in turn.

Whatever a model says, what is left of the true return is paid in equal parts: an episode's sum
stays its return, and a model that has learned nothing is `credit.Even`.
"""

import abc
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .. import require
from ..compilation import jit
from ..normalization import Moments, seen
from ..replay import Replay
from ..rollout import blank
from ..types import Transition
from .base import adam_state, averaged, descend
from .credit import AbstractRedistribution

BLOCK = 4  # episodes that are paid at a time: their frames are in memory together
Frames = tuple[Array, Array, Array]
"""Observations `[episodes, steps, obs]`, actions and next observations, as networks see them. Of a
team those of its agents, one behind the other."""


class Part(eqx.Module):
    """Some episodes of a replay buffer."""

    replay: Replay
    moments: Moments | None  # what observations are normalised by
    start: Int[Array, " episodes"]  # first rows
    length: Int[Array, " episodes"]
    steps: int = eqx.field(static=True)  # of any episode, at most

    def at(self, steps: Int[Array, "episodes some"]) -> Frames:
        """What happened at these steps of each."""
        rows = (self.start[:, None] + steps).reshape(-1) % self.replay.capacity
        data = self.replay.data
        obs, after = (seen(self.moments, x[rows]) for x in (data.obs, data.next_obs))
        action = jnp.clip(data.action[rows], -1.0, 1.0)
        obs, action, after = (x.reshape(*steps.shape, -1) for x in (obs, action, after))
        return obs, action, after

    def every(self) -> Frames:
        """What happened at every step. What stands behind an episode's length means nothing."""
        return self.at(
            jnp.broadcast_to(jnp.arange(self.steps)[None], (len(self.length), self.steps))
        )


class Episodes(eqx.Module):
    """Which rows of a replay buffer are an episode: a ring of the last ones."""

    start: Int[Array, " n"]  # the first row, counted since the first ever written
    length: Int[Array, " n"]  # rows; 0: there is no such episode
    value: Float[Array, " n"]  # the return
    late: Bool[Array, " n"]  # whether it is to be redistributed
    written: Int[Array, ""]  # episodes so far
    fresh: Int[Array, ""]  # those of them that are not paid yet
    turn: Int[Array, ""]  # the next past episode that is paid anew

    @classmethod
    def none(cls, n: int) -> "Episodes":
        """Room for `n`."""
        ints, zero = jnp.zeros(n, jnp.int32), jnp.int32(0)
        return cls(ints, ints, jnp.zeros(n), jnp.zeros(n, bool), zero, zero, zero)

    @jit
    def after(self, rows: Int[Array, ""], length: Array, value: Array, late: Array) -> "Episodes":
        """With new ones, whose rows are the last of the `rows` ever written; those without rows
        leave no trace."""
        n, kept = self.length.shape[0], length > 0
        rank = jnp.cumsum(kept.astype(jnp.int32)) - 1
        slot = jnp.where(kept, (self.written + rank) % n, n)
        first = rows - jnp.sum(length)
        start = first + jnp.cumsum(length) - length
        # A buffer that was lost, and begun anew, holds none of the rows that are beyond its end.
        there = jnp.where(self.start + self.length <= first, self.length, 0)
        old, new = (self.start, there, self.value, self.late), (start, length, value, late)
        ring = [x.at[slot].set(y, mode="drop") for x, y in zip(old, new, strict=True)]
        ring = dict(zip(("start", "length", "value", "late"), ring, strict=True))
        more = jnp.sum(kept.astype(jnp.int32))
        return replace(self, **ring, written=self.written + more, fresh=self.fresh + more)

    def whole(self, replay: Replay) -> Bool[Array, " n"]:
        """Which of them are to be redistributed and have all their rows in the buffer."""
        return self.late & (self.length > 0) & (self.start >= replay.written - replay.capacity)


class Known(eqx.Module):
    """What is known between two generations."""

    model: PyTree
    opt: optax.OptState
    episodes: Episodes
    paid: Replay  # row by row as the replay buffer, of one reward alone
    due: Float[Array, ""]  # updates that are due, below 1
    signal: str = eqx.field(static=True)
    steps: int = eqx.field(static=True)  # of an episode, at most


class AbstractPrediction(AbstractRedistribution):
    """A model of returns; a method says how it is fitted and what it pays for each frame."""

    network: eqx.AbstractVar[Any]  # config of the model
    signal: eqx.AbstractVar[str | None]  # the reward that is redistributed; None: the task's first
    learning_rate: eqx.AbstractVar[float]  # step size of the model's Adam
    batch_size: eqx.AbstractVar[int]  # episodes per update of the model
    updates_per_frame: eqx.AbstractVar[float]  # updates of the model per frame played
    refresh: eqx.AbstractVar[int]  # past episodes that are paid anew for each new one
    memory: eqx.AbstractVar[int]  # episodes that the model learns from: the last ones

    def __check_init__(self):
        for name in ("batch_size", "memory"):
            require.at_least(name, getattr(self, name), 1)
        for name in ("learning_rate", "updates_per_frame", "refresh"):
            require.at_least(name, getattr(self, name), 0)

    @abc.abstractmethod
    def model(self, obs_size: int, action_size: int, *, key: PRNGKeyArray) -> PyTree:
        """A network with fresh weights."""

    @abc.abstractmethod
    def target(self, value: Array, length: Array) -> Array:
        """Of returns and lengths of episodes the number that is predicted; it is standardised."""

    @abc.abstractmethod
    def loss(self, model: PyTree, part: Part, target: Array, key: PRNGKeyArray) -> Any:
        """The error on some episodes with these targets, and None."""

    @abc.abstractmethod
    def rewards(self, model: PyTree, part: Part) -> Float[Array, "episodes steps"]:
        """What the model says of every step, in standard deviations of the target. What stands
        behind an episode's length means nothing."""

    def init(self, env, episodes, capacity, *, key):
        require.signal(self.signal, env.signals)
        signal, row = self.signal or env.signals[0], blank(env)
        if row.rewards[signal].ndim:
            raise ValueError(
                f"{signal!r} is paid to each agent apart: {type(self).__name__} redistributes a "
                "reward of one agent or of a whole team; name one by signal, or give Even()"
            )
        model = self.model(row.obs.size, row.action.size, key=key)
        paid = Transition(None, None, {signal: jnp.float32(0.0)}, None, jnp.bool_(False), None)  # pyright: ignore[reportArgumentType]
        ring = Episodes.none(max(self.memory, episodes))
        counted = (jnp.float32(0.0), signal, env.max_steps)
        return Known(model, adam_state(model), ring, Replay.empty(paid, capacity), *counted)

    def noted(self, known, replay, experience, played):
        value = played.returns[known.signal].reshape(-1)
        length = experience.lived(played)
        late = np.ones(length.shape, bool)
        late = experience.late(played, known.signal) if self.late_only else late
        new = (jnp.asarray(length, jnp.int32), jnp.asarray(value, jnp.float32), jnp.asarray(late))
        return replace(known, episodes=known.episodes.after(replay.written, *new))

    def taught(self, known, replay, moments, frames, *, key):
        known, loss = _taught(self, known, replay, moments, frames, key=key)
        rewards = replay.data.rewards | known.paid.data.rewards
        paid = eqx.tree_at(lambda r: r.data.rewards, replay, rewards)
        return known, paid, {"redistribution_loss": loss}


@jit
def _taught(how, known: Known, replay: Replay, moments: Moments | None, frames, *, key):
    """The model after its updates, and the rows that it pays; and the mean loss."""
    episodes = known.episodes
    whole = episodes.whole(replay)
    weight = jnp.where(whole, episodes.length, 0)
    target = how.target(episodes.value, jnp.maximum(episodes.length, 1).astype(jnp.float32))
    target, scale = _standardised(target, weight.astype(jnp.float32))
    due = known.due + frames.astype(jnp.float32) * how.updates_per_frame
    updates = jnp.where(jnp.any(whole), jnp.floor(due), 0.0).astype(jnp.int32)
    part = partial(Part, replay, moments, steps=known.steps)
    known = replace(known, due=due - jnp.floor(due))
    known, loss = _fitted(how, known, part, target, jnp.cumsum(weight), updates, key=key)
    known = _paid(how, known, part, whole, scale)
    return known, averaged({"": loss}, updates)[""]


def _standardised(x: Array, weight: Array) -> tuple[Array, Array]:
    """With mean 0 and standard deviation 1 by these weights; and what that was before."""
    weight = weight / jnp.maximum(jnp.sum(weight), 1.0)
    mean = jnp.sum(weight * x)
    scale = jnp.sqrt(jnp.sum(weight * jnp.square(x - mean)))
    scale = jnp.maximum(scale, 1e-4 * jnp.abs(mean) + 1e-8)
    return (x - mean) / scale, scale


def _fitted(how, known: Known, part, target: Array, ends: Array, updates: Array, *, key):
    """The model after `updates`, each on episodes drawn by their lengths, whose sums are `ends`;
    and the sum of the losses."""
    episodes = known.episodes
    dynamic, static = eqx.partition((known.model, known.opt), eqx.is_array)

    def body(i, loop):
        (model, opt), total = eqx.combine(loop[0], static), loop[1]
        draw_key, loss_key = jax.random.split(jax.random.fold_in(key, i))
        drawn = jax.random.randint(draw_key, (how.batch_size,), 0, jnp.maximum(ends[-1], 1))
        at = jnp.searchsorted(ends, drawn, side="right")
        given = (model, part(episodes.start[at], episodes.length[at]), target[at], loss_key)
        model, opt, (loss, _) = descend(how.loss, given, opt, how.learning_rate)
        return eqx.filter((model, opt), eqx.is_array), total + loss

    dynamic, total = jax.lax.fori_loop(0, updates, body, (dynamic, jnp.float32(0.0)))
    model, opt = eqx.combine(dynamic, static)
    return replace(known, model=model, opt=opt), total


def _paid(how, known: Known, part, whole: Array, scale: Array) -> Known:
    """With new rewards for the rows of fresh episodes, and of some past ones."""
    replay: Replay = part.args[0]
    episodes, steps, capacity = known.episodes, jnp.arange(known.steps), replay.capacity
    n, fresh = episodes.length.shape[0], episodes.fresh
    again = jnp.where(jnp.any(whole), how.refresh * fresh, 0)
    true = replay.data.rewards[known.signal]

    def pay(block, rewards):
        place = block * BLOCK + jnp.arange(BLOCK)
        past = (episodes.turn + place - fresh) % jnp.clip(episodes.written, 1, n)
        at = jnp.where(place < fresh, (episodes.written - 1 - place) % n, past)
        start, length = episodes.start[at], episodes.length[at]
        there = (steps[None] < length[:, None]) & (place < fresh + again)[:, None]
        there &= start[:, None] + steps[None] >= replay.written - capacity
        rows = (start[:, None] + steps[None]) % capacity
        said = scale * how.rewards(known.model, part(start, length))
        said = _summing(jnp.where(there, said, 0.0), episodes.value[at], length)
        said = jnp.where(whole[at][:, None], said, true[rows])
        return rewards.at[jnp.where(there, rows, capacity)].set(said, mode="drop")

    blocks = (fresh + again + BLOCK - 1) // BLOCK
    paid = jax.lax.fori_loop(0, blocks, pay, known.paid.data.rewards[known.signal])
    data = replace(known.paid.data, rewards={known.signal: paid})
    turn = (episodes.turn + again) % jnp.clip(episodes.written, 1, n)
    ring = replace(episodes, fresh=jnp.int32(0), turn=turn)
    return replace(known, episodes=ring, paid=Replay(data, replay.written))


def _summing(rewards: Array, value: Array, length: Array) -> Array:
    """`rewards` `[episodes, steps]` and equal parts of what they lack of the returns."""
    rest = (value - jnp.sum(rewards, axis=1)) / jnp.maximum(length, 1).astype(jnp.float32)
    return rewards + rest[:, None]
