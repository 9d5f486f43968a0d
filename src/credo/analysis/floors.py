"""Floors and ceilings of the sequence tasks: what a policy with next to no memory scores.

A success rate means nothing beside 0: remembering one signal solves a third of 21-deep Sequence
Classification where ties are free. The values are exact: they count sequences with integers, one
running sum at a time, under the tie rule in force.

Sequence Classification at depth 5 / 21: remember the first signal .500 / .256 with ties in
class 1 and .625 / .336 with ties free; echo the last signal .188 / .000 and .438 / .002.
"""

from collections import defaultdict
from collections.abc import Callable
from typing import Literal

from ..environments.base import AbstractSequenceTask
from ..environments.sequence_classification import SequenceClassification
from ..environments.sequence_recall import SequenceRecall

CEILING = 1.0
"""Success of a perfect memory on either task, at any depth: neither hides anything."""

Ties = Literal["positive", "free"]


def classification_floors(depth: int, ties: Ties = "positive") -> dict[str, float]:
    """Strict success of trivial policies on Sequence Classification.

    **Arguments:** `depth` signals, at least 1 (the work grows with its square); `ties` as in
    `SequenceClassification`.
    **Returns:** the probability, in [0, 1], that every signal of a sequence is answered right.
    """
    _check_depth(depth)
    if ties not in ("positive", "free"):
        raise ValueError(f"ties is {ties!r}: it must be 'positive' or 'free'")

    def success(answer: Callable[[int, int], int]) -> float:
        return _solved(depth, ties, answer) / 2**depth

    return {
        "remember the first signal": success(lambda first, last: first),
        "echo the last signal": success(lambda first, last: last),
        "constant": max(success(lambda first, last: 1), success(lambda first, last: -1)),
    }


def recall_floors(depth: int) -> dict[str, float]:
    """Strict success of trivial policies on Sequence Recall.

    All 2^depth mazes are equally likely; a policy solves as many as it has different plans.

    **Arguments:** `depth` directions, at least 1.
    """
    _check_depth(depth)
    plans = {"chance": 1, "repeat one direction": 1, "repeat the first direction": 2}
    return {name: count / 2**depth for name, count in plans.items()}


def known(task: object) -> bool:
    """Whether `floor` has an answer for this task."""
    if isinstance(task, SequenceClassification):
        return task.persistence == 0.5  # the count is over equally likely sequences
    return isinstance(task, SequenceRecall)


def floor(task: AbstractSequenceTask) -> tuple[str, float]:
    """The best trivial policy on `task`: its name and its exact success."""
    if isinstance(task, SequenceClassification):
        floors = classification_floors(task.depth, task.ties)
    elif isinstance(task, SequenceRecall):
        floors = recall_floors(task.depth)
    else:
        raise TypeError(
            f"no floors are known for {type(task).__name__}: "
            "give a SequenceClassification or a SequenceRecall"
        )
    name = max(floors, key=lambda name: floors[name])
    return name, floors[name]


def _solved(depth: int, ties: Ties, answer: Callable[[int, int], int]) -> int:
    """How many of the 2^depth signal sequences `answer(first, last)` gets right at each signal."""
    alive = {(first, first): 1 for first in (-1, 1) if _right(answer(first, first), first, ties)}
    for _ in range(depth - 1):
        reached = defaultdict(int)  # (first signal, running sum): sequences without a mistake
        for (first, total), sequences in alive.items():
            for last in (-1, 1):
                if _right(answer(first, last), total + last, ties):
                    reached[first, total + last] += sequences
        alive = reached
    return sum(alive.values())


def _right(answer: int, total: int, ties: Ties) -> bool:
    if total == 0:
        return ties == "free" or answer > 0
    return (answer > 0) == (total > 0)


def _check_depth(depth: int) -> None:
    if depth < 1:
        raise ValueError(f"depth is {depth}: it must be at least 1")
