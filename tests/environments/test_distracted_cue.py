"""Distracted Cue against sequences written by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.environments.distracted_cue import DistractedCue

KEY = jax.random.key(0)


def test_a_sequence_step_by_step():
    task = DistractedCue(1, 3)
    sequence = task.lay_out(jnp.array([-1.0, 1.0, 1.0, -1.0, 1.0]), jnp.int32(2))
    assert sequence.inputs[:, 0].tolist() == [-1, 1, 1, 0, 0]
    assert sequence.inputs[:, 1].tolist() == [1, 0, 0, 0, 0]
    assert sequence.inputs[:, 2].tolist() == [0, 0, 0, 1, 0]
    assert sequence.scored.tolist() == [False, False, False, True, False]
    assert float(sequence.targets[3]) == -1.0
    assert int(sequence.length) == 4


def test_drawn_ones_ask_for_the_cue_after_every_allowed_number_of_distractors():
    task = DistractedCue(2, 4)
    keys = jax.random.split(KEY, 400)
    drawn = jax.tree.map(np.asarray, jax.vmap(lambda key: task.sample(key=key))(keys))
    asked = drawn.scored.argmax(axis=1)
    assert (drawn.scored.sum(axis=1) == 1).all()
    assert set(asked.tolist()) == {3, 4, 5}
    assert (drawn.length == asked + 1).all()
    rows = np.arange(len(asked))
    assert (drawn.targets[rows, asked] == drawn.inputs[:, 0, 0]).all()
    distractors = drawn.inputs[:, 1:3, 0]
    assert set(np.unique(distractors)) == {-1.0, 1.0}
    agree = (distractors == drawn.inputs[:, :1, 0]).mean()
    assert agree == pytest.approx(0.5, abs=0.06)  # a distractor says nothing of the cue


def test_the_reward_is_the_answer_times_the_cue_where_it_is_asked_for():
    task = DistractedCue(0, 0)
    answer, target = jnp.array([0.5, 0.5]), jnp.array([-1.0, -1.0])
    scored, right = jnp.array([True, False]), jnp.array([False, True])
    assert task.reward(answer, target, scored, right).tolist() == [-0.5, 0.0]


@pytest.mark.parametrize("fields", [(-1, 2), (3, 2)])
def test_impossible_numbers_are_refused(fields):
    with pytest.raises(ValueError, match="needs 0 <= min_distractors <= max_distractors"):
        DistractedCue(*fields)
