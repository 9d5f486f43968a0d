"""Genomes of NEAT, against the examples of Stanley & Miikkulainen (2002) worked by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.evolution.augment import Augmentation, numbered
from credo.evolution.genome import (
    NONE,
    Compatibility,
    Form,
    Genome,
    Innovations,
    cross,
    express,
    first,
    loops,
)
from credo.networks.graph import Graph

# Figure 4: sensors 1 to 3 are nodes 0 to 2 here, the output 4 is node 3; 5 and 6 are hidden.
FORM = Form(3, 1, Graph(hidden=3))
ONE = {1: (1, 4), 2: (2, 4), 3: (3, 4), 4: (2, 5), 5: (5, 4), 8: (1, 5)}
TWO = {n: ONE[n] for n in range(1, 6)} | {6: (5, 6), 7: (6, 4), 9: (3, 5), 10: (1, 6)}
KEYS = jax.random.split(jax.random.key(0), 400)


def genome(genes, disabled=(), weight=1.0, room=12, nodes=3):
    def padded(values, empty, dtype):
        return jnp.asarray([*values, *[empty] * (room - len(genes))], dtype)

    hidden = sorted({end - 1 for pair in genes.values() for end in pair} - {0, 1, 2, 3})
    return Genome(
        node=jnp.asarray(hidden + [NONE] * (nodes - len(hidden)), jnp.int32),
        source=padded([a - 1 for a, _ in genes.values()], NONE, jnp.int32),
        target=padded([b - 1 for _, b in genes.values()], NONE, jnp.int32),
        port=jnp.zeros(room, jnp.int32),
        weight=padded([weight] * len(genes), 0.0, jnp.float32),
        enabled=padded([n not in disabled for n in genes], False, bool),
        innovation=padded(genes, NONE, jnp.int32),
    )


PARENTS = genome(ONE, disabled=(2,), weight=1.0), genome(TWO, disabled=(2, 5), weight=2.0)


def children(lead, stays=1.0, parents=PARENTS, form=FORM):
    made = jax.jit(jax.vmap(lambda key: cross(form, *parents, jnp.float32(lead), stays, key=key)))
    return jax.tree.map(np.asarray, made(KEYS))


def numbers(made):
    return [tuple(row[row != NONE].tolist()) for row in made.innovation]


@pytest.mark.parametrize(("lead", "genes", "nodes"), [(1.0, ONE, 1), (-1.0, TWO, 2)])
def test_disjoint_and_excess_genes_come_from_the_fitter(lead, genes, nodes):
    made = children(lead)
    assert set(numbers(made)) == {tuple(genes)}
    assert ((made.node != NONE).sum(axis=1) == nodes).all()
    assert set(made.weight[0].tolist()) <= {0.0, 1.0, 2.0}
    common = made.weight[:, :5]  # genes 1 to 5, from either parent
    assert np.abs((common == 2.0).mean(axis=0) - 0.5).max() < 0.1
    own = made.weight[:, 5 : len(genes)]
    assert (own == (1.0 if lead > 0 else 2.0)).all()


def test_equals_give_each_of_their_own_genes_by_chance_as_in_figure_4():
    made = children(0.0)
    found = numbers(made)
    assert all(set(range(1, 6)) <= set(n) <= set(range(1, 11)) for n in found)
    assert all(list(n) == sorted(n) for n in found)
    shares = [np.mean([i in n for n in found]) for i in range(6, 11)]
    assert np.abs(np.asarray(shares) - 0.5).max() < 0.1
    figure = found.index(tuple(range(1, 11)))  # the child that the figure shows
    ends = np.stack([made.source[figure], made.target[figure]], axis=1)[:10] + 1
    assert dict(zip(range(1, 11), map(tuple, ends.tolist()), strict=True)) == ONE | TWO
    assert made.enabled[figure].tolist() == [n not in (2, 5) for n in range(1, 11)] + [False] * 2
    assert made.node[figure].tolist() == [4, 5, NONE]


def test_a_gene_disabled_in_either_parent_stays_so_by_chance():
    enabled = children(-1.0, 0.75).enabled
    shares = enabled.mean(axis=0)
    assert (np.delete(shares[:9], [1, 4]) == 1.0).all()
    np.testing.assert_allclose(shares[[1, 4]], 0.25, atol=0.07)
    assert not enabled[:, 9:].any()


def test_equals_without_room_for_all_genes_give_those_of_one():
    parents = genome(ONE, room=9), genome(TWO, room=9)
    found = numbers(children(0.0, parents=parents))
    assert {len(n) for n in found} == set(range(5, 10))
    assert found.count(tuple(ONE)) > found.count(tuple(TWO))  # also where all ten were drawn


def test_equals_without_room_for_all_nodes_give_those_of_one():
    """Each has a hidden node of its own, and there is room for one."""
    chain = {1: (1, 4), 2: (1, 5), 3: (5, 4)}, {1: (1, 4), 4: (2, 6), 5: (6, 4)}
    made = children(
        0.0,
        parents=tuple(genome(genes, room=6, nodes=1) for genes in chain),
        form=Form(3, 1, Graph(hidden=1)),
    )
    lone = {n for n in numbers(made) if set(n) & {2, 3} and set(n) & {4, 5}}
    assert not lone
    assert {made.node[i, 0] for i, n in enumerate(numbers(made)) if len(n) > 1} == {4, 5}


def test_compatibility_by_hand():
    """Of figure 4: 9 and 10 are excess, 6, 7 and 8 disjoint; five weights differ by 1."""
    assert float(Compatibility()(*PARENTS)) == pytest.approx(2 + 3 + 0.4)
    assert float(Compatibility(excess=2.0, disjoint=0.5)(*PARENTS[::-1])) == pytest.approx(5.9)
    assert float(Compatibility(small=9)(*PARENTS)) == pytest.approx(5 / 9 + 0.4)
    assert float(Compatibility()(PARENTS[0], PARENTS[0])) == 0.0


def test_a_genome_is_expressed_as_the_network_it_describes():
    made = express(FORM, PARENTS[1])
    # Rows: output, hidden 5, 6, none. Columns: sensors 1 to 3, output, hidden 5, 6, none.
    expected = np.zeros((4, 7))
    expected[0, [0, 2, 5]] = 2.0  # 1, 3 and 6 to 4; 2 to 4 and 5 to 4 are disabled
    expected[1, [1, 2]] = 2.0  # 2 and 3 to 5
    expected[2, [0, 4]] = 2.0  # 1 and 5 to 6
    np.testing.assert_array_equal(made.W, expected)


def test_a_signal_takes_one_pass_for_each_unit():
    form = Form(2, 1, Graph(hidden=2, activation="tanh"))
    chain = {1: (1, 4), 2: (4, 3)}  # a sensor, a hidden unit, the output; node 1 is the bias
    policy = express(form, genome(chain, room=3, nodes=2))
    slow, carry = policy(jnp.ones(1), policy.start())
    assert slow == 0.0
    assert float(policy(jnp.zeros(1), carry)[0][0]) == pytest.approx(np.tanh(np.tanh(1.0)))
    twice = express(
        form._replace(network=Graph(2, activation="tanh", passes=2)), genome(chain, nodes=2)
    )
    assert float(twice(jnp.ones(1), twice.start())[0][0]) == pytest.approx(np.tanh(np.tanh(1.0)))


def test_a_cell_adds_up_and_gates_that_have_connections_close_it():
    """A sensor on the block input of a cell; then also on its input, forget or output gate."""
    form = Form(2, 1, Graph(1, "lstm"))
    chain = genome({1: (1, 4), 2: (4, 3), 3: (1, 4)}, room=3, nodes=1)
    σ, step = 1 / (1 + np.exp(-1.0)), np.tanh(1.0)

    def shown(port):
        """Contents and output of the cell after the sensor was 1 twice."""
        gene = (chain.enabled.at[2].set(port > 0), chain.port.at[2].set(port))
        policy = express(form, eqx.tree_at(lambda g: (g.enabled, g.port), chain, gene))
        carry = policy.start()
        for _ in range(2):
            _, carry = policy(jnp.ones(1), carry)
        return [float(carry[1][0]), float(carry[0][1])]

    assert shown(0) == pytest.approx([2 * step, np.tanh(2 * step)], rel=1e-5)
    assert shown(1) == pytest.approx([2 * σ * step, np.tanh(2 * σ * step)], rel=1e-5)
    assert shown(2) == pytest.approx([(σ + 1) * step, np.tanh((σ + 1) * step)], rel=1e-5)
    assert shown(3) == pytest.approx([2 * step, σ * np.tanh(2 * step)], rel=1e-5)


def population(*members):
    return jax.tree.map(lambda *xs: jnp.stack(xs), *members)


def test_the_same_change_gets_the_same_numbers():
    due = jnp.asarray([True, True, False, True, True])
    change = jnp.asarray([[4, 1], [2, 2], [4, 1], [4, 1], [2, 3]])
    rank, number = numbered(due, change)
    assert rank.tolist() == [0, 1, 0, 0, 2]
    assert int(number) == 3


def test_a_split_connection_is_disabled_and_replaced_by_two():
    """Figure 3, right: the new node gets weight 1 in, and the old weight out."""
    lone = genome({1: (1, 4)}, weight=0.5)
    members = population(lone, lone, genome({2: (2, 4)}, weight=0.7))
    always = Augmentation(node=1.0)
    next_ = Innovations(jnp.int32(11), jnp.int32(6))
    made, after = always.split(FORM, members, next_, key=jax.random.key(0))
    assert made.enabled[:, :4].tolist() == [[False, True, True, False]] * 3
    assert made.innovation[:, :3].tolist() == [[1, 11, 12], [1, 11, 12], [2, 13, 14]]
    assert made.node[:, 0].tolist() == [6, 6, 7]
    assert made.source[0, :3].tolist() == [0, 0, 6]
    assert made.target[0, :3].tolist() == [3, 6, 3]
    np.testing.assert_allclose(made.weight[:, :3], [[0.5, 1, 0.5]] * 2 + [[0.7, 1, 0.7]])
    assert (int(after.connection), int(after.node)) == (15, 8)


def test_a_connection_from_the_bias_is_not_split():
    members = population(genome({1: (3, 4)}))
    next_ = Innovations(jnp.int32(2), jnp.int32(4))
    made, after = Augmentation(node=1.0).split(FORM, members, next_, key=KEYS[0])
    assert made.innovation.tolist() == members.innovation.tolist()
    assert int(after.node) == 4


def test_weights_are_perturbed_or_replaced():
    members = population(*[genome(ONE, weight=10.0)] * 400)
    moved = Augmentation(strength=0.5).perturbed(members, key=jax.random.key(1)).weight[:, :6]
    moved = np.asarray(moved)
    hit = (moved != 10.0).any(axis=1)
    assert hit.mean() == pytest.approx(0.8, abs=0.06)
    assert (moved[hit] != 10.0).all()
    new = np.abs(moved) <= 4.0
    assert new[hit].mean() == pytest.approx(0.1, abs=0.03)
    assert np.abs(moved[~new] - 10.0).max() <= 0.5


@pytest.mark.parametrize(("recurrent", "cells"), [(True, "rnn"), (False, "rnn"), (True, "lstm")])
def test_growing_genomes_keep_their_order_and_fill_their_room(recurrent, cells):
    """Until nothing more fits in: all mutations and crossovers of equals, many times."""
    form, n = Form(2, 1, Graph(3, cells, recurrent=recurrent)), 40
    mutation = Augmentation(node=0.3, connection=0.5)

    @jax.jit
    def grown(members, numbers, key):
        cross_key, key = jax.random.split(key)
        others = jax.tree.map(lambda x: jnp.roll(x, 1, axis=0), members)
        keys = jax.random.split(cross_key, n)
        members = jax.vmap(lambda a, b, k: cross(form, a, b, jnp.float32(0.0), 0.75, key=k))(
            members, others, keys
        )
        return mutation(form, members, numbers, key=key)

    members = population(*(first(form, 10, key=k) for k in KEYS[:n]))
    numbers = Innovations(jnp.int32(2), jnp.int32(3))
    for key in KEYS[:30]:
        members, numbers = grown(members, numbers, key)
    there = members.innovation != NONE
    ascending = jnp.diff(members.innovation, axis=1)
    assert ((ascending > 0) | ~there[:, 1:]).all()
    assert (jnp.where(there, members.innovation, 0) < numbers.connection).all()
    assert not (members.enabled & ~there).any()
    assert int(there.sum(axis=1).max()) == 12
    assert (jnp.where(members.node != NONE, members.node, 0) < numbers.node).all()
    assert int((members.node != NONE).sum(axis=1).max()) == 3
    for ends in (members.source, members.target):
        hidden = there & (ends >= 3)
        assert (~hidden | (ends[:, :, None] == members.node[:, None]).any(axis=2)).all()
    assert bool(jax.vmap(lambda g: loops(form, g))(members).any()) == recurrent
    assert np.isfinite(members.weight).all()
    ports = np.asarray(jnp.where(there & (members.target >= 3), members.port, -1))
    assert set(ports.ravel().tolist()) == {-1, *range(form.network.ports)}
    assert (jnp.where(members.target < 3, members.port, 0) == 0).all()
