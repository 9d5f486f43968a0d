"""What the networks share: initial weights, packing, gradients, and errors at construction."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reading import read

from credo import rollout, tree
from credo.networks.base import ACTIVATIONS, draw, matvec, to_action
from credo.networks.dnc import DNC
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.ntm import NTM
from credo.networks.recurrent import Recurrent

NETWORKS = {
    "mmu": MMU(hidden=3),
    "general mmu": MMU(hidden=3, memory=2, alpha=0.3, encoder="learned", decoder="learned"),
    "rnn": Recurrent(cell="rnn", hidden=3),
    "gru": Recurrent(cell="gru", hidden=3),
    "lstm": Recurrent(cell="lstm", hidden=3),
    "mlp": MLP(hidden=(3, 3)),
}
EVERY = NETWORKS | {
    "ntm": NTM("lstm", hidden=3, rows=4, width=2, initializer="fan_in"),
    "dnc": DNC(hidden=3, rows=4, width=2, read_heads=2, initializer="fan_in"),
}


def population_of(net, n, obs, act):
    keys = jax.random.split(jax.random.key(0), n)
    return eqx.filter_vmap(lambda key: net.init(obs, act, key=key))(keys)


@pytest.mark.parametrize("name", NETWORKS)
def test_packed_population_equals_one_by_one(name):
    pop, lanes, steps = 4, 3, 6
    population = population_of(NETWORKS[name], pop, 2, 2)
    inputs = jax.random.normal(jax.random.key(1), (steps, 2, lanes, pop))
    packed = rollout.pack(population)
    assert all(leaf.shape[-2:] == (1, pop) for leaf in jax.tree.leaves(packed))

    def spread(x):
        return jnp.broadcast_to(x, (x.shape[0], lanes, pop))

    def body(carry, x):
        action, carry = packed(x, carry)
        return carry, action

    start = jax.tree.map(spread, packed.start(key=None))
    together = jax.jit(lambda: jax.lax.scan(body, start, inputs)[1])()
    assert together.shape == (steps, 2, lanes, pop)
    for member in range(pop):
        for lane in range(lanes):
            alone, _ = read(tree.take(population, member), inputs[:, :, lane, member])
            np.testing.assert_allclose(together[:, :, lane, member], alone, atol=1e-5)


@pytest.mark.parametrize("name", EVERY)
def test_gradients_through_time_are_finite_and_reach_every_matrix(name):
    policy = EVERY[name].init(2, 1, key=jax.random.key(0))
    inputs = jax.random.normal(jax.random.key(1), (20, 2))
    loss = eqx.filter_jit(eqx.filter_grad(lambda p: jnp.sum(read(p, inputs)[0] ** 2)))
    for path, gradient in jax.tree.leaves_with_path(loss(policy)):
        assert np.isfinite(gradient).all(), jax.tree_util.keystr(path)
        assert np.abs(gradient).max() > 1e-7, jax.tree_util.keystr(path)


@pytest.mark.parametrize(
    ("initializer", "matrix_std", "vector_std"),
    [("normal", 1.0, 1.0), ("fan_in", 64**-0.5, 1.0), ("kaiming", (2 / 64) ** 0.5, 0.0)],
)
def test_initializers_have_the_stated_spread(initializer, matrix_std, vector_std):
    drawn = draw({"W": (100, 64), "b": (4000,)}, initializer, key=jax.random.key(0))
    assert np.std(drawn["W"]) == pytest.approx(matrix_std, rel=0.05)
    assert np.std(drawn["b"]) == pytest.approx(vector_std, rel=0.05)
    assert abs(np.mean(drawn["W"])) < 4 * matrix_std / 80


def test_initial_weights_differ_between_leaves_and_keys():
    net = MMU(hidden=3)
    a, b = (net.init(1, 1, key=jax.random.key(seed)) for seed in (0, 1))
    assert not np.allclose(a.N_i, a.N_r)
    assert not np.allclose(a.N_i, b.N_i)


def test_matvec_is_the_matrix_product_with_and_without_batch():
    w = np.arange(6.0, dtype=np.float32).reshape(2, 3)
    x = np.array([1.0, -1.0, 2.0], np.float32)
    assert matvec(jnp.array(w), jnp.array(x)).tolist() == [3.0, 9.0]
    batched = matvec(jnp.array(w)[:, :, None], jnp.array([x, 2 * x]).T)
    assert batched.tolist() == [[3.0, 6.0], [9.0, 18.0]]


def test_outputs_become_actions_between_minus_1_and_1():
    output = jnp.array([0.0, 0.5, 1.0])
    assert to_action(output, "sigmoid").tolist() == [-1.0, 0.0, 1.0]
    assert to_action(output, "tanh").tolist() == [0.0, 0.5, 1.0]
    assert ACTIVATIONS["relu"](jnp.array([-1.0, 2.0])).tolist() == [0.0, 2.0]


def test_configs_compare_by_value():
    assert MMU(hidden=3) == MMU(hidden=3)
    assert MMU(hidden=3) != MMU(hidden=4)


@pytest.mark.parametrize(
    ("build", "told"),
    [
        (lambda: MMU(hidden=5, memory=3), "hidden is 5 and memory is 3.*learned"),
        (lambda: MMU(hidden=5, memory=3, encoder="learned"), "hidden is 5 and memory is 3"),
        (lambda: MMU(hidden=5, memory=3, decoder="learned"), "hidden is 5 and memory is 3"),
        (lambda: MMU(alpha=1.01), r"alpha is 1.01.*\[0, 1\]"),
        (lambda: MMU(alpha=-0.1), "alpha is -0.1"),
        (lambda: MMU(alpha=float("nan")), "alpha is nan"),
        (lambda: MMU(hidden=0), "hidden is 0: it must be at least 1"),
        (lambda: MMU(encoder="none"), "encoder is 'none'.*identity, learned"),
        (lambda: MMU(decoder="none"), "decoder is 'none'"),
        (lambda: MMU(block_activation="swish"), "block_activation is 'swish'.*elu"),
        (lambda: MMU(encoder_activation="swish"), "encoder_activation is 'swish'"),
        (lambda: MMU(decoder_activation="swish"), "decoder_activation is 'swish'"),
        (lambda: MMU(output_activation="relu"), "output_activation is 'relu'.*sigmoid, tanh"),
        (lambda: MMU(start_memory="one"), "start_memory is 'one'.*learned, zero"),
        (lambda: MMU(initializer="uniform"), "initializer is 'uniform'.*kaiming"),
        (lambda: Recurrent(cell="ntm"), "cell is 'ntm'.*gru, lstm, rnn"),
        (lambda: Recurrent(hidden=0), "hidden is 0"),
        (lambda: Recurrent(output_activation="relu"), "output_activation is 'relu'"),
        (lambda: Recurrent(initializer="uniform"), "initializer is 'uniform'"),
        (lambda: MLP(hidden=(0,)), r"hidden\[0\] is 0"),
        (lambda: MLP(activation="swish"), "activation is 'swish'"),
        (lambda: MLP(output_activation="relu"), "output_activation is 'relu'"),
        (lambda: MLP(initializer="flat"), "initializer is 'flat'"),
    ],
)
def test_impossible_networks_are_refused_with_a_reason(build, told):
    with pytest.raises(ValueError, match=told):
        build()
