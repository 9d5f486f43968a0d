"""The server fleet: episodes by hand, fair claims, busy periods, comings and goings."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.environments.checks import check_environment
from credo.environments.server_fleet import ServerFleet

STEPS = {}
SMALL = ServerFleet(servers=3, devices=4, requests=2, nefarious=(1, 3), busy=(0, 2), max_steps=6)
KEY = jax.random.key(0)


def serve(env, devices):
    """The action by which each server chooses one of these devices."""
    return 2 * np.eye(env.devices, dtype=np.float32)[np.asarray(devices)] - 1


def step(env, state, devices, key=KEY):
    """One compiled step of each task of this file."""
    if env not in STEPS:
        STEPS[env] = jax.jit(lambda state, action, key: env.step(state, action, key=key))
    return STEPS[env](state, serve(env, devices), key)


def many(env, state, devices, count):
    """The same step with that many keys."""
    action = serve(env, devices)
    play = jax.jit(jax.vmap(lambda key: env.step(state, action, key=key)))
    return play(jax.random.split(KEY, count))


def begin(env, *genuine):
    return env.begin(jnp.array(genuine, bool))


@pytest.fixture(scope="module")
def played():
    """200 episodes of random choices: states and time steps `[episodes, steps, ...]`."""

    def episode(key):
        reset_key, key = jax.random.split(key)

        def advance(state, key):
            act_key, step_key = jax.random.split(key)
            action = jax.random.uniform(act_key, (SMALL.servers, SMALL.devices))
            after, now = SMALL.step(state, action, key=step_key)
            return after, (state, after, now)

        return jax.lax.scan(advance, SMALL.reset(key=reset_key)[0], jax.random.split(key, 6))[1]

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(episode))(jax.random.split(KEY, 200)))


@pytest.mark.parametrize(
    "env",
    [
        SMALL,
        ServerFleet(
            servers=2,
            devices=3,
            requests=1,
            nefarious=1,
            max_steps=4,
            observation="scalar",
            schedule=((0, 2), (1, 9)),
        ),
    ],
    ids=["one-hot", "scalar, scheduled"],
)
def test_the_contract(env):
    assert check_environment(env) == []


def test_sizes():
    env = ServerFleet()
    assert (env.sizes, env.max_steps, env.signals) == ((41, 20, 10), 15, ("net",))
    assert env.reported == "net"
    assert ServerFleet(status=False).obs_size == 40
    assert ServerFleet(observation="scalar").obs_size == 22
    case = ServerFleet.case_study()
    assert (case.sizes, case.requests, case.nefarious, case.busy) == ((9, 4, 2), 3, 2, 1)


def test_an_episode_by_hand():
    """The third configuration of Table 4.1: devices 0 and 3 are nefarious."""
    env = ServerFleet.case_study((False, True, True, False))
    state, now = env.reset(key=KEY)
    np.testing.assert_array_equal(now.obs, [[3, 3, 3, 3, 0, 0, 0, 0, 1]] * 2)
    np.testing.assert_array_equal(now.active, [True, True])
    state, now = step(env, state, [1, 0])
    assert float(now.rewards["net"]) == 0.0  # +1 and -1
    np.testing.assert_array_equal(state.pending, [2, 2, 3, 3])
    np.testing.assert_array_equal(
        now.obs, [[0, 0, 0, 0, 0, 1, 0, 0, 0], [0, 0, 0, 0, -1, 0, 0, 0, 0]]
    )
    np.testing.assert_array_equal(now.active, [False, False])
    state, now = step(env, state, [1, 1])  # both are busy
    assert float(now.rewards["net"]) == 0.0
    np.testing.assert_array_equal(now.obs, [[2, 2, 3, 3, 0, 0, 0, 0, 1]] * 2)
    net = []
    for _ in range(6):
        state, now = step(env, state, [1, 2])
        net.append(float(now.rewards["net"]))
    assert net == [2, 0, 2, 0, 1, 0]  # device 1 had two requests left
    np.testing.assert_array_equal(state.pending, [2, 0, 0, 3])
    assert bool(now.truncated)
    assert not bool(now.terminated)


def test_the_clock_leaves_eight_actions_of_fifteen_steps():
    env = ServerFleet(servers=2, devices=2, requests=9, nefarious=0)
    state, now = env.reset(key=KEY)
    acted, total = np.array(now.active, int), 0.0
    for t in range(15):
        assert not bool(now.truncated), t
        state, now = step(env, state, [0, 1])
        total += float(now.rewards["net"])
        acted += np.asarray(now.active) & (t < 14)
    assert bool(now.truncated)
    assert acted.tolist() == [8, 8]
    assert total == 16.0


@pytest.mark.parametrize(("requests", "share"), [(1, 1 / 3), (2, 2 / 3), (3, 1.0)])
def test_claims_on_the_last_requests_are_fair(requests, share):
    env = ServerFleet(servers=3, devices=2, requests=requests, nefarious=1)
    state, now = many(env, begin(env, True, False)[0], [0, 0, 0], 3000)
    got = np.asarray(state.told)[:, :, 0]
    assert (got.sum(axis=1) == requests).all()
    np.testing.assert_allclose(got.mean(axis=0), share, atol=0.035)  # 4 standard errors
    assert (np.asarray(now.rewards["net"]) == requests).all()
    assert (np.asarray(state.pending) == [0, requests]).all()


def test_a_claim_on_another_device_is_not_in_the_way():
    env = ServerFleet(servers=3, devices=2, requests=1, nefarious=1)
    state, now = many(env, begin(env, True, False)[0], [0, 1, 0], 500)
    told = np.asarray(state.told)
    assert (told[:, 1, 1] == -1).all()
    assert (told[:, [0, 2], 0].sum(axis=1) == 1).all()
    assert 0.35 < told[:, 0, 0].mean() < 0.65
    assert (np.asarray(now.rewards["net"]) == 0).all()


def test_nothing_is_served_twice(played):
    before, after, now = played
    assert after.pending.min() == 0
    assert (after.pending <= before.pending).all()
    served = 2 - after.pending[:, -1]
    net = np.where(after.genuine[:, -1], served, -served).sum(axis=1)
    np.testing.assert_array_equal(now.rewards["net"].sum(axis=1), net)


def test_only_who_acts_is_told(played):
    before, after, _ = played
    idle = before.busy > 0
    assert idle.any()
    assert (after.told[idle] == 0).all()
    assert (after.busy[idle] == before.busy[idle] - 1).all()


def test_busy_steps_are_uniform_also_behind_an_empty_device():
    env = dataclasses.replace(SMALL, requests=1)
    state, _ = begin(env, True, True, False, False)
    state = dataclasses.replace(state, pending=jnp.array([0, 1, 1, 1]))
    state, now = many(env, state, [0, 1, 2], 3000)
    busy = np.asarray(state.busy)
    for steps in range(3):
        np.testing.assert_allclose((busy == steps).mean(axis=0), 1 / 3, atol=0.035)
    np.testing.assert_array_equal(now.active, busy == 0)
    assert (np.asarray(state.told)[:, 0] == 0).all()
    assert (np.asarray(now.rewards["net"]) == 0).all()  # +1, -1 and an empty device


def test_classes_are_drawn_uniformly():
    reset = jax.jit(jax.vmap(lambda key: SMALL.reset(key=key)[0].genuine))
    genuine = np.asarray(reset(jax.random.split(KEY, 3000)))
    count = (~genuine).sum(axis=1)
    for n in (1, 2, 3):
        assert abs((count == n).mean() - 1 / 3) < 0.035
    np.testing.assert_allclose(genuine.mean(axis=0), 0.5, atol=0.04)


def test_the_scalar_is_the_sum_of_the_one_hot():
    env = ServerFleet(servers=3, devices=3, requests=1, nefarious=1, observation="scalar")
    state, _ = step(env, begin(env, True, False, True)[0], [1, 2, 2])
    _, now = step(env, begin(env, True, False, True)[0], [1, 2, 2])
    np.testing.assert_array_equal(now.obs[:, 3], np.asarray(state.told).sum(axis=1))
    assert sorted(np.asarray(now.obs)[1:, 3].tolist()) == [0.0, 1.0]
    assert float(now.obs[0, 3]) == -1.0


def test_what_was_told_may_stay_until_the_next_action():
    env = ServerFleet(servers=1, devices=2, nefarious=1, busy=2, told="until-action")
    once = dataclasses.replace(env, told="once")
    seen = {}
    for task in (env, once):
        state, _ = begin(task, True, False)
        seen[task] = []
        for _ in range(4):
            state, now = step(task, state, [1])
            seen[task].append(float(now.obs[0, 3]))
    assert seen[env] == [-1.0, -1.0, -1.0, -1.0]
    assert seen[once] == [-1.0, 0.0, 0.0, -1.0]


def test_servers_join_and_leave():
    env = ServerFleet(
        servers=3, devices=2, requests=9, nefarious=1, busy=0, schedule=((0, 9), (1, 3), (0, 1))
    )
    state, now = begin(env, True, False)
    present, net = [np.asarray(now.active)], []
    assert float(now.obs[1, -1]) == -1.0
    assert (np.asarray(now.obs)[1, :-1] == 0).all()
    for _ in range(4):
        state, now = step(env, state, [0, 0, 0])
        present.append(np.asarray(now.active))
        net.append(float(now.rewards["net"]))
        away = ~np.asarray(now.active)
        np.testing.assert_array_equal(now.obs[:, -1], np.where(away, -1.0, 1.0))
        assert (np.asarray(now.obs)[away, :-1] == 0).all()
    expected = [[1, 0, 1], [1, 1, 0], [1, 1, 0], [1, 0, 0], [1, 0, 0]]
    np.testing.assert_array_equal(present, np.array(expected, bool))
    assert net == [2, 2, 2, 1]


def test_vmap_equals_single(played):
    before, after, now = played
    for episode in range(3):
        keys = jax.random.split(jax.random.split(jax.random.split(KEY, 200)[episode])[1], 6)
        act_key, step_key = jax.random.split(keys[2])
        action = jax.random.uniform(act_key, (SMALL.servers, SMALL.devices))
        state = jax.tree.map(lambda x, i=episode: jnp.asarray(x[i, 2]), before)
        single = SMALL.step(state, action, key=step_key)
        batched = jax.tree.map(lambda x, i=episode: x[i, 2], (after, now))
        jax.tree.map(np.testing.assert_array_equal, single, batched)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"servers": 0}, "servers is 0"),
        ({"nefarious": 21}, "nefarious is 21"),
        ({"nefarious": (5, 3)}, r"nefarious is \(5, 3\)"),
        ({"busy": (0, -1)}, r"busy is \(0, -1\)"),
        ({"busy": -1}, "busy is -1"),
        ({"classes": (True,)}, "1 entries for 20 devices"),
        ({"schedule": ((0, 5),)}, "1 entries for 10 servers"),
        ({"schedule": ((5, 5),) * 10}, r"schedule\[0\] is \(5, 5\)"),
        ({"schedule": ((0, 5),) * 9 + ((15, 20),)}, r"schedule\[9\] is \(15, 20\).*joins < 15"),
        ({"schedule": ((0, 5, 9),) * 10}, r"schedule\[0\] is \(0, 5, 9\)"),
        ({"servers": 2, "schedule": (3, 4)}, r"schedule\[0\] is 3: it must be \(joins, leaves\)"),
        ({"schedule": 7}, r"schedule is 7: give \(joins, leaves\)"),
        ({"observation": "vector"}, "observation is 'vector'"),
        ({"told": "never"}, "told is 'never'"),
        ({"scale": (0.0, 1.0)}, r"scale is \(0.0, 1.0\)"),
        ({"scale": 0.02}, "scale is 0.02"),
        ({"scale": (float("inf"), 1.0)}, r"scale is \(inf, 1.0\)"),
    ],
)
def test_wrong_arguments_are_named(given, told):
    with pytest.raises(ValueError, match=told):
        ServerFleet(**given)


def test_what_is_observed_may_be_scaled():
    env = dataclasses.replace(SMALL, scale=(0.5, 3.0), busy=1)
    state, now = begin(env, True, False, True, False)
    np.testing.assert_array_equal(now.obs[0], [1, 1, 1, 1, 0, 0, 0, 0, 1])
    state, now = step(env, state, [0, 1, 2])
    np.testing.assert_array_equal(now.obs[:, 4:8], 3 * np.diag([1, -1, 1, 0])[:3])
    assert float(now.rewards["net"]) == 1.0
    assert check_environment(env) == []
