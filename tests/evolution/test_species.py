"""Species of NEAT: membership, sharing and stagnation, worked by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import tree
from credo.algorithms.neat import NEAT, crossed
from credo.environments.probes import Remember
from credo.evolution.augment import Augmentation
from credo.evolution.genome import NONE, Compatibility, Form, Innovations, first
from credo.evolution.species import LEAST, Species, aged, seats, shared, sizes, speciate
from credo.networks.graph import Graph

FORM = Form(1, 1, Graph(hidden=1))
NEAR = Compatibility(weights=1.0)


def genomes(*weights):
    """One connection each, so that two are as far apart as their weights."""
    one = first(FORM, 2, key=jax.random.key(0))
    made = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(weights), *x.shape)), one)
    weight = made.weight.at[:, 0].set(jnp.asarray(weights, jnp.float32))
    return jax.tree.map(lambda x: weight if x is made.weight else x, made)


def species(room=3):
    return Species.none(jax.tree.map(lambda x: x[0], genomes(0.0)), room)


def test_a_genome_joins_the_first_species_that_is_near_enough():
    member, after = speciate(NEAR, 1.5, species(), genomes(0.0, 1.0, 2.0, 1.4, 9.0))
    assert member.tolist() == [0, 0, 1, 0, 2]
    assert after.alive.tolist() == [True] * 3
    assert sizes(after, member).tolist() == [3, 1, 1]
    assert after.representative.weight[:, 0].tolist() == [0.0, 2.0, 9.0]


def test_without_room_for_a_species_the_nearest_takes_its_founder():
    member, after = speciate(NEAR, 1.5, species(2), genomes(0.0, 5.0, 9.0, -3.0))
    assert member.tolist() == [0, 1, 1, 0]
    assert after.representative.weight[:, 0].tolist() == [0.0, 5.0]


def test_a_species_without_members_gives_its_place_to_the_next():
    _, before = speciate(NEAR, 1.5, species(), genomes(0.0, 5.0))
    member, after = speciate(NEAR, 1.5, aged(before, jnp.array([0, 1]), jnp.ones(2)), genomes(5.0))
    assert member.tolist() == [1]
    assert after.alive.tolist() == [False, True, False]
    member, later = speciate(NEAR, 1.5, after, genomes(9.0, 5.0))
    assert member.tolist() == [0, 1]
    assert later.best.tolist() == [LEAST, 1.0, LEAST]  # a new one has no past


def test_age_is_counted_from_the_last_better_fitness():
    member = jnp.asarray([0, 0, 1])
    _, now = speciate(NEAR, 1.5, species(), genomes(0.0, 0.0, 5.0))
    for fitness in ([1.0, 2.0, 3.0], [2.0, 0.0, 4.0], [1.0, 1.0, 4.0]):
        now = aged(now, member, jnp.asarray(fitness))
    assert now.best[:2].tolist() == [2.0, 4.0]
    assert now.waited[:2].tolist() == [2, 1]


def test_offspring_are_shared_by_mean_fitness():
    """Species of 3 and 1: the sums of adjusted fitness are 2 and 6."""
    member = jnp.asarray([0, 0, 0, 1])
    _, now = speciate(NEAR, 1.5, species(), genomes(0.0, 0.0, 0.0, 5.0))
    share = shared(now, member, jnp.asarray([1.0, 2.0, 3.0, 6.0]), now.alive)
    np.testing.assert_allclose(share, [0.25, 0.75, 0.0])
    only = shared(now, member, jnp.asarray([1.0, 2.0, 3.0, 6.0]), jnp.array([True, False, False]))
    np.testing.assert_allclose(only, [1.0, 0.0, 0.0])


def test_fitness_below_zero_is_raised_and_nan_is_the_lowest():
    member = jnp.asarray([0, 0, 1, 1])
    _, now = speciate(NEAR, 1.5, species(), genomes(0.0, 0.0, 5.0, 5.0))
    share = shared(now, member, jnp.asarray([-2.0, 0.0, 1.0, jnp.nan]), now.alive)
    np.testing.assert_allclose(share, [0.4, 0.6, 0.0])  # raised: 0, 2, 3, 0
    equal = shared(now, member, jnp.full(4, -7.0), now.alive)
    np.testing.assert_allclose(equal, [0.5, 0.5, 0.0])
    one = shared(now, member, jnp.asarray([0.0, 0.0, jnp.nan, jnp.nan]), now.alive)
    np.testing.assert_allclose(one, [1.0, 0.0, 0.0])
    nobody = shared(now, member, jnp.full(4, jnp.nan), now.alive)
    np.testing.assert_allclose(nobody, [0.5, 0.5, 0.0])


def test_seats_are_given_by_largest_remainder():
    assert seats(jnp.asarray([0.5, 0.26, 0.24, 0.0]), 10).tolist() == [5, 3, 2, 0]
    assert seats(jnp.asarray([0.47, 0.16, 0.158, 0.12, 0.061, 0.031]), 100).tolist() == [
        47,
        16,
        16,
        12,
        6,
        3,
    ]
    assert seats(jnp.full(3, 1 / 3), 10).tolist() == [4, 3, 3]


def grown(steps, key):
    """Forty genomes of very different lengths."""
    form = Form.of(Graph(hidden=30), 2, 1)
    population = jax.vmap(lambda k: first(form, 90, key=k))(jax.random.split(key, 40))
    innovations = Innovations(jnp.int32(3), jnp.int32(form.fixed))
    mutate = jax.jit(Augmentation(node=0.3, connection=0.6).__call__, static_argnums=0)
    for step in range(steps):
        # Only some go on, so that others stay short.
        longer, innovations = mutate(
            form, population, innovations, key=jax.random.fold_in(key, step)
        )
        goes_on = jnp.arange(40) % steps >= step
        population = jax.vmap(tree.where)(goes_on, longer, population)
    return form, population


def one_by_one(distance, threshold, species, population):
    """The members by the definition: genome after genome, a species after the other."""
    alive = list(np.asarray(species.alive))
    known = [tree.take(species.representative, i) for i in range(len(alive))]
    apart, member = jax.jit(distance.__call__), []
    for i in range(len(population.weight)):
        genome = tree.take(population, i)
        pairs = zip(known, alive, strict=True)
        away = np.array([apart(genome, x) if there else np.inf for x, there in pairs])
        if not (away < threshold).any() and not all(alive):
            at = alive.index(False)
            alive[at], known[at] = True, genome
            member.append(at)
        else:
            near = away < threshold
            member.append(int(np.argmax(near) if near.any() else np.argmin(away)))
    return member


@pytest.mark.parametrize(("room", "threshold"), [(3, 12.0), (12, 12.0), (30, 4.0), (60, 1.0)])
def test_genomes_of_any_length_find_their_species_as_if_one_came_after_the_other(room, threshold):
    _, population = grown(25, jax.random.key(0))
    used = np.asarray(population.used).sum(axis=1)
    assert used.min() < 10
    assert used.max() > 32
    distance = Compatibility(small=1000)
    before = Species.none(tree.take(population, 0), room)
    member, after = speciate(distance, threshold, before, population)
    assert member.tolist() == one_by_one(distance, threshold, before, population)
    assert len(set(member.tolist())) >= 3
    order = jax.random.permutation(jax.random.key(1), 40)
    mixed = tree.take(population, order)
    # Every second species has died, so that new ones have lower numbers than old ones.
    dead = after.alive & (jnp.arange(room) % 2 == 1)
    after = eqx.tree_at(lambda s: s.alive, after, dead)
    again, _ = speciate(distance, threshold, after, mixed)
    assert again.tolist() == one_by_one(distance, threshold, after, mixed)


def test_a_child_has_all_genes_of_the_fitter_parent_however_long():
    form, population = grown(25, jax.random.key(2))
    algorithm = NEAT(Remember(1), form.network)
    other = jax.tree.map(lambda x: x[::-1], population)
    keys = jax.random.split(jax.random.key(3), 40)
    for lead, fitter in ((1.0, population), (-1.0, other)):
        children = crossed(algorithm, population, other, jnp.full(40, lead), keys)
        assert children.innovation.tolist() == fitter.innovation.tolist()
        assert children.node.tolist() == fitter.node.tolist()
        assert children.source.tolist() == fitter.source.tolist()


def test_genes_far_behind_count():
    """Two genomes of forty genes that differ in the last twenty weights alone."""
    one = first(Form(20, 2, Graph(hidden=1)), 60, key=jax.random.key(0))
    other = eqx.tree_at(lambda g: g.weight, one, one.weight.at[20:40].add(8.0))
    both = jax.tree.map(lambda *xs: jnp.stack(xs), one, other)
    none = Species.none(one, 3)
    few = eqx.tree_at(lambda s: s.representative.innovation, none, jnp.full((3, 100), NONE))
    member, _ = speciate(Compatibility(weights=1.0), 3.0, few, both)
    assert member.tolist() == [0, 1]


def test_a_species_founded_later_is_not_joined_by_who_came_before():
    """Number 0 is free; the first genome joins number 1, the second founds number 0, which would be
    near enough to the first as well."""
    before = species(2)
    old = tree.put(before, 1, Species(tree.take(genomes(0.0), 0), jnp.bool_(True), LEAST, 0))
    member, _ = speciate(NEAR, 1.5, old, genomes(1.0, 2.0))
    assert member.tolist() == [1, 0]
