"""The rover domain, against numbers by hand and a plain NumPy replay of whole episodes."""

import dataclasses
import functools
import math
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.environments.checks import check_environment
from credo.environments.rover import Rover

ALL = ("global", "local", "mixed", "difference", "dpp")
PLAIN = Rover(rovers=5, coupling=3, pois=3, size=8.0, max_steps=12, rewards=ALL)
GRADED = dataclasses.replace(
    PLAIN,
    graded=True,
    harvest_period=2,
    poi_values=(1.0, 2.0, 5.0),
    local="closeness",
    rewards=("global", "local", "difference"),
)
CODED = Rover(
    coupling=2,
    motion="as-coded",
    start="as-coded",
    observation="as-coded",
    poi_values=(1.0, 2.0, 3.0, 4.0),
)


def scene(rovers, pois, heading=None, **fields):
    """An environment and its state at a start that is given."""
    env = Rover(rovers=len(rovers), pois=len(pois), **fields)
    heading = jnp.zeros(len(rovers)) if heading is None else jnp.asarray(heading, jnp.float32)
    state, first = jax.jit(env.begin)(
        jnp.asarray(rovers, jnp.float32), heading, jnp.asarray(pois, jnp.float32)
    )
    return env, state, first


def action(*rows):
    """Turns in degrees and speeds in m per step, of at most 1."""
    return jnp.array([[turn / 180, 2 * speed - 1] for turn, speed in rows], jnp.float32)


def step(env, state, *rows):
    return jax.jit(env.step)(state, action(*rows), key=jax.random.key(0))


@functools.lru_cache
def episodes(env, worlds=64):
    """Random games in full: the state and the time step after reset and after each step."""

    def one(key):
        reset_key, action_key = jax.random.split(key)
        begun = env.reset(key=reset_key)
        actions = jax.random.uniform(
            action_key, (env.max_steps, env.agents, 2), minval=-1.0, maxval=1.0
        )

        def advance(loop, action):
            loop = env.step(loop[0], action, key=key)
            return loop, loop

        return begun, actions, jax.lax.scan(advance, begun, actions)[1]

    keys = jax.random.split(jax.random.key(3), worlds)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(keys))


# Sensors


def sensors(position, heading, poi, observed, worth=None):
    """Both layouts, written from the text with atan2 and loops."""
    n = len(position)
    obs = np.zeros((n, 72)) if worth is None else np.full((n, 72), -1.0)
    for i in range(n):
        others = [(0, position[j], 1.0) for j in range(n) if j != i]
        pois = [
            (36, poi[j], 1.0 if worth is None else worth[j])
            for j in range(len(poi))
            if not observed[j]
        ]
        for channel, place, value in others + pois:
            x, y = place - position[i]
            d = math.hypot(x, y)
            if worth is None:
                angle, strength = math.degrees(math.atan2(y, x) - heading[i]), 1 / (1 + d)
            else:
                angle, strength = math.degrees(math.atan2(x, y)), value / (d or 0.001) ** 2
            at = channel + min(int(angle % 360 // 10), 35)
            obs[i, at] = max(obs[i, at], strength)
    return obs


def test_sensors_of_one_scene_by_hand():
    rovers, pois = [(0, 0), (3, 0), (0, 1), (0, 4)], [(-3, 0), (0, -1), (-1, -0.01)]
    _, _, first = scene(rovers, pois, coupling=4)
    expected = np.zeros(72)
    expected[0] = 1 / 4  # rover 1 dead ahead, 3 m
    expected[9] = 1 / 2  # rover 2 to the left, 1 m, hides rover 3 behind it
    # Behind: POI 0 is exactly there, POI 2 a little to its left and closer.
    expected[36 + 18] = 1 / (1 + math.hypot(1, 0.01))
    expected[36 + 27] = 1 / 2  # to the right
    np.testing.assert_allclose(first.obs[0], expected, atol=1e-6)
    _, _, turned = scene(rovers, pois, heading=[math.radians(95)] * 4, coupling=4)
    np.testing.assert_array_equal(np.flatnonzero(turned.obs[0, :36]), [26, 35])


def test_at_the_very_same_place_is_bracket_zero():
    _, _, first = scene([(1, 1), (1, 1)], [(5, 5)], coupling=2)
    assert first.obs[0, 0] == 1.0
    assert np.count_nonzero(first.obs[0, :36]) == 1


def test_sensors_agree_with_numpy():
    states = episodes(PLAIN)[2][0]
    shown = episodes(PLAIN)[2][1].obs
    wrong = total = 0
    for w in range(0, 64, 2):
        for t in range(0, 12, 3):
            s = jax.tree.map(lambda x, w=w, t=t: x[w, t], states)
            expected = sensors(s.position, s.heading, s.poi, s.observed)
            wrong += np.sum(np.abs(expected - shown[w, t]) > 1e-5)
            total += np.sum(expected > 0)
    assert total > 2000
    assert wrong <= 2  # a target within rounding of a border


def test_layout_as_coded():
    assert CODED.obs_size == 75
    states, steps = episodes(CODED)[2]
    shown = steps.obs
    for w in range(8):
        s = jax.tree.map(lambda x, w=w: x[w, 20], states)
        expected = sensors(s.position, s.heading, s.poi, s.observed, worth=(1, 2, 3, 4))
        np.testing.assert_allclose(shown[w, 20, :, 1:73], expected, rtol=1e-3)
    np.testing.assert_array_equal(shown[:, 20, :, 0], np.tile(np.arange(4.0), (64, 1)))
    assert (shown[..., 73] == 0.5).all()
    turns = np.cumsum(episodes(CODED)[1][..., 1], axis=1) / 2
    np.testing.assert_allclose(shown[..., 74], turns, atol=1e-4)
    _, _, first = scene([(0, 0), (0, 0)], [(2, 0)], coupling=2, observation="as-coded")
    assert first.obs[0, 1] == pytest.approx(1e6)  # d = 0 counts as 0.001
    assert first.obs[0, 37 + 9] == 0.25  # +x is 90° clockwise from +y
    assert np.sum(first.obs[0] == -1.0) == 70
    assert (first.obs[:, 73:] == 0.0).all()


# Motion


def test_turn_first_then_drive():
    env, state, _ = scene([(0, 0)], [(9, 9)], coupling=1)
    state, _ = step(env, state, (90, 1.0))
    np.testing.assert_allclose(state.position[0], [0, 1], atol=1e-6)
    state, _ = step(env, state, (-180, 0.25))
    np.testing.assert_allclose(state.position[0], [0, 0.75], atol=1e-6)
    assert float(state.heading[0]) == pytest.approx(-math.pi / 2)
    assert float(state.speed[0]) == 0.25
    fast = dataclasses.replace(env, max_speed=3.0)
    np.testing.assert_allclose(step(fast, state, (0, 1.0))[0].position[0], [0, -2.25], atol=1e-6)


def test_motion_as_coded_is_half_a_metre_whatever_the_drive():
    env, state, _ = scene([(0, 0)], [(9, 9)], coupling=1, motion="as-coded")
    for drive in (-1.0, 1.0):
        state, _ = env.step(state, jnp.array([[drive, 1.0]]), key=jax.random.key(0))
    np.testing.assert_allclose(state.position[0], [-0.5, 0.5], atol=1e-6)  # north, then west


# Starts


def test_continuous_starts():
    env = Rover(coupling=5)
    state, _ = jax.jit(jax.vmap(lambda key: env.reset(key=key)))(
        jax.random.split(jax.random.key(0), 500)
    )
    half = 10 * math.sqrt(0.1)
    rovers, pois = np.asarray(state.position), np.asarray(state.poi)
    assert np.abs(rovers - 10).max() <= half + 1e-4
    assert np.abs(rovers - 10).max() > half - 0.05
    assert (np.abs(pois - 10).max(axis=-1) > half).all()
    assert pois.min() >= 0
    assert pois.max() <= 20
    apart = np.linalg.norm(rovers[:, :, None] - pois[:, None], axis=-1)
    assert 2.0 <= apart.min() < 2.2
    # Uniform outside: the outer frame of 2 m has 36 % of the area, the centre 10 %; some of the
    # rest is too close to a rover.
    frame = np.mean(np.abs(pois - 10).max(axis=-1) > 8)
    assert 0.37 < frame < 0.5
    assert abs(np.cos(state.heading).mean()) < 0.05


def test_starts_as_coded():
    env = Rover(coupling=2, pois=6, start="as-coded")
    state, _ = jax.jit(jax.vmap(lambda key: env.reset(key=key)))(
        jax.random.split(jax.random.key(0), 500)
    )
    rovers, pois = np.asarray(state.position), np.asarray(state.poi)
    assert set(rovers.ravel()) == set(range(7, 14))
    left, right, middle = (pois[:, i::3].reshape(-1, 2) for i in range(3))
    assert set(left[:, 0]) == {0, 1, 2, 3}
    assert set(right[:, 0]) == {15, 16, 17, 18, 19}
    assert set(left[:, 1]) == set(right[:, 1]) == set(range(20))
    assert set(middle[:, 0]) == set(range(4, 15))
    assert set(middle[:, 1]) == {0, 1, 2, 3, 15, 16, 17, 18, 19}
    assert abs(np.mean(middle[:, 1] < 10) - 0.5) < 0.06
    assert (state.heading == 0).all()


def test_motivating_start():
    state, _ = Rover.motivating().reset(key=jax.random.key(0))
    np.testing.assert_array_equal(state.position, [[9, 10], [14, 17]])
    np.testing.assert_array_equal(state.poi, [[1, 1], [1, 18]])
    assert Rover.motivating(coupling=2).coupling == 2


# Rewards


def test_local_and_global_by_hand():
    env, state, _ = scene(
        [(0, 0), (0, 1)], [(3, 0), (0, 9)], coupling=2, max_steps=2, rewards=ALL[:3]
    )
    state, now = step(env, state, (0, 0.5), (0, 0.0))
    assert state.observed.tolist() == [False, False]  # rover 1 is √10 m away
    np.testing.assert_allclose(now.rewards["local"], [-2.5, -math.sqrt(10)], rtol=1e-6)
    assert float(now.rewards["global"]) == 0.0
    state, now = step(env, state, (0, 0.0), (0, 1.0))
    assert state.observed.tolist() == [True, False]
    assert now.obs[0, 36] == 0.0  # it vanished
    assert bool(now.truncated)
    assert not bool(now.terminated)
    assert float(now.rewards["global"]) == 0.5
    local = [-2.5, -math.hypot(1, 2)]  # observed or not
    np.testing.assert_allclose(now.rewards["local"], local, rtol=1e-6)
    np.testing.assert_allclose(now.rewards["mixed"], np.add(local, 5.0), rtol=1e-6)


@pytest.mark.parametrize(
    ("local", "there", "observing", "then"),
    [
        ("distance", -4.0, -3.0, -4.0),
        ("unobserved", -4.0, -3.0, -6.0),
        ("closeness", 0.75, 1.0, 0.5),
        ("progress", 1.0, 1.0, -1.0),
    ],
)
def test_local_rewards_before_at_and_after_an_observation(local, there, observing, then):
    """Along +x: one POI 5 m ahead; another 10 m ahead, where the rover does not get."""
    env, state, _ = scene([(0, 0)], [(5, 0), (2, 8)], coupling=1, local=local, poi_values=(1, 1))
    state = eqx.tree_at(lambda s: s.poi, state, jnp.array([[5.0, 0.0], [7.0, 0.0]]))
    found = []
    for turn in (0, 0, 180):
        state, now = step(env, state, (turn, 1.0))
        found.append(float(now.rewards["local"][0]))
    assert found == [there, observing, then]


@pytest.mark.parametrize(
    ("local", "before", "after"), [("distance", -4, -3), ("closeness", 0.75, 1)]
)
def test_the_episode_ends_when_all_are_observed(local, before, after):
    env, state, _ = scene([(0, 0)], [(5, 0)], coupling=1, local=local)
    state, now = step(env, state, (0, 1.0))
    assert float(now.rewards["local"][0]) == before
    assert not bool(now.terminated)
    _, now = step(env, state, (0, 1.0))
    assert bool(now.terminated)
    assert not bool(now.truncated)
    assert float(now.rewards["global"]) == 1.0
    assert float(now.rewards["local"][0]) == after


def test_one_rover_fewer_never_observes():
    env = Rover(rovers=3, coupling=3, pois=2, size=4.0, max_steps=10)
    away = jnp.array([[0.0, 0.0], [0.1, 0.0], [60.0, 0.0]])  # two inside, one out of range

    def one(key):
        poi = jax.random.uniform(key, (2, 2))
        state, _ = env.begin(away, jnp.zeros(3), poi)
        for _ in range(10):
            state, now = env.step(state, jnp.tile(jnp.array([0.9, -0.9]), (3, 1)), key=key)
        return now.rewards["global"]

    rewards = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 50))
    assert (rewards == 0).all()


def test_poi_values_are_shares():
    env, state, _ = scene([(0, 0)], [(1, 0), (9, 9)], coupling=1, poi_values=(1, 3), max_steps=1)
    _, now = step(env, state, (0, 0.0))
    assert float(now.rewards["global"]) == 0.25


def test_harvest_needs_consecutive_steps():
    env, state, _ = scene([(0, 0)], [(3, 0)], coupling=1, harvest_period=2, activation_distance=2.5)
    seen = []
    for row in ((0, 1.0), (180, 1.0), (180, 1.0), (0, 0.0)):  # in, out, in, stay
        state, now = step(env, state, row)
        seen.append(bool(state.observed[0]))
    assert seen == [False, False, False, True]
    assert bool(now.terminated)


def test_graded_pays_the_closest_approach():
    env, state, _ = scene(
        [(0, 0), (0, 0), (-9, 0)], [(10, 0)], coupling=2, graded=True, max_steps=2
    )
    state, _ = step(env, state, (0, 1.0), (0, 0.5), (0, 0.0))
    assert float(state.nearness[0]) == pytest.approx(3 / 9.25)
    _, now = step(env, state, (180, 1.0), (180, 1.0), (0, 0.0))  # back again
    assert float(now.rewards["global"]) == pytest.approx(3 / 9.25)


def replay(env, position, poi):
    """Global reward of trajectories `[time, rovers, 2]`, from the definitions."""
    values = np.ones(env.pois) if env.poi_values is None else np.array(env.poi_values)
    d = np.linalg.norm(position[:, :, None] - poi[None, None], axis=-1)
    paid = np.zeros(env.pois)
    for p in range(env.pois):
        run = 0
        for now in d[:, :, p]:
            run = run + 1 if np.sum(now <= env.activation_distance) >= env.coupling else 0
            if run >= env.harvest_period:
                paid[p] = 1.0
            if env.graded and len(now) >= env.coupling:
                mean = np.sort(now)[: env.coupling].mean()
                near = env.activation_distance / max(env.activation_distance, mean)
                paid[p] = max(paid[p], near)
    return values @ paid / values.sum()


def d_plus_plus(env, position, poi):
    """Algorithm 1 of Rahmattalabi et al. (2016), with copies that are really added."""
    whole, result = replay(env, position, poi), []
    for i in range(env.agents):

        def gain(copies, i=i):
            more = np.concatenate([position, *[position[:, i : i + 1]] * copies], axis=1)
            return (replay(env, more, poi) - whole) / copies

        difference = whole - replay(env, np.delete(position, i, axis=1), poi)
        best = difference
        if env.coupling > 1 and gain(env.coupling - 1) > difference + 1e-9:
            last = difference
            for copies in range(1, env.coupling):
                if gain(copies) > last + 1e-9:
                    best = gain(copies)
                    break
                last = gain(copies)
        result.append(best)
    return np.array(result)


@pytest.mark.parametrize("env", [PLAIN, GRADED], ids=["plain", "graded, harvest, values"])
def test_rewards_at_the_end_agree_with_a_replay(env):
    _, _, (states, steps) = episodes(env)
    seen, stones = [], 0
    for w in range(64):
        ends = int(np.argmax(steps.terminated[w] | steps.truncated[w]))
        position = states.position[w, : ends + 1].astype(np.float64)
        poi = states.poi[w, 0].astype(np.float64)
        paid = {name: reward[w, ends] for name, reward in steps.rewards.items()}
        whole = replay(env, position, poi)
        assert paid["global"] == pytest.approx(whole, abs=1e-5)
        without = [replay(env, np.delete(position, i, axis=1), poi) for i in range(env.agents)]
        np.testing.assert_allclose(paid["difference"], whole - without, atol=1e-5)
        if "dpp" in paid:
            np.testing.assert_allclose(paid["dpp"], d_plus_plus(env, position, poi), atol=1e-5)
            stones += np.sum(paid["dpp"] > paid["difference"] + 0.01)
        before = {name: reward[w, :ends] for name, reward in steps.rewards.items()}
        for name in set(before) - {"local", "mixed"}:
            assert (before[name] == 0).all()
        seen.append((whole, np.abs(paid["difference"]).max()))
    whole, difference = np.array(seen).T
    assert 0.05 < whole.mean() < 0.95
    assert np.sum(difference > 0) >= 10
    assert stones > 10 or "dpp" not in env.rewards


def ends_of(rovers, coupling):
    """D and D++ when all stand where they are, 1 POI at the origin with d_a 3, 2 far away."""
    pois = [(0, 0), (80, 0), (80, 80)]
    env, state, _ = scene(rovers, pois, coupling=coupling, max_steps=1, rewards=ALL)
    _, now = step(env, state, *[(0, 0.0)] * len(rovers))
    return np.asarray(now.rewards["difference"]), np.asarray(now.rewards["dpp"])


def test_difference_and_dpp_by_hand():
    third = 1 / 3
    # Exactly three of three: each is needed, and no copy adds anything.
    d, dpp = ends_of([(0, 0), (1, 0), (2, 0), (70, 0)], coupling=3)
    np.testing.assert_allclose(d, [third, third, third, 0], rtol=1e-6)
    np.testing.assert_allclose(dpp, d, rtol=1e-6)
    # Four of three: nobody is needed.
    d, dpp = ends_of([(0, 0), (1, 0), (2, 0), (0, 1)], coupling=3)
    np.testing.assert_array_equal(d, np.zeros(4))
    np.testing.assert_array_equal(dpp, np.zeros(4))
    # Two of three: one copy of either would do; nobody is credited for being far away.
    d, dpp = ends_of([(0, 0), (1, 0), (70, 0)], coupling=3)
    np.testing.assert_array_equal(d, np.zeros(3))
    np.testing.assert_allclose(dpp, [third, third, 0], rtol=1e-6)
    # One of four: three copies, so a third of the gain each.
    _, dpp = ends_of([(0, 0), (70, 0), (70, 0), (70, 0)], coupling=4)
    np.testing.assert_allclose(dpp, [third / 3, 0, 0, 0], rtol=1e-6)


# What must not matter


def played(env, position, heading, poi, actions):
    state, first = env.begin(position, heading, poi)

    def advance(state, action):
        state, now = env.step(state, action, key=jax.random.key(0))
        return state, (now.obs, now.rewards)

    return first.obs, jax.lax.scan(advance, state, actions)[1]


@pytest.fixture(scope="module")
def game():
    (state, _), actions, _ = episodes(PLAIN)
    return state.position[:32], state.heading[:32], state.poi[:32], actions[:32]


@pytest.fixture(scope="module")
def outcome(game):
    return jax.jit(jax.vmap(lambda *x: played(PLAIN, *x)))(*game)


def assert_alike(a, b, rovers=slice(None)):
    """Observations and rewards of two games; a target may cross a border by rounding."""
    (first_a, (obs_a, rewards_a)), (first_b, (obs_b, rewards_b)) = a, b
    for x, y in ((first_a, first_b), (obs_a, obs_b)):
        assert np.mean(np.abs(x[..., rovers, :] - y) > 1e-4) < 1e-3
    assert float(np.max(rewards_a["global"])) > 0
    for name, reward in rewards_a.items():
        reward = reward if name == "global" else reward[..., rovers]
        np.testing.assert_allclose(reward, rewards_b[name], atol=2e-4)


def test_the_world_may_be_turned_and_shifted(game, outcome):
    position, heading, poi, actions = game
    c, s = math.cos(1.0), math.sin(1.0)
    turn, shift = np.array([[c, s], [-s, c]], np.float32), np.float32([7.0, -3.0])
    other = position @ turn + shift, heading + np.float32(1.0), poi @ turn + shift, actions
    assert_alike(outcome, jax.jit(jax.vmap(lambda *x: played(PLAIN, *x)))(*other))


def test_rovers_and_pois_have_no_order(game, outcome):
    position, heading, poi, actions = game
    order = np.array([3, 0, 4, 1, 2])
    other = position[:, order], heading[:, order], poi[:, ::-1], actions[:, :, order]
    assert_alike(outcome, jax.jit(jax.vmap(lambda *x: played(PLAIN, *x)))(*other), order)


def test_one_world_alone_is_as_in_a_batch(game, outcome):
    alone = jax.jit(lambda *x: played(PLAIN, *x))(*(x[5] for x in game))
    for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(outcome), strict=True):
        np.testing.assert_allclose(a, b[5], atol=1e-5)


# The contract


@pytest.mark.parametrize(
    "env",
    [
        PLAIN,
        GRADED,
        CODED,
        Rover.motivating(),
    ],
    ids=["plain", "graded", "coded", "motivating"],
)
def test_contract(env):
    assert check_environment(env) == []


def test_fields():
    assert Rover(coupling=3) == Rover(rovers=None, coupling=3)
    assert Rover(coupling=3) != Rover(coupling=3, size=30.0)
    assert Rover(coupling=7).agents == 14
    assert Rover().reported == "global"
    assert Rover(rewards=("local", "dpp")).reported == "dpp"


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"rovers": 2, "coupling": 3}, "coupling is 3 and there are 2 rovers"),
        ({"pois": 0}, "pois is 0"),
        ({"coupling": 0}, "coupling is 0"),
        ({"max_steps": 0}, "max_steps is 0"),
        ({"activation_distance": 0.0}, "activation_distance is 0.0"),
        ({"rewards": ("global", "d")}, "a reward is 'd'"),
        ({"rewards": ()}, "rewards is ()"),
        ({"rewards": ("local", "local")}, "only once"),
        ({"rewards": ("dpp",), "harvest_period": 2}, "harvest_period 2"),
        ({"poi_values": (1.0, 2.0)}, "2 numbers for 4 POIs"),
        ({"poi_values": (1.0, 2.0, 3.0, -1.0)}, "value is -1.0"),
        ({"placed": (((0.0, 0.0),), ((1.0, 1.0),))}, "placed has 1 rovers and 1 POIs"),
        ({"local": "near"}, "local is 'near'"),
    ],
)
def test_impossible_fields_are_refused(fields, told):
    with pytest.raises(ValueError, match=re.escape(told)):
        Rover(**fields)


def test_its_picture_shows_pois_and_rovers_where_they_are():
    env = Rover(rovers=2, pois=1, coupling=2, size=20.0)
    position, poi = jnp.array([[10.0, 10.0], [3.0, 16.0]]), jnp.array([[15.0, 5.0]])
    state, _ = env.begin(position, jnp.zeros(2), poi)
    picture = env.render(state, pixels=200)
    assert (picture.shape, picture.dtype) == ((200, 200, 3), np.uint8)
    assert picture[100, 100].tolist() == picture[40, 30].tolist() == [0, 92, 175]
    assert picture[150, 150].tolist() == [0, 0, 0]  # row 0 is the north edge
    assert picture[150, 180].tolist() == [0, 0, 0]  # the ring, 3 m to the east
    assert picture[10, 190].tolist() == [255, 255, 255]
    seen = eqx.tree_at(lambda s: s.observed, state, jnp.array([True]))
    assert env.render(seen, pixels=200)[150, 150].tolist() == [200, 16, 46]


# Decoys


def test_decoys_lie_near_and_the_others_far_and_nothing_is_observed_at_the_start():
    env = Rover.misleading(coupling=3)
    state, _ = jax.jit(jax.vmap(lambda key: env.reset(key=key)))(
        jax.random.split(jax.random.key(0), 300)
    )
    radius = np.linalg.norm(np.asarray(state.poi) - 10.0, axis=2)
    assert 4.0 <= radius[:, :4].min() < 4.6
    assert 6.8 < radius[:, :4].max() <= 7.0 + 1e-5
    assert 8.0 - 1e-5 <= radius[:, 4:].min() < 8.1
    assert 9.9 < radius[:, 4:].max() <= 10.0 + 1e-5
    # Uniform in the ring: half of its area lies beyond the root of the mean square.
    assert abs((radius[:, 4:] > np.sqrt(0.5 * (8**2 + 10**2))).mean() - 0.5) < 0.05
    away = state.position[:, :, None] - state.poi[:, None]
    assert np.linalg.norm(away, axis=3).min() >= 3.0


def test_a_decoy_needs_one_rover_and_another_poi_the_coupling():
    pois = [(0, 0), (50, 0)]
    fields = {"coupling": 2, "decoys": 1, "poi_values": (1.0, 4.0), "max_steps": 2}
    env, state, _ = scene([(0, 0), (50, 0)], pois, **fields)
    assert env.needed == (1, 2)
    state, _ = step(env, state, (0, 0.0), (0, 0.0))
    assert np.asarray(state.observed).tolist() == [True, False]
    _, now = step(env, state, (0, 0.0), (0, 0.0))
    assert float(now.rewards["global"]) == pytest.approx(0.2)
    env, state, _ = scene([(50, 0), (50, 1)], pois, **fields)
    state, _ = step(env, state, (0, 0.0), (0, 0.0))
    assert np.asarray(state.observed).tolist() == [False, True]
    other = Rover(coupling=3, pois=2, poi_couplings=(2, 3))
    assert other.needed == (2, 3)


def test_d_plus_plus_of_pois_that_differ():
    """One copy more would observe the second POI, which needs two; the first needs three."""
    fields = {"coupling": 3, "poi_couplings": (3, 2), "poi_values": (3.0, 1.0), "max_steps": 1}
    env, state, _ = scene([(0, 0), (50, 0), (99, 9)], [(0, 0), (50, 0)], rewards=("dpp",), **fields)
    _, now = step(env, state, (0, 0.0), (0, 0.0), (0, 0.0))
    np.testing.assert_allclose(now.rewards["dpp"], [0.75 / 2, 0.25, 0.0])


def test_graded_with_couplings_of_their_own():
    fields = {"coupling": 2, "poi_couplings": (1, 2), "graded": True, "max_steps": 1}
    env, state, _ = scene([(0, 0), (0, 8)], [(0, 6), (0, 12)], rewards=("global",), **fields)
    _, now = step(env, state, (0, 0.0), (0, 0.0))
    assert float(now.rewards["global"]) == pytest.approx(0.5 * 1.0 + 0.5 * 3 / 8)


@pytest.mark.parametrize(
    ("mislead", "paid"),
    [
        (0.0, [1.0, 1.0, 1.0, 1.0]),
        (1.0, [0.75, 1.0, 0.0, 0.0]),
        (0.25, [0.9375, 1.0, 0.75, 0.75]),
    ],
)
def test_the_misleading_reward_of_a_rover_that_passes_a_decoy(mislead, paid):
    """Along +x: a decoy 5 m ahead, observed from 3 m in the second step, and another POI at 20."""
    fields = {"coupling": 1, "decoys": 1, "local": "decoys", "mislead": mislead}
    env, state, _ = scene([(0, 0)], [(5, 0), (20, 0)], **fields)
    found = []
    for _ in range(4):
        before, (state, now) = state, step(env, state, (0, 1.0))
        found.append(float(now.rewards["local"][0]))
    # The decoy is paid once more in the step that observes it, as with `closeness`.
    assert found == pytest.approx(paid)
    assert not np.asarray(before.observed)[1]


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"poi_couplings": (1, 2)}, "poi_couplings has 2 numbers for 4 POIs"),
        ({"poi_couplings": (1, 2, 3, 4)}, "coupling is 4"),
        ({"poi_rings": ((1.0, 2.0),)}, "poi_rings has 1 pairs for 4 POIs"),
        ({"poi_rings": ((2.0, 1.0),) * 4}, "greatest distance of a ring is 1.0"),
        ({"decoys": 5}, "decoys is 5"),
        ({"mislead": 1.5}, "mislead is 1.5"),
    ],
)
def test_impossible_decoys_are_refused(fields, told):
    with pytest.raises(ValueError, match=re.escape(told)):
        Rover(coupling=3, **fields)
