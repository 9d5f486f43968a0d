"""NEAT: its bookkeeping, what it compiles, and that it finds the hidden units that a task needs."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations

from credo import rollout, tree
from credo.algorithms.neat import NEAT, apportioned, breed, parents
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Meet, Remember, Xor
from credo.evolution.augment import Augmentation
from credo.evolution.genome import express
from credo.evolution.species import Species
from credo.networks.graph import Graph
from credo.networks.mlp import MLP
from credo.networks.normalized import Normalized
from credo.runs.loop import resume, train

TASK = Remember(2)
ALGORITHM = NEAT(
    TASK, Graph(hidden=4), population_size=20, connections=10, episodes=4, test_episodes=8
)
STILL = Augmentation(weights=0.0, node=0.0, connection=0.0)
QUIET = {"progress": False, "tensorboard": False}


def same(a, b):
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in leaves)


@pytest.fixture(scope="module")
def start():
    return ALGORITHM.init(key=jax.random.key(0))


@pytest.fixture(scope="module")
def after(start):
    return ALGORITHM.generation(start, key=jax.random.key(1))


def test_all_begin_without_hidden_units_and_with_the_same_markings(start):
    population = start.population
    assert population.innovation[:, :2].tolist() == [[0, 1]] * 20
    assert not population.used[:, 2:].any()
    assert population.weight[:, :2].std() > 0.3
    assert (int(start.innovations.connection), int(start.innovations.node)) == (2, 3)


def test_the_champion_is_the_network_of_the_fittest_genome(start, after):
    state, metrics = after
    networks = jax.vmap(lambda g: express(ALGORITHM.form, g))(start.population)
    key = jax.random.split(jax.random.key(1), 4)[0]
    fitness = rollout.evaluate(TASK, networks, 4, key=key).returns["fitness"].mean(axis=1)
    assert same(state.champion, tree.take(networks, int(jnp.argmax(fitness))))
    assert float(metrics["fitness_max"]) == pytest.approx(float(fitness.max()))
    assert int(metrics["frames"]) == 20 * 4 * 3
    assert (float(metrics["hidden"]), float(metrics["genes"])) == (0.0, 2.0)
    assert all(jnp.shape(value) == () for value in metrics.values())


def bred(algorithm, state, fitness, member, offspring):
    given = (jnp.asarray(member), jnp.asarray(fitness), jnp.asarray(offspring, jnp.int32))
    made = breed(algorithm, state, *given, key=jax.random.key(2))[0]
    return np.asarray(made.weight)


def test_each_species_breeds_its_own_and_large_ones_keep_their_champion(start):
    """Without mutation and crossover every offspring is a parent again, one of the best fifth."""
    quiet = dataclasses.replace(ALGORITHM, mutation=STILL, crossover=0.0)
    member = [0] * 12 + [1] * 8
    offspring = [5, 15, *[0] * 28]
    made = bred(quiet, start, jnp.arange(20.0), member, offspring)
    weights = np.asarray(start.population.weight)
    parent = [int(np.argmax((weights == row).all(axis=1))) for row in made]
    assert parent[0] == 11
    assert parent[5] == 19
    assert set(parent[:5]) <= {9, 10, 11}  # 0.2 · 12, and one more
    assert set(parent[5:]) == {18, 19}
    moved = dataclasses.replace(ALGORITHM, mutation=Augmentation(weights=1.0))
    made = bred(moved, start, jnp.arange(20.0), member, offspring)
    unchanged = [bool((weights == row).all(axis=1).any()) for row in made]
    assert unchanged == [i in (0, 5) for i in range(20)]
    few = dataclasses.replace(moved, champions=8)
    made = bred(few, start, jnp.arange(20.0), member, offspring)
    unchanged = [bool((weights == row).all(axis=1).any()) for row in made]
    assert unchanged == [i == 0 for i in range(20)]


def test_mates_are_of_the_same_species_but_for_rare_ones():
    algorithm = dataclasses.replace(ALGORITHM, population_size=400, champions=400)
    member = jnp.repeat(jnp.arange(2), 200)
    offspring = jnp.zeros(30, jnp.int32).at[:2].set(200)
    given = (member, jnp.arange(400.0), offspring)
    mother, father, kept = parents(algorithm, *given, key=jax.random.key(0))
    assert not kept.any()
    assert (member[mother] == jnp.repeat(jnp.arange(2), 200)).all()
    assert float((mother == father).mean()) == pytest.approx(0.25 + 0.75 / 41, abs=0.06)
    away = dataclasses.replace(algorithm, elsewhere=1.0, crossover=1.0)
    _, father, _ = parents(away, *given, key=jax.random.key(0))
    assert set(np.asarray(father).tolist()) == {199, 399}  # the fittest of either


def stagnation(waited, best, of_all, patience=20):
    """Offspring of three species of equal fitness sums, after so long a wait."""
    algorithm = dataclasses.replace(ALGORITHM, population_size=21, species=3, patience=patience)
    none = Species.none(tree.take(algorithm.init(key=jax.random.key(0)).population, 0), 3)
    species = eqx.tree_at(
        lambda s: (s.alive, s.best, s.waited), none, (jnp.ones(3, bool), best, jnp.asarray(waited))
    )
    state = algorithm.init(key=jax.random.key(0))
    state = eqx.tree_at(lambda s: (s.best, s.waited), state, (jnp.float32(9.0), jnp.int32(of_all)))
    fitness = jnp.repeat(jnp.asarray([2.0, 2.5, 1.5]), 7)
    return apportioned(algorithm, state, species, jnp.repeat(jnp.arange(3), 7), fitness)


def test_a_stagnant_species_has_no_offspring_unless_it_is_the_best():
    best = jnp.full(3, 5.0)
    offspring, _, record, waited = stagnation([14, 15, 15], best, 3)
    assert offspring.tolist() == [9, 12, 0]  # 21 · 2 / 4.5 and 21 · 2.5 / 4.5
    assert (float(record), int(waited)) == (9.0, 4)


def test_a_stagnant_population_goes_on_with_its_best_two_species():
    offspring, species, _, waited = stagnation([99, 99, 0], jnp.full(3, 5.0), 20)
    assert offspring.tolist() == [9, 12, 0]
    assert species.waited.tolist() == [0, 0, 0]
    assert int(waited) == 0


def test_without_patience_no_species_but_stagnant_ones_end():
    offspring, _, _, waited = stagnation([3, 3, 0], jnp.full(3, 5.0), 20, patience=None)
    assert offspring.tolist() == [7, 9, 5]  # 21 · 2 / 6, 21 · 2.5 / 6 and 21 · 1.5 / 6
    assert int(waited) == 21


def test_a_genome_whose_fitness_is_nan_is_counted_and_never_wins(start):
    weight = start.population.weight.at[2, 0].set(jnp.nan)
    spoilt = eqx.tree_at(lambda s: s.population.weight, start, weight)
    state, metrics = ALGORITHM.generation(spoilt, key=jax.random.key(1))
    assert int(metrics["fitness_nan"]) == 1
    assert np.isfinite(state.population.weight).all()
    assert np.isfinite(state.champion.W).all()


def test_nothing_compiles_after_the_first_generation(start, after):
    state, _ = after
    with compilations() as events:
        for g in range(2, 5):
            state, _ = ALGORITHM.generation(state, key=jax.random.key(g))
        jax.block_until_ready(state)
    assert events == []
    again, _ = ALGORITHM.generation(start, key=jax.random.key(1))
    assert same(again, after[0])


def test_a_run_that_was_resumed_ends_in_the_same_bytes(tmp_path):
    straight = train(ALGORITHM, generations=6, path=tmp_path / "straight", seed=1, **QUIET)
    train(ALGORITHM, generations=3, path=tmp_path / "resumed", seed=1, **QUIET)
    again = resume(tmp_path / "resumed", generations=6, progress=False)
    for name in ("metrics.csv", "champion.safetensors"):
        assert (again.path / name).read_bytes() == (straight.path / name).read_bytes()
    last = [sorted((run.path / "checkpoints").iterdir())[-1] for run in (straight, again)]
    arrays = [sorted(p for p in folder.iterdir() if p.suffix == ".safetensors") for folder in last]
    assert [a.read_bytes() for a in arrays[0]] == [b.read_bytes() for b in arrays[1]]
    assert arrays[0]


def test_lstm_cells_evolve_with_connections_to_their_gates():
    mutation = Augmentation(node=0.5, connection=0.9)
    algorithm = dataclasses.replace(ALGORITHM, network=Graph(4, "lstm"), mutation=mutation)
    state = algorithm.init(key=jax.random.key(0))
    for g in range(6):
        state, metrics = algorithm.generation(state, key=jax.random.key(g))
    ports = np.asarray(jnp.where(state.population.enabled, state.population.port, 0))
    assert set(ports.ravel().tolist()) == {0, 1, 2, 3}
    assert state.champion.W.shape == (1 + 4 * 4, 2 + 1 + 4)
    assert float(metrics["hidden"]) > 0.0


def test_xor_is_solved_with_hidden_units():
    algorithm = NEAT(
        Xor(),
        Graph(hidden=10, recurrent=False, passes=6),
        connections=50,
        episodes=1,
        test_episodes=4,
    )
    state, root = algorithm.init(key=jax.random.key(100)), jax.random.key(100)
    for g in range(100):
        state, metrics = algorithm.generation(state, key=jax.random.fold_in(root, g))
        if metrics["champion_score"] == 1.0:
            break
    assert float(metrics["champion_score"]) == 1.0
    W = np.asarray(state.champion.W)
    assert (W[0, 4:] != 0).any()  # the output listens to a hidden unit


def test_a_task_of_gymnasium_is_played_and_observations_are_normalised():
    env = Gymnasium("CartPole-v1", in_process=True, max_episode_steps=10)
    algorithm = NEAT(
        env,
        Graph(hidden=2),
        population_size=4,
        episodes=1,
        test_episodes=1,
        normalize_observations=True,
    )
    state = algorithm.init(key=jax.random.key(0))
    state, metrics = algorithm.generation(state, key=jax.random.key(1))
    assert isinstance(state.champion, Normalized)
    assert int(state.moments.count) == int(metrics["frames"]) >= 20
    assert 5 <= float(metrics["champion_score"]) <= 10


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: NEAT(Meet()), "Meet has 2 agents and NEAT evolves networks of one"),
        (lambda: NEAT(TASK, MLP()), "topology of a Graph, and MLP has one of its own"),
        (lambda: NEAT(TASK, species=1), "species is 1: it must be at least 2"),
        (lambda: NEAT(TASK, survival=2.0), r"survival is 2.0: it must lie in \[0, 1\]"),
        (lambda: NEAT(TASK, fitness="speed"), "no reward signal 'speed'"),
        (lambda: Augmentation(node=-1.0), r"node is -1.0: it must lie in \[0, 1\]"),
        (lambda: Graph(passes=0), "passes is 0: it must be at least 1"),
    ],
)
def test_settings_that_cannot_be_are_refused(make, told):
    with pytest.raises(ValueError, match=told):
        make()


def test_a_fixed_graph_can_be_evolved_by_other_algorithms():
    algorithm = Neuroevolution(TASK, Graph(hidden=2), population_size=10, test_episodes=1)
    state, _ = algorithm.generation(algorithm.init(key=jax.random.key(0)), key=jax.random.key(1))
    assert np.isfinite(state.champion.W).all()
