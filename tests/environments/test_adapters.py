"""What an environment of others says is read by one rule, and what it must not say is named."""

import dataclasses
import re
import warnings

import gymnasium
import jax
import numpy as np
import pytest

from credo.algorithms.off_policy import OffPolicy
from credo.environments import checks, foreign
from credo.environments.adapters import Single
from credo.environments.foreign import close_all
from credo.environments.gymnasium import Gymnasium
from credo.environments.host import EnvironmentFailure
from credo.environments.wrappers import delayed


@pytest.fixture(scope="module", autouse=True)
def _workers_end():
    yield
    close_all()


@pytest.fixture(autouse=True)
def _nothing_was_said_before(monkeypatch):
    monkeypatch.setattr(foreign, "_WARNED", set())


def here(name, steps=6, **kwargs):
    return Gymnasium(
        f"broken:{name}", kwargs, max_episode_steps=steps, in_process=True, tolerated=0.0
    )


def first(env, seed=0):
    copies = env.copies(1)
    return copies, copies.reset(np.array([seed], np.uint32), np.ones(1, bool))[0]


def step(env, action=None):
    copies, _ = first(env)
    action = np.zeros(env.action_size) if action is None else action
    return copies.step(np.float32(action)[None], np.ones(1, bool))


@pytest.mark.parametrize("obs", ["float64", "list"])
def test_the_parts_of_a_dict_are_read_as_a_box_is(obs):
    """One shape, any real numbers, within the bounds or not; a Discrete is one-hot."""
    assert first(here("Says", space="dict", obs=obs))[1].tolist() == [0, 1, 0, 0.25, 5, 3]


UNREADABLE = {
    (
        "dict",
        "shape",
    ): r"observation with 'pos' of shape \(1,\).*: its observation_space says \(2,\)",
    ("dict", "kind"): r"an observation with 'kind' of 7.*: its observation_space is Discrete\(3\)",
    ("dict", "missing"): r"of the keys \['pos', 'kind'\].*: its observation_space says",
    ("dict", "other"): r"an observation without 'sub'.*: its observation_space says",
    (
        "dict",
        "inner",
    ): r"an observation with 'sub' of type tuple and length 2.*: its observation_space says \[0\]",
    ("box", "strings"): r"an observation of dtype <U3.*: return real numbers",
    ("box", "complex"): r"an observation of dtype complex128.*: return real numbers",
    ("box", "objects"): r"an observation of dtype object.*: return real numbers",
    ("bytes", "part"): r"an observation of dtype float64 that uint8 cannot hold",
}


@pytest.mark.parametrize(("space", "obs"), UNREADABLE)
def test_what_cannot_be_read_is_named(space, obs):
    told = UNREADABLE[space, obs]
    with pytest.raises(EnvironmentFailure, match=f"returned .*{told}"):
        first(here("Says", space=space, obs=obs))


def test_bytes_stay_bytes():
    env = here("Says", space="bytes", obs="whole")
    assert env.obs_dtype == "uint8"
    seen = first(env)[1]
    assert (seen.dtype, seen.tolist()) == (np.uint8, [3, 255])


@pytest.mark.parametrize(
    ("said", "ended"),
    [
        ({"reward": "np.array(2)", "terminated": "np.bool_(True)"}, True),
        ({"reward": "True", "terminated": "np.array([True])"}, True),
        ({"reward": "np.float16(2)", "terminated": "0", "truncated": "1"}, True),
        ({"reward": "np.int8(-1)", "truncated": "np.array(False)"}, False),
    ],
)
def test_numbers_and_truth_values_of_every_kind_are_read(said, ended):
    now = step(here("Answers", **said))
    assert now.rewards["reward"][0] in (1.0, 2.0, -1.0)
    assert (now.terminated | now.truncated).tolist() == [ended]


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({"reward": "'1.5'"}, "the reward '1.5': return one number"),
        ({"reward": "1j"}, "the reward 1j: return one number"),
        ({"reward": "None"}, "the reward None: return one number"),
        ({"reward": "np.ones(1)"}, r"the reward array\(\[1.\]\): return one number"),
        ({"terminated": "'False'"}, "'False' for terminated: return True or False"),
        ({"truncated": "None"}, "None for truncated: return True or False"),
        ({"truncated": "np.zeros(2, bool)"}, "for truncated: return True or False"),
        ({"terminated": "2"}, "2 for terminated: return True or False"),
    ],
)
def test_values_of_a_wrong_type_are_refused(said, told):
    with pytest.raises(EnvironmentFailure, match=f"returned .*{told.split(':')[0]}.*in copy 0"):
        step(here("Answers", **said))


@pytest.mark.parametrize("where", ["obs", "info"])
def test_the_largest_entry_that_is_allowed_is_played(where):
    env = here("Masked", where=where)
    assert (env.obs_size, env.choices, env.masked) == (5, (4,), True)
    copies, seen = first(env)
    assert seen.tolist() == [1, 0, 0, 1, 0]
    on, action = np.ones(1, bool), np.float32([[0.1, 0.9, 0.8, 0.3]])
    paid = [copies.step(action, on).rewards["reward"][0] for _ in range(4)]
    assert paid == [13.0, 11.0, 13.0, 11.0]
    assert action.tolist() == np.float32([[0.1, 0.9, 0.8, 0.3]]).tolist()


def test_an_observation_that_is_no_number_is_left_out_and_that_is_said():
    env = here("Worded")
    with pytest.warns(UserWarning, match="its observation 'mission' is no array of numbers"):
        assert env.obs_size == 2
    assert first(env)[1].tolist() == [0.25, 0.5]


def test_a_mask_that_allows_nothing_is_a_fault_but_at_the_end():
    action = np.float32([0, 1, 0, 0])
    with pytest.raises(EnvironmentFailure, match="allows no action: its action_mask is 0"):
        step(here("Masked", never=1), action)
    assert checks.check_environment(here("Masked", never=4)) == []


def test_without_a_time_limit_an_episode_is_cut_and_that_is_said():
    env = Gymnasium("broken:Tiny", in_process=True)
    told = r"Tiny: it names no time limit: .* after 1,000 steps"
    with pytest.warns(UserWarning, match=told) as seen:
        OffPolicy.td3(env).init(key=jax.random.key(0))
    assert [w.filename for w in seen] == [__file__]  # the line of the user's
    assert env.max_steps == 1000
    with warnings.catch_warnings(action="error"):  # once
        assert env.copies(2).n == 2
        assert dataclasses.replace(env, timeout=7.0).max_steps == 1000
        assert checks.check_environment(env) == []
    assert len(checks.examine(env)[1]) == 1


def test_statistics_that_outlive_an_episode_are_warned_of():
    env = Gymnasium("broken:running", in_process=True)
    with pytest.warns(UserWarning, match=r"Normalize\w+ keeps statistics") as seen:
        assert env.max_steps == 4
    assert "leave it out and set normalize_observations of" in str(seen[0].message)
    assert [str(w.message).split()[3] for w in seen] == ["NormalizeObservation", "NormalizeReward"]
    problems, remarks = checks.examine(env)
    assert len(remarks) == 2
    assert "the same seed gave two different episodes" in problems[0]


def test_an_observation_outside_its_box_is_said_and_taken():
    env = here("Says", space="box", obs="box")
    assert first(env)[1].tolist() == [0.5, 5.0]
    told = "leaves its observation_space at reset: entry 1 is 5, and its bounds are -1 and 1"
    with pytest.warns(UserWarning, match=told):
        assert checks.check_environment(env) == []


def test_the_check_is_bounded_in_time(monkeypatch):
    monkeypatch.setattr(checks, "HOST_SECONDS", 0.4)
    with pytest.warns(UserWarning, match=r"stopped after 0.4 s: \d+ steps were looked at") as seen:
        assert checks.check_environment(here("Slow", steps=2000)) == []
    steps = int(re.search(r": (\d+) steps", str(seen[0].message))[1])
    assert 4 <= steps <= 24


def test_a_task_says_how_it_takes_actions():
    record = here("Grid").task_record()
    assert record == {
        "obs_size": 6,
        "action_size": 3,
        "agents": None,
        "choices": [3],
        "masked": False,
        "lengths": None,
        "actions": {"n": 3, "start": 5},
        "observations": None,
        "shown": None,
        "asks": False,
        "names": None,
    }
    numbered = here("Numbered").task_record()
    assert numbered["observations"] == {"n": 4, "start": -1}
    assert numbered["actions"] == {
        "low": [-3, -3],
        "high": [3, 3],
        "shape": [2],
        "dtype": "int64",
    }
    low, high = here("Numbered").obs_range
    assert (low.tolist(), high.tolist()) == ([0] * 4, [1] * 4)
    assert Single.agents is None


def test_a_delayed_task_is_described_as_the_task_itself():
    env = here("Says", space="bytes", obs="whole")
    hard = delayed(env)
    assert (hard.obs_dtype, hard.task_record()) == ("uint8", env.task_record())
    assert [x.tolist() for x in hard.obs_range] == [[0, 0], [255, 255]]


class Timed(gymnasium.Env):
    """It says itself after how many steps it is over."""

    observation_space = action_space = gymnasium.spaces.Box(-1, 1, (1,))

    def __init__(self, max_episode_steps=7):
        self.max_episode_steps = max_episode_steps

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, False, False, {}


def test_an_environment_may_name_its_own_limit():
    env = Timed()
    single = Single(env, {"max_episode_steps": None})
    assert (single.max_steps, single.warnings) == (7, [])
    assert Single(env, {"max_episode_steps": 5}).max_steps == 5
    assert Single(Timed(np.int64(7)), {"max_episode_steps": None}).max_steps == 7
    for none in ("soon", -1, 0, True, None):
        single = Single(Timed(none), {"max_episode_steps": None})
        assert single.max_steps == 1000
        assert "names no time limit" in single.warnings[0]


def test_a_mask_of_what_is_no_choice_is_warned_of():
    class Pushed(Timed):
        observation_space = gymnasium.spaces.Dict(
            {"action_mask": gymnasium.spaces.MultiBinary(2), "x": Timed.observation_space}
        )

    (told,) = Single(Pushed(), {"max_episode_steps": 5}).warnings
    assert "an action_mask of shape (2,) and 0 options to choose from" in told
