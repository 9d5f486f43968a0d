"""Exploration: what noise adds, and that it starts anew with each episode."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reading import read

from credo.networks.base import AbstractPolicy
from credo.networks.exploration import Explorer, GaussianNoise, OrnsteinUhlenbeck
from credo.networks.mlp import MLP

STEPS, LANES = 400, 200


class Still(AbstractPolicy):
    """Always the same action."""

    action: jax.Array

    def start(self, *, key):
        return ()

    def __call__(self, obs, carry):
        return self.action, carry


@eqx.filter_jit
def play(noise, action, random):
    """Actions `[lanes, steps, act]` of independent episodes."""
    explorer = Explorer(Still(action), noise, random, action.shape[0])

    def episode(key):
        def body(carry, _):
            action, carry = explorer(jnp.zeros(1), carry)
            return carry, action

        return jax.lax.scan(body, explorer.start(key=key), length=STEPS)[1]

    return jax.vmap(episode)(jax.random.split(jax.random.key(0), LANES))


def actions(noise, at=(0.0, 0.0), *, random=False):
    return np.asarray(play(noise, jnp.asarray(at, jnp.float32), jnp.bool_(random)))


def correlation(a, b):
    return np.corrcoef(a.ravel(), b.ravel())[0, 1]


def test_gaussian_noise_is_independent_in_time_lanes_and_dimensions():
    drawn = actions(GaussianNoise(0.2), (0.1, -0.3))
    np.testing.assert_allclose(drawn.mean(axis=(0, 1)), [0.1, -0.3], atol=0.003)
    np.testing.assert_allclose(drawn.std(axis=(0, 1)), 0.2, rtol=0.02)
    noise = drawn - drawn.mean(axis=(0, 1))
    for a, b in (
        (noise[:, 1:], noise[:, :-1]),
        (noise[1:], noise[:-1]),
        (noise[..., 0], noise[..., 1]),
    ):
        assert abs(correlation(a, b)) < 0.02


def test_ornstein_uhlenbeck_noise_has_its_stationary_spread_and_memory():
    θ, σ = 0.15, 0.2
    drawn = actions(OrnsteinUhlenbeck(θ, σ, scale=0.3))
    late = drawn[:, 50:]
    # x' = (1 - θ) x + σ ε has the variance σ² / (1 - (1 - θ)²).
    assert late.std() == pytest.approx(0.3 * σ / np.sqrt(1 - (1 - θ) ** 2), rel=0.03)
    assert late.mean() == pytest.approx(0.0, abs=0.005)
    for lag in (1, 5):
        assert correlation(late[:, lag:], late[:, :-lag]) == pytest.approx((1 - θ) ** lag, abs=0.03)
    assert abs(correlation(late[..., 0], late[..., 1])) < 0.05


def test_ornstein_uhlenbeck_noise_starts_from_0():
    θ, σ = 0.5, 0.4
    drawn = actions(OrnsteinUhlenbeck(θ, σ, scale=0.3))
    for step in range(3):
        variance = σ**2 * sum((1 - θ) ** (2 * i) for i in range(step + 1))
        assert drawn[:, step].std() == pytest.approx(0.3 * np.sqrt(variance), rel=0.1)


def test_what_ornstein_uhlenbeck_adds_is_its_scaled_place():
    noise = OrnsteinUhlenbeck(theta=0.25, sigma=0.0, scale=0.5)
    added, place = noise(jnp.array([0.8, -0.4]), key=jax.random.key(0))
    np.testing.assert_allclose(place, [0.6, -0.3], rtol=1e-6)
    np.testing.assert_allclose(added, [0.3, -0.15], rtol=1e-6)


def test_actions_stay_in_range():
    drawn = actions(GaussianNoise(0.5), (0.9, -0.9))
    assert (np.abs(drawn) <= 1.0).all()
    assert np.mean(drawn[..., 0] == 1.0) == pytest.approx(0.42, abs=0.02)  # Φ(-0.2)
    np.testing.assert_array_equal(actions(GaussianNoise(0.0), (0.5, -1.0))[3, 7], [0.5, -1.0])


def test_random_actions_are_uniform_and_do_not_ask_the_policy():
    drawn = actions(GaussianNoise(0.1), (0.9, jnp.nan), random=True)
    assert drawn.mean() == pytest.approx(0.0, abs=0.01)
    assert drawn.var() == pytest.approx(1 / 3, rel=0.01)
    assert np.mean(np.abs(drawn) < 0.5) == pytest.approx(0.5, abs=0.01)
    assert abs(correlation(drawn[:, 1:], drawn[:, :-1])) < 0.02
    assert abs(correlation(drawn[..., 0], drawn[..., 1])) < 0.02


def test_the_policy_inside_keeps_its_carry():
    inner = MLP(hidden=(2,)).init(1, 1, key=jax.random.key(0))
    explorer = Explorer(inner, GaussianNoise(0.0), jnp.bool_(False), 1)
    inputs = jnp.array([[0.1], [0.5], [-0.9]])
    np.testing.assert_allclose(read(explorer, inputs)[0], read(inner, inputs)[0], atol=1e-6)


@pytest.mark.parametrize(
    ("build", "told"),
    [
        (lambda: GaussianNoise(-0.1), "std is -0.1"),
        (lambda: OrnsteinUhlenbeck(theta=1.5), r"theta is 1.5.*\[0, 1\]"),
        (lambda: OrnsteinUhlenbeck(sigma=-1.0), "sigma is -1"),
        (lambda: OrnsteinUhlenbeck(scale=-1.0), "scale is -1"),
    ],
)
def test_impossible_noise_is_refused(build, told):
    with pytest.raises(ValueError, match=told):
        build()
