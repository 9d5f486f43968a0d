"""NTM and DNC against plain loops, written from the equations of their papers row by row."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reading import read

from credo.algorithms.bptt import BPTT
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.sequence_copy import SequenceCopy
from credo.networks.dnc import DNC, DNCPolicy, allocation, linked, usage
from credo.networks.external_memory import by_content
from credo.networks.ntm import NTM, NTMPolicy, sharpened, shifted

X, Y, STEPS = 3, 2, 12
NTMS = {
    "ntm": NTM("feedforward", hidden=4, rows=5, width=3),
    "lstm": NTM("lstm", hidden=3, rows=6, width=2, read_heads=2, write_heads=2, shift=2),
    "constant": NTM("lstm", 3, 4, 2, start_memory="constant", output_activation="tanh"),
}
DNCS = {
    "feedforward": DNC("feedforward", hidden=4, rows=5, width=3, read_heads=1),
    "lstm": DNC("lstm", hidden=3, rows=4, width=2, read_heads=2, output_activation="tanh"),
}
EVERY = NTMS | {f"dnc {name}": net for name, net in DNCS.items()}


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def softmax(x):
    return np.exp(x) / np.exp(x).sum()


def softplus(x):
    return np.log(1.0 + np.exp(x))


class Loop:
    """Weights in float64, and the controller: what both papers describe alike."""

    def __init__(self, net, weights):
        self.net, self.w = net, {k: np.asarray(v, np.float64) for k, v in weights.items()}
        zeros = np.zeros(net.hidden)
        self.h, self.c = self.w.get("h_0", zeros), self.w.get("c_0", zeros)

    def emitted(self, name):
        return self.w[f"W_{name}"] @ self.h + self.w[f"b_{name}"]

    def control(self, x):
        if self.net.controller == "feedforward":
            self.h = np.tanh(self.w["W_h"] @ x + self.w["b_h"])
            return
        i, f, o, new = (
            self.w[f"W_{g}"] @ x + self.w[f"U_{g}"] @ self.h + self.w[f"b_{g}"] for g in "ifoc"
        )
        self.c = sigmoid(f) * self.c + sigmoid(i) * np.tanh(new)
        self.h = sigmoid(o) * np.tanh(self.c)

    def content(self, memory, key, strength):
        """Equations 5 and 6 of the NTM, "content-based addressing" of the DNC."""
        similarity = [
            sum(key * row) / math.sqrt((sum(key * key) + 1e-6) * (sum(row * row) + 1e-6))
            for row in memory
        ]
        return softmax(strength * np.array(similarity))

    def action(self, read):
        y = self.w["Z_y"] @ self.h + self.w["Z_r"] @ read + self.w["b_y"]
        return np.tanh(y) if self.net.output_activation == "tanh" else 2 * sigmoid(y) - 1


def ntm_by_hand(net, weights, inputs):
    """Graves et al. (2014), equations 1-9, head by head and row by row."""
    loop, n, m = Loop(net, weights), net.rows, net.width
    start = np.full((n, m), 1e-6)
    memory = loop.w.get("M_0", start).copy()
    reads = loop.w["r_0"]
    at = {kind: [softmax(w) for w in loop.w[f"w_{kind}_0"].reshape(-1, n)] for kind in ("r", "w")}

    def address(kind, head, memory):
        def mine(name):
            return loop.emitted(f"{name}_{kind}").reshape(len(at[kind]), -1)[head]

        found = loop.content(memory, mine("k"), softplus(mine("beta")[0]))
        g, s = sigmoid(mine("g")[0]), softmax(mine("s"))
        gated = g * found + (1 - g) * at[kind][head]  # (7)
        moved = np.zeros(n)
        for i in range(n):  # (8): s(0) is the middle one
            for j in range(n):
                for d in range(-net.shift, net.shift + 1):
                    if (i - j - d) % n == 0:
                        moved[i] += gated[j] * s[d + net.shift]
        sharp = moved ** (1 + softplus(mine("gamma")[0]))
        at[kind][head] = sharp / sharp.sum()  # (9)
        return at[kind][head], mine

    actions = []
    for x in inputs:
        loop.control(np.concatenate([x, reads]))
        old, erased = memory.copy(), memory.copy()
        added = np.zeros((n, m))
        for head in range(net.write_heads):
            w, mine = address("w", head, old)
            e, a = sigmoid(mine("e")), mine("a")
            for i in range(n):
                erased[i] = erased[i] * (1 - w[i] * e)  # (3)
                added[i] += w[i] * a  # (4)
        memory = erased + added
        looked = [address("r", head, memory)[0] for head in range(net.read_heads)]
        reads = np.concatenate(
            [sum(w_i * row for w_i, row in zip(w, memory, strict=True)) for w in looked]  # (2)
        )
        actions.append(loop.action(reads))
    return np.array(actions), memory


def dnc_by_hand(net, weights, inputs):
    """Graves et al. (2016), Methods, row by row."""
    loop, n, r = Loop(net, weights), net.rows, net.read_heads
    memory, link = np.zeros((n, net.width)), np.zeros((n, n))
    u, p, w_w = np.zeros(n), np.zeros(n), np.zeros(n)
    w_r, reads = [np.zeros(n) for _ in range(r)], np.zeros(r * net.width)
    actions = []
    for x in inputs:
        loop.control(np.concatenate([x, reads]))
        free = sigmoid(loop.emitted("f_r"))
        retention = [math.prod(1 - free[k] * w_r[k][i] for k in range(r)) for i in range(n)]
        u = np.array([(u[i] + w_w[i] - u[i] * w_w[i]) * retention[i] for i in range(n)])
        order, a = sorted(range(n), key=lambda i: u[i]), np.zeros(n)
        for j, row in enumerate(order):
            a[row] = (1 - u[row]) * math.prod(u[order[i]] for i in range(j))
        found = loop.content(memory, loop.emitted("k_w"), 1 + softplus(loop.emitted("beta_w")[0]))
        g_a, g_w = sigmoid(loop.emitted("ga_w"))[0], sigmoid(loop.emitted("gw_w"))[0]
        w_w = g_w * (g_a * a + (1 - g_a) * found)
        e, v = sigmoid(loop.emitted("e_w")), loop.emitted("v_w")
        memory = np.array([memory[i] * (1 - w_w[i] * e) + w_w[i] * v for i in range(n)])
        old = link.copy()
        for i in range(n):
            for j in range(n):
                kept = (1 - w_w[i] - w_w[j]) * old[i, j]
                link[i, j] = 0.0 if i == j else kept + w_w[i] * p[j]
        p = (1 - w_w.sum()) * p + w_w
        keys = loop.emitted("k_r").reshape(r, -1)
        modes = [softmax(mode) for mode in loop.emitted("pi_r").reshape(r, 3)]
        for k in range(r):
            forward = [sum(link[i, j] * w_r[k][j] for j in range(n)) for i in range(n)]
            backward = [sum(link[j, i] * w_r[k][j] for j in range(n)) for i in range(n)]
            strength = 1 + softplus(loop.emitted("beta_r")[k])
            parts = backward, loop.content(memory, keys[k], strength), forward
            w_r[k] = sum(mode * np.array(part) for mode, part in zip(modes[k], parts, strict=True))
        reads = np.concatenate([w_r[k] @ memory for k in range(r)])
        actions.append(loop.action(reads))
    return np.array(actions), memory


def weights_of(net, seed=0):
    """As large as the fresh ones: every gate moves."""
    shapes = {k: v.shape for k, v in net.init(X, Y, key=jax.random.key(0)).weights.items()}
    rng = np.random.default_rng(seed)
    return {k: np.float32(rng.standard_normal(shape)) for k, shape in shapes.items()}


@pytest.mark.parametrize("name", EVERY)
def test_it_follows_the_equations(name):
    net = EVERY[name]
    w = weights_of(net)
    inputs = np.random.default_rng(1).uniform(-1.0, 1.0, (STEPS, X))
    policy, by_hand = (NTMPolicy, ntm_by_hand) if name in NTMS else (DNCPolicy, dnc_by_hand)
    made = policy({k: jnp.asarray(v) for k, v in w.items()}, net)
    actions, carries = read(made, jnp.asarray(inputs, jnp.float32))
    expected, memory = by_hand(net, w, inputs)
    assert np.ptp(expected) > 0.05
    np.testing.assert_allclose(actions, expected, atol=2e-4)
    np.testing.assert_allclose(carries[-1][-1], memory, atol=2e-4)


def test_shifting_goes_around_and_sharpening_is_a_power():
    w = jnp.array([[0.5, 0.3, 0.2, 0.0]])
    right = shifted(w, jnp.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(right, [[0.0, 0.5, 0.3, 0.2]])
    np.testing.assert_allclose(shifted(w, jnp.array([[1.0, 0.0, 0.0]])), [[0.3, 0.2, 0.0, 0.5]])
    expected = np.array([0.25, 0.09, 0.04, 0.0]) / 0.38
    np.testing.assert_allclose(sharpened(w, jnp.array([[2.0]]))[0], expected, atol=1e-6)


def test_heads_start_at_the_first_row_of_a_constant_memory():
    """Otherwise nothing would tell one row from another."""
    net = NTM("feedforward", 4, 5, 3, 2, start_memory="constant", initializer="kaiming")
    policy = net.init(X, Y, key=jax.random.key(0))
    _, _, at_read, at_write, memory = policy.start()
    assert at_read.shape == (2, 5)
    assert (at_read[:, 0] > 0.99).all()
    assert (at_write[:, 0] > 0.99).all()
    np.testing.assert_array_equal(memory, np.full((5, 3), np.float32(1e-6)))
    inputs = jax.random.normal(jax.random.key(1), (4, X))
    rows = read(policy, inputs)[1][-1][-1]
    assert np.abs(rows[0] - rows[3]).max() > 1e-3


def test_gradients_are_finite_where_weights_rows_and_keys_are_zero():
    one = jnp.array([[1.0, 0.0, 0.0]])
    slope = jax.grad(lambda w, g: jnp.sum(sharpened(w, g)[0, 0] ** 2), (0, 1))
    for exponent in (1.0, 2.0, 50.0):
        assert all(np.isfinite(g).all() for g in slope(one, jnp.full((1, 1), exponent)))
    zeros = jnp.zeros((3, 2))
    similar = jax.grad(lambda m, k: by_content(m, k, jnp.ones(1))[0, 0], (0, 1))
    for memory, key in ((zeros, zeros[:1]), (zeros, zeros[:1] + 1.0), (zeros + 1.0, zeros[:1])):
        assert all(np.isfinite(g).all() for g in similar(memory, key))
    np.testing.assert_allclose(by_content(zeros, zeros[:1], jnp.ones(1)), np.full((1, 3), 1 / 3))


def test_the_least_used_row_is_allocated_and_freed_rows_are_unused():
    np.testing.assert_allclose(allocation(jnp.array([1.0, 0.2, 0.0])), [0.0, 0.0, 1.0])
    np.testing.assert_allclose(
        allocation(jnp.array([0.5, 0.25, 1.0])), [0.25 * 0.5, 0.75, 0.0], atol=1e-6
    )
    np.testing.assert_allclose(allocation(jnp.zeros(3)), [1.0, 0.0, 0.0])  # ties: the first
    assert not np.any(allocation(jnp.ones(3)))  # nothing is free
    assert all(np.isfinite(jax.jacobian(allocation)(u)).all() for u in (jnp.zeros(3), jnp.ones(3)))
    written, looked = jnp.array([0.0, 1.0, 0.5]), jnp.array([[1.0, 0.0, 0.0]])
    used = jnp.array([1.0, 0.0, 0.5])
    kept = usage(used, written, looked, jnp.zeros((1, 1)))
    np.testing.assert_allclose(kept, [1.0, 1.0, 0.75])
    np.testing.assert_allclose(usage(used, written, looked, jnp.ones((1, 1))), [0.0, 1.0, 0.75])


def test_links_go_from_a_row_to_the_one_written_next():
    links, last, rows = jnp.zeros((3, 3)), jnp.zeros(3), jnp.eye(3)
    for row in (1, 2, 0):
        links, last = linked(links, rows[row], last), rows[row]
    expected = np.zeros((3, 3))
    expected[2, 1] = expected[0, 2] = 1.0  # 2 was written after 1, and 0 after 2
    np.testing.assert_array_equal(links, expected)


@pytest.mark.parametrize("net", [NTM(), NTM("lstm"), DNC(rows=128, width=20)], ids=str)
def test_memories_of_the_papers_size_stay_finite(net):
    policy = net.init(9, 8, key=jax.random.key(0))
    inputs = jax.random.bernoulli(jax.random.key(1), 0.5, (41, 9)).astype(jnp.float32)
    actions, carries = read(policy, inputs)
    assert carries[-1].shape == (41, 128, 20)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((actions, carries)))
    assert (np.abs(actions) <= 1.0).all()


@pytest.mark.parametrize("name", ["ntm", "dnc lstm"])
def test_it_can_be_evolved(name):
    task = SequenceCopy(bits=2, max_length=2)
    algorithm = Neuroevolution.as_written(
        task, EVERY[name], population_size=10, episodes=2, test_episodes=2
    )
    state = algorithm.init(key=jax.random.key(0))
    state, metrics = algorithm.generation(state, key=jax.random.key(1))
    assert np.isfinite(float(metrics["champion_score"]))


@pytest.mark.parametrize(
    ("net", "length", "rate"),
    [(NTM("feedforward", 32, 16, 8), 5, 0.005), (DNCS["lstm"], 1, 0.02)],
    ids=["ntm", "dnc"],
)
def test_it_learns_to_copy_by_gradient(net, length, rate):
    """Vectors of two bits; by chance two bits each, (1 + length) / 2 vectors on average."""
    task = SequenceCopy(bits=2, max_length=length)
    fields = {"loss": "cross_entropy", "max_norm": 10.0, "test_episodes": 20}
    bptt = BPTT.ours(task, net, learning_rate=rate, **fields)
    state = bptt.init(key=jax.random.key(0))
    bits = []
    for g in range(12):
        state, metrics = bptt.generation(state, key=jax.random.key(g))
        bits.append(float(metrics["bits"]))
    assert bits[0] > 0.25 * (1 + length)
    assert bits[-1] < 0.05 * (1 + length), bits
    assert float(metrics["champion_score"]) > 0.9
    leaves = jax.tree.leaves(eqx.filter(state.champion, eqx.is_array))
    assert all(np.isfinite(leaf).all() for leaf in leaves)


@pytest.mark.parametrize(
    ("build", "told"),
    [
        (lambda: NTM("gru"), "controller is 'gru'.*feedforward, lstm"),
        (lambda: NTM(hidden=0), "hidden is 0"),
        (lambda: NTM(rows=0), "rows is 0"),
        (lambda: NTM(width=0), "width is 0"),
        (lambda: NTM(read_heads=0), "read_heads is 0"),
        (lambda: NTM(write_heads=0), "write_heads is 0"),
        (lambda: NTM(shift=-1), "shift is -1"),
        (lambda: NTM(rows=4, shift=2), "shift is 2 and rows is 4"),
        (lambda: NTM(start_memory="zero"), "start_memory is 'zero'.*constant, learned"),
        (lambda: NTM(initializer="flat"), "initializer is 'flat'"),
        (lambda: DNC("gru"), "controller is 'gru'"),
        (lambda: DNC(read_heads=0), "read_heads is 0"),
        (lambda: DNC(initializer="flat"), "initializer is 'flat'"),
    ],
)
def test_impossible_networks_are_refused(build, told):
    with pytest.raises(ValueError, match=told):
        build()
