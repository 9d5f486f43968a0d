"""The example of a team of one's own keeps what docs/tutorials/own-team.md says of it."""

import pathlib

import numpy as np
import pytest

from credo.environments.pettingzoo import PettingZoo
from credo.environments.worker import Environments

EXAMPLES = pathlib.Path(__file__).parents[2] / "examples"


@pytest.fixture
def carry(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return PettingZoo("own_team:Carry", in_process=True)


def test_it_names_a_sparse_team_reward_beside_dense_local_ones(carry):
    assert (carry.obs_size, carry.action_size, carry.agents, carry.max_steps) == (10, 2, 3, 50)
    assert carry.signals == ("global", "local")
    assert carry.task_record()["names"] == ["agent_0", "agent_1", "agent_2"]


def test_a_script_carries_the_box_and_is_paid_once(carry):
    copy, active = Environments(carry.spec(), 1), np.ones(1, bool)
    frame, paid, local = copy.reset(np.array([3], np.uint32), active), [], []
    while not (frame.terminated[0] or frame.truncated[0]):
        ways = frame.obs[0, :, 4:].reshape(3, 3, 2)  # to the box: its own first, then the others'
        near = np.linalg.norm(ways, axis=2)
        held = (near < 0.2).all(axis=1, keepdims=True)
        to_box = np.where(near[:, :1] >= 0.1, np.clip(10 * ways[:, 0], -1, 1), 0.0)
        action = np.where(held, [[1.0, 0.0]], to_box).astype(np.float32)
        frame = copy.step(action[None], active)
        paid.append(float(frame.rewards["global"][0]))
        local.append(frame.rewards["local"][0])
    assert np.abs(local[:5]).min(axis=1).max() > 0.05  # dense: everybody is on the way
    assert paid[:-1] == [0.0] * 49
    assert paid[-1] == pytest.approx(1.0)
