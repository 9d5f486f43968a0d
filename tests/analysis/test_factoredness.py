"""Factoredness, where it is known."""

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.analysis.factoredness import _agreement, factoredness, lines
from credo.environments.base import AbstractEnvironment
from credo.environments.probes import Copy, Meet
from credo.types import TimeStep


class Shares(AbstractEnvironment):
    """One step: the team gets the sum of all actions, agents what their names say."""

    obs_size: ClassVar[int] = 1
    action_size: ClassVar[int] = 1
    agents: ClassVar[int | None] = 3
    max_steps: ClassVar[int] = 1
    signals: ClassVar[tuple[str, ...]] = ("own", "against", "nothing", "team")

    def reset(self, *, key):
        return (), self._now(jnp.zeros((3, 1)), False)

    def step(self, state, action, *, key):
        return (), self._now(action, True)

    def _now(self, action, over):
        own, over = action[:, 0], jnp.bool_(over)
        rewards = {"own": own, "against": -own, "nothing": 0 * own, "team": jnp.sum(own)}
        return TimeStep(jnp.ones((3, 1)), rewards, over, jnp.bool_(False), jnp.ones(3, bool))


def test_of_rewards_whose_agreement_is_known():
    found = factoredness(Shares(), changes=4, worlds=1)
    assert {name: x.share for name, x in found.items()} == {
        "own": 1.0,
        "against": 0.0,
        "nothing": 0.5,
        "team": 1.0,
    }
    assert found["own"].counted == found["own"].tried == 32 * 4


def test_only_changes_of_the_team_count_and_a_tie_is_a_half():
    whole = np.array([0.0, 1.0, 0.0, -1.0, 2.0])[None, :, None]
    agent = np.array([[0, 1, 0, 1]])
    own = np.zeros((1, 5, 1, 2))
    own[0, 1:, 0, 0], own[0, 1:, 0, 1] = [5.0, 9.0, 0.0, 9.0], [9.0, 9.0, 9.0, 3.0]
    # Up and up; no change of the team; down and up for agent 0: none; up and up.
    found = _agreement(own, whole, agent)
    assert found == (pytest.approx((1 + 0.5 + 1) / 3), 3, 4)
    assert math.isnan(_agreement(own, np.zeros_like(whole), agent).share)


def test_a_task_of_one_agent_has_none():
    with pytest.raises(ValueError, match="one agent"):
        factoredness(Copy())
    assert lines(Copy()) == []


def test_what_is_printed():
    told = lines(Shares())
    assert told[1].split()[:2] == ["own", "1.00"]
    assert len(told) == 5
    assert jax.tree.leaves(lines(Meet())) == lines(Meet())
