"""The breeder: whom each member of the next population descends from."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import tree
from credo.evolution.breeder import Breeder, draw, evolving, overridden
from credo.evolution.crossover import MaskedCrossover, NoCrossover
from credo.evolution.extinction import Extinction
from credo.evolution.islands import Islands
from credo.evolution.mutation import GaussianMutation, MatrixMutation
from credo.evolution.selection import Uniform
from credo.networks.mlp import MLP

POP, E = 12, 3
FRESH = partial(draw, MLP(hidden=(3,)), (2, 1))
OLD = FRESH(POP, key=jax.random.key(0))
FITNESS = jnp.arange(float(POP))  # the last member is the best
STILL = Breeder(elite_fraction=0.25, mutation=MatrixMutation(probability=0.0))


@eqx.filter_jit
def bred(breeder, fitness, key):
    return breeder.next(None, OLD, fitness, FRESH, key=key)[:2]


def breed(breeder, seed=0, fitness=FITNESS):
    population, descent = bred(breeder, fitness, jax.random.key(seed))
    assert tree.size(population) == POP
    return weights(population), jax.tree.map(np.asarray, descent)


def weights(population):
    return np.asarray(jax.vmap(lambda one: tree.ravel(one)[0])(population))


BEFORE = weights(OLD)


@pytest.mark.parametrize("ordered", [False, True])
def test_everybody_is_a_copy_of_its_parent_when_nothing_changes(ordered):
    after, descent = breed(dataclasses.replace(STILL, ordered=ordered))
    np.testing.assert_array_equal(after, BEFORE[descent.parent])
    assert descent.parent[:E].tolist() == [11, 10, 9]
    assert descent.elite.tolist() == [True] * E + [False] * (POP - E)
    assert not descent.crossed.any()
    assert not descent.mutated.any()
    assert not descent.taken.any()
    fitness = descent.parent[E:].tolist()
    assert (fitness == sorted(fitness, reverse=True)) == ordered


def test_all_offspring_are_mutated_and_no_elite_is():
    after, descent = breed(dataclasses.replace(STILL, mutation=GaussianMutation()))
    assert descent.mutated.tolist() == [False] * E + [True] * (POP - E)
    assert (after != BEFORE[descent.parent]).all(axis=1).tolist() == descent.mutated.tolist()


def test_mates_are_elites_and_what_was_taken_is_measured():
    """A child has a weight of its mate or of its parent; which share is the mate's is counted."""
    crossing = MaskedCrossover(part="entry", probability=0.3)
    after, descent = breed(
        dataclasses.replace(STILL, crossover=crossing, crossover_probability=0.7)
    )
    mates, parents = BEFORE[descent.mate[:, 0]], BEFORE[descent.parent]
    assert set(descent.mate[E:, 0].tolist()) <= {11, 10, 9}
    assert 0 < descent.crossed.sum() < POP - E
    expected = ((after == mates) & (mates != parents)).sum(axis=1)
    expected = expected / np.maximum((mates != parents).sum(axis=1), 1)
    np.testing.assert_allclose(descent.taken[:, 0], expected, rtol=1e-6)
    assert not descent.taken[~descent.crossed].any()
    assert ((after == mates) | (after == parents)).all()


def test_repeated_parents_are_crossed_only_if_asked():
    repeat = dataclasses.replace(STILL, cross_repeated=True)
    _, descent = breed(repeat)
    parents = descent.parent[E:].tolist()
    assert descent.crossed[E:].tolist() == [p in parents[:i] for i, p in enumerate(parents)]
    assert not breed(dataclasses.replace(repeat, elite_fraction=0.0))[1].crossed.any()


def test_a_later_mate_is_another_offspring():
    mating = dataclasses.replace(STILL, mating=(MaskedCrossover(part="entry"),))
    after, descent = breed(mating)
    mate = descent.mate[E:, 1]
    assert (mate >= E).all()
    assert (mate != np.arange(E, POP)).all()
    parents, mates = BEFORE[descent.parent[E:]], BEFORE[descent.parent[mate]]
    assert ((after[E:] == parents) | (after[E:] == mates)).all()
    assert (descent.crossed[E:] == (descent.taken[E:, 1] > 0)).all()


def test_the_dead_have_no_parent():
    dying = dataclasses.replace(
        STILL, mutation=GaussianMutation(), extinction=Extinction(probability=1.0, magnitude=0.5)
    )
    after, descent = breed(dying)
    dead = descent.parent < 0
    assert 0 < dead[E:].sum() < POP - E
    assert not dead[:E].any()
    assert not (descent.mutated & dead).any()
    assert (descent.mutated | dead)[E:].all()
    np.testing.assert_array_equal(after[:E], BEFORE[[11, 10, 9]])


def test_islands_breed_apart_and_count_the_whole_population():
    islands = dataclasses.replace(STILL, islands=Islands(3, renewal=0.0))
    assert islands.elites(POP) == 3
    after, descent = breed(islands)
    np.testing.assert_array_equal(after, BEFORE[descent.parent])
    assert (descent.parent // 4 == np.arange(POP) // 4).all()
    assert descent.parent[descent.elite].tolist() == [3, 7, 11]
    renewed = dataclasses.replace(islands, islands=Islands(3, renewal=1.0))
    _, descent = breed(renewed)
    assert (descent.parent < 0).tolist() == [True] * 4 + [False] * 8


def test_without_a_look_at_fitness_elites_are_drawn_too():
    blind = dataclasses.replace(STILL, selection=Uniform())
    elites = {tuple(breed(blind, seed)[1].parent[:E].tolist()) for seed in range(6)}
    assert len(elites) > 3
    assert all(len(set(some)) == E for some in elites)


def test_settings_of_a_breeder_may_be_given_flat():
    mutation = GaussianMutation(0.5)
    flat = {"mutation": mutation, "episodes": 4}
    assert evolving(STILL, flat) == {
        "episodes": 4,
        "breeder": dataclasses.replace(STILL, mutation=mutation),
    }
    own = Breeder(crossover=NoCrossover())
    assert evolving(STILL, {"elite_fraction": 0.5}, {"breeder": own}) == {"breeder": own}
    assert overridden({"elite_fraction": 0.5, "workers": 2}, {"workers": 3}) == {
        "elite_fraction": 0.5,
        "workers": 3,
    }


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"elite_fraction": 1.5}, "elite_fraction is 1.5"),
        ({"crossover_probability": -0.1}, "crossover_probability is -0.1"),
        ({"crossover": NoCrossover(), "cross_repeated": True}, "nothing would be crossed"),
    ],
)
def test_impossible_settings_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        Breeder(**fields)
