import itertools

import numpy as np
import pytest

from credo.analysis import bounds
from credo.environments.probes import Copy
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_recall import SequenceRecall


def enumerate_all(depth, ties):
    """Every signal sequence, every answer: no running sums kept, no counting trick."""
    signals = np.array(list(itertools.product((-1, 1), repeat=depth)))
    sums = np.cumsum(signals, axis=1)
    wanted = np.where(sums >= 0, 1, -1)
    free = (sums == 0) if ties == "free" else np.zeros_like(sums, bool)

    def success(answers):
        return ((answers == wanted) | free).all(axis=1).mean()

    return {
        "remember the first signal": success(np.repeat(signals[:, :1], depth, axis=1)),
        "echo the last signal": success(signals),
        "constant": max(success(np.ones_like(sums)), success(-np.ones_like(sums))),
    }


@pytest.mark.parametrize("ties", ["positive", "free"])
@pytest.mark.parametrize("depth", [1, 2, 3, 6, 11])
def test_classification_baselines_equal_full_enumeration(depth, ties):
    assert bounds.baselines(SequenceClassification(depth, ties=ties)) == enumerate_all(depth, ties)


@pytest.mark.parametrize(
    ("depth", "ties", "first", "echo"),
    [
        (5, "positive", 0.500, 0.188),
        (21, "positive", 0.256, 0.000),
        (5, "free", 0.625, 0.438),
        (21, "free", 0.336, 0.002),
    ],
)
def test_classification_baselines_at_known_depths(depth, ties, first, echo):
    found = bounds.baselines(SequenceClassification(depth, ties=ties))
    assert found["remember the first signal"] == pytest.approx(first, abs=5.1e-4)
    assert found["echo the last signal"] == pytest.approx(echo, abs=5.1e-4)


def test_deep_baselines_fall_as_the_arcsine_law_says():
    # P(a walk of d steps never falls below 0) ~ sqrt(2 / (π d)).
    found = bounds.baselines(SequenceClassification(200))
    assert found["constant"] == pytest.approx(np.sqrt(2 / (np.pi * 200)), rel=0.01)


def test_recall_baselines_equal_full_enumeration():
    depth = 6
    turns = np.array(list(itertools.product((-1, 1), repeat=depth)))
    found = bounds.baselines(SequenceRecall(depth))
    assert found["chance"] == found["repeat one direction"] == (turns == 1).all(axis=1).mean()
    assert found["repeat the first direction"] == (turns == turns[:, :1]).all(axis=1).mean()


def test_the_best_baseline_under_the_tasks_rule():
    assert bounds.best_baseline(SequenceClassification(depth=5)) == (
        "remember the first signal",
        0.5,
    )
    free = SequenceClassification(depth=5, ties="free")
    assert bounds.best_baseline(free) == ("remember the first signal", 0.625)
    assert bounds.best_baseline(SequenceRecall(depth=3)) == ("repeat the first direction", 0.25)


def test_a_perfect_memory_is_the_upper_bound():
    assert bounds.upper_bound(SequenceClassification(depth=5)) == (1.0, "optimal")
    assert bounds.upper_bound(SequenceRecall(depth=3)) == (1.0, "optimal")


def test_of_which_tasks_bounds_are_counted():
    assert bounds.exact(SequenceClassification())
    assert not bounds.exact(SequenceClassification(persistence=0.7))
    assert bounds.exact(SequenceRecall())
    assert not bounds.exact(Copy())


def test_a_task_without_bounds_is_told():
    with pytest.raises(TypeError, match="no baselines are known for Copy: give a Sequence"):
        bounds.baselines(Copy())
    with pytest.raises(TypeError, match="int"):
        bounds.upper_bound(3)
