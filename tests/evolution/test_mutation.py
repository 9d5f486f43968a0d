"""Mutation: what share of the weights moves, and by how much."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import compilation
from credo.evolution.mutation import GaussianMutation, MatrixMutation, Mutations

GENOMES = 300
# Two matrices of one shape, so that shared noise would show, a vector, and what is no weight.
GENOME = {
    "a": jnp.full((20, 10), 2.0),
    "b": jnp.full((20, 10), 2.0),
    "v": jnp.full((5,), 2.0),
    "count": jnp.arange(3),
    "name": "genome",
    "frozen": None,
}


@compilation.jit
def mutate_all(mutation, genome, keys):
    return eqx.filter_vmap(lambda key: mutation(genome, key=key))(keys)


def mutants(mutation, seed=0, genome=GENOME):
    """`GENOMES` mutants of one genome, on the host."""
    keys = jax.random.split(jax.random.key(seed), GENOMES)
    return {
        k: v if v is None else np.asarray(v) for k, v in mutate_all(mutation, genome, keys).items()
    }


def share(x):
    """Share of the weights that moved."""
    return (x != 2.0).mean()


def test_the_fraction_of_a_gated_matrix_is_hit():
    m = mutants(MatrixMutation(probability=1.0, fraction=0.1))
    for name in ("a", "b", "v"):
        n = m[name].size
        assert share(m[name]) == pytest.approx(0.1, abs=4 * (0.09 / n) ** 0.5)


def test_the_noise_is_relative_to_the_weight():
    m = mutants(MatrixMutation(probability=1.0, fraction=1.0, strength=0.1))
    noise = m["a"] - 2.0
    assert noise.std() == pytest.approx(0.1 * 2.0, rel=0.02)
    assert abs(noise.mean()) < 4 * 0.2 / noise.size**0.5
    zeros = mutants(
        MatrixMutation(probability=1.0, fraction=1.0), genome=GENOME | {"a": jnp.zeros((20, 10))}
    )
    assert not zeros["a"].any()  # a weight of 0 cannot move …
    floor = MatrixMutation(probability=1.0, fraction=1.0, floor=0.5)
    moved = mutants(floor, genome=GENOME | {"a": jnp.zeros((20, 10))})
    assert moved["a"].std() == pytest.approx(0.5, rel=0.02)  # … unless there is a floor


def test_leaves_members_and_entries_do_not_share_noise():
    m = mutants(MatrixMutation(probability=1.0, fraction=1.0))
    a, b = m["a"], m["b"]
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 4 / a.size**0.5
    start = a[:, 0, :5].ravel()
    assert abs(np.corrcoef(start, m["v"].ravel())[0, 1]) < 4 / start.size**0.5
    assert len(np.unique(a[0])) == a[0].size
    assert not (a[0] == a[1]).any()
    m = mutants(MatrixMutation(probability=1.0, fraction=0.3))
    both = ((m["a"] != 2.0) & (m["b"] != 2.0)).mean()
    assert both == pytest.approx(0.09, abs=0.01)  # hit independently too


def test_super_and_reset_share_the_hits():
    m = mutants(
        MatrixMutation(
            probability=1.0,
            fraction=1.0,
            strength=0.0,
            super_probability=0.2,
            super_strength=10.0,
            reset_probability=0.3,
            reset_std=0.001,
        )
    )["a"]
    unmoved, reset = m == 2.0, np.abs(m) < 0.006
    supers = m[~unmoved & ~reset] - 2.0
    assert unmoved.mean() == pytest.approx(0.5, abs=0.01)
    assert reset.mean() == pytest.approx(0.3, abs=0.01)
    assert supers.size / m.size == pytest.approx(0.2, abs=0.01)
    assert supers.std() == pytest.approx(20.0, rel=0.03)
    assert m[reset].std() == pytest.approx(0.001, rel=0.03)


def test_a_reset_of_std_0_erases():
    m = mutants(
        MatrixMutation(probability=1.0, fraction=0.25, reset_probability=1.0, reset_std=0.0)
    )["a"]
    assert (m == 0.0).mean() == pytest.approx(0.25, abs=0.01)
    assert set(np.unique(m)) == {0.0, 2.0}


def test_the_limit_clips():
    m = mutants(MatrixMutation(probability=1.0, fraction=1.0, strength=10.0, limit=3.0))["a"]
    assert np.abs(m).max() == 3.0
    assert 0.5 < (np.abs(m) == 3.0).mean() < 1.0


def test_a_gate_per_matrix_lets_matrices_through_alone():
    m = mutants(MatrixMutation(probability=0.5, fraction=1.0, gate="matrix"))
    through = {name: (m[name] != 2.0).any(axis=tuple(range(1, m[name].ndim))) for name in "abv"}
    for gates in through.values():
        assert gates.mean() == pytest.approx(0.5, abs=4 * 0.5 / GENOMES**0.5)
    assert (through["a"] & through["b"]).mean() == pytest.approx(0.25, abs=0.1)
    for name in "abv":  # a matrix that is let through is hit everywhere, here
        assert share(m[name][through[name]]) == 1.0


def test_a_gate_per_genome_lets_all_through_or_none():
    m = mutants(MatrixMutation(probability=0.5, fraction=1.0, gate="genome"))
    through = {name: (m[name] != 2.0).any(axis=tuple(range(1, m[name].ndim))) for name in "abv"}
    assert through["a"].mean() == pytest.approx(0.5, abs=4 * 0.5 / GENOMES**0.5)
    np.testing.assert_array_equal(through["a"], through["b"])
    np.testing.assert_array_equal(through["a"], through["v"])


def test_up_to_fraction_hits_at_least_one_and_up_to_the_share():
    m = mutants(MatrixMutation(probability=1.0, fraction=0.2, up_to_fraction=True))
    hits = (m["a"] != 2.0).sum(axis=(1, 2))
    assert hits.min() >= 1
    assert (hits <= 3).any()
    # The count is uniform over 1..40 of 200, and all entries but one are hit by chance.
    variance = (40**2 - 1) / 12 + 19.5 * (1 - 19.5 / 199)
    assert hits.mean() == pytest.approx(20.5, abs=4 * (variance / GENOMES) ** 0.5)
    assert hits.std() == pytest.approx(variance**0.5, rel=0.15)
    assert hits.max() <= 40 + 4 * (40 * 0.8) ** 0.5
    assert (m["v"] != 2.0).sum(axis=1).tolist() == [1] * GENOMES  # 20 % of five
    each = (m["v"] != 2.0).mean(axis=0)
    np.testing.assert_allclose(each, 0.2, atol=4 * (0.16 / GENOMES) ** 0.5)


def test_no_chance_means_no_change():
    for still in (MatrixMutation(probability=0.0), MatrixMutation(fraction=0.0)):
        m = mutants(still)
        assert share(m["a"]) == share(m["v"]) == 0.0


@pytest.mark.parametrize("mutation", [MatrixMutation(), GaussianMutation()])
def test_what_is_no_weight_is_left_alone(mutation):
    m = mutants(mutation)
    np.testing.assert_array_equal(m["count"], np.broadcast_to([0, 1, 2], (GENOMES, 3)))
    assert m["name"] == "genome"
    assert m["frozen"] is None
    assert share(m["a"]) > 0.05


@pytest.mark.parametrize("mutation", [MatrixMutation(probability=1.0), GaussianMutation()])
def test_a_key_is_a_mutation(mutation):
    once, again, other = (mutants(mutation, seed)["a"] for seed in (0, 0, 1))
    np.testing.assert_array_equal(once, again)
    assert not np.array_equal(once, other)


def test_gaussian_noise_has_its_std_everywhere():
    m = mutants(GaussianMutation(std=0.5))
    for name in "abv":
        assert share(m[name]) == 1.0
        assert (m[name] - 2.0).std() == pytest.approx(0.5, rel=0.05)
    assert abs(np.corrcoef(m["a"].ravel(), m["b"].ravel())[0, 1]) < 4 / m["a"].size ** 0.5


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"probability": 1.5}, "probability is 1.5"),
        ({"fraction": -0.1}, "fraction is -0.1"),
        ({"super_probability": 2.0}, "super_probability is 2.0"),
        ({"reset_probability": float("nan")}, "reset_probability is nan"),
        ({"gate": "row"}, "gate is 'row'.*genome, matrix"),
    ],
)
def test_impossible_mutations_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        MatrixMutation(**fields)


def test_one_entry_of_so_many_in_a_row_is_hit():
    m = mutants(MatrixMutation(probability=1.0, one_in=7, strength=0.5))
    moved = np.concatenate([m[name].reshape(GENOMES, -1) != 2.0 for name in "abv"], axis=1)
    whole = moved[:, : 405 // 7 * 7].reshape(GENOMES, -1, 7)
    assert (whole.sum(axis=2) == 1).all()
    np.testing.assert_allclose(moved.mean(axis=0), 1 / 7, atol=5 * (0.13 / GENOMES) ** 0.5)
    assert (m["a"] - 2.0)[m["a"] != 2.0].std() == pytest.approx(1.0, rel=0.05)


def test_and_only_where_the_gate_is_open():
    m = mutants(MatrixMutation(probability=0.5, one_in=2, vectors=False))
    opened = np.stack([(m[name] != 2.0).any(axis=(1, 2)) for name in "ab"])
    assert opened.mean() == pytest.approx(0.5, abs=0.1)
    assert (opened[0] != opened[1]).any()
    assert not (m["v"] != 2.0).any()
    with pytest.raises(ValueError, match="one_in is 3 and up_to_fraction is set"):
        MatrixMutation(one_in=3, up_to_fraction=True)
    with pytest.raises(ValueError, match=r"one_in is 3 and fraction is 0.2: .* give one of them"):
        MatrixMutation(one_in=3, fraction=0.2)


def test_several_mutations_follow_each_other():
    double = Mutations((GaussianMutation(3.0), GaussianMutation(4.0)))
    m = mutants(double)
    assert (m["a"] - 2.0).std() == pytest.approx(5.0, rel=0.03)
