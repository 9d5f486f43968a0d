"""Streams of any length: does a finished policy count, and how far?

Source: Khadka (2019), section 3.2.3.3 and Table 3.2. A stream of Sequence Classification is fed
signal by signal and never laid out, so that memory does not depend on its length: a million
signals with their distractors, some 16 million steps, cost what the policy's carry costs.

The distractors between two signals are the same number for all lanes of a stream (policy by
signal sequence); the signals are not. So no lane ever waits for another.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .. import tree
from ..compilation import jit
from ..environments.base import correct
from ..networks.mmu import MMU, MMUPolicy
from .memory import memory_of


class RandomSignals(eqx.Module):
    """Signals ±1 with p = ½: signal `t` depends on the key and on `t` alone."""

    key: PRNGKeyArray
    streams: int = eqx.field(static=True)

    def __call__(self, t: Int[Array, ""]) -> Float[Array, " streams"]:
        return jax.random.rademacher(jax.random.fold_in(self.key, t), (self.streams,), jnp.float32)


class NegativesFirst(eqx.Module):
    """One stream: so many signals of -1, then +1 for ever."""

    negatives: Int[Array, ""]

    def __call__(self, t: Int[Array, ""]) -> Float[Array, " streams"]:
        return jnp.where(t < self.negatives, -1.0, 1.0)[None]


class RandomGaps(eqx.Module):
    """The number of zeros after signal `t`: uniform in `min_gap`..`max_gap`, both included."""

    key: PRNGKeyArray
    min_gap: int = eqx.field(static=True, default=10)
    max_gap: int = eqx.field(static=True, default=20)

    def __check_init__(self):
        if not 0 <= self.min_gap <= self.max_gap:
            raise ValueError(
                f"gaps of {self.min_gap}..{self.max_gap} zeros: needs 0 <= min_gap <= max_gap"
            )

    def __call__(self, t: Int[Array, ""]) -> Int[Array, ""]:
        key = jax.random.fold_in(self.key, t)
        return jax.random.randint(key, (), self.min_gap, self.max_gap + 1)


class Stream(eqx.Module):
    """What is known of a stream after the fact. The sign axis is (-1, +1)."""

    signals: Int[Array, " checkpoints"]  # signals fed up to here
    sums: Int[Array, "checkpoints policies streams"]  # their running sum
    memory: Float[Array, "checkpoints policies streams cells"]  # right after the last of them
    correct: Int[Array, "policies streams"]
    """Signals answered right before the first mistake: that mistake's index, counted from 0; or
    all signals fed if there was none."""
    counted: Int[Array, "policies streams sign cells"]
    """How many signals of that sign the cell counted, from the first on, before it once did not.

    A cell counts a signal if signal and distractors after it move the cell by at least
    `minimum`, in the direction in which the first signal of that sign moved it; and if it is not
    the distractors that do it: what the last one moved, times their number, is under half of
    that."""


class _Loop(eqx.Module):
    """The state between two signals. Lanes are policies × streams, on the last axis."""

    carry: PyTree  # leaves [features, lanes]
    fed: Int[Array, ""]
    fed_of_sign: Int[Array, "2 lanes"]
    correct: Int[Array, " lanes"]
    memory: Float[Array, "cells lanes"]
    direction: Float[Array, "2 cells lanes"]
    counted: Int[Array, "2 cells lanes"]

    @property
    def sums(self) -> Int[Array, " lanes"]:
        return self.fed_of_sign[1] - self.fed_of_sign[0]


@jit
def stream(
    policies: PyTree,
    signals: Callable[[Int[Array, ""]], Float[Array, " streams"]],
    gaps: Callable[[Int[Array, ""]], Int[Array, ""]],
    checkpoints: Int[Array, " checkpoints"],
    *,
    ties: Literal["positive", "free"] = "positive",
    minimum: float = 0.05,
    until_mistake: bool = False,
) -> Stream:
    """Feed Sequence Classification without end to a population of features-first policies.

    **Arguments:** `signals(t)`, signal `t` ±1 of every stream; `gaps(t)`, the zeros after it;
    `checkpoints`, ascending counts of signals at which memory is recorded, the last of which
    ends the stream (below 2^31); `minimum`, the smallest move of a cell that counts;
    `until_mistake` ends the stream once every lane has made one.
    """
    if not getattr(policies, "features_first", False):
        raise ValueError(
            f"{type(policies).__name__} is not features first: a stream needs such a policy "
            "(MMU, RNN, GRU, LSTM)"
        )
    lanes = (tree.size(policies), jax.eval_shape(signals, jnp.int32(0)).shape[0])
    packed = jax.tree.map(
        lambda x: jnp.repeat(jnp.moveaxis(x, 0, -1), lanes[1], axis=-1) if eqx.is_array(x) else x,
        policies,
    )

    def ongoing(loop: _Loop, stop):
        unfinished = loop.fed < stop
        return unfinished & jnp.any(loop.correct == loop.fed) if until_mistake else unfinished

    def period(loop: _Loop) -> _Loop:
        signal, zeros = jnp.tile(signals(loop.fed), lanes[0]), gaps(loop.fed)
        return _period(packed, loop, signal, zeros, minimum, ties)

    def advance(loop: _Loop, stop):
        loop = jax.lax.while_loop(lambda loop: ongoing(loop, stop), period, loop)
        return loop, (loop.fed, loop.sums, loop.memory)

    loop, (fed, sums, memory) = jax.lax.scan(advance, _start(packed, lanes), checkpoints)
    return Stream(
        signals=fed,
        sums=sums.reshape(-1, *lanes),
        memory=jnp.moveaxis(memory, 1, -1).reshape(-1, *lanes, memory.shape[1]),
        correct=loop.correct.reshape(lanes),
        counted=jnp.moveaxis(loop.counted, 2, 0).reshape(*lanes, 2, -1),
    )


def _start(packed: PyTree, lanes: tuple[int, int]) -> _Loop:
    carry = packed.start(key=None)
    memory = memory_of(carry)
    none = jnp.zeros(lanes[0] * lanes[1], jnp.int32)
    return _Loop(
        carry=carry,
        fed=jnp.int32(0),
        fed_of_sign=jnp.stack([none, none]),
        correct=none,
        memory=memory,
        direction=jnp.zeros((2, *memory.shape)),
        counted=jnp.zeros((2, *memory.shape), jnp.int32),
    )


def _period(packed: PyTree, loop: _Loop, signal, zeros, minimum, ties) -> _Loop:
    """A signal and the zeros after it: the only place where the policies step."""
    answer, carry = packed(signal[None], loop.carry)
    memory = memory_of(carry)

    def distract(_, carries):
        carry, _ = carries
        return packed(jnp.zeros_like(signal)[None], carry)[1], memory_of(carry)

    carry, before_last = jax.lax.fori_loop(0, zeros, distract, (carry, memory))
    net = memory_of(carry) - memory_of(loop.carry)
    drift = (memory_of(carry) - before_last) * zeros.astype(jnp.float32)
    moved = (jnp.abs(net) >= minimum) & (jnp.abs(drift) < 0.5 * jnp.abs(net))
    return _tally(loop, signal, answer[0], carry, memory, jnp.where(moved, net, 0.0), ties)


def _tally(loop: _Loop, signal, answer, carry, memory, move, ties) -> _Loop:
    """What one signal changes. `move` is 0 for a cell that did not count the signal."""
    of_sign = jnp.stack([signal < 0, signal > 0])
    fed_of_sign = loop.fed_of_sign + of_sign.astype(jnp.int32)
    total = (fed_of_sign[1] - fed_of_sign[0]).astype(jnp.float32)
    right = correct(answer, total + 0.5 if ties == "positive" else total)
    right = right & (loop.correct == loop.fed)

    of_sign, way = of_sign[:, None], jnp.sign(move)[None]
    direction = jnp.where(of_sign & (loop.direction == 0), way, loop.direction)
    counts = of_sign & (move != 0)[None] & (way == direction)
    counts = counts & (loop.counted == loop.fed_of_sign[:, None])
    return _Loop(
        carry=carry,
        fed=loop.fed + 1,
        fed_of_sign=fed_of_sign,
        correct=loop.correct + right.astype(jnp.int32),
        memory=memory,
        direction=direction,
        counted=loop.counted + counts.astype(jnp.int32),
    )


def logarithmic(total: int) -> list[int]:
    """1, 2, 5, 10, 20, 50, … below `total`, and `total`."""
    if total < 1:
        raise ValueError(f"a stream of {total} signals: it must have at least 1")
    steps = (digit * 10**power for power in range(len(str(total))) for digit in (1, 2, 5))
    return [*(step for step in steps if step < total), total]


class CountingStudy(eqx.Module):
    """Table 3.2 for several policies. The sign axis is (-1, +1)."""

    negatives: Int[Array, " rows"]  # signals -1 fed so far
    positives: Int[Array, " rows"]  # signals +1 fed so far
    memory: Float[Array, "rows policies cells"]  # right after the last signal
    counted: Int[Array, "policies sign cells"]  # see `Stream.counted`
    correct: Int[Array, " policies"]  # signals answered right before the first mistake

    def counts(self, signals: int) -> Bool[Array, " policies"]:
        """Has each policy a cell that counted the first `signals` signals of -1, and one (it may
        be the same) that counted as many of +1?"""
        return jnp.all(jnp.max(self.counted, axis=2) >= signals, axis=1)


def counting_study(
    policies: PyTree,
    negatives: int = 100_000,
    positives: int = 1_000_000,
    *,
    min_gap: int = 10,
    max_gap: int = 20,
    key: PRNGKeyArray,
) -> CountingStudy:
    """The protocol of Table 3.2: so many signals -1, then so many +1, each followed by
    distractors; a row at the start of every 1, 2, 5, 10, … signals of either sign.

    **Arguments:** `policies`, a population of features-first policies (`tree.stack` makes one).
    """
    minus, plus = (np.asarray(logarithmic(n), np.int32) for n in (negatives, positives))
    checkpoints = np.concatenate([minus, negatives + plus])
    signals = NegativesFirst(jnp.int32(negatives))
    kept = stream(policies, signals, RandomGaps(key, min_gap, max_gap), jnp.asarray(checkpoints))
    return CountingStudy(
        negatives=jnp.minimum(checkpoints, negatives),
        positives=jnp.maximum(checkpoints - negatives, 0),
        memory=kept.memory[:, :, 0],
        counted=kept.counted[:, 0],
        correct=kept.correct[:, 0],
    )


def longest_correct(
    policies: PyTree,
    depth: int = 1_000_000,
    streams: int = 10,
    *,
    min_gap: int = 10,
    max_gap: int = 20,
    ties: Literal["positive", "free"] = "positive",
    key: PRNGKeyArray,
) -> Int[Array, "policies streams"]:
    """Signals of random streams answered right before the first mistake; `depth` if none.

    Every policy gets the same streams. Ends early once all have failed.
    """
    if depth < 1:
        raise ValueError(f"depth is {depth}: it must be at least 1 signal")
    signal_key, gap_key = jax.random.split(key)
    signals, gaps = RandomSignals(signal_key, streams), RandomGaps(gap_key, min_gap, max_gap)
    checkpoints = jnp.array([depth], jnp.int32)
    return stream(policies, signals, gaps, checkpoints, ties=ties, until_mistake=True).correct


def exact_counter() -> MMUPolicy:
    """An MMU of 3 cells, written by hand, that solves Sequence Classification at any depth up
    to 2^23 signals: proof that the Chapter 3 instance can.

    M1 starts at +32 and gains 1 at each +1; M2 starts at -32 and loses 1 at each -1. At 32 the
    encoder's tanh is exactly ±1, and gates at ±100 are exactly 0 or 1. What a step writes is not
    yet in the memory that it reads, so the third hidden unit, p = σ(200 x), shows the output the
    present signal: y = σ(M1 + M2 + 2p - 1 + ½) has the sign of the running sum, a tie being +1.
    """
    shape = eqx.filter_eval_shape(MMU(hidden=3).init, 1, 1, key=jax.random.key(0))
    silent = jax.tree.map(lambda x: jnp.zeros(x.shape), shape)
    return dataclasses.replace(
        silent,
        b_i=jnp.full(3, 100.0),
        K_p=jnp.array([[0.0], [0.0], [200.0]]),
        b_p=jnp.array([-100.0, -100.0, 0.0]),
        b_r=jnp.array([100.0, 100.0, -100.0]),
        K_w=jnp.array([[200.0], [-200.0], [0.0]]),
        b_w=jnp.array([-100.0, -100.0, -200.0]),
        Z_y=jnp.array([[1.0, 1.0, 2.0]]),
        b_y=jnp.array([-0.5]),
        m_0=jnp.array([32.0, -32.0, 0.0]),
    )
