"""Islands: which members breed with each other, and which island is re-initialised."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.evolution.islands import Islands

ISLANDS, SIZE = 3, 4
OLD = {"w": jnp.arange(24.0).reshape(12, 2), "b": jnp.arange(12.0), "name": "kept"}
FRESH = {"w": jnp.full((SIZE, 2), -1.0), "b": jnp.full(SIZE, -1.0), "name": "kept"}
FITNESS = jnp.array([5.0, 0, 0, 0, 2, 2, 2, 2, 3, 0, 0, 4])  # the mean of island 1 is the best
KEY = jax.random.key(0)


def best_alone(island, fitness, *, key):
    """A next generation: copies of the island's best."""
    best = jnp.argmax(fitness)
    copied = jax.tree.map(lambda x: jnp.stack([x[best]] * SIZE), eqx.filter(island, eqx.is_array))
    return eqx.combine(copied, island)


def test_members_of_an_island_breed_among_themselves():
    bred = Islands(ISLANDS, renewal=0.0)(best_alone, lambda: FRESH, OLD, FITNESS, key=KEY)
    np.testing.assert_array_equal(bred["b"], np.repeat([0, 4, 11], SIZE))
    np.testing.assert_array_equal(bred["w"], OLD["w"][np.repeat([0, 4, 11], SIZE)])
    assert bred["name"] == "kept"


def test_islands_have_keys_of_their_own():
    def noise(island, fitness, *, key):
        return {"b": jax.random.normal(key, (SIZE,))}

    islands = Islands(ISLANDS, renewal=0.0)
    bred = islands(noise, lambda: {"b": FRESH["b"]}, {"b": OLD["b"]}, FITNESS, key=KEY)
    assert np.unique(bred["b"]).size == ISLANDS * SIZE


@pytest.mark.parametrize(
    ("fitness", "weakest"),
    [
        (FITNESS, 1),
        (FITNESS.at[4:8].set(9.0), 2),
        (FITNESS.at[8].set(jnp.nan), 1),  # one NaN does not make an island weak
        (FITNESS.at[8:].set(jnp.nan), 2),
        (jnp.zeros(12), 1),  # of equals the first: the champion's island stays
    ],
)
def test_the_island_with_the_worst_best_is_reinitialised(fitness, weakest):
    bred = Islands(ISLANDS, renewal=1)(best_alone, lambda: FRESH, OLD, fitness, key=KEY)
    new = np.asarray(bred["b"]).reshape(ISLANDS, SIZE) == -1
    assert new.all(axis=1).tolist() == [i == weakest for i in range(ISLANDS)]
    assert new.sum() == SIZE
    np.testing.assert_array_equal(bred["w"][:, 0] == -1, new.reshape(-1))


def test_renewals_come_with_their_chance():
    islands = Islands(ISLANDS, renewal=0.3)
    after = eqx.filter_jit(
        eqx.filter_vmap(lambda key: islands(best_alone, lambda: FRESH, OLD, FITNESS, key=key)["b"])
    )(jax.random.split(KEY, 1000))
    events = (np.asarray(after) == -1).any(axis=1)
    assert events.mean() == pytest.approx(0.3, abs=4 * (0.21 / 1000) ** 0.5)


def test_a_population_that_cannot_be_divided_is_refused():
    assert Islands(4).size(100) == 25
    with pytest.raises(ValueError, match="3 islands for a population of 100"):
        Islands(3).size(100)
    with pytest.raises(ValueError, match=r"20 islands for a population of 20: .* two members"):
        Islands(20).size(20)
    with pytest.raises(TypeError, match=r"number is 2.5: give how many"):
        Islands(2.5)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="number is 1: it must be at least 2"):
        Islands(1)
    with pytest.raises(ValueError, match=r"renewal is 1.5: it must lie in \[0, 1\]"):
        Islands(renewal=1.5)
