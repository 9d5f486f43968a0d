"""A sequence task as an environment: reset and step walk along what `sample` drew."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.environments.probes import Remember
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_recall import SequenceRecall

TASKS = {
    "classification": SequenceClassification(depth=3, min_gap=1, max_gap=3),
    "recall": SequenceRecall(depth=2, min_corridor=1, max_corridor=3),
    "remember": Remember(delay=3),
}


def walk(task, key, answers):
    state, first = task.reset(key=key)
    step = eqx.filter_jit(task.step)
    seen = [first]
    while not (seen[-1].terminated or seen[-1].truncated):
        answer = jnp.array([answers[len(seen) - 1]])
        state, time_step = step(state, answer, key=jax.random.key(9))
        seen.append(time_step)
    return seen


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_steps_show_the_inputs_and_pay_the_rewards_of_sample(name, sign):
    task, key = TASKS[name], jax.random.key(3)
    sequence = jax.tree.map(np.asarray, task.sample(key=key))
    answers = sign * np.where(sequence.targets >= 0, 1.0, -1.0).astype(np.float32)
    seen = walk(task, key, answers)
    n = int(sequence.length)
    assert len(seen) == n + 1
    np.testing.assert_array_equal([s.obs for s in seen[:-1]], sequence.inputs[:n])
    right = (answers >= 0) == (sequence.targets > 0)
    perfect = np.logical_and.accumulate(right | ~sequence.scored)
    rewards = task.reward(*map(jnp.asarray, (answers, sequence.targets, sequence.scored, perfect)))
    np.testing.assert_allclose([s.rewards["fitness"] for s in seen[1:]], rewards[:n], rtol=1e-6)
    assert [float(s.rewards["success"]) for s in seen] == [0.0] * n + [float(sign == 1.0)]
    assert seen[0].rewards["fitness"] == 0.0
    assert bool(seen[-1].terminated)
    assert not bool(seen[-1].truncated)


@pytest.mark.parametrize("name", TASKS)
def test_a_key_is_an_episode(name):
    task = TASKS[name]
    sample = jax.jit(jax.vmap(lambda key: task.sample(key=key)))
    keys = jax.random.split(jax.random.key(0), 32)
    once, twice = (np.asarray(sample(keys).inputs) for _ in range(2))
    np.testing.assert_array_equal(once, twice)
    kinds = len(np.unique(once.reshape(32, -1), axis=0))
    assert kinds == 2 if name == "remember" else kinds > 8
