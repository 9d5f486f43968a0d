"""Baselines, scripts and bounds of the rover domain."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import rollout
from credo.analysis import bounds, planner
from credo.analysis.planner import (
    bound_from,
    greedy_team,
    play_team,
    scripted_team,
    straight_lines,
)
from credo.analysis.scripts import random_team, starts
from credo.environments.rover import Rover

SCARCE = Rover(coupling=2, max_steps=5)  # too short to get everywhere


def start(env, rovers, pois):
    heading = jnp.zeros(env.agents)
    return env.begin(jnp.asarray(rovers, jnp.float32), heading, jnp.asarray(pois, jnp.float32))


def bounds_of(env, states):
    worlds = states.step.shape[0]
    return np.array(
        [bound_from(env, jax.tree.map(lambda x, i=i: x[i], states)) for i in range(worlds)]
    )


@pytest.fixture(scope="module")
def scarce():
    begun = starts(SCARCE, 100, key=jax.random.key(0))
    return begun, bounds_of(SCARCE, begun[0]), scripted_team(SCARCE, begun)


@pytest.mark.parametrize("coupling", [1, 4, 7])
def test_with_full_knowledge_every_poi_is_observed(coupling):
    env = Rover(coupling=coupling)
    begun = starts(env, 40, key=jax.random.key(coupling))
    assert scripted_team(env, begun).mean() >= 0.99


def test_so_it_is_as_coded():
    env = Rover(coupling=3, motion="as-coded", start="as-coded")
    begun = starts(env, 40, key=jax.random.key(0))
    assert scripted_team(env, begun).mean() >= 0.99


def test_the_motivating_example_has_a_solution_that_greed_misses():
    env = Rover.motivating()
    begun = starts(env, 8, key=jax.random.key(0))
    assert (bounds_of(env, begun[0]) == 1.0).all()
    assert (scripted_team(env, begun) == 1.0).all()
    greedy = play_team(env, begun, greedy_team(env), key=jax.random.key(1))
    assert (np.asarray(greedy) == 0.5).all()  # both at POI 1
    # Rover 1 alone reaches POI 1 only.
    alone = start(Rover(rovers=1, pois=2, coupling=1, **MOTIVATING), [(14, 17)], POIS)[0]
    assert bound_from(Rover(rovers=1, pois=2, coupling=1, **MOTIVATING), alone) == 0.5
    # Rover 0 could reach either, but not both.
    alone = start(Rover(rovers=1, pois=2, coupling=1, **MOTIVATING), [(9, 10)], POIS)[0]
    assert bound_from(Rover(rovers=1, pois=2, coupling=1, **MOTIVATING), alone) == 0.5


MOTIVATING = {"activation_distance": 2.0, "max_steps": 30, "max_speed": 0.5}
POIS = [(1, 1), (1, 18)]


def test_more_than_four_pois_go_to_whoever_is_there_first():
    env = Rover(coupling=2, pois=9, max_steps=80)
    begun = starts(env, 20, key=jax.random.key(0))
    assert scripted_team(env, begun).mean() >= 0.95


def test_no_team_passes_the_bound(scarce):
    begun, bound, scripted = scarce
    assert (scripted <= bound + 1e-6).all()
    assert 0.2 < bound.mean() < 0.8
    assert np.mean(scripted > bound - 1e-6) > 0.2  # where they agree both are exact
    for team in (random_team, straight_lines, greedy_team):
        for seed in range(5):
            share = play_team(SCARCE, begun, team(SCARCE), key=jax.random.key(seed))
            assert (np.asarray(share) <= bound + 1e-6).all()


def test_the_bound_by_hand():
    env = Rover(rovers=2, pois=2, coupling=1, activation_distance=1.0, max_steps=8)
    # 9 - 1 = 8 m to either side: one each.
    pois = [(9, 0), (-9, 0)]
    assert bound_from(env, start(env, [(0, 0), (0, 0)], pois)[0]) == 1.0
    both = dataclasses.replace(env, coupling=2)  # the pair has to choose
    assert bound_from(both, start(both, [(0, 0), (0, 0)], pois)[0]) == 0.5
    worth = dataclasses.replace(both, poi_values=(1.0, 3.0))
    assert bound_from(worth, start(worth, [(0, 0), (0, 0)], pois)[0]) == 0.75
    assert bound_from(both, start(both, [(0, 0), (-0.1, 0)], pois)[0]) == 0.5
    assert bound_from(both, start(both, [(0.1, 0), (-0.1, 0)], pois)[0]) == 0.0
    # One after the other: 3 - 1 to the first and 8 - 2 to the next make 8.
    line = [(3, 0), (11, 0)]
    assert bound_from(both, start(both, [(0, 0), (0, 0)], line)[0]) == 1.0
    assert bound_from(both, start(both, [(-0.1, 0), (0, 0)], line)[0]) == 0.5


def brute_force(env, position, poi):
    """The same bound by trying every choice of one sequence of POIs per rover."""
    d_a, values, range_ = env.activation_distance, np.ones(env.pois) / env.pois, env.max_steps
    tours = []
    for rover in position:
        sets = set()
        for length in range(env.pois + 1):
            for order in itertools.permutations(range(env.pois), length):
                stops = [poi[p] for p in order]
                way = sum(
                    max(np.linalg.norm(b - a) - k * d_a, 0)
                    for a, b, k in zip([rover, *stops], stops, [1] + [2] * length, strict=False)
                )
                if way <= range_:
                    sets.add(frozenset(order))
        tours.append(sets)
    best = 0.0
    for choice in itertools.product(*tours):
        visits = np.array([sum(p in chosen for chosen in choice) for p in range(env.pois)])
        best = max(best, values @ (visits >= env.coupling))
    return best


def test_the_bound_agrees_with_brute_force():
    env = Rover(rovers=4, pois=3, coupling=2, max_steps=5)
    begun = starts(env, 30, key=jax.random.key(1))
    expected = [
        brute_force(env, np.float64(position), np.float64(poi))
        for position, poi in zip(begun[0].position, begun[0].poi, strict=True)
    ]
    np.testing.assert_allclose(bounds_of(env, begun[0]), expected, atol=1e-6)
    assert len(np.unique(np.round(expected, 3))) >= 3


def test_many_pois_have_the_bound_of_each_alone():
    env = Rover(rovers=4, pois=20, coupling=2, max_steps=6)
    begun = starts(env, 20, key=jax.random.key(0))
    bound = bounds_of(env, begun[0])
    way = np.linalg.norm(
        np.asarray(begun[0].position)[:, :, None] - np.asarray(begun[0].poi)[:, None], axis=-1
    )
    alone = np.mean(np.sum(way - 3.0 <= 6.0, axis=1) >= 2, axis=1)
    np.testing.assert_allclose(bound, alone, atol=1e-6)
    assert (scripted_team(env, begun) <= bound + 1e-6).all()
    assert 0.1 < bound.mean() < 0.95


def test_graded_bound():
    env = Rover(rovers=2, pois=1, coupling=2, graded=True, max_steps=4)
    begun = start(env, [(0, 0), (2, 0)], [(15, 0)])
    # At best 15 - 4 and 13 - 4 metres away.
    assert bound_from(env, begun[0]) == pytest.approx(3 / 10, rel=1e-4)
    one = jax.tree.map(lambda x: x[None], begun)
    assert scripted_team(env, one)[0] == pytest.approx(3 / 10, rel=1e-3)


def test_lines_are_straight_and_greed_reads_the_sensors():
    env = Rover(rovers=2, pois=1, coupling=2, max_steps=5)
    team = straight_lines(env)
    carry = team.start(key=jax.random.key(0))
    first, carry = team(jnp.zeros((2, 72)), carry)
    second, _ = team(jnp.zeros((2, 72)), carry)
    assert abs(float(first[0, 0] - first[1, 0])) > 1e-3
    assert first[:, 1].tolist() == second[:, 1].tolist() == [1.0, 1.0]
    assert second[:, 0].tolist() == [0.0, 0.0]
    obs = jnp.zeros((2, 72)).at[0, 36 + 9].set(1 / 5).at[0, 36 + 20].set(1 / 1.5)
    greedy, _ = greedy_team(env)(obs, None)
    np.testing.assert_allclose(greedy[0], [-155 / 180, 0.0], atol=1e-6)  # half a metre there
    np.testing.assert_allclose(greedy[1], [0.0, 1.0], atol=1e-6)
    with pytest.raises(ValueError, match="observation is 'as-coded'"):
        greedy_team(Rover(observation="as-coded"))


def test_baselines_are_policies_like_any_other():
    env = Rover(rovers=4, pois=2, coupling=2, max_steps=30, rewards=("local", "global"))
    teams = (random_team, straight_lines, greedy_team)
    shares = [rollout.score(env, team(env), 20, key=jax.random.key(0)) for team in teams]
    assert max(shares[:2]) < 0.5
    assert shares[2] > 0.8


def test_baselines_and_bound_are_means_over_the_same_worlds(scarce):
    mean = planner.baselines(SCARCE, 30, draws=2)
    bound, kind = planner.upper_bound(SCARCE, 30)
    assert list(mean) == ["random", "straight", "greedy", "scripted"]
    assert mean["random"] < mean["greedy"] <= bound
    assert mean["scripted"] <= bound
    assert bound == pytest.approx(scarce[1].mean(), abs=0.15)
    assert kind == "upper bound"
    assert not bounds.exact(SCARCE)


def test_the_bound_counts_what_each_poi_needs():
    """Two rovers at 0, 8 m of way: a decoy to the left and a POI for both to the right."""
    fields = {"activation_distance": 1.0, "max_steps": 8, "poi_values": (1.0, 4.0)}
    env = Rover(rovers=2, pois=2, coupling=2, decoys=1, **fields)
    there = start(env, [(0, 0), (0, 0)], [(-9, 0), (9, 0)])[0]
    assert bound_from(env, there) == pytest.approx(0.8)  # not 1: nobody is left for the decoy
    third = dataclasses.replace(env, rovers=3)
    assert bound_from(third, start(third, [(0, 0)] * 3, [(-9, 0), (9, 0)])[0]) == 1.0


def test_baselines_of_decoys():
    env = Rover.misleading(coupling=3)
    begun = starts(dataclasses.replace(env, rewards=("global",)), 20, key=jax.random.key(0))
    bound = bounds_of(env, begun[0])
    scripted = scripted_team(dataclasses.replace(env, rewards=("global",)), begun)
    assert (scripted <= bound + 1e-6).all()
    assert scripted.mean() > 0.95
    assert bound.mean() == 1.0
