"""Sequence Recall against mazes written by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.environments.sequence_recall import SequenceRecall


@pytest.fixture(scope="module")
def drawn():
    task = SequenceRecall(depth=3, min_corridor=2, max_corridor=5)
    keys = jax.random.split(jax.random.key(0), 300)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda key: task.sample(key=key)))(keys))


def test_a_small_maze_step_by_step():
    task = SequenceRecall(depth=2, min_corridor=1, max_corridor=4, unit=1)
    maze = task.lay_out(jnp.array([1.0, -1.0]), jnp.array([3, 2]))
    #          hear +1, -1 | corridor of 3 | corridor of 2 | padding
    signal = [1, -1, 0, 0, 0, 0, 0, 0, 0, 0]
    distance = [3, 3, 2, 1, 0, 1, 0, 0, 0, 0]
    junction = [0, 0, 0, 0, 1, 0, 1, 0, 0, 0]
    assert maze.inputs[:, 0].tolist() == signal
    assert maze.inputs[:, 1].tolist() == distance
    assert maze.scored.tolist() == [bool(x) for x in junction]
    assert int(maze.length) == 7
    assert maze.targets[jnp.array([4, 6])].tolist() == [1.0, -1.0]
    assert maze.targets[:2].tolist() == [0.0, 0.0]


def test_distances_are_scaled_by_the_longest_corridor():
    directions, corridors = jnp.array([1.0, -1.0]), jnp.array([3, 2])
    raw, scaled = (
        SequenceRecall(2, 1, 4, unit).lay_out(directions, corridors) for unit in (1, None)
    )
    np.testing.assert_allclose(scaled.inputs[:, 1] * 4, raw.inputs[:, 1], rtol=1e-6)
    np.testing.assert_array_equal(scaled.inputs[:, 0], raw.inputs[:, 0])


def test_every_drawn_maze_counts_down_and_asks_for_what_it_said(drawn):
    lengths = set()
    for signal, distance, targets, scored, length in zip(
        drawn.inputs[:, :, 0],
        np.round(drawn.inputs[:, :, 1] * 5).astype(int),
        drawn.targets,
        drawn.scored,
        drawn.length,
        strict=True,
    ):
        junctions = np.flatnonzero(scored)
        starts = np.append(3, junctions[:-1] + 1)
        for start, junction in zip(starts, junctions, strict=True):
            corridor = junction - start + 1
            lengths.add(int(corridor))
            assert distance[start : junction + 1].tolist() == list(range(corridor))[::-1]
        assert distance[:3].tolist() == [junctions[0] - 2] * 3
        assert targets[junctions].tolist() == signal[:3].tolist()
        assert not signal[3:].any()
        assert length == junctions[-1] + 1
    assert lengths == {2, 3, 4, 5}
    directions = drawn.inputs[:, :3, 0]
    assert set(np.unique(directions)) == {-1.0, 1.0}
    assert abs(directions.mean()) < 4 / np.sqrt(900)


def returns(task, maze, answers):
    """Fitness of given answers at the junctions, by the environment's own accounting."""
    total, perfect = 0.0, True
    for t in range(int(maze.length)):
        answer, target, scored = answers[t], float(maze.targets[t]), bool(maze.scored[t])
        perfect = perfect and (not scored or (answer >= 0) == (target > 0))
        total += float(
            task.reward(jnp.float32(answer), maze.targets[t], maze.scored[t], jnp.bool_(perfect))
        )
    return total


def test_rewards_run_from_minus_a_half_to_1():
    task = SequenceRecall(depth=2, min_corridor=1, max_corridor=3)
    maze = task.lay_out(jnp.array([1.0, -1.0]), jnp.array([2, 3]))
    targets = np.asarray(maze.targets)
    assert returns(task, maze, targets) == pytest.approx(1.0)
    assert returns(task, maze, -targets) == pytest.approx(-0.5)
    assert returns(task, maze, 0.5 * targets) == pytest.approx(0.75)
    # First turn right, second wrong: (½ + ½)/2 + (-½ + 0)/2.
    assert returns(task, maze, np.abs(targets)) == pytest.approx(0.25)
    # First wrong, second right: the prefix is lost for good.
    assert returns(task, maze, -np.abs(targets)) == pytest.approx(0.0)


def test_length_is_depth_plus_corridors_and_max_steps_its_bound(drawn):
    task = SequenceRecall(depth=3, min_corridor=2, max_corridor=5)
    assert task.max_steps == 3 + 3 * 5 == drawn.inputs.shape[1]
    assert int(task.lay_out(jnp.ones(3), jnp.array([5, 5, 5])).length) == 18
    assert drawn.length.min() >= 9
    assert drawn.length.max() <= 18
    assert drawn.length.mean() == pytest.approx(3 + 3 * 3.5, abs=0.5)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"depth": 0}, "depth is 0"),
        ({"min_corridor": 0}, "corridors of 0..20"),
        ({"min_corridor": 5, "max_corridor": 4}, "corridors of 5..4"),
    ],
)
def test_impossible_mazes_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        SequenceRecall(**fields)
