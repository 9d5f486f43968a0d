import itertools

import numpy as np
import pytest

from credo.analysis import floors
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
def test_classification_floors_equal_full_enumeration(depth, ties):
    assert floors.classification_floors(depth, ties) == enumerate_all(depth, ties)


@pytest.mark.parametrize(
    ("depth", "ties", "first", "echo"),
    [
        (5, "positive", 0.500, 0.188),
        (21, "positive", 0.256, 0.000),
        (5, "free", 0.625, 0.438),
        (21, "free", 0.336, 0.002),
    ],
)
def test_classification_floors_at_known_depths(depth, ties, first, echo):
    found = floors.classification_floors(depth, ties)
    assert found["remember the first signal"] == pytest.approx(first, abs=5.1e-4)
    assert found["echo the last signal"] == pytest.approx(echo, abs=5.1e-4)


def test_deep_floors_fall_as_the_arcsine_law_says():
    # P(a walk of d steps never falls below 0) ~ sqrt(2 / (π d)).
    found = floors.classification_floors(200)
    assert found["constant"] == pytest.approx(np.sqrt(2 / (np.pi * 200)), rel=0.01)


def test_recall_floors_equal_full_enumeration():
    depth = 6
    turns = np.array(list(itertools.product((-1, 1), repeat=depth)))
    found = floors.recall_floors(depth)
    assert found["chance"] == found["repeat one direction"] == (turns == 1).all(axis=1).mean()
    assert found["repeat the first direction"] == (turns == turns[:, :1]).all(axis=1).mean()


def test_floor_names_the_best_trivial_policy_under_the_tasks_rule():
    assert floors.floor(SequenceClassification(depth=5)) == ("remember the first signal", 0.5)
    free = SequenceClassification(depth=5, ties="free")
    assert floors.floor(free) == ("remember the first signal", 0.625)
    assert floors.floor(SequenceRecall(depth=3)) == ("repeat the first direction", 0.25)


def test_errors_name_what_is_allowed():
    with pytest.raises(ValueError, match="depth is 0"):
        floors.classification_floors(0)
    with pytest.raises(ValueError, match="depth is 0"):
        floors.recall_floors(0)
    with pytest.raises(ValueError, match="'positive' or 'free'"):
        floors.classification_floors(3, "half")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="int"):
        floors.floor(3)  # pyright: ignore[reportArgumentType]
