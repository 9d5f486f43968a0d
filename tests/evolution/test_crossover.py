"""Crossover mixes parts of two parents and invents nothing."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.evolution.crossover import MaskedCrossover, OnePointCrossover

CHILDREN = 400
A = {"m": jnp.arange(12.0).reshape(4, 3), "v": jnp.arange(4.0), "n": jnp.arange(2), "none": None}
B = {"m": A["m"] + 100.0, "v": A["v"] + 100.0, "n": jnp.arange(2) + 7, "none": None}


def children(crossover):
    """Where each weight of many children is from `B`."""
    keys = jax.random.split(jax.random.key(0), CHILDREN)
    made = eqx.filter_jit(eqx.filter_vmap(lambda key: crossover(A, B, key=key)))(keys)
    for name in ("m", "v"):
        x, a = np.asarray(made[name]), np.asarray(A[name])
        assert ((x == a) | (x == a + 100.0)).all()
    np.testing.assert_array_equal(made["n"], np.broadcast_to(A["n"], (CHILDREN, 2)))
    assert made["none"] is None
    return np.asarray(made["m"]) >= 100.0, np.asarray(made["v"]) >= 100.0


def uniform_along(mask, axes):
    """Share of the parts along `axes` that come from one parent alone."""
    return (mask.all(axis=axes) | ~mask.any(axis=axes)).mean()


def test_matrices_go_whole():
    m, v = children(MaskedCrossover(part="matrix", probability=0.3))
    assert uniform_along(m, (1, 2)) == 1.0
    assert uniform_along(v, 1) == 1.0
    assert m.mean() == pytest.approx(0.3, abs=4 * (0.21 / CHILDREN) ** 0.5)
    assert (m[:, 0, 0] != v[:, 0]).any()  # matrices independently


def test_rows_go_whole():
    m, v = children(MaskedCrossover(part="row", probability=0.3))
    assert uniform_along(m, 2) == 1.0
    assert uniform_along(m, (1, 2)) < 0.5
    assert m.mean() == pytest.approx(0.3, abs=4 * (0.21 / CHILDREN / 4) ** 0.5)
    assert v.mean() == pytest.approx(0.3, abs=4 * (0.21 / CHILDREN / 4) ** 0.5)
    assert uniform_along(v, 1) < 0.5  # a vector is a matrix of one column: its rows are entries


def test_entries_go_alone():
    m, _ = children(MaskedCrossover(part="entry", probability=0.3))
    assert m.mean() == pytest.approx(0.3, abs=4 * (0.21 / CHILDREN / 12) ** 0.5)
    assert uniform_along(m, 2) == pytest.approx(0.3**3 + 0.7**3, abs=0.06)


def test_from_one_point_on_rows_are_the_other_parents():
    m, v = children(OnePointCrossover(probability=0.5))
    assert uniform_along(m, 2) == 1.0
    for mask in (m.all(axis=2), v):
        assert (np.diff(mask.astype(int), axis=1) >= 0).all()  # once begun, to the end
        counts = np.bincount(mask.sum(axis=1), minlength=5) / CHILDREN
        np.testing.assert_allclose(counts, [0.5, *[0.125] * 4], atol=0.1)
    assert (m.any(axis=(1, 2)) != v.any(axis=1)).any()  # matrices independently


def test_one_row_alone_is_taken():
    m, v = children(OnePointCrossover(probability=0.5, taken="row"))
    assert uniform_along(m, 2) == 1.0
    for mask in (m.all(axis=2), v):
        assert set(mask.sum(axis=1)) == {0, 1}
        assert mask.sum(axis=1).mean() == pytest.approx(0.5, abs=0.1)
        assert mask.any(axis=0).all()


@pytest.mark.parametrize("part", ["matrix", "row", "entry"])
@pytest.mark.parametrize(("probability", "share"), [(0.0, 0.0), (1.0, 1.0)])
def test_the_bounds_copy_one_parent(part, probability, share):
    m, v = children(MaskedCrossover(part=part, probability=probability))
    assert m.mean() == v.mean() == share


def test_a_key_is_a_child():
    cross = MaskedCrossover(part="entry")
    once, again, other = (cross(A, B, key=jax.random.key(k))["m"] for k in (0, 0, 1))
    np.testing.assert_array_equal(once, again)
    assert not np.array_equal(once, other)


def test_an_unknown_part_is_refused():
    with pytest.raises(ValueError, match=r"part is 'column'.*entry, matrix, row"):
        MaskedCrossover(part="column")
    with pytest.raises(ValueError, match=r"taken is 'rows'.*rest, row"):
        OnePointCrossover(taken="rows")
