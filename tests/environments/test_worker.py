"""Gymnasium environments in a worker: what they say arrives, and no failure is left unexplained."""

import os
import re
import signal
import time

import gymnasium
import numpy as np
import pytest

from credo.environments.checks import check_environment
from credo.environments.gymnasium import Gymnasium, close_all
from credo.environments.host import EnvironmentFailure

HERE = os.path.dirname(__file__)
MUJOCO = ["Hopper", "HalfCheetah", "Swimmer", "InvertedDoublePendulum"]


@pytest.fixture(scope="module", autouse=True)
def _workers_end():
    yield
    close_all()


def tiny(name="Tiny", steps=10, **fields):
    return Gymnasium(f"broken:{name}", max_episode_steps=steps, **fields)


def on(*copies, n=2):
    return np.isin(np.arange(n), copies)


def seeds(*numbers):
    return np.array(numbers, np.uint32)


def play(env, copies, seed, copy=0, steps=100):
    """The bytes of one episode in one copy, with actions that follow from nothing but the step."""
    active = on(copy, n=copies.n)
    random = np.random.default_rng(0)
    seen = [copies.reset(np.full(copies.n, seed, np.uint32), active)[copy].tobytes()]
    for _ in range(steps):
        action = random.uniform(-1, 1, env.action_size).astype(np.float32)
        step = copies.step(np.tile(action, (copies.n, 1)), active)
        seen.append(step.obs[copy].tobytes() + step.rewards["reward"][copy].tobytes())
        if step.terminated[copy] or step.truncated[copy]:
            break
    return seen


@pytest.mark.parametrize("in_process", [False, True])
class TestWhatArrives:
    def test_sizes_and_spaces(self, in_process):
        env = tiny(in_process=in_process)
        assert (env.obs_size, env.action_size, env.max_steps) == (2, 1, 10)
        assert env.signals == ("reward",)
        grid = tiny("Grid", in_process=in_process)
        assert (grid.obs_size, grid.action_size) == (6, 3)

    def test_actions_are_scaled_and_clipped(self, in_process):
        copies = tiny(in_process=in_process).copies(5)
        everyone = np.ones(5, bool)
        first = copies.reset(seeds(1, 2, 3, 4, 5), everyone)
        assert first.dtype == np.float32
        assert first[:, 0].tolist() == [0.0] * 5
        actions = np.float32([[-1], [0], [0.5], [1], [8]])
        step = copies.step(actions, everyone)
        assert step.obs[:, 0].tolist() == [-2.0, 1.0, 2.5, 4.0, 4.0]
        assert step.rewards["reward"].tolist() == [1.5] * 5
        assert step.rewards["reward"].dtype == np.float64

    def test_a_seed_decides_the_episode(self, in_process):
        copies = tiny(in_process=in_process).copies(2)
        expected = [np.random.Generator(np.random.PCG64(s)).random() for s in (4, 9)]
        first = copies.reset(seeds(4, 9), on(0, 1))
        np.testing.assert_array_equal(first[:, 1], np.float32(expected))

    def test_only_active_copies_step(self, in_process):
        copies = tiny(in_process=in_process).copies(2)
        copies.reset(seeds(0, 0), on(0, 1))
        action = np.zeros((2, 1), np.float32)
        for _ in range(5):
            copies.step(action, on(1))
        step = copies.step(action, on(0, 1))
        assert step.terminated.tolist() == [False, True]  # step 1 and step 6
        copies.reset(seeds(0, 0), on(1))
        for _ in range(4):
            assert not copies.step(action, on(0)).terminated[0]
        assert copies.step(action, on(0, 1)).terminated.tolist() == [True, False]

    def test_time_limits_truncate(self, in_process):
        for env, steps in ((tiny(steps=3, in_process=in_process), 3), (clock(in_process), 4)):
            copies = env.copies(1)
            copies.reset(seeds(0), on(0, n=1))
            ends = [copies.step(np.zeros((1, 1)), on(0, n=1)) for _ in range(steps)]
            assert [bool(e.truncated[0]) for e in ends] == [False] * (steps - 1) + [True]
            assert not ends[-1].terminated[0]
            assert env.max_steps == steps

    def test_discrete_actions_and_flat_observations(self, in_process):
        copies = tiny("Grid", in_process=in_process).copies(2)
        first = copies.reset(seeds(0, 0), on(0, 1))
        assert first.tolist() == [[0, 1, 2, 3, 4, 5]] * 2
        step = copies.step(np.float32([[0.1, -1, 0.9], [0.3, 0.2, 0]]), on(0, 1))
        assert step.rewards["reward"].tolist() == [7.0, 5.0]
        assert step.obs[:, 0].tolist() == [7.0, 5.0]
        assert step.obs[:, 1].tolist() == [in_process] * 2  # a worker imports no JAX

    def test_discrete_observations_and_whole_numbered_actions(self, in_process):
        env = tiny("Numbered", in_process=in_process)
        copies = env.copies(1)
        assert copies.reset(seeds(0), on(0, n=1)).tolist() == [[0, 0, 0, 1]]
        step = copies.step(np.float32([[0.3, -1.0]]), on(0, n=1))
        assert step.obs.tolist() == [[1, 0, 0, 0]]
        assert step.rewards["reward"].tolist() == [10.0 - 3.0]


def clock(in_process=False):
    return Gymnasium("broken:Clock", in_process=in_process)


def test_more_than_a_pipe_holds():
    copies = tiny("Wide").copies(3)
    copies.reset(seeds(0, 0, 0), on(0, 2, n=3))
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 30_000)).astype(np.float32)
    obs = copies.step(actions, on(0, 2, n=3)).obs
    np.testing.assert_array_equal(obs[[0, 2]], actions[[0, 2]])


def test_what_an_environment_prints_breaks_nothing(capfd):
    copies = tiny(kwargs={"fault": "prints"}).copies(1)
    copies.reset(seeds(0), on(0, n=1))
    for _ in range(3):
        step = copies.step(np.zeros((1, 1)), on(0, n=1))
        assert step.obs[0, 0] == 1.0
    printed = capfd.readouterr()
    assert printed.out == ""
    assert printed.err.count("noise") == 2000


def test_copies_are_kept_until_they_are_closed():
    env = tiny()
    copies = env.copies(2)
    assert tiny().copies(2) is copies
    assert env.copies(1) is not copies
    process = copies._backend._process
    close_all()
    assert process.poll() == 0  # it ended by itself
    with pytest.raises(EnvironmentFailure, match=r"closed: ask for copies\(n\) again"):
        copies.reset(seeds(0, 0), on(0, 1))
    assert env.copies(2).reset(seeds(0, 0), on(0, 1)).shape == (2, 2)


FAULTS = {
    "raises": r"raised ValueError: the bridge is out \(.*broken.py:\d+\)",
    "leaves": r"raised SystemExit: 3 \(.*broken.py:\d+\)",
    "dies": "ended its process with exit status 7",
    "hangs": "gave no answer within 1 s",
    "nan": "returned NaN or inf in an observation",
    "shape": r"returned an observation of shape \(1,\)",
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("where", ["reset", "step"])
def test_a_failed_episode_is_named_and_its_copy_is_opened_anew(fault, where):
    env = tiny(kwargs=(("fault", fault), ("where", where)), timeout=1.0)
    copies = env.copies(3)
    action, active = np.zeros((3, 1), np.float32), on(1, n=3)
    at = "the reset" if where == "reset" else "step 2"
    told = f"^broken:Tiny {FAULTS[fault]}, in copy 1 at {at} of the episode with seed 8: ."

    def episode():
        copies.reset(seeds(7, 8, 9), active)
        if where == "reset":
            return copies.failed
        assert not copies.failed.any()
        assert copies.step(action, active).obs[1, 0] == 1.0
        step = copies.step(action, active)
        assert not step.obs.any()
        assert not (step.terminated | step.truncated | step.rewards["reward"].astype(bool)).any()
        return step.failed

    began = time.monotonic()
    for _ in range(2):
        assert episode().tolist() == [False, True, False]
        assert re.search(told, copies.failure_text(1))
    with pytest.raises(EnvironmentFailure, match=told):  # whoever does not look at `failed`
        copies.step(action, active)
    assert env.copies(3) is copies
    process = copies._backend._process
    with pytest.raises(EnvironmentFailure, match=told + r".* \(3 of 3 episodes failed\)$"):
        episode()
    assert time.monotonic() - began < 20
    assert process.poll() is not None  # reaped
    assert env.copies(3) is not copies


@pytest.mark.parametrize("fault", ["raises", "leaves", "nan", "shape"])
def test_a_failure_in_this_process(fault):
    copies = tiny(kwargs=(("fault", fault),), in_process=True).copies(2)
    copies.reset(seeds(3, 4), on(0, 1))
    copies.step(np.zeros((2, 1)), on(0, 1))
    assert copies.step(np.zeros((2, 1)), on(0, 1)).failed.all()
    for i in range(2):
        assert re.search(f"{FAULTS[fault]}, in copy {i} at step 2 of", copies.failure_text(i))


def test_none_is_tolerated_if_the_task_says_so():
    copies = tiny(kwargs={"fault": "raises"}, tolerated=0.0, in_process=True).copies(1)
    copies.reset(seeds(3), on(0, n=1))
    copies.step(np.zeros((1, 1)), on(0, n=1))
    with pytest.raises(EnvironmentFailure, match=FAULTS["raises"] + ".*: mend the environment$"):
        copies.step(np.zeros((1, 1)), on(0, n=1))


def rare(fault, **fields):
    return Gymnasium("failing:Rare", kwargs=(("fault", fault),), max_episode_steps=10, **fields)


def lived(copies, first):
    """How many steps each copy's episode has, with seeds from `first`; 0 if it failed."""
    numbers, active = np.arange(first, first + copies.n), np.ones(copies.n, bool)
    copies.reset(numbers.astype(np.uint32), active)
    active, steps = ~copies.failed, np.zeros(copies.n, int)
    while active.any():
        step = copies.step(np.zeros((copies.n, 1)), active)
        steps[active] += 1
        steps[step.failed] = 0
        active = active & ~(step.terminated | step.truncated | step.failed)
    return steps.tolist()


def test_rare_failures_are_tolerated_and_many_are_not():
    copies = rare("nan", in_process=True).copies(10)
    for first in range(0, 200, 10):
        failed = first % 20 == 0
        assert lived(copies, first) == [0 if failed else 6] + [6] * 9
    assert copies.failures == 5  # of the last 100
    few = rare("nan", in_process=True, tolerated=0.04).copies(10)
    for first in range(0, 40, 10):
        lived(few, first)
    with pytest.raises(EnvironmentFailure, match=r"seed 0: .* \(3 of 50 episodes failed\)$"):
        lived(few, 40)
    # Failed episodes are short: while others play, they are not all there is.
    short = rare("nan", in_process=True).copies(40)
    assert lived(short, 1).count(0) == 2
    assert lived(short, 1).count(0) == 2


@pytest.mark.parametrize("fault", ["dies", "hangs"])
def test_a_lost_worker_takes_its_episodes_with_it(fault):
    copies = rare(fault, timeout=1.0).copies(3)
    assert lived(copies, 19) == [0, 0, 0]  # the one in the middle fails
    assert copies.failures == 1
    assert "in copy 1 at step 2 of the episode with seed 20" in copies.failure_text(0)
    assert lived(copies, 21) == [6, 6, 6]
    # Of a copy that was not asked anything, the next step says so.
    copies.reset(seeds(1, 20, 3), on(0, 1, 2, n=3))
    copies.step(np.zeros((3, 1)), on(1, n=3))
    assert copies.step(np.zeros((3, 1)), on(1, n=3)).failed.tolist() == [False, True, False]
    assert copies.step(np.zeros((3, 1)), on(0, n=3)).failed.tolist() == [True, False, False]
    copies.close()


def test_a_reset_that_fails_leaves_the_others_theirs():
    env = Gymnasium(
        "failing:Rare",
        kwargs=(("fault", "dies"), ("where", "reset")),
        max_episode_steps=10,
    )
    copies = env.copies(3)
    assert lived(copies, 19) == [6, 0, 6]
    copies.close()


def test_every_copy_has_its_own_time():
    copies = Gymnasium(
        "failing:Slow", kwargs={"opening": 0.5, "step": 0.7}, max_episode_steps=2, timeout=2.0
    ).copies(4)
    assert lived(copies, 0) == [2, 2, 2, 2]
    copies.close()


@pytest.mark.parametrize("in_process", [False, True])
def test_rewards_and_observations_are_float32(in_process):
    env = tiny("Reward", kwargs={"reward": 1e200}, in_process=in_process)
    copies = env.copies(1)
    copies.reset(seeds(0), on(0, n=1))
    assert copies.step(np.zeros((1, 1)), on(0, n=1)).failed[0]
    assert "returned too large a number for float32 in the reward" in copies.failure_text(0)
    if not in_process:
        kwargs = {"fault": "large"}
        copies = Gymnasium("failing:Faulty", kwargs=kwargs, max_episode_steps=9).copies(1)
        assert lived(copies, 0) == [0]
        told = "returned too large a number for float32 in an observation"
        assert told in copies.failure_text(0)


def test_bytes_stay_bytes():
    env = Gymnasium("failing:Picture", max_episode_steps=10)
    copies = env.copies(2)
    assert env.obs_dtype == "uint8"
    first = copies.reset(seeds(0, 0), on(0, 1))
    assert first.dtype == np.uint8
    assert first.tolist() == [[200] * 4] * 2
    assert copies.step(np.zeros((2, 1)), on(1)).obs.tolist() == [[0] * 4, [201] * 4]


@pytest.mark.parametrize(
    ("name", "kwargs", "told"),
    [
        ("OldStep", {}, r"returned 4 values from step, .*: return \(observation, reward, term"),
        ("Reward", {"reward": np.nan}, "returned NaN or inf in the reward"),
        (
            "Reward",
            {"reward": (1.0, 2.0)},
            r"returned the reward \(1.0, 2.0\).*: return one number",
        ),
    ],
)
def test_a_wrong_result_of_step(name, kwargs, told):
    copies = tiny(name, kwargs=kwargs, in_process=True).copies(1)
    copies.reset(seeds(0), on(0, n=1))
    assert copies.step(np.zeros((1, 1)), on(0, n=1)).failed[0]
    assert re.search(told, copies.failure_text(0))


def test_what_the_caller_does_wrong():
    copies = tiny(in_process=True).copies(1)
    with pytest.raises(EnvironmentFailure, match=r"a step outside an episode.*: reset this copy"):
        copies.step(np.zeros((1, 1)), on(0, n=1))
    copies = tiny(in_process=True).copies(1)
    copies.reset(seeds(0), on(0, n=1))
    with pytest.raises(ValueError, match=r"shape \(2, 1\) was given: it must be \(1, 1\)"):
        copies.step(np.zeros((2, 1)), on(0, n=1))
    with pytest.raises(EnvironmentFailure, match=r"was given the action \[nan\]"):
        copies.step(np.full((1, 1), np.nan), on(0, n=1))


def test_what_may_not_be_open_at_once_plays_in_turn():
    env = Gymnasium("failing:Robot", max_episode_steps=9, in_process=True, at_once=1)
    copies, everyone = env.copies(3), np.ones(3, bool)
    assert [turn.tolist() for turn in env.turns(~on(1, n=3))] == [
        [True, False, False],
        [False, False, True],
    ]
    with pytest.raises(ValueError, match="3 episodes were to begin at once: at_once allows 1"):
        copies.reset(seeds(1, 2, 3), everyone)
    alone = tiny(in_process=True).copies(3)
    expected = alone.reset(seeds(1, 2, 3), everyone)
    for i, turn in enumerate(env.turns(everyone)):
        np.testing.assert_array_equal(copies.reset(seeds(1, 2, 3), turn)[i], expected[i])
        for t in range(6):
            step = copies.step(np.float32([[0.5], [-0.5], [0.1]]), turn)
            assert step.terminated.tolist() == (turn & (t == 5)).tolist()
        assert step.obs[i, 0] == np.float32([2.5, -0.5, 1.3])[i]
    close_all()


UNFIT = {
    "unbounded": (tiny("Unbounded"), "action space without bounds.*: give its Box a finite low"),
    "other actions": (tiny("Asks"), r"action space Text\(.*: use a Box, a Discrete, a Multi"),
    "no env": (tiny("NoEnv"), "is a NoEnv: name a class derived from gymnasium.Env"),
    "unknown id": (
        Gymnasium("Hoper-v5"),
        "unknown to Gymnasium here .*Did you mean: `Hopper`.*: look at the id",
    ),
    "no package": (Gymnasium("nosuch:Env"), "raised ModuleNotFoundError.*: look at its id"),
    "wrong kwargs": (tiny(kwargs={"x": 1}), "raised TypeError.*unexpected keyword"),
    "unseeded": (tiny("Unseeded"), "same seed gave two different episodes: draw everything from"),
    "nan": (tiny(kwargs={"fault": "nan"}), "NaN or inf in an observation, in copy 0 at step 2"),
    "shape": (tiny(kwargs={"fault": "shape", "where": "reset"}), "shape .*: make the two agree"),
}


@pytest.mark.parametrize("name", UNFIT)
def test_the_check_lists_what_is_wrong(name):
    env, told = UNFIT[name]
    problem = check_environment(env)[0]
    assert re.search(told, problem), problem


def test_the_check_finds_nothing_wrong():
    for env in (tiny(), clock(), tiny("Grid"), Gymnasium("Pendulum-v1")):
        assert check_environment(env) == []


def test_fields_are_checked():
    with pytest.raises(ValueError, match=r"kwargs is .*: it must be pairs"):
        Gymnasium("Pendulum-v1", kwargs={"g": object()})
    with pytest.raises(ValueError, match="max_episode_steps is 0"):
        Gymnasium("Pendulum-v1", max_episode_steps=0)
    with pytest.raises(ValueError, match="tolerated is 2: it must be a share"):
        Gymnasium("Pendulum-v1", tolerated=2)
    with pytest.raises(ValueError, match="at_once is 0: it must be at least 1"):
        Gymnasium("Pendulum-v1", at_once=0)
    with pytest.raises(ValueError, match="timeout is 0"):
        Gymnasium("Pendulum-v1", timeout=0)
    with pytest.raises(ValueError, match="at least 1"):
        Gymnasium("Pendulum-v1").copies(0)


def test_configs_are_compared_by_value():
    once, again = (Gymnasium("Pendulum-v1", kwargs={"g": 9.0}) for _ in range(2))
    assert once == again
    assert hash(once) == hash(again)
    assert once != Gymnasium("Pendulum-v1", kwargs={"g": 1.0})


def test_an_interrupted_call_is_not_answered_late():
    env = tiny(kwargs={"fault": "hangs"})
    copies = env.copies(1)
    copies.reset(seeds(0), on(0, n=1))
    copies.step(np.zeros((1, 1)), on(0, n=1))
    previous = signal.signal(signal.SIGALRM, _interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.3)
    with pytest.raises(KeyboardInterrupt):
        copies.step(np.zeros((1, 1)), on(0, n=1))
    signal.signal(signal.SIGALRM, previous)
    again = env.copies(1)
    assert again is not copies
    assert again.reset(seeds(0), on(0, n=1)).shape == (1, 2)


def _interrupt(*_):
    raise KeyboardInterrupt


def test_an_episode_is_what_gymnasium_plays():
    copies = Gymnasium("Pendulum-v1").copies(1)
    env = gymnasium.make("Pendulum-v1", disable_env_checker=True)
    obs, _ = env.reset(seed=5)
    np.testing.assert_array_equal(copies.reset(seeds(5), on(0, n=1))[0], obs)
    for t in range(200):
        action = np.float32([np.cos(t)])
        obs, reward, terminated, truncated, _ = env.step(2 * action)
        step = copies.step(action[None], on(0, n=1))
        np.testing.assert_array_equal(step.obs[0], obs)
        assert step.rewards["reward"][0] == reward
        assert (step.terminated[0], step.truncated[0]) == (terminated, truncated)
    assert truncated


@pytest.mark.parametrize(
    "id", ["Pendulum-v1", *(f"{name}-{v}" for name in MUJOCO for v in ("v4", "v5"))]
)
def test_a_used_copy_plays_what_a_fresh_one_does(id):
    """Nothing of the episodes before is left, bit for bit."""
    env = Gymnasium(id, in_process=True)
    copies = env.copies(2)
    for seed in range(3):
        play(env, copies, seed, copy=1)
    used = {seed: play(env, copies, seed, copy=1) for seed in (100, 101)}
    assert used[100] != used[101]
    copies.close()
    assert play(env, env.copies(2), 101) == used[101]
    env.copies(2).close()


def test_a_worker_plays_what_this_process_does(capfd):
    """MuJoCo's and Gymnasium's warnings about their own -v4 tasks are not shown."""
    once, again = (Gymnasium("HalfCheetah-v4", in_process=here) for here in (False, True))
    assert play(once, once.copies(2), 3, steps=20) == play(again, again.copies(1), 3, steps=20)
    assert capfd.readouterr() == ("", "")
    assert not os.path.exists("MUJOCO_LOG.TXT")
