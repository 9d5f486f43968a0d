"""What critics say of the return, against plain NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.networks.mlp import Critic, ResidualCritic
from credo.networks.values import Histogram, Mean, Quantiles

N, CRITICS = 7, 2


@pytest.fixture(scope="module")
def rng():
    return np.random.default_rng(0)


def test_the_mean_is_the_square_and_the_least(rng):
    atoms, target = rng.normal(size=(1, N)), rng.normal(size=(1, N))
    both = rng.normal(size=(CRITICS, 1, N))
    values = Mean()
    np.testing.assert_array_equal(values.mean(jnp.asarray(atoms)), np.float32(atoms[0]))
    np.testing.assert_allclose(values.error(atoms, target), (atoms - target)[0] ** 2, rtol=1e-6)
    np.testing.assert_allclose(
        values.cautious(jnp.asarray(both))[0], both.min(axis=0)[0], rtol=1e-6
    )


def test_quantiles_are_those_of_the_equations(rng):
    """Kuznetsov et al. 2020, equations 9 to 12, quantile by quantile."""
    values = Quantiles(5, dropped=1)
    atoms, both = rng.normal(size=(5, N)), rng.normal(size=(CRITICS, 5, N))
    target = values.cautious(jnp.asarray(both))
    kept = np.sort(both.reshape(10, N), axis=0)[:8]
    np.testing.assert_allclose(target, kept, rtol=1e-6)
    expected = np.zeros(N)
    for i in range(N):
        for m in range(5):
            level = (2 * m + 1) / 10
            losses = []
            for y in kept[:, i]:
                u = y - atoms[m, i]
                huber = 0.5 * u * u if abs(u) <= 1 else abs(u) - 0.5
                losses.append(abs(level - (u < 0)) * huber)
            expected[i] += np.mean(losses)
    np.testing.assert_allclose(values.error(jnp.asarray(atoms), target), expected, rtol=1e-5)
    np.testing.assert_allclose(values.mean(jnp.asarray(atoms)), atoms.mean(axis=0), rtol=1e-5)


def test_a_histogram_that_minimises_its_error_has_the_mean_of_its_target():
    values = Histogram(51, limit=5.0)
    target = jnp.asarray([[-4.2, -0.03, 0.0, 1.234, 4.0, 7.0]])

    @jax.jit
    def slope(atoms):
        return jax.grad(lambda x: jnp.sum(values.error(x, target)))(atoms)

    atoms = jnp.zeros((51, 6))
    for _ in range(3000):
        atoms = atoms - 2.0 * slope(atoms)
    found = values.mean(atoms)
    # Beyond the bins the last one is meant, whose centre is half a bin inside.
    np.testing.assert_allclose(found[:5], target[0, :5], atol=0.03)
    assert 4.7 < found[5] < 5.0
    least = values.cautious(jnp.stack([atoms, jnp.zeros_like(atoms)]))
    np.testing.assert_allclose(least[0], jnp.minimum(found, 0.0), atol=1e-5)


@pytest.mark.parametrize("values", [Mean(), Quantiles(5), Histogram(11)])
@pytest.mark.parametrize("kind", [Critic(hidden=(8,)), ResidualCritic(8, 1)])
def test_a_critic_has_an_output_for_every_atom(values, kind, rng):
    critic = type(kind)(**{**vars(kind), "values": values}).init(3, 2, key=jax.random.key(0))
    obs, action = jnp.asarray(rng.normal(size=(3, N))), jnp.asarray(rng.normal(size=(2, N)))
    obs, action = obs.astype(jnp.float32), action.astype(jnp.float32)
    atoms = critic.atoms(obs, action)
    assert atoms.shape == (values.atoms, N)
    np.testing.assert_array_equal(critic(obs, action), values.mean(atoms))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Quantiles(0), "atoms is 0"),
        (lambda: Quantiles(5, dropped=5), "dropped is 5"),
        (lambda: Histogram(1), "atoms is 1"),
        (lambda: Histogram(limit=0.0), "limit is 0.0"),
        (lambda: Histogram(blur=-1.0), "blur is -1.0"),
    ],
)
def test_bad_values_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
