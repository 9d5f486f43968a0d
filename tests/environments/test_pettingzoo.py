# ruff: noqa: E402
"""PettingZoo both ways: its teams arrive in arrays, its failures are named, ours pass its tests."""

import dataclasses
import os
import re
import subprocess
import sys
import time
import types
import warnings

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

pettingzoo = pytest.importorskip("pettingzoo")

with warnings.catch_warnings():  # about a game that its tests import
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import max_cycles_test, parallel_api_test, parallel_seed_test, render_test
import broken_team
from pettingzoo.utils.conversions import parallel_to_aec

from credo import rollout, tree
from credo.environments.checks import check_environment
from credo.environments.foreign import close_all
from credo.environments.gymnasium import Gymnasium
from credo.environments.host import EnvironmentFailure
from credo.environments.pettingzoo import PettingZoo, to_pettingzoo
from credo.environments.probes import Copy, Meet
from credo.environments.simple_spread import SimpleSpread
from credo.environments.wrappers import delayed
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic
from credo.networks.team import Team
from credo.replay import Replay, extend
from credo.types import Batch


@pytest.fixture(scope="module", autouse=True)
def _workers_end():
    yield
    close_all()


def pair(name="Pair", steps=10, **fields):
    return PettingZoo(f"broken_team:{name}", max_episode_steps=steps, **fields)


def seeds(*numbers):
    return np.array(numbers, np.uint32)


def everyone(copies):
    return np.ones(copies.n, bool)


def started(env, n=1):
    copies = env.copies(n)
    copies.reset(np.arange(n, dtype=np.uint32), everyone(copies))
    return copies


def idle(copies, env):
    return copies.step(np.zeros((copies.n, *env.sizes[:0:-1]), np.float32), everyone(copies))


@pytest.mark.parametrize("in_process", [False, True])
class TestWhatArrives:
    def test_sizes_are_those_of_the_largest_agent(self, in_process):
        env = pair(in_process=in_process)
        assert env.sizes == (3, 2, 2)
        assert (env.max_steps, env.discrete, env.reported) == (10, False, "global")
        assert env.reward_shapes == {"global": (), "local": (2,)}

    def test_observations_are_padded_and_actions_scaled_and_cut(self, in_process):
        copies = pair(in_process=in_process).copies(3)
        first = copies.reset(seeds(4, 5, 6), everyone(copies))
        drawn = [np.float32(np.random.default_rng(seed).random()) for seed in (4, 5, 6)]
        assert first.dtype == np.float32
        np.testing.assert_array_equal(first[:, 0], [[0, 0, x] for x in drawn])
        np.testing.assert_array_equal(first[:, 1], np.zeros((3, 3)))
        actions = np.float32([[[-1, -1], [-1, 9]], [[0, 0], [0.5, 9]], [[8, 1], [1, 9]]])
        step = copies.step(actions, everyone(copies))
        assert step.obs[:, 0, :2].tolist() == [[-2, 0], [1, 0.5], [4, 1]]
        assert step.obs[:, 1].tolist() == [[-1, -1, 0], [0.5, 0.5, 0], [1, 1, 0]]
        assert step.rewards["local"].tolist() == [[-2, -1], [1.5, 0.5], [5, 1]]
        assert step.rewards["global"].tolist() == [-1.5, 1.0, 3.0]
        assert step.active is not None
        assert step.active.all()
        assert not (step.terminated | step.truncated).any()

    def test_agents_leave_and_join(self, in_process):
        leave = (("a", 2, "terminated"), ("b", 4, "terminated"))
        env = pair(kwargs={"leave": leave, "join": (("b", 1),)}, in_process=in_process)
        copies = started(env)
        act = np.float32([[[1, 1], [1, 0]]])
        steps = [copies.step(act, everyone(copies)) for _ in range(4)]
        active = [step.active[0].tolist() for step in steps]
        assert active == [[True, True], [False, True], [False, True], [False, False]]
        assert [step.rewards["local"][0].tolist() for step in steps] == [
            [5, 0],
            [5, 1],
            [0, 1],
            [0, 1],
        ]
        assert [step.obs[0, :, 0].tolist() for step in steps] == [[4, 7], [4, 1], [0, 1], [0, 1]]
        assert [bool(step.terminated[0]) for step in steps] == [False] * 3 + [True]
        assert not any(step.truncated[0] for step in steps)

    @pytest.mark.parametrize(
        ("ends", "expected"),
        [
            ((("a", 1, "terminated"), ("b", 2, "terminated")), (True, False)),
            ((("a", 1, "truncated"), ("b", 2, "terminated")), (False, True)),
            ((("a", 1, "terminated"), ("b", 2, "truncated")), (False, True)),
            ((("a", 2, "truncated"), ("b", 2, "truncated")), (False, True)),
        ],
    )
    def test_terminated_means_that_every_agent_has(self, in_process, ends, expected):
        env = pair(kwargs={"leave": ends}, in_process=in_process)
        copies = started(env)
        first, second = idle(copies, env), idle(copies, env)
        assert (first.terminated[0], first.truncated[0]) == (False, False)
        assert (second.terminated[0], second.truncated[0]) == expected
        assert not second.active.any()

    def test_only_active_copies_step(self, in_process):
        env = pair(kwargs={"leave": (("a", 2, "terminated"),)}, in_process=in_process)
        copies = started(env, 2)
        action, second = np.zeros((2, 2, 2), np.float32), np.array([False, True])
        copies.step(action, second)
        step = copies.step(action, everyone(copies))
        assert step.active.tolist() == [[True, True], [False, True]]
        copies.reset(seeds(0, 0), second)
        assert copies.step(action, second).active[1].tolist() == [True, True]

    def test_a_worker_imports_no_jax(self, in_process):
        env = pair("Watchful", in_process=in_process)
        assert idle(started(env), env).rewards["global"] == [float(in_process)]


@pytest.mark.parametrize(("asked", "limit"), [(None, 4), (9, 4), (2, 2)])
def test_the_time_limit_is_the_lesser_one(asked, limit):
    env = PettingZoo("broken_team", max_episode_steps=asked, in_process=True)
    assert env.max_steps == limit
    copies = started(env)
    ends = [bool(idle(copies, env).truncated[0]) for _ in range(limit)]
    assert ends == [False] * (limit - 1) + [True]


def test_agents_of_one_kind_are_a_group():
    unlike, alike = pair(in_process=True), pair("Movable", in_process=True)
    assert unlike.groups == (0, 1)
    network = Team((4,), sharing="groups").fitted(unlike)
    assert network.groups == (0, 1)
    assert len(network.init(*unlike.sizes, key=jax.random.key(0)).heads) == 2
    spread = Team((4,), sharing="groups").fitted(SimpleSpread())
    assert spread.groups == (0, 0, 0)
    assert alike.groups == (0, 1)  # they see different things
    with pytest.raises(
        ValueError, match=r"groups are \(0, 1\) of 3 agents: give the group of each"
    ):
        network.init(3, 2, 3, key=jax.random.key(0))


def test_continuous_actions_are_asked_for():
    assert pair("Movable", in_process=True).sizes == (3, 2, 2)
    asked = pair("Movable", in_process=True, kwargs={"continuous_actions": False})
    assert (asked.sizes, asked.choices) == ((3, 3, 2), (3,))


def test_an_id_that_pettingzoo_knows():
    registry = pytest.importorskip("pettingzoo.env_registry.registration").parallel_registry
    pettingzoo.register("parallel", "credo-tests/pair-v0", "broken_team:Pair", kwargs={"at": 3})
    env = PettingZoo("credo-tests/pair-v0", max_episode_steps=3, in_process=True)
    assert env.sizes == (3, 2, 2)
    assert idle(started(env), env).rewards["global"].tolist() == [0.75]
    del registry["credo-tests/pair-v0"]


UNFIT = {
    "Unlike": (pair("Unlike"), r"action spaces Box.*, Discrete\(3\): a team needs Boxes, or a D"),
    "no maker": (PettingZoo("broken"), "broken has no parallel_env: name a module of PettingZoo"),
    "no such": (pair("Missing"), "broken_team has no Missing"),
    "no team": (pair("a_number"), "is a int: name what makes a pettingzoo.ParallelEnv"),
    "nobody": (pair("Nobody"), "has no possible_agents: name there every agent"),
    "no package": (PettingZoo("nosuch.team_v0"), "raised ModuleNotFoundError.*: look at its id"),
    "wrong kwargs": (pair(kwargs={"x": 1}), "raised TypeError.*unexpected keyword"),
}


@pytest.mark.parametrize("name", UNFIT)
def test_what_cannot_be_opened_is_a_wrong_value(name):
    env, told = UNFIT[name]
    env = PettingZoo(env.id, env.kwargs, env.max_episode_steps, in_process=True)
    with pytest.raises(ValueError, match=told) as error:
        _ = env.obs_size
    assert isinstance(error.value, EnvironmentFailure)


FAULTS = {
    "raises": r"raised ValueError: the bridge is out \(.*broken.py:\d+\)",
    "leaves": r"raised SystemExit: 3 \(.*broken.py:\d+\)",
    "dies": "ended its process with exit status 7",
    "hangs": "gave no answer within 2 s",
    "nan": "returned NaN or inf in an observation",
    "shape": r"returned an observation of shape \(1, 1\)",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_failure_is_named_and_the_next_copies_are_new(fault):
    env = pair(kwargs=(("fault", fault),), timeout=2.0, tolerated=0.0)
    copies = env.copies(3)
    active, action = np.array([False, True, False]), np.zeros((3, 2, 2), np.float32)
    began = time.monotonic()
    told = f"^broken_team:Pair {FAULTS[fault]}, in copy 1 at step 2 of the episode with seed 8: ."

    def episode():
        copies.reset(seeds(7, 8, 9), active)
        copies.step(action, active)
        copies.step(action, active)

    with pytest.raises(EnvironmentFailure, match=told):
        episode()
    assert time.monotonic() - began < 10
    again = env.copies(3)
    assert again is not copies
    again.reset(seeds(7, 8, 9), active)
    assert again.step(action, active).obs[1, 0, 0] == 1.0
    again.close()


@pytest.mark.parametrize(
    ("part", "told", "fix"),
    [
        (0, "returned no observation of 'b'", "return one for every agent that was or is there"),
        (1, "returned no reward of 'b'", "return one for every agent"),
        (2, "returned no termination of 'b'", "return one for every agent"),
        (3, "returned no truncation of 'b'", "return one for every agent"),
        (5, "has the agent 'c'", "name every agent in possible_agents"),
        (6, "returned rewards in a list", "return a dict by agent"),
    ],
)
def test_an_incomplete_answer_is_named(part, told, fix):
    env = pair("Forgetful", kwargs={"part": part}, in_process=True, tolerated=0.0)
    copies = started(env)
    where = ", in copy 0 at step 1 of the episode with seed 0: "
    with pytest.raises(EnvironmentFailure, match=told + where + fix):
        idle(copies, env)


def test_what_the_caller_does_wrong():
    copies = started(pair(in_process=True), 2)
    with pytest.raises(ValueError, match=r"shape \(2, 2\) was given: it must be \(2, 2, 2\)"):
        copies.step(np.zeros((2, 2)), everyone(copies))
    with pytest.raises(EnvironmentFailure, match=r"was given the action .*: look at the policy"):
        copies.step(np.full((2, 2, 2), np.nan), everyone(copies))


def test_the_check_finds_nothing_wrong():
    leave = {"leave": (("a", 2, "terminated"),)}
    assert check_environment(PettingZoo("broken_team")) == []
    assert check_environment(pair(kwargs=leave)) == []


@pytest.mark.parametrize(
    ("name", "kwargs", "told"),
    [
        ("Pair", {"fault": "nan"}, "NaN or inf in an observation, in copy 0 at step 2"),
        ("Unseeded", {}, "the same seed gave two different episodes: draw everything from"),
        ("Unlike", {}, "a team needs Boxes, or a Discrete for each agent, or the same choices"),
    ],
)
def test_the_check_lists_what_is_wrong(name, kwargs, told):
    (problem,) = check_environment(pair(name, kwargs=kwargs, in_process=True))
    assert re.search(told, problem), problem


def test_the_delayed_variant_pays_agents_at_the_end():
    env = delayed(pair(kwargs={"leave": (("b", 2, "terminated"),)}, steps=3, in_process=True))
    assert (env.reported, env.reward_shapes) == ("global", {"global": (), "local": (2,)})
    copies = started(env, 2)
    action, second = np.ones((2, 2, 2), np.float32), np.array([False, True])
    steps = [copies.step(action, active) for active in (everyone(copies), second, second)]
    assert [step.rewards["local"][1].tolist() for step in steps] == [[0, 0], [0, 0], [15, 2]]
    assert [step.rewards["global"][1] for step in steps] == [0.0, 0.0, 8.5]
    assert steps[-1].rewards["local"][0].tolist() == [0, 0]
    assert steps[1].active is not None
    assert steps[1].active[1].tolist() == [True, False]


def alone(name, **fields):
    return PettingZoo(f"broken_team:{name}", in_process=True, tolerated=0.0, **fields)


def one(env, steps=3):
    copies = started(env)
    return [copies.step(np.ones((1, 2, env.action_size)), everyone(copies)) for _ in range(steps)]


class TestNamedRewards:
    def test_those_of_the_infos_are_found_and_read(self):
        env = alone("Named")
        assert env.signals == ("global", "local", "dense")
        assert env.reward_shapes == {"global": (), "local": (2,), "dense": (2,)}
        assert env.reported == "global"
        steps = one(env)
        assert [step.rewards["global"][0] for step in steps] == [1.0, 2.0, 3.0]
        assert steps[0].rewards["dense"].tolist() == [[0.0, 10.0]]
        assert steps[0].rewards["local"].tolist() == [[5.0, 1.0]]  # the environment's own

    def test_a_worker_says_the_same(self):
        here, there = alone("Named"), PettingZoo("broken_team:Named")
        assert here.signals == there.signals
        for a, b in zip(one(here), one(there), strict=True):
            assert {k: v.tolist() for k, v in a.rewards.items()} == {
                k: v.tolist() for k, v in b.rewards.items()
            }

    def test_who_left_earns_nothing_more(self):
        env = alone("Named", kwargs={"leave": (("a", 1, "terminated"),)})
        first, second, _ = one(env)
        assert (first.rewards["global"][0], second.rewards["global"][0]) == (1.0, 2.0)
        assert second.rewards["local"].tolist() == [[0.0, 1.0]]

    def test_what_all_share_one_may_say(self):
        assert [x.rewards["global"][0] for x in one(alone("Named", kwargs={"wrong": "one"}))] == [
            1.0,
            2.0,
            3.0,
        ]

    @pytest.mark.parametrize(
        ("wrong", "told"),
        [
            ("differ", "returned the reward 'global' as 2.0 and, of 'b', as 7.0"),
            ("silent", r"returned no info\['rewards'\] of 'b'"),
            ("private", "returned no reward 'dense' in the info of 'b'"),
            ("new", "names the reward 'other', which its first step did not"),
            ("nobody", "returned no reward 'global' in any info"),
            ("text", "returned the reward '1.0'"),
        ],
    )
    def test_a_missing_or_contradictory_reward_is_named(self, wrong, told):
        with pytest.raises(EnvironmentFailure, match=f"Named {told}, in copy 0 at step 2"):
            one(alone("Named", kwargs={"wrong": wrong}))

    def test_names_that_come_late_are_named(self):
        with pytest.raises(EnvironmentFailure, match=r"rewards in an info, .*at step 2"):
            one(alone("Late"))

    def test_shared_says_what_is_one_number(self):
        env = alone("Named", shared=())
        assert env.reward_shapes["global"] == (2,)
        assert one(env)[1].rewards["global"].tolist() == [[2.0, 2.0]]

    def test_functions_pay(self):
        rewards = {"global": broken_team.arrived, "local": broken_team.each, "own": _pay_own}
        env = PettingZoo("broken_team:Pair", max_episode_steps=4, rewards=rewards)
        assert env.rewards[0] == ("global", "broken_team:arrived")
        assert env.foreign_code == "broken_team:Pair"
        assert PettingZoo("mpe2.simple_spread_v3", rewards=env.rewards).foreign_code is not None
        assert env == PettingZoo("broken_team:Pair", rewards=env.rewards, max_episode_steps=4)
        steps = one(env)
        assert [step.rewards["global"][0] for step in steps] == [100.0, 200.0, 300.0]
        assert steps[0].rewards["local"].tolist() == [[5.5, 1.5]]
        assert (env.signals[2], steps[0].rewards["own"].tolist()) == ("own", [6.0])

    def test_a_function_that_changes_its_mind_is_named(self):
        env = alone("Limited", rewards={"global": "broken_team:fickle"})
        with pytest.raises(EnvironmentFailure, match=r"was paid 'global' as a dict, .*at step 2"):
            one(env)

    def test_a_function_of_no_module_needs_this_process(self):
        pay = {"global": lambda env, rewards, infos: 2.5}
        with pytest.raises(ValueError, match="'global' cannot be imported by a worker: define"):
            PettingZoo("broken_team:Limited", rewards=pay)
        assert one(alone("Limited", rewards=pay))[0].rewards["global"].tolist() == [2.5]
        with pytest.raises(ValueError, match="give a class, a plain Python function"):
            alone("Limited", rewards={"global": 3.0})

    def test_what_is_no_function_is_never_called(self, tmp_path):
        env = alone("Limited", rewards={"global": "os:system"})
        with pytest.raises(EnvironmentFailure, match="is a builtin_function_or_method"):
            _ = env.signals


def _pay_own(env, rewards, infos):
    return sum(rewards.values())


def test_our_own_teams_come_back_with_all_their_rewards():
    env = PettingZoo(f"{__name__}:ours", in_process=True)
    assert env.reward_shapes == {"global": (), "local": (2,)}
    copies, task = started(env), Meet()
    episode = int(np.random.default_rng(0).integers(2**31))
    state, _ = task.reset(key=jax.random.split(jax.random.key(episode))[0])
    for _ in range(4):
        action = np.float32([[1.0], [-0.9]])
        state, now = task.step(state, action, key=jax.random.key(0))
        told = copies.step(action[None], everyone(copies)).rewards
        np.testing.assert_allclose(told["local"][0], now.rewards["local"], atol=1e-6)
        assert told["global"][0] == now.rewards["global"]


def ours():
    env = to_pettingzoo(Meet())
    env.max_cycles = 5  # pyright: ignore[reportAttributeAccessIssue]
    return env


@pytest.mark.parametrize(("how", "ended"), [("terminated", [True, False]), ("cut", [False, False])])
def test_an_agents_own_end_is_recorded(how, ended):
    """Its termination ends its value and no other's; its truncation bootstraps."""
    env = alone("Dies", kwargs={"how": how})
    policy = Team(sharing="nothing", head=MLP(hidden=())).init(2, 1, 2, key=jax.random.key(0))
    _, experience = rollout.collect(env, tree.stack(policy), 1, key=jax.random.key(1))
    rows = experience.transitions
    assert rows.terminated.tolist() == [ended, *[[False, False]] * 3]
    assert rows.truncated.tolist() == [False] * 3 + [True]
    assert rows.active.tolist() == [[True, True], *[[False, True]] * 3]
    blank = rollout.blank(env)
    assert (blank.terminated.shape, blank.truncated.shape) == ((2,), ())


def test_the_value_of_an_agent_that_ends_is_its_last_reward():
    """γ = 0.9: 1 for `a`, which ends, and r + γ·Q for `b`, for whom all goes on."""
    learner = TD3(critic=Critic(hidden=(2,)), gamma=0.9, target_noise=0.0)
    network = Team(sharing="nothing", head=MLP(hidden=()))
    state = learner.init(network, 2, 1, 2, key=jax.random.key(0))
    row = rollout.blank(alone("Dies"))
    row = eqx.tree_at(lambda x: x.terminated, row, jnp.array([True, False]))
    row = eqx.tree_at(lambda x: x.rewards["local"], row, jnp.array([1.0, 0.0]))
    replay = extend(Replay.empty(row, 1), jax.tree.map(lambda x: x[None], row), jnp.ones(1, bool))
    for together in (False, True):
        rows = replay.sample(3, together=together, key=jax.random.key(0))[0]
        ends = (rows.terminated, rows.truncated, rows.active)
        batch = Batch(rows.obs, rows.action, rows.rewards["local"], rows.next_obs, *ends)
        target = learner.bellman_target(state, batch, key=jax.random.key(0))[0]
        assert target[:, 0].tolist() == [1.0, 1.0, 1.0]
        assert (np.abs(np.asarray(target[:, 1])) > 0).all()


class Mortal(Meet):
    """Agent 0 ends for itself at its first step."""

    def _time_step(self, state, local, met):
        told = super()._time_step(state, local, met)
        gone = jnp.array([True, False]) & (state.step == 1)
        return dataclasses.replace(told, gone=gone)


def test_an_agents_own_end_in_jax():
    env = delayed(Mortal())
    policy = Team(sharing="nothing", head=MLP(hidden=())).init(2, 1, 2, key=jax.random.key(0))
    _, experience = rollout.collect(env, tree.stack(policy), 1, key=jax.random.key(1))
    ended = experience.transitions.terminated
    assert (ended.shape, ended[0].tolist()) == ((5, 2), [True, False])
    assert rollout.blank(env).terminated.shape == (2,)
    assert rollout.blank(Meet()).terminated.shape == ()  # as it always was


def test_configs_are_compared_by_value():
    once, again = (PettingZoo("mpe2.simple_spread_v3", kwargs={"N": 4}) for _ in range(2))
    assert once == again
    assert hash(once) == hash(again)
    assert once != PettingZoo("mpe2.simple_spread_v3", kwargs={"N": 3})
    assert once != Gymnasium("mpe2.simple_spread_v3", kwargs={"N": 4})


def test_an_episode_is_what_pettingzoo_plays():
    spread = pytest.importorskip("mpe2.simple_spread_v3")
    task = PettingZoo("mpe2.simple_spread_v3")
    assert task.sizes == (18, 5, 3)
    copies, env = task.copies(1), spread.parallel_env(continuous_actions=True)
    random = np.random.default_rng(0)
    obs, _ = env.reset(seed=5)
    np.testing.assert_array_equal(copies.reset(seeds(5), everyone(copies))[0], [*obs.values()])
    for _ in range(25):
        action = random.uniform(-1, 1, (1, 3, 5)).astype(np.float32)
        own = dict(zip(env.agents, np.float32(0.5 + 0.5 * action[0]), strict=True))
        obs, rewards, *_ = env.step(own)
        step = copies.step(action, everyone(copies))
        np.testing.assert_array_equal(step.obs[0], [*obs.values()])
        assert step.rewards["local"][0].tolist() == pytest.approx([*rewards.values()], rel=1e-6)
    assert (step.terminated[0], step.truncated[0]) == (False, True)


class Drawn(Meet):
    """The two agents as white dots on a line of 81 pixels."""

    def render(self, state):
        picture = np.zeros((1, 81, 3), np.uint8)
        picture[0, np.int32(np.round(40 + 20 * np.asarray(state.position)))] = 255
        return picture


def rover(**fields):
    module = pytest.importorskip("credo.environments.rover")
    return module.Rover(**fields)


OURS = {
    "meet": Meet,
    "spread": lambda: SimpleSpread(max_steps=4),
    "rover": lambda: rover(max_steps=4),
}


@pytest.fixture(scope="module", params=OURS)
def team(request):
    return OURS[request.param]()


def test_pettingzoos_own_tests_find_nothing_wrong(team, capsys):
    parallel_api_test(to_pettingzoo(team), num_cycles=12)
    parallel_seed_test(lambda: to_pettingzoo(team), num_cycles=12)
    assert "Passed Parallel API test" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["spread", "rover"])
def test_pettingzoos_test_of_the_clock(name):
    def parallel_env(max_cycles):
        return to_pettingzoo(SimpleSpread(max_steps=4) if name == "spread" else rover(max_steps=4))

    module = types.SimpleNamespace(
        parallel_env=parallel_env, env=lambda **kw: parallel_to_aec(parallel_env(**kw))
    )
    assert max_cycles_test(module) is None


def test_pettingzoos_test_of_drawing():
    for env in (Drawn(), rover(max_steps=4)):
        render_test(
            lambda render_mode, env=env: parallel_to_aec(to_pettingzoo(env, None, render_mode))
        )
    env = to_pettingzoo(Drawn(), render_mode="rgb_array")
    env.reset(seed=0)
    assert env.metadata["render_modes"] == ["rgb_array"]
    assert np.count_nonzero(env.render()) == 6
    plain = to_pettingzoo(Meet())
    plain.reset(seed=0)
    with pytest.raises(ValueError, match="render_mode is None: Meet draws nothing"):
        plain.render()


def walk(env, moves=(1.0, -1.0)):
    return {agent: np.float32([move]) for agent, move in zip(env.agents, moves, strict=True)}


def test_an_episode_is_that_of_the_task():
    env, task = to_pettingzoo(Meet()), Meet()
    obs, infos = env.reset(seed=3)
    episode = int(np.random.default_rng(3).integers(2**31))
    state, first = task.reset(key=jax.random.split(jax.random.key(episode))[0])
    np.testing.assert_array_equal(np.stack([*obs.values()]), first.obs)
    assert infos["agent_1"] == {"rewards": {"global": 0.0, "local": 0.0}, "active": True}
    np.testing.assert_array_equal(env.state(), np.ravel(first.obs))
    steps = 0
    while env.agents:
        obs, rewards, terminated, truncated, infos = env.step(walk(env))
        state, now = task.step(state, np.float32([[1.0], [-1.0]]), key=jax.random.key(0))
        np.testing.assert_allclose(np.stack([*obs.values()]), now.obs, atol=1e-6)
        assert [*rewards.values()] == pytest.approx(now.rewards["local"].tolist(), abs=1e-6)
        steps += 1
    assert steps in (4, 5)
    assert terminated == {"agent_0": True, "agent_1": True}
    assert truncated == {"agent_0": False, "agent_1": False}
    assert [info["rewards"]["global"] for info in infos.values()] == [1.0, 1.0]


def test_the_signal_asked_for_is_paid():
    env = to_pettingzoo(Meet(), signal="global")
    env.reset(seed=0)
    while env.agents:
        rewards = env.step(walk(env))[1]
    assert rewards == {"agent_0": 1.0, "agent_1": 1.0}
    assert to_pettingzoo(Meet()).signal == "local"


def test_actions_are_clipped():
    env = to_pettingzoo(Meet())
    env.reset(seed=0)
    rewards = env.step(walk(env, (9.0, -0.5)))[1]
    assert [*rewards.values()] == pytest.approx([0.2, 0.1], abs=1e-6)


def test_the_next_episode_without_a_seed_is_another():
    env = to_pettingzoo(Meet())
    starts = [env.reset(seed=0)[0]["agent_0"][0], *(env.reset()[0]["agent_0"][0] for _ in "abc")]
    assert len(set(starts)) == 4


def test_wrong_use_is_refused():
    with pytest.raises(ValueError, match="Copy has one agent: give a team task"):
        to_pettingzoo(Copy())
    with pytest.raises(ValueError, match="no reward signal 'speed': there is global, local"):
        to_pettingzoo(Meet(), signal="speed")
    env = to_pettingzoo(Meet())
    with pytest.raises(gymnasium.error.ResetNeeded, match=re.escape("call reset()")):
        env.step({})
    env.reset(seed=0)
    with pytest.raises(ValueError, match="no action for agent_1: give one for every agent"):
        env.step({"agent_0": np.zeros(1)})


def test_credo_does_not_import_pettingzoo():
    code = "import credo, sys; credo.Gymnasium; sys.exit('pettingzoo' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], env=os.environ, check=False).returncode == 0
