"""What a finished policy keeps in its memory, and which of it matters.

Source: Khadka (2019), section 3.2.3: Table 3.1 (final states, masking, signatures), Figures 3.6
and 3.7 (writes), Algorithm 3 (the pseudo-algorithm). The probes take one policy whose carry is
(output, memory), as an MMU's; an LSTM's (h, c) and a plain array work too.
"""

import dataclasses
import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from ..compilation import jit
from ..environments.base import correct
from ..environments.sequence_classification import SequenceClassification
from ..environments.wrappers import Given
from ..networks.base import AbstractPolicy
from ..networks.dmmu import DMMUCarry
from ..networks.dnc import DNCPolicy
from ..networks.normalized import Normalized
from ..networks.ntm import NTMPolicy
from ..rollout import record
from ..types import Sequence

EXHAUSTIVE = 8
"""Up to so many cells all subsets are tried (256); beyond, cells are dropped one by one."""


def known_memory(carry: Any) -> Any:
    """The memory in a carry: what a DMMU's agents share, the second of a pair, or the carry itself
    if it is one array; None: no memory is known in it."""
    if isinstance(carry, DMMUCarry):
        return carry.memory
    if isinstance(carry, tuple):
        return carry[1] if len(carry) == 2 and eqx.is_array_like(carry[1]) else None
    return carry if eqx.is_array(carry) or isinstance(carry, np.ndarray) else None


def memory_of(carry: Any) -> Float[Array, "cells *batch"]:
    """`known_memory`. Raises `TypeError` if there is none."""
    memory = known_memory(carry)
    if memory is None:
        raise TypeError(
            f"no memory is known in a carry {jax.tree.structure(carry)}: it must be a pair "
            "(output, memory), as an MMU's, or one array"
        )
    return memory


def weightings(policy: AbstractPolicy, carries: PyTree) -> dict[str, Float[Any, "moments rows"]]:
    """How much each head of an NTM or a DNC looks at each row of the memory, moment by moment, by
    the head's name; of `carries` `[moments, ...]`. Empty for other policies."""
    inner = policy.policy if isinstance(policy, Normalized) else policy
    if not isinstance(inner, NTMPolicy | DNCPolicy):
        return {}
    _, _, at_read, at_write, *_ = carries
    found = {}
    for kind, heads in (("writing head", at_write), ("reading head", at_read)):
        heads = heads[:, None] if heads.ndim == 2 else heads  # a DNC has one head that writes
        for i in range(heads.shape[1]):
            number = f" {i + 1}" if heads.shape[1] > 1 else ""
            found[kind + number] = heads[:, i]
    return found


def permutations(depth: int) -> Float[np.ndarray, "n depth"]:
    """All 2^depth signal sequences, in the order of Table 3.1: by sum, -1 before +1."""
    signals = np.array(list(itertools.product((-1.0, 1.0), repeat=depth)), np.float32)
    return signals[np.argsort(signals.sum(axis=1), kind="stable")]


def lay_out(
    task: SequenceClassification, signals: Float[np.ndarray, "n depth"], gap: int = 15
) -> Sequence:
    """The sequences with these signals and `gap` zeros between two of them, leaves `[n, ...]`.
    Of `task` only the tie rule matters."""
    depth = signals.shape[1]
    fixed = dataclasses.replace(task, depth=depth, min_gap=gap, max_gap=gap)
    gaps = jnp.full(depth, gap)
    return jax.vmap(lambda row: fixed.lay_out(row, gaps))(jnp.asarray(signals, jnp.float32))


def with_memory(carry: Any, memory: Float[Array, "*agents cells"]) -> Any:
    """A carry with another memory, of a carry in which `known_memory` is known."""
    if isinstance(carry, DMMUCarry):
        return dataclasses.replace(carry, memory=memory)
    return (carry[0], memory) if isinstance(carry, tuple) else memory


class FinalStates(eqx.Module):
    """Table 3.1: one row per signal sequence."""

    signals: Float[Array, "n depth"]
    sums: Float[Array, " n"]
    memory: Float[Array, "n cells"]  # after the last signal
    right: Bool[Array, "n depth"]  # the answer at each signal


def final_states(
    policy: AbstractPolicy,
    task: SequenceClassification,
    signals: Float[np.ndarray, "n depth"] | None = None,
    gap: int = 15,
) -> FinalStates:
    """Where each signal sequence leaves the memory.

    **Arguments:** `signals`, all permutations of depth 3 by default; `gap`, the zeros between two
    signals, the same everywhere.
    """
    signals = permutations(3) if signals is None else signals
    sequences = lay_out(task, signals, gap)
    answers, memory = _recall(policy, sequences.inputs)
    right = correct(answers, sequences.targets)[:, :: gap + 1]
    rows = jnp.asarray(signals)
    return FinalStates(rows, jnp.sum(rows, axis=1), memory[:, -1], right)


class Masked(AbstractPolicy):
    """A policy some of whose cells are held at a fixed value, before every step; of a team with
    private memories the same of every agent."""

    policy: AbstractPolicy
    keep: Bool[Array, " cells"]  # cells left alone
    held: Float[Array, " cells"]  # the value of the others

    def start(self, *, key: PRNGKeyArray):
        return self._mask(self.policy.start(key=key))

    def __call__(self, obs, carry):
        action, carry = self.policy(obs, carry)
        return action, self._mask(carry)

    def _mask(self, carry):
        return with_memory(carry, jnp.where(self.keep, memory_of(carry), self.held))


class Relevance(eqx.Module):
    """Which cells a policy needs. Success is the share of sequences without a mistake."""

    success: float
    without: Float[np.ndarray, " cells"]  # success with only that cell masked
    needed: tuple[int, ...]  # the fewest cells that keep `success`, all others masked

    @property
    def marginal_value(self) -> Float[np.ndarray, " cells"]:
        """What masking each cell alone costs."""
        return self.success - self.without


def relevant_cells(policy: AbstractPolicy, sequences: Sequence) -> Relevance:
    """The value of each cell, by holding it at zero throughout a run, as if it were not there.

    Up to 8 cells `needed` is the smallest set (of equals the one with the best success, then the
    first); beyond, cells are dropped one at a time, the least missed first, and the set is only
    one from which no further cell can go.

    **Arguments:** `sequences` `[n, ...]`, `lay_out(task, permutations(3))` for Table 3.1.
    """
    held = jnp.zeros_like(memory_of(policy.start(key=jax.random.key(0))))

    def success(keep) -> np.ndarray:
        return np.asarray(_masked_success(policy, sequences, jnp.asarray(keep), held))

    cells = held.shape[0]
    unmasked = float(success(np.ones((1, cells), bool))[0])
    without = success(~np.eye(cells, dtype=bool))
    needed = _smallest if cells <= EXHAUSTIVE else _dropped
    return Relevance(unmasked, without, needed(success, cells, unmasked))


def _smallest(success, cells: int, goal: float) -> tuple[int, ...]:
    subsets = np.array(list(itertools.product((True, False), repeat=cells)))
    scores = success(subsets)
    good = [i for i in range(len(subsets)) if scores[i] >= goal]
    best = min(good, key=lambda i: (subsets[i].sum(), -scores[i]))
    return tuple(np.flatnonzero(subsets[best]).tolist())


def _dropped(success, cells: int, goal: float) -> tuple[int, ...]:
    keep = np.ones(cells, bool)
    while keep.any():
        # One row per cell, also for those gone, so that every round has the same shape.
        scores = np.where(keep, success(keep & ~np.eye(cells, dtype=bool)), -1.0)
        if scores.max() < goal:
            break
        keep[scores.argmax()] = False
    return tuple(np.flatnonzero(keep).tolist())


@jit
def _masked_success(policy, sequences: Sequence, keep, held) -> Float[Array, " masks"]:
    def one(keep):
        answers, _ = _recall(Masked(policy, keep, held), sequences.inputs)
        right = ~sequences.scored | correct(answers, sequences.targets)
        return jnp.mean(jnp.all(right, axis=1).astype(jnp.float32))

    return jax.lax.map(one, keep)


@jit
def _recall(policy, inputs: Float[Array, "n time in"]):
    """Answers `[n, time]` and the memory after each step `[n, time, cells]`."""

    def one(x):
        nothing = jnp.zeros(len(x))
        sequence = Sequence(x, nothing, nothing > 0, jnp.int32(len(x)))
        task = Given.alone(SequenceClassification(), sequence)
        played = record(task, policy, key=jax.random.key(0), padded=True)
        return played.actions[:, 0], memory_of(played.carries)[1:]

    return jax.vmap(one)(inputs)


def signature(
    memory: Float[Array, "*n cells"], cells: tuple[int, ...]
) -> Int[np.ndarray, "*n relevant"]:
    """Positions within `cells`, in ascending order of their value (Table 3.1)."""
    return np.argsort(np.asarray(memory)[..., list(cells)], axis=-1, kind="stable")


def writes(policy: AbstractPolicy, inputs: Float[Array, "time in"]) -> Float[Array, "time cells"]:
    """By how much each step moved each cell, with its sign; how far in Figures 3.6 and 3.7."""
    memory = _recall(policy, inputs[None])[1][0]
    start = memory_of(policy.start(key=jax.random.key(0)))
    return jnp.diff(memory, axis=0, prepend=start[None])


def share_at_signals(
    magnitudes: Float[Array, "time cells"], inputs: Float[Array, "time in"]
) -> float:
    """The share of all writing done at signals, in [0, 1]; 1 where distractors move nothing.
    A signal is a step whose first input is not 0. NaN if nothing is written at all."""
    at_signals = jnp.sum(jnp.where((inputs[:, 0] != 0)[:, None], magnitudes, 0.0))
    return float(at_signals / jnp.sum(magnitudes))


@dataclasses.dataclass(frozen=True)
class CellRole:
    """What one cell does, in units of memory per step."""

    cell: int  # counted from 0; the text prints from M1
    plus: float  # mean move at a signal +1
    minus: float  # mean move at a signal -1
    distractor: float  # mean move at a distractor
    drift: float  # mean distance moved by all distractors between two signals
    plus_share: float  # share of +1 at which it moved in its mean direction, and enough
    minus_share: float  # the same for -1
    role: str


def pseudo_algorithm(
    policy: AbstractPolicy,
    task: SequenceClassification,
    sequences: int = 50,
    *,
    threshold: float = 0.05,
    consistency: float = 0.9,
    key: PRNGKeyArray,
) -> tuple[CellRole, ...]:
    """Algorithm 3 as measured: the part each cell plays, over sequences drawn from `task`.

    The first of these that holds:

    - "moves on distractors": those between two signals move it by `threshold` or more;
    - "constant": no signal moves it by `threshold` on average;
    - "irregular": a signal that moves it does so at less than `consistency` of its occurrences;
    - "counts both (integrator)": +1 and -1 move it, in opposite directions;
    - "counts signals": +1 and -1 move it, in the same direction;
    - "counts +1" or "counts -1".
    """
    drawn = jax.vmap(lambda key: task.sample(key=key))(jax.random.split(key, sequences))
    memory = _recall(policy, drawn.inputs)[1]
    start = jnp.broadcast_to(memory_of(policy.start(key=key)), (sequences, 1, memory.shape[2]))
    played = np.asarray(drawn.length)[:, None] > np.arange(memory.shape[1])
    signals = np.asarray(drawn.inputs[:, :, 0])[played]
    moves = np.diff(np.asarray(memory), axis=1, prepend=np.asarray(start))[played]
    gap = (task.min_gap + task.max_gap) / 2
    return tuple(
        _role(cell, signals, moves[:, cell], gap, threshold, consistency)
        for cell in range(moves.shape[1])
    )


def _role(cell: int, signals, moves, gap: float, threshold: float, consistency: float) -> CellRole:
    def at(value):
        """Mean move, and the share of moves in that direction that reach the threshold."""
        here = moves[signals == value]
        mean = here.mean() if len(here) else 0.0
        reached = here * np.sign(mean) >= threshold
        return float(mean), float(reached.mean()) if len(here) else 0.0

    (plus, plus_share), (minus, minus_share) = at(1), at(-1)
    between = moves[signals == 0] if (signals == 0).any() else np.zeros(1)
    drift = float(np.abs(between).mean()) * gap
    moved = [
        share
        for mean, share in ((plus, plus_share), (minus, minus_share))
        if abs(mean) >= threshold
    ]
    if drift >= threshold:
        role = "moves on distractors"
    elif not moved:
        role = "constant"
    elif min(moved) < consistency:
        role = "irregular"
    elif len(moved) == 2:
        role = "counts both (integrator)" if plus * minus < 0 else "counts signals"
    else:
        role = "counts +1" if abs(plus) >= threshold else "counts -1"
    return CellRole(cell, plus, minus, float(between.mean()), drift, plus_share, minus_share, role)


def describe(roles: tuple[CellRole, ...]) -> str:
    """The pseudo-algorithm as text, in the form of Algorithm 3, and the role of each cell."""

    def line(name: str, otherwise: str) -> str:
        moving = [r for r in roles if abs(getattr(r, name)) >= 0.005]
        return ", ".join(f"M{r.cell + 1} {getattr(r, name):+.2f}" for r in moving) or otherwise

    cells = ", ".join(f"M{r.cell + 1}" for r in roles)
    return "\n".join(
        [
            "for each item of the input:",
            f"    if the item is -1: {line('minus', 'no cell moves')}",
            f"    if the item is +1: {line('plus', 'no cell moves')}",
            f"    if the item is 0: {line('distractor', 'no cell moves')}",
            f"    answer f({cells})",
            *(f"M{r.cell + 1}: {r.role}" for r in roles),
        ]
    )


def probe(policy: AbstractPolicy, task: SequenceClassification) -> dict[str, np.ndarray]:
    """Table 3.1 of one champion: its memory after every permutation of `task`'s signals.

    **Returns:** by permutation `permutations`, their `sums`, the final `memory`, whether every
    answer was `right`, and `signatures` (of the cells that are needed); by cell the
    `masking costs`; the cells `needed`, from 0; the largest difference of a needed cell between
    permutations of equal sum (`spread`); and whether a signature always means the same class.
    """
    states = final_states(policy, task)
    relevance = relevant_cells(policy, lay_out(task, permutations(task.depth)))
    final, sums = np.asarray(states.memory), np.asarray(states.sums)
    needed = list(relevance.needed)
    spread = [np.ptp(final[sums == x][:, needed], axis=0).max(initial=0.0) for x in np.unique(sums)]
    signatures = signature(states.memory, relevance.needed)
    pairs = {(tuple(s), bool(x > 0)) for s, x in zip(signatures.tolist(), sums, strict=True)}
    return {
        "permutations": np.asarray(states.signals, int),
        "sums": sums.astype(int),
        "memory": final,
        "right": np.all(np.asarray(states.right), axis=1, keepdims=False),
        "signatures": signatures,
        "masking costs": np.asarray(relevance.marginal_value),
        "needed": np.array(needed, int),
        "spread": np.array(max(spread)),
        "predicts": np.array(len({x for x, _ in pairs}) == len(pairs)),
    }
