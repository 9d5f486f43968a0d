"""Baselines of the sequence tasks: what a policy with next to no memory scores.

The values are exact: they count sequences with integers, one running sum at a time, under the tie
rule in force. A perfect memory scores 1 on either task, at any depth: neither hides anything.

Sequence Classification at depth 5 / 21: remember the first signal .500 / .256 with ties in
class 1 and .625 / .336 with ties free; echo the last signal .188 / .000 and .438 / .002.
"""

from collections import defaultdict
from collections.abc import Callable
from typing import Literal

from ..environments.sequence_classification import SequenceClassification
from ..environments.sequence_recall import SequenceRecall
from ..types import Bound

Ties = Literal["positive", "free"]


def baselines(task: SequenceClassification | SequenceRecall) -> dict[str, float]:
    """Strict success of trivial policies: the probability, in [0, 1], that every answer of a
    sequence is right. Of classification the work grows with the square of its depth."""
    if isinstance(task, SequenceRecall):
        # All 2^depth mazes are equally likely; a policy solves as many as it has different plans.
        plans = {"chance": 1, "repeat one direction": 1, "repeat the first direction": 2}
        return {name: count / 2**task.depth for name, count in plans.items()}

    def success(answer: Callable[[int, int], int]) -> float:
        return _solved(task.depth, task.ties, answer) / 2**task.depth

    return {
        "remember the first signal": success(lambda first, last: first),
        "echo the last signal": success(lambda first, last: last),
        "constant": max(success(lambda first, last: 1), success(lambda first, last: -1)),
    }


def upper_bound(task: SequenceClassification | SequenceRecall) -> Bound:
    """That of a perfect memory."""
    return Bound(1.0, "optimal")


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
