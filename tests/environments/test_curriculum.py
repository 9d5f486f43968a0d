"""A curriculum: what is played at a level, and when the next one begins."""

import jax
import jax.numpy as jnp
import pytest

from credo.environments.curriculum import Curriculum
from credo.environments.probes import Copy
from credo.environments.sequence_classification import SequenceClassification

TASK = SequenceClassification(depth=4, min_gap=1, max_gap=2)


@pytest.mark.parametrize(
    ("success", "level"), [(0.0, 3), (0.79, 3), (0.8, 4), (1.0, 4), (float("nan"), 3)]
)
def test_the_level_rises_by_one_at_the_threshold(success, level):
    curriculum = Curriculum(threshold=0.8)
    risen = curriculum.next(jnp.int32(3), jnp.float32(success))
    assert int(risen) == level
    assert risen.dtype == jnp.int32


def test_a_level_is_a_number_of_questions():
    for level in (1, 3, 9):
        sequence = Curriculum().task(TASK, jnp.int32(level)).sample(key=jax.random.key(0))
        assert int(sequence.scored.sum()) == min(level, 4)


def test_it_may_train_on_a_longer_task():
    longer = SequenceClassification(depth=6, min_gap=1, max_gap=2)
    task = Curriculum(whole=longer).task(TASK, jnp.int32(9))
    assert task.max_steps == longer.max_steps > TASK.max_steps
    assert int(task.sample(key=jax.random.key(0)).scored.sum()) == 6


def test_a_task_without_questions_is_refused():
    with pytest.raises(TypeError, match="Copy is no sequence task"):
        Curriculum().task(Copy(), jnp.int32(1))


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"start": 0}, "start is 0: it must be at least 1"),
        ({"threshold": 1.5}, "threshold is 1.5"),
        ({"threshold": -0.1}, "threshold is -0.1"),
    ],
)
def test_impossible_settings_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        Curriculum(**fields)
