"""Info-max: its bits against counts, and that two phases follow each other."""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import rollout, tree
from credo.algorithms.infomax import InfoMax, entropy, features, information, stored
from credo.algorithms.neat import NEAT
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.curriculum import Curriculum
from credo.environments.probes import Copy
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_recall import SequenceRecall
from credo.networks.dnc import DNC
from credo.networks.graph import Graph
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent

TASK = SequenceClassification(depth=3, min_gap=0, max_gap=2)
QUICK = InfoMax(generations=2, episodes=32)
SIZES = {"population_size": 8, "episodes": 2, "test_episodes": 2}


def table(*columns):
    return jnp.asarray(np.array(columns, np.float32).T)


HALVES = [0, 1] * 8
QUARTERS = [0, 1, 2, 3] * 4
OTHERS = [0] * 8 + [1] * 8  # independent of both


def test_entropy_is_in_bits():
    assert float(entropy(jnp.array([0.5, 0.5, 0.0]))) == 1.0
    assert float(entropy(jnp.array([1.0, 0.0]))) == 0.0
    assert entropy(jnp.full((3, 4), 0.25)).tolist() == [2.0] * 3


@pytest.mark.parametrize(
    ("columns", "bits"),
    [
        ([[7.0] * 16], 0),  # a constant
        ([HALVES], 1),
        ([QUARTERS], 2),
        ([HALVES, OTHERS], 2),
        ([HALVES, HALVES], 1),  # a copy says nothing new
        ([HALVES, [-5 * x for x in HALVES]], 1),
        ([QUARTERS, HALVES], 2),  # which is its last bit
        ([HALVES, QUARTERS], 2),
        ([OTHERS, HALVES, QUARTERS], 3),
        ([[np.nan, *HALVES[1:]]], 0),
        ([[1.0 + 1e-7 * (x > 0) for x in HALVES]], 0),  # rounding says nothing
        ([[3e38 * x for x in np.sign(np.array(HALVES) - np.mean(HALVES))]], 1),
    ],
)
def test_what_is_stored_is_counted_once(columns, bits):
    assert float(stored(table(*columns), 4)) == pytest.approx(bits, abs=1e-5)


def test_a_cell_is_cut_between_its_lowest_and_its_highest_value():
    values = table([-3.0, -2.9, 0.0, 1.0])  # of two bins: two low, two high
    assert float(stored(values, 2)) == pytest.approx(1.0)
    low = table([0.0, 0.1, 0.2, 1.0])
    quarter = -0.25 * np.log2(0.25) - 0.75 * np.log2(0.75)
    assert float(stored(low, 2)) == pytest.approx(quarter, abs=1e-6)


@pytest.mark.parametrize(
    "network", [MMU(hidden=3), Recurrent(cell="lstm", hidden=3), Graph(hidden=3, cells="lstm")]
)
def test_memory_is_that_of_the_last_step(network):
    """Beside each policy on each sequence, step by step."""
    keys = jax.random.split(jax.random.key(0), 4)
    population = eqx.filter_vmap(lambda key: network.init(1, 1, key=key))(keys)
    if isinstance(network, Graph):  # connect the hidden units
        w = jax.random.normal(keys[0], population.W.shape)
        population = eqx.tree_at(lambda p: p.W, population, w)
    key = jax.random.key(1)
    carries, lengths = rollout.remembered(TASK, population, 5, key=key)
    sequences = [TASK.sample(key=k) for k in jax.random.split(key, 5)]
    assert len({int(s.length) for s in sequences}) > 1
    assert lengths.tolist() == [int(s.length) for s in sequences]
    for p, e in itertools.product(range(4), range(5)):
        policy = tree.take(population, p)
        carry = policy.start(key=key)
        for t in range(int(sequences[e].length)):
            _, carry = policy(sequences[e].inputs[t], carry)
        ours = features(population, carries)[:, e, p]
        np.testing.assert_allclose(ours, features(policy, carry), rtol=1e-5, atol=1e-6)


def counting(weight):
    """One LSTM cell that adds up what it hears: input to its block input alone."""
    network = Graph(hidden=1, cells="lstm")
    w = jnp.zeros((network.sockets(1), network.sources(1, 1))).at[1, 0].set(weight)
    return eqx.tree_at(lambda p: p.W, network.init(1, 1, key=jax.random.key(0)), w)


def test_a_counter_knows_the_sum_and_a_dead_cell_nothing():
    """Of three signals the sum is -3, -1, 1 or 3, with probabilities 1, 3, 3, 1 of 8."""
    population = jax.tree.map(lambda *x: jnp.stack(x), counting(0.1), counting(0.0))
    algorithm = InfoMax(episodes=2000)
    bits, frames = information(algorithm, TASK, population, key=jax.random.key(0))
    shares = np.array([1, 3, 3, 1]) / 8
    assert float(bits[0]) == pytest.approx(-(shares * np.log2(shares)).sum(), abs=0.03)
    assert float(bits[1]) == 0.0
    assert 2 * 2000 * 3 <= int(frames) <= 2 * 2000 * 7


@pytest.mark.parametrize(
    "algorithm",
    [
        NEAT(TASK, Graph(hidden=3, cells="lstm"), connections=9, infomax=QUICK, **SIZES),
        Neuroevolution(TASK, MMU(hidden=3), infomax=QUICK, **SIZES),
    ],
)
def test_bits_count_first_and_then_the_task(algorithm):
    plain = dataclasses.replace(algorithm, infomax=None)
    state = algorithm.init(key=jax.random.key(0))
    for g in range(4):
        key = jax.random.fold_in(jax.random.key(1), g)
        before, (state, metrics) = state, algorithm.generation(state, key=key)
        if isinstance(algorithm, NEAT):
            start = before
        else:
            start = dataclasses.replace(before, generation=None)
        _, task = plain.generation(start, key=key)
        same = float(task["fitness_max"]) == float(metrics["fitness_max"])
        assert same == (g >= 2)
        extra = int(metrics["frames"]) - int(task["frames"])
        assert (extra > 0) == (g < 2)
    phase = state.phase if isinstance(algorithm, NEAT) else state
    assert int(phase.generation) == 4


@pytest.mark.parametrize(("given", "ends"), [(3, 3), (3, 2), (3, 5)])
def test_what_was_reached_in_bits_is_forgotten_whenever_they_end(given, ends):
    """After 3 generations of bits; a resumed run may have been told another number."""
    longer = InfoMax(generations=given, episodes=32)
    algorithm = NEAT(TASK, Graph(hidden=3), connections=9, infomax=longer, **SIZES)
    state = algorithm.init(key=jax.random.key(0))
    for g in range(3):
        state, _ = algorithm.generation(state, key=jax.random.fold_in(jax.random.key(1), g))
    high = (jnp.float32(99.0), jnp.full_like(state.species.best, 99.0), jnp.int32(7))
    state = eqx.tree_at(lambda s: (s.best, s.species.best, s.waited), state, high)
    changed = dataclasses.replace(algorithm, infomax=dataclasses.replace(longer, generations=ends))
    for g in range(3, 7):
        state, _ = changed.generation(state, key=jax.random.fold_in(jax.random.key(1), g))
        rewards = g >= ends
        assert (float(state.best) < 99.0) == rewards
        assert (int(state.waited) < 7) == rewards
        assert bool((state.species.best[state.species.alive] < 99.0).all()) == rewards


def test_a_curriculum_waits_for_the_task_and_a_row_has_one_unit():
    """One that a network of any kind would pass."""
    easy = Curriculum(start=1, threshold=0.0)
    algorithm = Neuroevolution(TASK, MMU(hidden=3), infomax=QUICK, curriculum=easy, **SIZES)
    state, levels = algorithm.init(key=jax.random.key(0)), []
    for g in range(4):
        key = jax.random.fold_in(jax.random.key(1), g)
        state, metrics = algorithm.generation(state, key=key)
        levels.append(int(metrics["level"]))
        assert float(metrics["fitness_mean"]) <= float(metrics["fitness_max"])
        if g < 2:  # of three cells nobody knows nothing
            assert float(metrics["fitness_mean"]) > 0.5
    assert levels == [1, 1, 1, 2]


def test_without_info_max_there_is_no_phase():
    """So that runs of before have the state that they were saved with."""
    assert NEAT(TASK, Graph(hidden=3), **SIZES).init(key=jax.random.key(0)).phase is None


def test_evolution_for_bits_finds_them():
    """Twenty generations of LSTM cells, from none, know more than at first."""
    task = SequenceRecall(depth=2, min_corridor=1, max_corridor=2)
    infomax = InfoMax(generations=20, episodes=64)
    network = Graph(hidden=4, cells="lstm")
    algorithm = NEAT(task, network, 40, connections=30, infomax=infomax)
    algorithm = dataclasses.replace(algorithm, episodes=1, test_episodes=1)
    state, found = algorithm.init(key=jax.random.key(0)), []
    for g in range(20):
        key = jax.random.fold_in(jax.random.key(3), g)
        state, metrics = algorithm.generation(state, key=key)
        found.append(float(metrics["fitness_max"]))
    assert found[0] == 0.0  # no cells
    assert found[-1] > 1.0


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: Neuroevolution(Copy(), MMU(), infomax=QUICK), "Copy has none"),
        (lambda: Neuroevolution(TASK, MLP(), infomax=QUICK), "MLP has none that are"),
        (lambda: Neuroevolution(TASK, DNC(), infomax=QUICK), "DNC has none that are"),
        (
            lambda: Neuroevolution(TASK, MMU(), infomax=QUICK, elite_memory=3),
            "elite_memory is 3 beside infomax",
        ),
        (
            lambda: NEAT(TASK, Graph(), infomax=QUICK, normalize_observations=True),
            "normalize_observations is True",
        ),
        (lambda: InfoMax(generations=0), "generations is 0"),
        (lambda: InfoMax(episodes=1), "episodes is 1"),
        (lambda: InfoMax(bins=1), "bins is 1"),
    ],
)
def test_what_cannot_be_read_is_refused(make, told):
    with pytest.raises(ValueError, match=told):
        make()
