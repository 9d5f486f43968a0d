"""The Extended T-Maze: episodes by hand, and random ones against a NumPy reading of the text."""

import dataclasses
import functools
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.environments.checks import check_environment
from credo.environments.extended_tmaze import ExtendedTMaze

ALL = ("score", "difference")
TASKS = {
    "converge": ExtendedTMaze(rewards=ALL),
    "spread": ExtendedTMaze(
        robots=3, objective="spread", partner="resp", corridor=(1, 3), rewards=ALL, shaping=True
    ),
    "as coded": ExtendedTMaze(
        depth=1,
        robots=2,
        corridor=(1, 1),
        presence="as-coded",
        feedback="own",
        moves="as-coded",
        rewards=ALL,
        shaping=True,
        counterfactual="random",
    ),
    "learners": ExtendedTMaze(
        depth=1, robots=2, partner=None, corridor=(2, 4), rewards=ALL, shaping=True
    ),
    "large": ExtendedTMaze(depth=4, robots=8, objective="spread", partner=None, corridor=(1, 1)),
}


@functools.lru_cache
def episodes(env, lanes=6):
    """Random games in full: the state and the time step after reset and after each step."""

    def one(key):
        reset_key, action_key = jax.random.split(key)
        begun = env.reset(key=reset_key)
        actions = jax.random.uniform(action_key, (env.max_steps, env.robots, 1), minval=-1.0)
        # Many small teams should meet.
        actions = jnp.where(jax.random.bernoulli(reset_key), actions, actions[:, :1])

        def advance(loop, action):
            loop = env.step(loop[0], action, key=key)
            return loop, loop

        return begun, actions, jax.lax.scan(advance, begun, actions)[1]

    keys = jax.random.split(jax.random.key(3), lanes)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(keys))


def fixed(env, goals, **fields):
    """An episode with the reward at these endpoints."""
    state, first = env.reset(key=jax.random.key(0))
    fields = {name: jnp.int32(value) for name, value in fields.items()}
    return dataclasses.replace(state, goals=jnp.int32(goals), **fields), first


def play(env, state, plan):
    """Every robot goes to its planned endpoint of each trial: all time steps, trial by trial."""
    step = jax.jit(lambda state, action: env.step(state, action, key=jax.random.key(0)))
    trials = []
    for endpoints in plan:
        steps = []
        junction = 0
        for distance in [-1, *list(range(env.corridor[0]))[::-1] * env.depth]:
            turns = [(x >> (env.depth - 1 - junction)) & 1 for x in endpoints]
            wrong = distance != 0  # then the action must not count
            action = jnp.array([[1.0 if turn ^ wrong else -1.0] for turn in turns])
            junction += distance == 0
            state, now = step(state, action)
            steps.append(now)
        trials.append(steps)
    return state, trials


# Contract


@pytest.mark.parametrize("name", ["converge", "spread", "as coded"])
def test_the_contract(name):
    assert check_environment(TASKS[name]) == []


def test_sizes():
    env = ExtendedTMaze()
    assert env.sizes == (3, 1, 1)
    assert (env.trials, env.max_steps, env.signals, env.reported) == (12, 60, ("score",), "score")
    large = ExtendedTMaze(depth=5, robots=9, corridor=(1, 3), shaping=True)
    assert (large.sizes, large.trials, large.max_steps) == ((3, 1, 9), 96, 96 * 16)
    assert (large.signals, large.obs_range) == (("score", "shaped"), (0.0, 2.0))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"depth": 0}, "depth is 0: it must lie in [1, 24]"),
        ({"robots": 0}, "robots is 0: it must be at least 1"),
        ({"objective": "both"}, "objective is 'both': it must be one of converge, spread"),
        ({"partner": "none"}, "partner is 'none': it must be one of fsp, resp"),
        ({"corridor": (3, 2)}, "corridor is (3, 2): give (shortest, longest)"),
        ({"rewards": ("difference",)}, "rewards is ('difference',): it must be ('score',)"),
    ],
)
def test_what_cannot_be_is_refused(fields, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        ExtendedTMaze(**fields)


def test_pettingzoos_own_tests_find_nothing_wrong(capsys):
    pytest.importorskip("pettingzoo")
    from credo.environments.pettingzoo import to_pettingzoo

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its tests import old games of its own
        from pettingzoo.test import parallel_api_test, parallel_seed_test

    env = TASKS["as coded"]
    parallel_api_test(to_pettingzoo(env), num_cycles=14)
    parallel_seed_test(lambda: to_pettingzoo(env), num_cycles=14)
    assert "Passed Parallel API test" in capsys.readouterr().out


# By hand


def test_what_a_robot_sees_and_is_paid_beside_fsp():
    env = ExtendedTMaze(depth=1, objective="spread")  # 6 trials of 1 + 2 steps
    state, first = fixed(env, [1, 0, 1])
    # FSP: 0, 1 (reward), 1 (moved to 0), 0 (reward), 0 (moved to 1), 1 (reward).
    _, trials = play(env, state, [[0], [1], [0], [1], [1], [0]])
    np.testing.assert_array_equal(first.obs, [[0, 0, 0]])
    told = [[1, 0], [1, 1], [0, 1], [0, 0], [0, 1], [0, 0]]  # company, reward
    paid = [0, 1, 1, 1, 1, 1]
    for trial, told_now, pay in zip(trials, told, paid, strict=True):
        seen = [[1, 0, 0], [0, 0, 0], [0, *told_now]]
        np.testing.assert_array_equal([x.obs[0] for x in trial], seen)
        scores = [float(x.rewards["score"]) for x in trial]
        np.testing.assert_allclose(scores, [0, 0, pay / 6], rtol=1e-6)
    ends = [bool(x.terminated) for trial in trials for x in trial]
    assert ends == [False] * 17 + [True]
    assert not any(bool(x.truncated) for trial in trials for x in trial)


@pytest.mark.parametrize(("feedback", "stays"), [("own", True), ("objective", False)])
def test_in_converge_feedback_says_whether_fsp_stays_at_a_reward_alone(feedback, stays):
    env = ExtendedTMaze(depth=2, feedback=feedback)
    state, _ = fixed(env, [0, 1, 2])
    state, trials = play(env, state, [[3]])
    assert int(state.partner) == (0 if stays else 1)
    assert float(trials[0][-1].rewards["score"]) == 0.0
    state, _ = fixed(env, [3, 1, 2])
    _, trials = play(env, state, [[3]])
    np.testing.assert_array_equal(trials[0][-1].obs, [[0, 0, float(feedback == "own")]])


def test_together_at_the_reward_is_observed_by_either_rule():
    state, _ = fixed(ExtendedTMaze(), [0, 1, 2])
    state, trials = play(ExtendedTMaze(), state, [[0]])
    np.testing.assert_array_equal(trials[0][-1].obs, [[0, 1, 1]])
    np.testing.assert_allclose(trials[0][-1].rewards["score"], 1 / 12)
    assert int(state.partner) == 0


def test_company_of_some_is_company_of_all_only_as_coded():
    for presence, expected in (("others", [1, 1, 0]), ("as-coded", [0, 0, 0])):
        env = ExtendedTMaze(robots=3, partner=None, presence=presence)
        state, _ = fixed(env, [3, 0, 3])
        _, trials = play(env, state, [[1, 1, 2]])
        np.testing.assert_array_equal(trials[0][-1].obs[:, 1], expected)


def test_resp_counts_down_over_zero():
    env = ExtendedTMaze(depth=2, partner="resp", objective="spread")
    state, _ = fixed(env, [2, 0, 1], partner=1, direction=-1)
    places = [1]
    for _ in range(4):
        state, _ = play(env, state, [[0]])
        places.append(int(state.partner))
    assert places == [1, 0, 3, 2, 2]  # found at the fourth trial


@pytest.mark.parametrize(
    ("objective", "counterfactual", "plan", "expected"),
    [  # the reward is at 0, where FSP goes first
        ("spread", "absent", [0, 1], [0, 0]),
        ("converge", "absent", [0, 1], [0, -1]),
        ("converge", "absent", [0, 0], [0, 0]),
        ("converge", "random", [0, 0], [0.75, 0.75]),
        ("converge", "random", [0, 1], [0, -0.25]),
        ("converge", "random", [1, 1], [0, 0]),
    ],
)
def test_difference_reward(objective, counterfactual, plan, expected):
    env = ExtendedTMaze(
        robots=2, objective=objective, rewards=ALL, counterfactual=counterfactual, feedback="own"
    )
    state, _ = fixed(env, [0, 1, 2])
    _, trials = play(env, state, [plan])
    np.testing.assert_allclose(
        trials[0][-1].rewards["difference"], np.array(expected) / 12, rtol=1e-6
    )


def test_alone_at_the_reward_a_robot_makes_the_difference():
    env = ExtendedTMaze(robots=2, objective="spread", partner=None, rewards=ALL)
    state, _ = fixed(env, [2, 1, 2])
    _, trials = play(env, state, [[2, 1]])
    np.testing.assert_allclose(trials[0][-1].rewards["difference"], [1 / 12, 0], rtol=1e-6)


# Draws


@functools.lru_cache
def starts(env, lanes=8000):
    keys = jax.random.split(jax.random.key(1), lanes)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda key: env.reset(key=key)[0]))(keys))


@pytest.mark.parametrize("moves", ["uniform", "as-coded"])
def test_the_reward_moves_twice_to_another_endpoint(moves):
    goals = starts(ExtendedTMaze(partner="resp", corridor=(1, 3), moves=moves)).goals
    assert ((goals >= 0) & (goals < 4)).all()
    assert (goals[:, 0] != goals[:, 1]).all()
    assert (goals[:, 1] != goals[:, 2]).all()
    expected = {1: 1 / 3, 2: 1 / 3, 3: 1 / 3}  # by the turns that differ, as bits
    if moves == "as-coded":
        expected = {1: 1 / 4 + 1 / 8, 2: 1 / 4 + 1 / 8, 3: 1 / 4}
    for a, b in ((goals[:, 0], goals[:, 1]), (goals[:, 1], goals[:, 2])):
        for turns, share in expected.items():
            assert abs(np.mean((a ^ b) == turns) - share) < 0.02
    for block in range(3):
        np.testing.assert_allclose(np.bincount(goals[:, block]) / 8000, 0.25, atol=0.02)


def test_resp_and_corridors_are_drawn_per_episode():
    drawn = starts(ExtendedTMaze(partner="resp", corridor=(1, 3), moves="uniform"))
    np.testing.assert_allclose(np.bincount(drawn.partner) / 8000, 0.25, atol=0.02)
    assert set(drawn.direction) == {-1, 1}
    assert abs(drawn.direction.mean()) < 0.05
    assert drawn.lengths.shape == (8000, 2)
    for junction in range(2):
        share = np.bincount(drawn.lengths[:, junction])[1:] / 8000
        np.testing.assert_allclose(share, 1 / 3, atol=0.02)
    fsp = starts(ExtendedTMaze(corridor=(2, 2)), 16)
    assert (fsp.partner == 0).all()
    assert fsp.lengths is None


# Random episodes against NumPy


def replay(env, state, actions):
    """Observations and rewards of one episode, trial by trial, with lists and loops."""
    n, total, robots = 2**env.depth, 3 * 2**env.depth, env.robots
    lengths = [env.corridor[0]] * env.depth if state.lengths is None else list(state.lengths)
    static = None if state.partner is None else int(state.partner)
    way = 1 if state.direction is None else int(state.direction)
    actions, rows, feedback = iter(actions), [], np.zeros((robots, 2))
    paths, found = [[] for _ in range(robots)], [[] for _ in range(robots)]
    for trial in range(total):
        bits = ["" for _ in range(robots)]
        sights = [(0, feedback)]
        for length in lengths:
            sights += [(distance, np.zeros((robots, 2))) for distance in reversed(range(length))]
        for k, (distance, told) in enumerate(sights):
            rows.append((np.column_stack([np.full(robots, distance), told]), None))
            action = next(actions)
            if k > 0 and distance == 0:
                bits = [b + "01"[int(a[0] >= 0)] for b, a in zip(bits, action, strict=True)]
        ends = [int(b, 2) for b in bits] + ([] if static is None else [static])
        goal = int(state.goals[trial // n])
        won = (all if env.objective == "converge" else any)(end == goal for end in ends)
        own = [end == goal for end in ends]
        known = own if env.feedback == "own" else [x and won for x in own]
        same = len(set(ends)) == 1
        company = [
            same if env.presence == "as-coded" else ends.count(ends[i]) > 1 for i in range(robots)
        ]
        rewards = {"score": won / total, "difference": [], "shaped": []}
        for i in range(robots):
            others = ends[:i] + ends[i + 1 :]
            replaced = [None] if env.counterfactual == "absent" else range(n)
            without = []
            for x in replaced:
                rest = others if x is None else [*others, x]
                without.append(
                    (all if env.objective == "converge" else any)(e == goal for e in rest)
                )
            rewards["difference"].append((won - np.mean(without)) / total)
            new = trial > 0
            for back in range(1, n + 1):
                if trial - back < 0 or found[i][trial - back]:
                    break
                new = new and paths[i][trial - back] != ends[i]
            rewards["shaped"].append(won / total + 0.1 * same / total + 0.05 * new / (total - 1))
            paths[i].append(ends[i])
            found[i].append(own[i])
        rows[-1] = (rows[-1][0], rewards)
        feedback = np.column_stack([company, known[:robots]]).astype(float)
        if static is not None and not known[-1]:
            static = (static + way) % n
    return rows, feedback


@pytest.mark.parametrize("name", TASKS)
def test_random_episodes_are_those_of_the_text(name):
    env = TASKS[name]
    (states, first), actions, (_, played) = episodes(env)
    wins = 0
    for lane in range(6):
        start = jax.tree.map(lambda x, lane=lane: x[lane], states)
        rows, last = replay(env, start, actions[lane])
        steps = len(rows)
        obs = np.concatenate([first.obs[lane][None], played.obs[lane]])
        np.testing.assert_array_equal(obs[:steps], [row for row, _ in rows])
        np.testing.assert_array_equal(obs[steps][:, 1:], last)
        for signal in env.signals:
            got = played.rewards[signal][lane]
            zero = np.zeros(got.shape[1:])
            expected = np.array([zero if r is None else r[signal] for _, r in rows])
            np.testing.assert_allclose(got[:steps], expected, atol=1e-6)
        assert played.terminated[lane][:steps].tolist() == [False] * (steps - 1) + [True]
        assert not played.truncated[lane].any()
        assert played.active[lane].all()
        wins += np.sum(played.rewards["score"][lane][:steps] > 0)
    assert wins > 0


def test_a_lane_of_many_is_the_episode_alone():
    env = TASKS["spread"]
    (states, _), actions, (_, played) = episodes(env)
    state = jax.tree.map(lambda x: jnp.asarray(x[2]), states)
    step = jax.jit(lambda state, action: env.step(state, action, key=jax.random.key(0)))
    for t in range(40):
        state, now = step(state, actions[2, t])
        np.testing.assert_array_equal(now.obs, played.obs[2, t])
        np.testing.assert_allclose(now.rewards["shaped"], played.rewards["shaped"][2, t], rtol=1e-6)
