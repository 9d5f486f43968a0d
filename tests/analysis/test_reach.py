"""Probes of memory against policies written by hand, of which it is known what they remember."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import tree
from credo.analysis import probes
from credo.environments.base import AbstractSequenceTask
from credo.environments.distracted_cue import DistractedCue
from credo.environments.double_pole import DoublePole
from credo.environments.endless_tmaze import EndlessTMaze
from credo.environments.passive_tmaze import PassiveTMaze
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_copy import RepeatCopy, SequenceCopy
from credo.environments.sequence_recall import SequenceRecall
from credo.environments.wrappers import NoisyObservations, delayed
from credo.networks.base import AbstractPolicy
from credo.networks.mlp import MLP

KEY = jax.random.key(3)


class Fading(AbstractPolicy):
    """It walks, and turns to the first sign it saw while what is left of it is above ½. Cells 0 and
    1 hold the sign, cell 2 nothing."""

    keeps: jax.Array  # of the memory at each step

    def start(self, *, key=None):
        return jnp.zeros(3)

    def __call__(self, obs, carry):
        carry = jnp.where(obs[0] != 0, obs[0] * jnp.array([1.0, 1.0, 0.0]), self.keeps * carry)
        sign = jnp.where(jnp.max(jnp.abs(carry)) > 0.5, jnp.sign(carry[0] + carry[1]), 0.0)
        return jnp.stack([jnp.float32(1.0), jnp.where(sign == 0, 1.0, sign)]), carry


def test_the_curve_falls_where_memory_ends():
    """½^(1/30) is left of each step: the sign is known for 29 steps behind it."""
    policies = tree.stack(Fading(jnp.float32(0.5 ** (1 / 30))), Fading(jnp.float32(1.0)))
    found = probes.reach(PassiveTMaze(14), policies, (1, 2, 3), 200, key=KEY)
    assert [step.times for step in found] == [1, 2, 3]
    assert [step.changed for step in found] == ["length 14", "length 28", "length 42"]
    means = np.array([step.scores.mean(axis=1) for step in found])
    assert means[:, 1].tolist() == [1.0, 1.0, 1.0]
    assert means[:2, 0].tolist() == [1.0, 1.0]
    assert means[2, 0] == pytest.approx(0.5, abs=0.1)


def test_the_curve_is_that_of_the_task_inside_a_wrapper():
    policy = tree.single(Fading(jnp.float32(1.0)))
    (found,) = probes.reach(delayed(PassiveTMaze(3)), policy, (2,), 5, key=KEY)
    assert found.changed == "length 6"
    assert found.scores.tolist() == [[1.0] * 5]


def test_a_task_without_such_a_setting_is_refused():
    with pytest.raises(ValueError, match="DoublePole has no setting that says for how long"):
        probes.reach(DoublePole(), None, key=KEY)


@pytest.mark.parametrize(
    ("task", "fields"),
    [
        (PassiveTMaze(5), {"length": 15}),
        (EndlessTMaze(2, 3, 4), {"min_length": 9, "max_length": 12, "corridors": 2}),
        (DistractedCue(2, 5), {"min_distractors": 6, "max_distractors": 15}),
        (SequenceClassification(7), {"depth": 21, "max_gap": 20}),
        (SequenceRecall(2, 4, 5), {"min_corridor": 12, "max_corridor": 15, "unit": 5}),
        (SequenceRecall(2, 4, 5, unit=1), {"max_corridor": 15, "unit": 1}),
        (SequenceCopy(2, 1, 3), {"min_length": 3, "max_length": 9}),
        (RepeatCopy(2, 1, 3), {"min_length": 3, "max_length": 9, "max_repeats": 10}),
    ],
)
def test_three_times_as_long(task, fields):
    longer = task.longer(3)
    assert {name: getattr(longer, name) for name in fields} == fields
    assert longer.sizes == task.sizes
    assert longer.max_steps > task.max_steps


def test_wrappers_hand_it_on():
    assert delayed(PassiveTMaze(2)).longer(2) == delayed(PassiveTMaze(4))
    noisy = NoisyObservations(PassiveTMaze(2), 0.1)
    assert noisy.longer(2) == NoisyObservations(PassiveTMaze(4), 0.1)
    assert delayed(DoublePole()).longer(2) is None


def test_the_unit_of_longer_corridors_is_that_of_training():
    """Else a corridor of twice the steps would look like the trained one."""
    task = SequenceRecall(1, 4, 4)
    longest = np.asarray(task.longer(2).sample(key=KEY).inputs)
    assert isinstance(task, AbstractSequenceTask)
    assert longest[:, 1].max() == 2.0


def test_what_two_cells_hold_is_missed_with_both_alone():
    policy = Fading(jnp.float32(1.0))
    found = probes.worth_of_cells(PassiveTMaze(3), policy, 400, key=KEY)
    assert found is not None
    assert found.score == 1.0
    assert found.without.tolist() == [1.0, 1.0, 1.0]
    assert found.alone[:2].tolist() == [1.0, 1.0]
    assert found.alone[2] == found.nothing == pytest.approx(0.5, abs=0.1)


def test_nothing_is_told_of_a_policy_without_memory():
    policy = MLP((2,)).init(2, 2, key=KEY)
    assert probes.worth_of_cells(PassiveTMaze(3), policy, key=KEY) is None
