"""A shortened task is the whole one up to its n-th question."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import rollout, tree
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_recall import SequenceRecall
from credo.environments.wrappers import Shortened
from credo.networks.mmu import MMU

TASKS = {
    "classification": SequenceClassification(depth=4, min_gap=1, max_gap=3),
    "recall": SequenceRecall(depth=4, min_corridor=1, max_corridor=3),
}
KEYS = jax.random.split(jax.random.key(0), 16)


def sample(task):
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda key: task.sample(key=key)))(KEYS))


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("questions", [1, 2, 3, 4, 5, 100])
def test_it_asks_that_many_questions_and_ends_with_the_last(name, questions):
    whole, short = sample(TASKS[name]), sample(Shortened(TASKS[name], questions))
    np.testing.assert_array_equal(short.inputs, whole.inputs)
    np.testing.assert_array_equal(short.targets, whole.targets)
    for i in range(len(KEYS)):
        asked = np.flatnonzero(whole.scored[i])[:questions]
        assert np.flatnonzero(short.scored[i]).tolist() == asked.tolist()
        assert len(asked) == min(questions, 4)
        assert short.length[i] == (asked[-1] + 1 if questions <= 4 else whole.length[i])


def test_sizes_and_rewards_are_those_of_the_task():
    task = TASKS["recall"]
    short = Shortened(task, 2)
    assert (short.obs_size, short.max_steps) == (task.obs_size, task.max_steps)
    assert short.signals == task.signals
    arguments = (jnp.float32(0.5), jnp.float32(1.0), jnp.bool_(True), jnp.bool_(True))
    assert short.reward(*arguments) == task.reward(*arguments) == pytest.approx(0.75 / 4)


def test_the_number_of_questions_is_data():
    """A level traced in one program gives what each level gives alone."""
    task = TASKS["classification"]
    lengths = jax.jit(
        lambda n: jax.vmap(lambda key: Shortened(task, n).sample(key=key).length)(KEYS)
    )
    for n in (1, 3):
        np.testing.assert_array_equal(lengths(jnp.int32(n)), sample(Shortened(task, n)).length)
    assert lengths._cache_size() == 1


def test_what_is_cut_off_is_not_played():
    task = TASKS["classification"]
    population = tree.stack(MMU(hidden=3).init(1, 1, key=jax.random.key(1)))
    steps = rollout.evaluate(
        Shortened(task, jnp.int32(1)), population, 8, key=jax.random.key(2)
    ).steps
    assert np.asarray(steps).tolist() == [[1] * 8]  # the first signal is at step 0
