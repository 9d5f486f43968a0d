"""Populations as pytrees."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import tree
from credo.networks.mlp import MLP


class Genome(eqx.Module):
    w: jax.Array
    b: jax.Array
    name: str = "genome"
    missing: None = None


def population():
    return Genome(jnp.arange(6.0).reshape(3, 2), jnp.array([10, 20, 30]))


def test_size_counts_members():
    assert tree.size(population()) == 3


def test_take_orders_repeats_and_singles_out():
    taken = tree.take(population(), jnp.array([2, 0, 2]))
    assert taken.w.tolist() == [[4, 5], [0, 1], [4, 5]]
    assert taken.b.tolist() == [30, 10, 30]
    one = tree.take(population(), 1)
    assert one.w.tolist() == [2, 3]
    assert one.name == "genome"


def test_put_writes_one_slot_only():
    member = Genome(jnp.array([-1.0, -2.0]), jnp.array(-3))
    changed = tree.put(population(), 1, member)
    assert changed.w.tolist() == [[0, 1], [-1, -2], [4, 5]]
    assert changed.b.tolist() == [10, -3, 30]
    assert population().w.tolist() == [[0, 1], [2, 3], [4, 5]]


def test_concat_and_stack():
    joined = tree.concat(population(), tree.take(population(), jnp.array([0])))
    assert joined.b.tolist() == [10, 20, 30, 10]
    stacked = tree.stack(*(tree.take(population(), i) for i in (2, 1)))
    assert stacked.w.tolist() == [[4, 5], [2, 3]]


def test_stack_turns_floats_into_data_and_refuses_other_differences():
    assert tree.stack({"γ": 0.9}, {"γ": 0.99})["γ"].tolist() == pytest.approx([0.9, 0.99])
    with pytest.raises(ValueError, match="members that differ in"):
        tree.stack({"size": 3}, {"size": 4})
    with pytest.raises(ValueError, match="different structure"):
        tree.stack({"a": 1.0}, {"b": 1.0})
    nets = (MLP(hidden=(2,)), MLP(hidden=(3,)))
    with pytest.raises(ValueError, match="different structure"):
        tree.stack(*(net.init(1, 1, key=jax.random.key(0)) for net in nets))


def test_where_takes_all_leaves_from_one_side():
    a, b = tree.take(population(), 0), tree.take(population(), 1)
    assert tree.where(jnp.bool_(True), a, b).w.tolist() == [0, 1]
    assert tree.where(jnp.bool_(False), a, b).b.tolist() == 20


GENOME = {
    "a": jnp.arange(6.0).reshape(3, 2),
    "b": jnp.array([10.0, 20.0]),
    "n": jnp.arange(3),
    "none": None,
    "x": jnp.float32(7.0),
}


def test_ravel_knows_where_every_entry_is_from():
    vector, unravel, layout = tree.ravel(GENOME)
    assert vector.tolist() == [0, 1, 2, 3, 4, 5, 10, 20, 7]
    assert layout.leaf.tolist() == [0] * 6 + [1] * 2 + [2]
    assert layout.row.tolist() == [0, 0, 1, 1, 2, 2, 3, 4, 5]
    assert layout.place.tolist() == [0, 1, 2, 3, 4, 5, 0, 1, 0]
    assert layout.sizes.tolist() == [6, 2, 1]
    assert layout.rows == 6
    back = unravel(vector + 1.0)
    assert back["a"].tolist() == [[1, 2], [3, 4], [5, 6]]
    assert back["b"].tolist() == [11, 21]
    assert back["n"].tolist() == [0, 1, 2]
    assert back["none"] is None
    assert float(back["x"]) == 8.0


def test_ravel_acts_on_one_member_under_vmap():
    population = {"a": jnp.arange(12.0).reshape(2, 3, 2), "b": jnp.zeros((2, 2))}

    def scaled(genome):
        vector, unravel, layout = tree.ravel(genome)
        return unravel(vector * jnp.asarray(layout.row, jnp.float32))

    made = jax.vmap(scaled)(population)
    rows = np.array([[0.0], [1.0], [2.0]])
    np.testing.assert_array_equal(made["a"], np.arange(12.0).reshape(2, 3, 2) * rows)


def test_a_packed_member_is_few_arrays_and_comes_back():
    class Member(eqx.Module):
        w: jax.Array
        v: jax.Array
        count: jax.Array
        name: str = "member"

    members = Member(
        jnp.arange(12.0).reshape(2, 3, 2), jnp.arange(8.0).reshape(2, 4), jnp.array([[1], [2]])
    )
    rows, each, unpack = tree.packed(members)
    assert [x.shape for x in jax.tree.leaves(rows)] == [(2, 10), (2, 1)]
    swapped = tree.take(rows, jnp.array([1, 0]))
    assert eqx.tree_equal(unpack(swapped), tree.take(members, jnp.array([1, 0])))
    keys = []

    def plus(a, b, *, key):
        keys.append(key)
        return eqx.tree_at(lambda m: (m.w, m.v), a, (a.w + b.w, a.v + b.v))

    sums = unpack(each(plus, rows, swapped, key=jax.random.key(0)))
    np.testing.assert_array_equal(sums.v, np.stack([4.0 + 2.0 * np.arange(4)] * 2))
    np.testing.assert_array_equal(sums.count, members.count)
    assert len(keys) == 1  # one program for all members


def test_large_members_go_in_batches(monkeypatch):
    monkeypatch.setattr(tree, "CACHED", 25)
    members = {"w": jnp.arange(70.0).reshape(7, 10), "name": "x"}
    assert tree.batch(members) == 2  # 25 numbers hold two of ten
    assert tree.batch({"w": jnp.zeros((9, 5))}) == 5  # two batches, not one of 5 and one of 4 of 5
    assert tree.batch({"w": jnp.zeros((7, 30))}) == 1
    assert tree.batch({"n": jnp.zeros(4, int)}) == 4
    sizes = []

    def double(some):
        sizes.append(tree.size(some))
        return 2.0 * some["w"] + 1.0

    made = tree.in_batches(double, members)
    np.testing.assert_array_equal(made, 2.0 * np.arange(70.0).reshape(7, 10) + 1.0)
    assert set(sizes) == {2}
