"""CEM: a distribution over genomes in place of parents and offspring."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import tree
from credo.algorithms.erl import ERL
from credo.algorithms.lineage import SAMPLED, Lineage
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.probes import Copy
from credo.evolution.breeder import draw
from credo.evolution.cem import CEM, weights
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic

NETWORK = MLP((3,))
FRESH = partial(draw, NETWORK, (2, 1))
K = 6
LEARNER = TD3(critic=Critic(hidden=(4,)), batch_size=4)


def rows(population):
    return np.asarray(tree.packed(population)[0][0])


@pytest.fixture(scope="module")
def first():
    return CEM(start_variance=0.0).first(FRESH(K, key=jax.random.key(0)), key=jax.random.key(1))


def test_weights_are_those_of_cma():
    """log((1 + K) / i), and their sum is 1."""
    raw = np.log(4 / np.arange(1, 4))
    np.testing.assert_allclose(weights(3), raw / raw.sum(), rtol=1e-6)


def test_the_next_distribution_is_that_of_the_best_half(first):
    """By hand; with a sample of which every weight has one of two values, so that the mean is
    known, and without a draw where the variance is zero."""
    population, memory = first
    mean = rows(population)[0]
    np.testing.assert_array_equal(rows(population), np.tile(mean, (K, 1)))
    (old, rest), _, unpack = tree.packed(population)
    old = old + jnp.arange(K, dtype=jnp.float32)[:, None]  # the last three are the best
    fitness = jnp.asarray([jnp.nan, 0.0, 1.0, 2.0, 3.0, 4.0])
    given = (memory, unpack((old, rest)), fitness, FRESH)
    λ = np.asarray(weights(3))
    _, descent, after = CEM(start_variance=0.0).next(*given, key=jax.random.key(2))
    np.testing.assert_allclose(after.mean, mean + λ @ [5.0, 4.0, 3.0], rtol=1e-5)
    np.testing.assert_allclose(descent.parts, np.tile([0, 0, 0, λ[2], λ[1], λ[0]], (K, 1)))
    assert descent.parent.tolist() == [5] * K


def test_the_variance_is_taken_from_the_old_mean(first):
    """Three parents at 2 on one side of it: the deviations of a large sample are 2, and noise."""
    k = 4000
    memory = first[1]
    population = FRESH(k, key=jax.random.key(0))
    (old, rest), _, unpack = tree.packed(population)
    population = unpack((jnp.zeros_like(old) + memory.mean[None] + 2.0, rest))
    memory = type(memory)(memory.mean, jnp.float32(5.0))
    cem = CEM(decay=0.5, least_noise=1.0)
    drawn, _, after = cem.next(memory, population, jnp.zeros(k), FRESH, key=jax.random.key(3))
    away = rows(drawn) - np.asarray(after.mean)[None]
    assert np.square(away).mean() == pytest.approx(2.0**2 + 5.0, rel=0.03)
    assert after.noise == pytest.approx(3.0)


def test_lineage_mixes_what_the_parents_are():
    lineage = Lineage.first(K, 1).inject(K - 1, 0)
    population, memory = CEM().first(FRESH(K, key=jax.random.key(0)), key=jax.random.key(1))
    fitness = jnp.arange(float(K))
    _, descent, _ = CEM().next(memory, population, fitness, FRESH, key=jax.random.key(2))
    after = lineage.after(descent)
    assert after.maker.tolist() == [SAMPLED] * K
    np.testing.assert_allclose(after.share[:, 1], np.full(K, weights(3)[0]), rtol=1e-6)
    assert {name: int(n[0]) for name, n in lineage.fates(descent).items()} == {
        "elite": 0,
        "selected": 1,
        "discarded": 0,
    }


def test_it_evolves_alone():
    """The probe rewards an action that is the observation: no such policy is drawn by chance."""
    env = Copy()
    cem = Neuroevolution(env, MLP((4,)), 16, CEM(start_variance=0.1), episodes=2, test_episodes=2)
    state = cem.init(key=jax.random.key(0))
    step, scores = jax.jit(cem.generation), []
    for g in range(30):
        state, metrics = step(state, key=jax.random.key(g))
        scores.append(float(metrics["fitness_max"]))
    assert np.mean(scores[-3:]) > np.mean(scores[:3]) + 0.5 * abs(np.mean(scores[:3]))


def test_it_breeds_in_erl_and_goes_on_from_a_policy():
    erl = ERL.erl(
        Copy(), MLP((4,)), breeder=CEM(), learners=(LEARNER,), population_size=4, warmup_frames=0
    )
    state = erl.init(key=jax.random.key(0))
    policy = MLP((4,)).init(*erl.env.sizes, key=jax.random.key(7))
    warm = erl.warm(state, policy)
    mean = rows(tree.single(policy))[0]
    np.testing.assert_array_equal(warm.breeding.mean, mean)
    away = rows(warm.population) - mean[None]
    np.testing.assert_allclose(away, rows(state.population) - state.breeding.mean[None], atol=1e-6)
    after, metrics = jax.jit(erl.generation)(warm, key=jax.random.key(1))
    assert after.breeding.noise < state.breeding.noise
    assert metrics["updates"] > 0


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: CEM(parents=1.5), "parents is 1.5"),
        (lambda: CEM(decay=-0.1), "decay is -0.1"),
        (lambda: ERL.erl(Copy(), breeder=CEM(0.1)), "parents is 0.1 of 10 members"),
        (lambda: ERL.erl(Copy(), breeder=CEM(), elite_fraction=0.3), "CEM has no elite_fraction"),
    ],
)
def test_bad_settings_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
