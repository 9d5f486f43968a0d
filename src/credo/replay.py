"""Replay: a ring buffer of transitions on the device.

Written by whole rollouts, of which some rows are padding; read by minibatches. A phase that
writes donates it: extending 1 GB in place takes milliseconds, copying it half a second.
"""

import contextlib
import contextvars
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from . import memory, require
from .compilation import jit
from .types import Transition, Windows

_filled = contextvars.ContextVar("_filled", default=True)
SMALL = 2**28  # bytes for which it is not asked whether there is room
BLOCK = 1024  # rows that come from the host at a time: one shape, so one program


class Sampling(eqx.Module):
    """How minibatches are drawn from a buffer."""

    steps: int = eqx.field(static=True, default=1)
    """n: steps whose rewards a transition sums up, fewer where an episode ends, at least 1: n-step
    returns (Sutton & Barto 2018, equation 7.1)."""
    half_life: float | None = None
    """Age at which a transition is drawn half as often as a new one, above 0, in transitions; None:
    all are drawn alike."""
    window: int = eqx.field(static=True, default=64)
    """Rows in a row that a network with memory learns from, at least 1; others learn from frames on
    their own."""
    burn_in: int = eqx.field(static=True, default=16)
    """Rows before such a window that refresh a stored memory, unless the episode begins there, at
    least 0 (Kapturowski et al. 2019, "Recurrent Experience Replay", section 3)."""

    def __check_init__(self):
        require.at_least("steps", self.steps, 1)
        require.at_least("window", self.window, 1)
        require.at_least("burn_in", self.burn_in, 0)
        if isinstance(self.half_life, int | float) and not self.half_life > 0:
            raise ValueError(f"half_life is {self.half_life}: it must be above 0, or None")

    def draw(self, replay: "Replay", shape: tuple[int, ...], *, key: PRNGKeyArray) -> Array:
        """Numbers of rows of a buffer, with replacement."""
        if self.half_life is None:
            return jax.random.randint(key, shape, 0, jnp.maximum(replay.size, 1))
        return _recent(replay, self.half_life, jax.random.uniform(key, shape))


UNIFORM = Sampling()
Sampled = tuple[Transition, Any]  # and the discount behind each, or None
Windowed = tuple[Transition, None, Windows]


def _recent(replay: "Replay", half_life: float, u: Array) -> Array:
    """Rows whose ages are exponentially distributed up to that of the oldest, by the inverse of
    their distribution function at `u`, uniform in [0, 1)."""
    size = jnp.maximum(replay.size, 1)
    oldest = 1.0 - jnp.exp2(-size.astype(jnp.float32) / half_life)
    age = -half_life * jnp.log2(1.0 - u * oldest)
    age = jnp.minimum(age.astype(jnp.int32), size - 1)
    return (replay.position - 1 - age) % replay.capacity


class Replay(eqx.Module):
    """The last `capacity` transitions. Once it is full the oldest is overwritten."""

    data: Transition  # leaves [capacity, ...]
    written: Int[Array, ""]  # rows ever written, below 2^31

    @classmethod
    def empty(cls, row: Transition, capacity: int) -> "Replay":
        """Room for `capacity` rows like `row`.

        **Raises:** `ValueError` if that is more memory than this process may take.
        """
        require.at_least("capacity", capacity, 1)
        size = row_bytes(row)
        if _filled.get() and capacity * size > SMALL:
            require.memory(capacity, size, _free())
        zeros = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), row)
        return cls(zeros, jnp.int32(0))

    @property
    def capacity(self) -> int:
        return self.data.terminated.shape[0]

    @property
    def position(self) -> Int[Array, ""]:
        """The next row to be written."""
        return self.written % self.capacity

    @property
    def size(self) -> Int[Array, ""]:
        """Rows that hold something."""
        return jnp.minimum(self.written, self.capacity)

    def extend(self, rows: Transition, valid: Bool[Array, " n"]) -> "Replay":
        """With the valid ones of `rows`, leaves `[n, ...]`, behind what is there, in order."""
        n = jnp.sum(valid.astype(jnp.int32))
        rank = jnp.cumsum(valid.astype(jnp.int32)) - 1
        # Of more rows than there is room for, the last ones stay. Others get a slot that is
        # none, which `drop` leaves out.
        kept = valid & (rank >= n - self.capacity)
        slot = jnp.where(kept, (self.position + rank) % self.capacity, self.capacity)
        data = jax.tree.map(lambda old, new: old.at[slot].set(new, mode="drop"), self.data, rows)
        return Replay(data, self.written + n)

    def sample(self, n: int, sampling=UNIFORM, gamma: Any = 1.0, *, together=False, key) -> Sampled:
        """`n` transitions with replacement, and `gamma` to the number of steps that each spans;
        None if that is one. There must be at least one row.

        Of a team all leaves get an axis of agents, `[n, agents, ...]`. Each agent has rows of its
        own, as from a buffer of its own, unless they are drawn `together`.
        """
        team = () if together else self.data.action.shape[1:-1]
        index = sampling.draw(self, (n, *team), key=key)
        rows = self._rows(index)
        return (rows, None) if sampling.steps == 1 else self._followed(rows, index, sampling, gamma)

    def windows(
        self, n: int, sampling=UNIFORM, gamma: Any = 1.0, *, together=False, key
    ) -> Windowed:
        """About `n` rows in windows of `sampling.burn_in + sampling.window`, each around a row
        drawn as by `sample` and within its episode, as far as that is long enough: what stands
        behind its end is zeros and does not count, nor does the burn-in of a window that begins
        within it.

        **Returns:** the rows, `[windows · length, *agents, ...]`, `active` where they count; None,
        for each spans one step (`sample`); and the windows.
        """
        n = max(round(n / sampling.window), 1)
        length, team = sampling.burn_in + sampling.window, self.data.action.shape[1:-1]
        row_key, place_key = jax.random.split(key)
        shape = (n, *(() if together else team))
        row = sampling.draw(self, shape, key=row_key)
        place = jax.random.randint(place_key, shape, sampling.burn_in, length)
        # Near its end a window is moved back, so that an episode no longer than it is seen whole.
        before, behind = self._before(row, length - 1), self._behind(row, length - 1)
        place = jnp.minimum(jnp.maximum(place, length - 1 - behind), before)
        first = (row - place) % self.capacity
        first = jnp.broadcast_to(first.reshape(n, -1), (n, *(team or (1,))))
        # Of the first row ever nothing was overwritten, so an episode begins there.
        whole = self.written <= self.capacity
        fresh = jnp.where(first == self._oldest, whole, self._over(first - 1))
        steps = jnp.arange(length)[None, :, None]
        inside = steps <= self._behind(first, length - 1)[:, None]
        counts = inside & (fresh[:, None] | (steps >= sampling.burn_in))
        at = ((first[:, None] + steps) % self.capacity).reshape(n * length, -1)
        inside, counts = (x.reshape(n * length, *team) for x in (inside, counts))
        if not team:
            at, first, fresh = at[:, 0], first[:, 0], fresh[:, 0]
        rows = jax.tree.map(lambda x: _where(inside, x), replace(self._rows(at), memory=None))
        rows = replace(rows, active=counts if rows.active is None else counts & rows.active)
        memory: Any = self._rows(first).memory
        return rows, None, Windows(fresh, memory, length, sampling.burn_in)

    @property
    def _oldest(self) -> Int[Array, ""]:
        """The row that will be overwritten first."""
        return jnp.where(self.written > self.capacity, self.position, 0)

    def _over(self, row: Int[Array, "*any"]) -> Bool[Array, "*any"]:
        """Whether an episode ends with this row, for all agents. Rows do not say whether a world
        goes on that all of them left at once: that counts as its end."""
        row = row % self.capacity
        ended = self.data.terminated[row]
        return ended.reshape(*row.shape, -1).all(axis=-1) | self.data.truncated[row]

    def _before(self, row: Int[Array, "*any"], most: int) -> Int[Array, "*any"]:
        """How many rows of the same episode stand before this one; `most` if there are more."""
        back = row[..., None] - _steps(row, most)
        goes_on = ~self._over(back - 1) & (back % self.capacity != self._oldest)
        return jnp.sum(jnp.cumprod(goes_on.astype(jnp.int32), axis=-1), axis=-1)

    def _behind(self, row: Int[Array, "*any"], most: int) -> Int[Array, "*any"]:
        """How many rows of the same episode stand behind this one; `most` if there are more."""
        on = row[..., None] + _steps(row, most)
        goes_on = ~self._over(on) & ((on + 1) % self.capacity != self.position)
        return jnp.sum(jnp.cumprod(goes_on.astype(jnp.int32), axis=-1), axis=-1)

    def _followed(self, rows: Transition, index: Int[Array, "n *agents"], sampling, gamma):
        """Rows that go on for several steps, and the discount behind each."""
        discount = jnp.full(rows.terminated.shape, gamma)
        on = jnp.ones(rows.terminated.shape, bool)
        for step in range(1, sampling.steps):
            # Episodes lie one behind the other, and behind the newest row there is the oldest.
            at = (index + step) % self.capacity
            on = on & ~(rows.terminated | rows.truncated)
            on = on & jnp.broadcast_to(at != self.position, on.shape)
            later = self._rows(at)
            if later.active is not None:  # who has left is followed no further
                on = on & later.active if on.ndim > 1 else on
            rows = rows.followed(later, on, discount)
            discount = jnp.where(on, gamma * discount, discount)
        return rows, discount

    def _rows(self, index: Int[Array, "n *agents"]) -> Transition:
        if self.data.action.ndim > 2:
            return self._of_team(index)
        return jax.tree.map(lambda x: x[index], self.data)

    def _of_team(self, index: Int[Array, "n *agents"]) -> Transition:
        """Each agent's part of its own row; what all share is repeated."""
        n, agents = len(index), self.data.action.shape[1]
        index = jnp.broadcast_to(index.reshape(n, -1), (n, agents))
        every = jnp.arange(agents)
        return jax.tree.map(lambda x: x[index] if x.ndim == 1 else x[index, every], self.data)

    def spread(self, signal: str) -> Float[Array, ""]:
        """Root mean square of a reward over all rows."""
        rewards = self.data.rewards[signal]
        each = jnp.mean(jnp.square(rewards).reshape(self.capacity, -1), axis=1)  # 0 where none is
        return jnp.sqrt(jnp.sum(each) / jnp.maximum(self.size, 1).astype(jnp.float32))


def _where(inside: Array, x: Array) -> Array:
    """`x` in these rows, of these agents; zeros elsewhere."""
    inside = inside.reshape(*inside.shape, *(1,) * (x.ndim - inside.ndim))
    return jnp.where(inside, x, jnp.zeros_like(x))


def _steps(row: Array, most: int) -> Int[Array, "*any most"]:
    """0 to below `most`, behind the axes of `row`."""
    return jnp.arange(most, dtype=row.dtype).reshape(*(1,) * row.ndim, most)


@contextlib.contextmanager
def shapes_alone() -> Iterator[None]:
    """Buffers made here are never filled, so they may be larger than the memory: who asks for the
    shapes of a state may only want to read a policy."""
    token = _filled.set(False)
    try:
        yield
    finally:
        _filled.reset(token)


def extend(replay: Replay, rows: Transition, valid: Array | None = None) -> Replay:
    """`Replay.extend` for rows from anywhere; `replay` is donated. Rows from the host, all of them
    valid, go in blocks, so that their number is data."""
    return _extended(replay, rows) if valid is None else _extend((rows, valid), replay)


def _extended(replay: Replay, rows: Transition) -> Replay:
    """With rows from the host, block by block."""
    n = rows.terminated.shape[0]
    blocks = range(0, n, BLOCK)
    padded = jax.tree.map(lambda x: np.resize(x, (len(blocks) * BLOCK, *x.shape[1:])), rows)
    for start in blocks:
        block = jax.tree.map(lambda x, start=start: x[start : start + BLOCK], padded)
        replay = _extend((block, np.arange(start, start + BLOCK) < n), replay)
    return replay


@jit(donate="all-except-first")
def _extend(new: tuple[Transition, Any], replay: Replay) -> Replay:
    return replay.extend(*new)


def row_bytes(row: Transition) -> int:
    """Bytes one transition takes, and once more its largest part, as while it is read from disk."""
    sizes = [math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(row)]
    return sum(sizes) + max(sizes)


def _free() -> int:
    """Bytes of the device, if it has memory of its own; else what this process may still take."""
    own = jax.devices()[0].memory_stats() or {}
    return own["bytes_limit"] if "bytes_limit" in own else memory.available()
