"""CCEA: who is in which team, what each member is assigned, and that agents coevolve."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evolved import evolved

from credo import tree
from credo.algorithms.ccea import CCEA, assigned, breed
from credo.environments.extended_tmaze import ExtendedTMaze
from credo.environments.probes import Meet
from credo.evolution.extinction import Extinction
from credo.evolution.islands import Islands
from credo.evolution.mutation import MatrixMutation
from credo.networks.dmmu import DMMU
from credo.networks.mlp import MLP

SMALL = CCEA.ccea(
    Meet(), MLP(hidden=(4,)), population_size=6, elite_fraction=0.2, teams=3, episodes=2
)


def test_random_teams_are_k_phi_draws_from_each_population():
    many = CCEA.ccea(Meet(), population_size=20, elite_fraction=0.1, teams=50)
    members = np.asarray(many.drawn(key=jax.random.key(0)))
    assert members.shape == (2, 1000)
    counts = [np.bincount(row, minlength=20) for row in members]
    assert abs(np.mean(counts) - 50) < 1e-9
    assert 4 < np.std(counts) < 10  # binomial: 6.9
    assert (members[0] != members[1]).mean() > 0.9


def test_balanced_teams_have_everybody_equally_often():
    balanced = CCEA.ccea(Meet(), population_size=7, elite_fraction=0.2, teams=4, teaming="balanced")
    members = np.asarray(balanced.drawn(key=jax.random.key(0)))
    assert [np.bincount(row).tolist() for row in members] == [[4] * 7] * 2
    assert (members[0] != members[1]).any()


def test_without_partners_an_individual_plays_the_simulations_of_all_its_teams():
    alone = CCEA.ccea(ExtendedTMaze(depth=1), population_size=6, elite_fraction=0.2, teams=3)
    assert (alone.agents, alone.simulations) == (1, 3 * 7)
    np.testing.assert_array_equal(alone.drawn(key=jax.random.key(0)), [[0, 1, 2, 3, 4, 5]])
    assert SMALL.simulations == 2
    _, metrics = alone.generation(alone.init(key=jax.random.key(0)), key=jax.random.key(1))
    assert float(metrics["frames"]) == 6 * 21 * alone.env.max_steps
    assert float(metrics["fitness_nan"]) == 0


def test_fitness_is_the_mean_or_best_over_the_teams_of_a_member():
    members = jnp.array([[0, 0, 1, 1, 3], [2, 0, 2, 2, 2]])
    returns = jnp.array([[1.0, 3.0], [4.0, 4.0], [0.0, 0.0], [8.0, 6.0], [5.0, 5.0]])
    ccea = CCEA.ccea(Meet(), population_size=4, elite_fraction=0.25)
    none = -np.inf  # it ranks last
    np.testing.assert_allclose(
        assigned(ccea, members, returns),
        [[3.0, 3.5, none, 5.0], [4.0, none, (2 + 0 + 7 + 5) / 4, none]],
    )
    best = CCEA.ccea(Meet(), population_size=4, elite_fraction=0.25, assignment="best")
    np.testing.assert_allclose(
        assigned(best, members, returns), [[4.0, 7.0, none, 5.0], [4.0, none, 7.0, none]]
    )


def test_of_a_private_signal_each_member_is_assigned_its_own():
    members = jnp.array([[0, 1], [1, 1]])
    returns = jnp.array([[[1.0, 10.0]], [[2.0, 30.0]]])  # [teams, episodes, agents]
    ccea = CCEA.ccea(Meet(), population_size=2, elite_fraction=0.5)
    np.testing.assert_allclose(assigned(ccea, members, returns), [[1.0, 2.0], [-np.inf, 20.0]])


def test_a_generation_keeps_the_elite_of_each_population_and_joins_them():
    state = SMALL.init(key=jax.random.key(0))
    after, metrics = SMALL.generation(state, key=jax.random.key(1))
    assert float(metrics["frames"]) >= 6 * 3 * 2 * 4  # at least four steps an episode
    for i, head in enumerate(after.champion.heads):
        elite = tree.take(after.populations, (i, 0))
        for a, b in zip(jax.tree.leaves(head), jax.tree.leaves(elite), strict=True):
            np.testing.assert_array_equal(a, b)
    assert float(metrics["fitness_max"]) >= float(metrics["fitness_mean"])


@pytest.mark.parametrize("fitness", [None, "local"])
def test_two_populations_learn_to_meet(fitness):
    ccea = CCEA.ccea(
        Meet(), MLP(hidden=(4,)), population_size=16, elite_fraction=0.1, teams=2, fitness=fitness
    )
    state = ccea.init(key=jax.random.key(0))
    for g in range(8):
        state, metrics = ccea.generation(state, key=jax.random.key(g))
    assert float(metrics["champion_score"]) == 1.0


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"teaming": "fair"}, "teaming is 'fair': it must be one of balanced, random"),
        ({"assignment": "sum"}, "assignment is 'sum': it must be one of best, mean"),
        ({"teams": 0}, "teams is 0: it must be at least 1"),
        ({"fitness": "score"}, "no reward signal 'score': this task has global, local"),
        ({"elite_fraction": 0.001}, "elite_fraction is 0.001 of 100 members"),
        ({"network": DMMU()}, "DMMU acts for a team, and CCEA evolves a population for each agent"),
    ],
)
def test_bad_settings_say_what_is_allowed(fields, told):
    with pytest.raises(ValueError, match=told):
        CCEA.ccea(Meet(), **fields)


def test_islands_of_a_population_do_not_mix():
    still = MatrixMutation(probability=0.0)
    islands = Islands(2, renewal=0.0)
    apart = evolved(
        SMALL,
        population_size=8,
        elite_fraction=0.25,
        mutation=still,
        extinction=Extinction(probability=0.0),
        islands=islands,
    )
    assert apart.elites == 2
    state = apart.init(key=jax.random.key(0))
    after, _ = apart.generation(state, key=jax.random.key(1))
    for agent in range(apart.agents):
        first = np.asarray(jax.tree.leaves(state.populations)[0][agent]).reshape(8, -1)
        bred = np.asarray(jax.tree.leaves(after.populations)[0][agent]).reshape(8, -1)
        parents = [int(np.flatnonzero((first == x).all(axis=1))[0]) for x in bred]
        assert [parent // 4 for parent in parents] == [0] * 4 + [1] * 4


def test_the_weakest_island_of_each_population_is_settled_anew():
    renewed = evolved(
        SMALL,
        population_size=12,
        elite_fraction=0.25,
        mutation=MatrixMutation(probability=0.0),
        extinction=Extinction(probability=0.0),
        islands=Islands(3, renewal=1.0),
    )
    state = renewed.init(key=jax.random.key(0))
    first = np.asarray(jax.tree.leaves(state.populations)[0]).reshape(2, 12, -1)
    fitness = np.tile(np.arange(12.0), (2, 1))
    fitness[1] = fitness[1, ::-1]
    bred = jax.tree.leaves(breed(renewed, state.populations, fitness, key=jax.random.key(1)))[0]
    old = (np.asarray(bred).reshape(2, 12, 1, -1) == first[:, None]).all(axis=3).any(axis=2)
    assert old.reshape(2, 3, 4).all(axis=2).tolist() == [[False, True, True], [True, True, False]]
    assert old.sum() == 16  # no other member is new


def test_elites_are_counted_by_island():
    with pytest.raises(
        ValueError, match=r"elite_fraction is 0.04 of 14 members of an island.*give 0.072 or"
    ):
        CCEA.ccea(Meet(), population_size=70, islands=Islands(5))
    assert (
        CCEA.ccea(Meet(), population_size=70, elite_fraction=0.072, islands=Islands(5)).elites == 5
    )
    with pytest.raises(TypeError, match=r"islands is 4: give Islands\(number=4\)"):
        CCEA.ccea(Meet(), islands=4)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="4 islands for a population of 30"):
        CCEA.ccea(Meet(), population_size=30, islands=Islands(4))
