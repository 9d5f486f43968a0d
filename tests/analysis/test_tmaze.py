"""Baselines and upper bounds of the Extended T-Maze, against enumeration and the task itself."""

import dataclasses
import functools
import itertools
import re
from collections import defaultdict
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.analysis import tmaze
from credo.environments.extended_tmaze import ExtendedTMaze

RULES = [("converge", "objective"), ("converge", "own"), ("spread", "objective")]


def task(depth, objective="spread", feedback="objective", partner="fsp", **fields):
    return ExtendedTMaze(
        depth=depth, objective=objective, feedback=feedback, partner=partner, **fields
    )


def histories(env):
    """Every equally likely episode: the three places of the reward, and the static robot's draw."""
    n = env.endpoints
    goals = [g for g in itertools.product(range(n), repeat=3) if g[0] != g[1] != g[2]]
    draws = itertools.product(range(n), (1, -1)) if env.partner == "resp" else [(0, 1)]
    return list(itertools.product(goals, draws))


def enumerated(env):
    """The best share, by trying every endpoint after every sequence of observations."""
    n, drawn = env.endpoints, histories(env)
    hears_alone = env.objective == "spread" or env.feedback == "own"

    @functools.cache
    def best(trial, possible):  # possible: (which history, where the static robot goes)
        if trial == 3 * n:
            return 0
        values = []
        for at in range(n):
            told, won = defaultdict(list), 0
            for which, static in possible:
                goal, way = drawn[which][0][trial // n], drawn[which][1][1]
                pair = [at == goal, static == goal]
                observed = all(pair) if env.objective == "converge" else any(pair)
                mine, its = pair if hears_alone else (observed, observed)
                won += observed
                after = static if its else (static + way) % n
                told[mine, static == at].append((which, after))
            values.append(won + sum(best(trial + 1, tuple(rest)) for rest in told.values()))
        return max(values)

    start = tuple((which, draw[0]) for which, (_, draw) in enumerate(drawn))
    return Fraction(best(0, start), len(drawn) * 3 * n)


@functools.lru_cache
def in_the_task(env, script):
    """The share of a script over all episodes, played in the environment by turning left and right.

    `script(endpoint, seen, trial) -> endpoint`, called at feedback steps.
    """
    drawn = histories(env)
    state, first = env.reset(key=jax.random.key(0))

    def one(goals, start, way, at):
        begun = dataclasses.replace(state, goals=goals, partner=start)
        if env.partner == "resp":
            begun = dataclasses.replace(begun, direction=way)

        def advance(loop, _):
            state, obs, at, share = loop
            told = (state.junction < 0) & (state.trial > 0)
            at = jnp.where(told, script(at, obs[0, 2] > 0, state.trial - 1), at)
            bit = (at >> (env.depth - 1 - jnp.maximum(state.junction, 0))) & 1
            action = jnp.where(bit == 1, 0.0, -0.1).reshape(1, 1)
            state, now = env.step(state, action, key=jax.random.key(0))
            return (state, now.obs, at, share + now.rewards["score"]), None

        loop = (begun, first.obs, at, jnp.float32(0.0))
        return jax.lax.scan(advance, loop, length=env.max_steps)[0][3]

    goals = jnp.int32([g for g, _ in drawn])
    draws = jnp.int32([d for _, d in drawn])
    play = jax.jit(jax.vmap(one, in_axes=(0, 0, 0, None)))
    return lambda at: float(np.mean(play(goals, draws[:, 0], draws[:, 1], jnp.int32(at))))


@pytest.mark.parametrize("partner", ["fsp", "resp"])
@pytest.mark.parametrize("moves", ["uniform", "as-coded"])
def test_the_static_robot_alone(partner, moves):
    for depth in (1, 2, 3):
        n = 2**depth
        share = tmaze.static_alone(task(depth, "converge", "own", partner, moves=moves))
        assert share == Fraction(3 * n + 1, 6 * n)
    assert tmaze.static_alone(task(2)) == Fraction(13, 24)  # .542; as coded, .542 was measured


def test_a_robot_alone_that_counts_trials_beats_the_static_policy():
    for depth in (1, 2, 3):
        n, env = 2**depth, task(depth, partner=None)
        assert tmaze.searching(env) == Fraction(3 * n + 5, 6 * n)
        assert tmaze.shared_information(env) == Fraction(3 * n + 5, 6 * n)
        assert tmaze.imitating(env) == tmaze.static_alone(env) == Fraction(3 * n + 1, 6 * n)
        assert tmaze.upper_bound(env) == (float(Fraction(3 * n + 5, 6 * n)), "optimal")


@pytest.mark.parametrize("rules", RULES)
@pytest.mark.parametrize("partner", ["fsp", "resp"])
def test_the_optimum_is_that_of_trying_everything(rules, partner):
    env = task(1, *rules, partner)
    assert tmaze.optimal(env) == enumerated(env)
    assert tmaze.upper_bound(env) == (float(enumerated(env)), "optimal")


@pytest.mark.parametrize("rules", RULES)
def test_the_optimum_beside_fsp_at_depth_2(rules):
    env = task(2, *rules)
    best = tmaze.optimal(env)
    assert best == enumerated(env)
    # The arguments of `upper_bound` give the same for any depth.
    assert best == (Fraction(61, 72) if rules[0] == "spread" else Fraction(13, 24))
    assert best == (tmaze.searching(env) if rules[0] == "spread" else tmaze.imitating(env))
    assert tmaze.upper_bound(env) == (float(best), "optimal")


def test_the_optimum_beside_resp_at_depth_2():
    expected = [Fraction(361, 864), Fraction(63, 128), Fraction(1397, 1728)]
    for rules, best in zip(RULES, expected, strict=True):
        env = task(2, *rules, "resp")
        assert tmaze.optimal(env) == best
        assert best < tmaze.upper_bound(task(2, *rules)).value  # "provably lower" than beside FSP
        assert best > max(tmaze.searching(env), tmaze.imitating(env))


def test_deeper_beside_resp_knowing_the_draw_is_the_bound():
    env = task(3, "spread", partner="resp")
    assert tmaze.upper_bound(env) == (float(tmaze.searching(task(3))), "upper bound")
    assert tmaze.searching(env) < tmaze.searching(task(3)) < tmaze.shared_information(env)


def test_with_moves_as_coded_the_plan_is_used():
    env = task(2, "converge", moves="as-coded")
    assert tmaze.upper_bound(env) == (float(tmaze.optimal(env)), "optimal")
    assert tmaze.optimal(env) >= tmaze.imitating(env)


@pytest.mark.parametrize("rules", RULES)
@pytest.mark.parametrize("partner", ["fsp", "resp"])
def test_scripts_score_the_same_in_the_task(rules, partner):
    env = task(2, *rules, partner)
    n = env.endpoints

    def stick(at, seen, trial):
        return at

    def imitate(at, seen, trial):
        return jnp.where(seen, at, (at + 1) % n)

    def search(at, seen, trial):
        return jnp.where(seen & ((trial + 1) % n != 0), at, (at - 1) % n)

    stuck = in_the_task(env, stick)
    expected = {name: float(share) for name, share in tmaze.memoryless(env).items()}
    got = {"always left": stuck(0), "always right": stuck(n - 1)}
    assert got == pytest.approx(expected, abs=1e-6)
    assert in_the_task(env, imitate)(0) == pytest.approx(float(tmaze.imitating(env)), abs=1e-6)
    assert in_the_task(env, search)(n - 1) == pytest.approx(float(tmaze.searching(env)), abs=1e-6)


def test_baselines_by_hand_at_depth_1():
    # FSP goes 00 01 10 where the reward is at 0, then 1, then 0; and 01 10 01 at 1, 0, 1. So always
    # right misses the fifth trial or the third; always left the third, or the first and the fifth.
    known = tmaze.baselines(task(1))
    assert known["always right"] == pytest.approx(5 / 6)
    assert known["always left"] == pytest.approx(3 / 4)
    assert known["static robot alone"] == known["imitating FSP"] == pytest.approx(7 / 12)
    assert "static robot alone" not in tmaze.baselines(task(1, "converge"))


def test_feed_forward_networks_of_the_dissertation_reach_the_memoryless_baseline():
    for depth, published in ((2, 0.693), (3, 0.600)):
        assert max(tmaze.memoryless(task(depth)).values()) == pytest.approx(published, abs=0.007)


@pytest.mark.parametrize(
    ("robots", "objective", "feedback", "expected"),
    [  # four endpoints, uniform moves
        (2, "spread", "objective", ("optimal", ((0.5 + 3) + 2 * (2 / 3 + 3)) / 12)),
        (3, "spread", "objective", ("upper bound", ((0.75 + 3) + 2 * 4) / 12)),
        (4, "spread", "objective", ("optimal", 1.0)),
        (5, "spread", "objective", ("optimal", 1.0)),
        (3, "converge", "objective", ("optimal", 17 / 24)),
        # To look apart for one trial and meet: 3 of 4 trials, more than by walking together.
        (4, "converge", "own", ("upper bound", 0.75)),
    ],
)
def test_teams_without_a_static_robot(robots, objective, feedback, expected):
    env = task(2, objective, feedback, None, robots=robots)
    share, kind = tmaze.upper_bound(env)
    assert (kind, pytest.approx(share)) == expected


def test_a_team_beside_the_static_robot_has_a_bound():
    share, kind = tmaze.upper_bound(task(2, robots=2))
    assert (kind, share) == ("upper bound", pytest.approx((3.75 + 2 * 4) / 12))


def test_what_cannot_be_asked_is_refused():
    with pytest.raises(ValueError, match=re.escape("robots is 2: scripts and plans are for one")):
        tmaze.imitating(task(2, robots=2))
    with pytest.raises(ValueError, match="partner is None: give 'fsp' or 'resp'"):
        tmaze.optimal(task(2, partner=None))


def test_a_team_without_memory_has_two_endpoints_to_go_to():
    assert tmaze.baselines(task(2, partner=None, robots=3)) == {"one at each end": 0.5}
    assert tmaze.baselines(task(3, partner=None, robots=2)) == {"one at each end": 0.25}


@pytest.mark.parametrize("objective", ["converge", "spread"])
@pytest.mark.parametrize("depth", [1, 2, 3])
@pytest.mark.parametrize(("robots", "partner"), [(1, "fsp"), (1, "resp"), (2, None), (3, None)])
def test_no_baseline_is_above_the_bound(objective, depth, robots, partner):
    env = task(depth, objective, partner=partner, robots=robots)
    bound = tmaze.upper_bound(env).value
    for name, value in tmaze.baselines(env).items():
        assert 0.0 <= value <= bound + 1e-12, name


@pytest.mark.parametrize("objective", ["converge", "spread"])
def test_a_team_without_memory_has_its_baseline(objective):
    """Played: in Converge all go to one end, in Spread one to each."""
    env = task(2, objective, partner=None, robots=2)
    ((name, value),) = tmaze.baselines(env).items()
    ends = (0, 0) if objective == "converge" else (0, env.endpoints - 1)
    goals = [g for g, _ in histories(dataclasses.replace(env, partner="fsp", robots=1))]
    seen = [
        all(e == g for e in ends) if objective == "converge" else g in ends
        for x in goals
        for g in x
    ]
    assert value == pytest.approx(np.mean(seen)), name


def test_of_a_team_beside_a_static_robot_no_baseline_is_known():
    with pytest.raises(ValueError, match="2 robots beside 'fsp'"):
        tmaze.baselines(task(2, "converge", robots=2))
