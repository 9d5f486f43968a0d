"""Every cell against a plain loop over numbers, written from the published equations."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reading import read

from credo.networks.mlp import MLP, MLPPolicy
from credo.networks.mmu import MMU, MMUPolicy
from credo.networks.recurrent import Recurrent, RecurrentPolicy

STEPS = 30
BY_HAND = {
    "sigmoid": lambda v: [1.0 / (1.0 + math.exp(-a)) for a in v],
    "tanh": lambda v: [math.tanh(a) for a in v],
    "identity": list,
    "relu": lambda v: [max(a, 0.0) for a in v],
    "elu": lambda v: [a if a > 0 else math.exp(a) - 1.0 for a in v],
}
sigmoid, tanh = BY_HAND["sigmoid"], BY_HAND["tanh"]


def times(matrix, vector):
    return [sum(w * v for w, v in zip(row, vector, strict=True)) for row in matrix]


def plus(*vectors):
    return [sum(terms) for terms in zip(*vectors, strict=True)]


def hadamard(a, b):
    return [p * q for p, q in zip(a, b, strict=True)]


def as_action(y, activation):
    return [2.0 * v - 1.0 for v in y] if activation == "sigmoid" else y


def weights_of(shapes, seed=0):
    """Weights large enough that every gate moves."""
    rng = np.random.default_rng(seed)
    return {name: 0.8 * rng.standard_normal(shape) for name, shape in shapes.items()}


def inputs_of(size, seed=1):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (STEPS, size))


def on_device(weights):
    return {name: jnp.asarray(w, jnp.float32) for name, w in weights.items()}


def mmu_shapes(x, y, h, m, encoder, decoder, start):
    shapes = {"Z_y": (y, h), "b_y": (y,), "K_p": (h, x), "N_p": (h, m), "b_p": (h,)}
    for gate, size in {"i": h, "r": h, "w": m}.items():
        shapes |= {f"K_{gate}": (size, x), f"R_{gate}": (size, y), f"N_{gate}": (size, m)}
        shapes |= {f"b_{gate}": (size,)}
    if decoder == "learned":
        shapes |= {"N_d": (h, m), "b_d": (h,)}
    if encoder == "learned":
        shapes |= {"Z_f": (m, h), "b_f": (m,)}
    if start == "learned":
        shapes |= {"m_0": (m,)}
    return shapes


def mmu_by_hand(net, w, inputs):
    """Equations 3.1-3.5; actions, memories and outputs of every step."""
    y = [0.0] * len(w["b_y"])
    m = list(w["m_0"]) if "m_0" in w else [0.0] * len(w["b_w"])

    def gate(g, x):
        return sigmoid(
            plus(times(w[f"K_{g}"], x), times(w[f"R_{g}"], y), times(w[f"N_{g}"], m), w[f"b_{g}"])
        )

    actions, memories = [], []
    for x in inputs:
        i, r, write = gate("i", x), gate("r", x), gate("w", x)
        p = BY_HAND[net.block_activation](plus(times(w["K_p"], x), times(w["N_p"], m), w["b_p"]))
        d = plus(times(w["N_d"], m), w["b_d"]) if "N_d" in w else m
        d = BY_HAND[net.decoder_activation](d)
        h = plus(hadamard(r, d), hadamard(p, i))
        f = plus(times(w["Z_f"], h), w["b_f"]) if "Z_f" in w else h
        f = BY_HAND[net.encoder_activation](f)
        m = [
            (1 - net.alpha) * (m_k + w_k * f_k) + net.alpha * (w_k * f_k + (1 - w_k) * m_k)
            for m_k, w_k, f_k in zip(m, write, f, strict=True)
        ]
        y = BY_HAND[net.output_activation](plus(times(w["Z_y"], h), w["b_y"]))
        actions.append(as_action(y, net.output_activation))
        memories.append(m)
    return np.array(actions), np.array(memories)


BOTH_LEARNED = {"encoder": "learned", "decoder": "learned"}
MMUS = {
    "chapter 3": (MMU(hidden=3), 1, 1),
    "alpha 0.3, two in, two out": (MMU(hidden=3, alpha=0.3), 2, 2),
    "alpha 1": (MMU(hidden=3, alpha=1.0), 1, 1),
    "learned encoder": (MMU(hidden=3, encoder="learned"), 1, 1),
    "learned decoder": (MMU(hidden=3, decoder="learned", decoder_activation="tanh"), 1, 1),
    "memory below hidden": (MMU(hidden=4, memory=2, **BOTH_LEARNED), 3, 2),
    "memory above hidden": (MMU(hidden=2, memory=5, alpha=0.3, **BOTH_LEARNED), 2, 1),
    "tanh block and output": (
        MMU(hidden=3, block_activation="tanh", output_activation="tanh"),
        1,
        2,
    ),
    "relu and elu": (
        MMU(hidden=3, alpha=1.0, block_activation="relu", encoder_activation="elu"),
        2,
        1,
    ),
    "plain encoder": (MMU(hidden=3, alpha=1.0, encoder_activation="identity"), 1, 1),
    "memory starts at zero": (MMU(hidden=3, start_memory="zero"), 1, 1),
}


@pytest.mark.parametrize("name", MMUS)
def test_mmu_follows_the_equations(name):
    net, x, y = MMUS[name]
    shapes = mmu_shapes(
        x, y, net.hidden, net.memory or net.hidden, net.encoder, net.decoder, net.start_memory
    )
    w, inputs = weights_of(shapes), inputs_of(x)
    actions, (outputs, memories) = read(
        MMUPolicy(config=net, **on_device(w)), jnp.asarray(inputs, jnp.float32)
    )
    expected, expected_memories = mmu_by_hand(net, w, inputs)
    assert np.ptp(expected) > 0.05  # the case says something
    np.testing.assert_allclose(actions, expected, atol=2e-5)
    np.testing.assert_allclose(memories, expected_memories, rtol=2e-5, atol=2e-5)
    raw = (expected + 1.0) / 2.0 if net.output_activation == "sigmoid" else expected
    np.testing.assert_allclose(outputs, raw, atol=2e-5)  # fed back as it is, not as the action


def test_an_mmu_may_start_open_to_its_inputs():
    drawn, opened = (
        MMU(6, start_weights=start).init(3, 2, key=jax.random.key(0)) for start in ("drawn", "open")
    )
    scale = {"K": 3.7, "R": 0.4, "N": 0.16, "N_p": 0.6, "b_p": 2.5}
    raised = {"b_i": 2.7, "b_r": -2.3, "b_w": 1.2}
    for path, leaf in jax.tree.leaves_with_path(opened):
        name = path[0].name
        times = scale.get(name, scale.get(name[0], 1.0))
        expected = times * getattr(drawn, name) + raised.get(name, 0.0)
        np.testing.assert_allclose(leaf, expected, rtol=1e-6, err_msg=name)


def test_a_latched_mmu_keeps_its_memory_until_an_input_opens_the_gate():
    """A sign is written by about half of the cells; then nothing moves in 10,000 steps of zeros."""
    network = MMU(32, start_weights="latched", initializer="fan_in", output_activation="tanh")
    policy = network.init(2, 2, key=jax.random.key(0))
    carry = policy.start(key=jax.random.key(0))
    _, written = policy(jnp.array([1.0, 0.0]), carry)
    moved = np.abs(written[1] - carry[1])
    assert 4 < (moved > 0.01).sum() < 28

    def wait(carry, _):
        return policy(jnp.zeros(2), carry)[1], None

    kept, _ = jax.lax.scan(wait, written, None, 10_000)
    np.testing.assert_allclose(kept[1], written[1], atol=5e-3)


def test_mmu_has_one_leaf_per_matrix_of_the_equations():
    net = MMU(hidden=4, memory=2, **BOTH_LEARNED)
    policy = net.init(3, 2, key=jax.random.key(0))
    leaves = {path[0].name: leaf.shape for path, leaf in jax.tree.leaves_with_path(policy)}
    assert leaves == mmu_shapes(3, 2, 4, 2, "learned", "learned", "learned")
    frozen = MMU(hidden=3, start_memory="zero").init(1, 1, key=jax.random.key(0))
    assert len(jax.tree.leaves(frozen)) == 17
    assert all(getattr(frozen, name) is None for name in ("N_d", "b_d", "Z_f", "b_f", "m_0"))


def rnn_by_hand(w, x, state):
    h = tanh(plus(times(w["W_h"], x), times(w["U_h"], state), w["b_h"]))
    return h, h


def gru_by_hand(w, x, h):
    """Cho et al. 2014, equations 5-8: z keeps the old state."""

    def gate(g, h):
        return plus(times(w[f"W_{g}"], x), times(w[f"U_{g}"], h), w[f"b_{g}"])

    r, z = sigmoid(gate("r", h)), sigmoid(gate("z", h))
    candidate = tanh(gate("h", hadamard(r, h)))
    h = [z_k * h_k + (1 - z_k) * c_k for z_k, h_k, c_k in zip(z, h, candidate, strict=True)]
    return h, h


def lstm_by_hand(w, x, state):
    h, c = state

    def gate(g):
        return plus(times(w[f"W_{g}"], x), times(w[f"U_{g}"], h), w[f"b_{g}"])

    i, f, o, new = sigmoid(gate("i")), sigmoid(gate("f")), sigmoid(gate("o")), tanh(gate("c"))
    c = plus(hadamard(f, c), hadamard(i, new))
    h = hadamard(o, tanh(c))
    return h, (h, c)


CELLS = {"rnn": (rnn_by_hand, "h"), "gru": (gru_by_hand, "zrh"), "lstm": (lstm_by_hand, "ifoc")}


@pytest.mark.parametrize(("cell", "output"), [*((c, "sigmoid") for c in CELLS), ("gru", "tanh")])
def test_recurrent_cells_follow_the_equations(cell, output):
    x, h, y = 2, 3, 2
    step, gates = CELLS[cell]
    shapes = {"Z_y": (y, h), "b_y": (y,)}
    for g in gates:
        shapes |= {f"W_{g}": (h, x), f"U_{g}": (h, h), f"b_{g}": (h,)}
    w, inputs = weights_of(shapes), inputs_of(x)
    net = Recurrent(cell=cell, hidden=h, output_activation=output)
    fresh = net.init(x, y, key=jax.random.key(0))
    assert {name: leaf.shape for name, leaf in fresh.weights.items()} == shapes

    expected, state = [], ([0.0] * h, [0.0] * h) if cell == "lstm" else [0.0] * h
    for row in inputs:
        hidden, state = step(w, row, state)
        out = BY_HAND[output](plus(times(w["Z_y"], hidden), w["b_y"]))
        expected.append(as_action(out, output))
    actions, carries = read(RecurrentPolicy(on_device(w), net), jnp.asarray(inputs, jnp.float32))
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    last = jax.tree.map(lambda c: c[-1], carries)
    np.testing.assert_allclose(np.array(last), np.array(state), atol=1e-5)


@pytest.mark.parametrize(("depth", "activation"), [(1, "tanh"), (2, "elu")])
def test_mlp_follows_the_equations(depth, activation):
    x, h, y = 2, 4, 3
    sizes = [x, *[h] * depth, y]
    shapes = {}
    for layer in range(depth + 1):
        shapes |= {
            f"W_{layer}": (sizes[layer + 1], sizes[layer]),
            f"b_{layer}": (sizes[layer + 1],),
        }
    net = MLP(hidden=(h,) * depth, activation=activation)
    fresh = net.init(x, y, key=jax.random.key(0))
    assert {name: leaf.shape for name, leaf in fresh.weights.items()} == shapes
    w, inputs = weights_of(shapes), inputs_of(x)
    expected = []
    for values in inputs:
        for layer in range(depth + 1):
            values = plus(times(w[f"W_{layer}"], values), w[f"b_{layer}"])
            values = BY_HAND["tanh" if layer == depth else activation](values)
        expected.append(values)
    actions, carries = read(MLPPolicy(on_device(w), net), jnp.asarray(inputs, jnp.float32))
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    assert jax.tree.leaves(carries) == []


def test_chrono_gates_keep_a_state_up_to_the_span():
    """Times are uniform: the gate that keeps, σ(b), is 1 - 1 / time."""
    for cell, name in (("gru", "b_z"), ("lstm", "b_f")):
        weights = Recurrent(cell, 500, span=100).init(2, 1, key=jax.random.key(0)).weights
        times = 1.0 + np.exp(np.asarray(weights[name]))
        assert times.min() >= 2.0
        assert times.max() <= 100.0
        assert abs(times.mean() - 51.0) < 4.0
        if cell == "lstm":
            np.testing.assert_array_equal(weights["b_i"], -weights["b_f"])
        drawn = Recurrent(cell, 500).init(2, 1, key=jax.random.key(0)).weights
        np.testing.assert_array_equal(weights["U_" + name[2:]], drawn["U_" + name[2:]])
    with pytest.raises(ValueError, match="span is 2: it must be at least 3"):
        Recurrent("gru", span=2)
    with pytest.raises(ValueError, match="an rnn has no gates, give span=0"):
        Recurrent("rnn", span=10)
