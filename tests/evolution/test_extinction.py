"""Extinction: how often, and how many."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.evolution.extinction import Extinction

POP, GENERATIONS = 20, 1000
OLD = {"w": jnp.zeros((POP, 2)), "b": jnp.zeros(POP)}
FRESH = {"w": jnp.ones((POP, 2)), "b": jnp.ones(POP)}


def died(extinction):
    """`[generations, pop]`: who was replaced."""
    keys = jax.random.split(jax.random.key(0), GENERATIONS)
    after = eqx.filter_jit(eqx.filter_vmap(lambda key: extinction(OLD, lambda: FRESH, key=key)))(
        keys
    )
    w, b = np.asarray(after["w"]), np.asarray(after["b"])
    np.testing.assert_array_equal(w, np.stack([b, b], axis=2))  # whole members
    return b == 1.0


def test_events_come_with_their_probability_and_take_their_share():
    dead = died(Extinction(probability=0.3, magnitude=0.6))
    events = dead.any(axis=1)
    assert events.mean() == pytest.approx(0.3, abs=4 * (0.21 / GENERATIONS) ** 0.5)
    assert dead[events].mean() == pytest.approx(0.6, abs=4 * (0.24 / 300 / POP) ** 0.5)
    # Members die independently: the spread of their number is binomial.
    assert dead[events].sum(axis=1).std() == pytest.approx((POP * 0.24) ** 0.5, rel=0.2)
    np.testing.assert_allclose(dead[events].mean(axis=0), 0.6, atol=0.12)


@pytest.mark.parametrize(
    ("probability", "magnitude", "share"),
    [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1, 1, 1.0)],
)
def test_the_bounds(probability, magnitude, share):
    assert died(Extinction(probability, magnitude)).mean() == share


def test_fresh_members_are_made_at_an_event_alone():
    made = []

    def fresh():
        jax.debug.callback(lambda: made.append(1))
        return FRESH

    key = jax.random.key(0)
    step = eqx.filter_jit(lambda chance: Extinction(chance)(OLD, fresh, key=key))
    jax.block_until_ready(step(jnp.float32(0.0)))
    jax.effects_barrier()
    assert made == []
    jax.block_until_ready(step(jnp.float32(1.0)))
    jax.effects_barrier()
    assert made == [1]
