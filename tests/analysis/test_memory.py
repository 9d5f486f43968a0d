import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reading import read

from credo.analysis import memory
from credo.analysis.counting import exact_counter
from credo.environments.sequence_classification import SequenceClassification
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent

TASK = SequenceClassification(depth=3)


def biased():
    """The exact counter with M3 as its bias, in place of b_y: it is read at -½ and never moves.
    A fourth unit shows the present signal."""
    e = exact_counter()
    wide = MMU(hidden=4, initializer="kaiming").init(1, 1, key=jax.random.key(0))
    rows = {"K_p": [0, 0, 0, 200], "K_w": [200, -200, 0, 0]}
    vectors = {
        "b_i": [100, 100, 100, 100],
        "b_p": [-100, -100, -100, 0],
        "b_r": [100, 100, 100, -100],
        "b_w": [-100, -100, -200, -200],
        "m_0": [32, -32, -0.5, 0],
    }
    return dataclasses.replace(
        jax.tree.map(jnp.zeros_like, wide),
        Z_y=jnp.array([[1.0, 1.0, 1.0, 2.0]]),
        b_y=jnp.zeros_like(e.b_y),
        **{name: jnp.array(row, jnp.float32)[:, None] for name, row in rows.items()},
        **{name: jnp.array(vector, jnp.float32) for name, vector in vectors.items()},
    )


@pytest.fixture(scope="module")
def policy():
    return biased()


@pytest.fixture(scope="module")
def states(policy):
    return memory.final_states(policy, TASK)


def test_permutations_come_in_the_order_of_table_3_1():
    assert memory.permutations(3).astype(int).tolist() == [
        [-1, -1, -1],
        [-1, -1, 1],
        [-1, 1, -1],
        [1, -1, -1],
        [-1, 1, 1],
        [1, -1, 1],
        [1, 1, -1],
        [1, 1, 1],
    ]


def test_final_states_of_a_counter_count(states):
    assert states.sums.tolist() == [-3, -1, -1, -1, 1, 1, 1, 3]
    plus = (states.signals > 0).sum(axis=1)
    expected = np.stack([32 + plus, -32 - (3 - plus), np.full(8, -0.5), np.zeros(8)], axis=1)
    np.testing.assert_array_equal(states.memory, expected)
    assert states.right.shape == (8, 3)
    assert states.right.all()


def test_final_states_end_at_the_last_signal_whatever_the_gap(policy):
    signals = np.array([[1.0, 1.0, -1.0, -1.0]], np.float32)
    states = memory.final_states(policy, TASK, signals, gap=0)
    assert states.memory[0, :2].tolist() == [34, -34]
    # Without its bias it takes -1 for a tie: wrong exactly where the sum is -1.
    no_bias = dataclasses.replace(policy, m_0=policy.m_0.at[2].set(0.0))
    signals = np.array([[-1.0, -1.0, 1.0, 1.0]], np.float32)
    right = memory.final_states(no_bias, TASK, signals, gap=2).right
    assert right.tolist() == [[False, True, False, True]]


def test_masking_finds_the_counters_and_the_bias(policy):
    sequences = memory.lay_out(TASK, memory.permutations(3))
    found = memory.relevant_cells(policy, sequences)
    assert found.success == 1.0
    assert found.needed == (0, 1, 2)
    # M4 is not read. Without M3, a sum of -1 is taken for a tie: only sequences that never
    # stand at -1 survive, those that start with +1 and never fall below 0.
    survive = [s for s in memory.permutations(3) if -1 not in np.cumsum(s)]
    assert found.without[2] == len(survive) / 8 == 0.375
    assert found.without[3] == 1.0
    np.testing.assert_array_equal(found.marginal_value, 1.0 - found.without)
    # Without M1 the answer is always -1, without M2 always +1.
    sums = np.cumsum(memory.permutations(3), axis=1)
    assert found.without[0] == (sums < 0).all(axis=1).mean() == 0.25
    assert found.without[1] == (sums >= 0).all(axis=1).mean() == 0.375


def test_dropping_cells_one_by_one_ends_in_a_set_that_cannot_shrink(policy, monkeypatch):
    monkeypatch.setattr(memory, "EXHAUSTIVE", 0)
    sequences = memory.lay_out(TASK, memory.permutations(3))
    assert memory.relevant_cells(policy, sequences).needed == (0, 1, 2)


def test_a_masked_cell_is_held_before_every_step(policy):
    keep = jnp.array([False, True, True, True])
    masked = memory.Masked(policy, keep, jnp.full(4, 7.0))
    assert memory.memory_of(masked.start(key=jax.random.key(0))).tolist() == [7, -32, -0.5, 0]
    _, carry = read(masked, jnp.array([[1.0], [0.0], [-1.0]]))
    np.testing.assert_array_equal(memory.memory_of(carry)[:, 0], 7.0)
    assert memory.memory_of(carry)[-1, 1] == -33


def test_signature_is_that_of_table_3_1():
    published = {(-1.51, 2.72, -0.80): [0, 2, 1], (-1.51, 1.73, -1.46): [0, 2, 1]}
    published |= {(-1.51, 0.78, -2.36): [2, 0, 1], (-1.51, 0.01, -3.34): [2, 0, 1]}
    for values, expected in published.items():
        state = np.array([-0.33, values[0], values[1], 0.84, values[2]])
        assert memory.signature(state, (1, 2, 4)).tolist() == expected


def test_writes_of_the_counter(policy):
    inputs = jnp.array([-1.0, 0.0, 1.0, 0.0, -1.0])[:, None]
    np.testing.assert_array_equal(
        memory.writes(policy, inputs),
        [[0, -1, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0], [0, -1, 0, 0]],
    )
    magnitudes = jnp.abs(memory.writes(policy, inputs))
    assert magnitudes[:, 1].tolist() == [1, 0, 0, 0, 1]
    assert memory.share_at_signals(magnitudes, inputs) == 1.0
    assert memory.share_at_signals(jnp.ones((5, 4)), inputs) == pytest.approx(0.6)


def roles_of(policy, **options):
    roles = memory.pseudo_algorithm(policy, TASK, 20, key=jax.random.key(5), **options)
    return roles, [role.role for role in roles]


def test_pseudo_algorithm_of_the_counter(policy):
    roles, names = roles_of(policy)
    assert names == ["counts +1", "counts -1", "constant", "constant"]
    assert (roles[0].plus, roles[0].minus, roles[0].distractor) == (1.0, 0.0, 0.0)
    assert (roles[1].plus, roles[1].minus, roles[1].minus_share) == (0.0, -1.0, 1.0)
    text = memory.describe(roles).splitlines()
    assert text[1:4] == [
        "    if the item is -1: M2 -1.00",
        "    if the item is +1: M1 +1.00",
        "    if the item is 0: no cell moves",
    ]
    assert text[5] == "M1: counts +1"


def test_pseudo_algorithm_tells_the_other_roles_apart(policy):
    # M3 and M4 made to move, M1 to write all the time: gates alone decide.
    moving = dataclasses.replace(
        policy,
        m_0=jnp.array([32.0, -32.0, 32.0, 0.0]),
        K_w=policy.K_w.at[0].set(0.0).at[2].set(100.0).at[1].set(-200.0),
        b_w=jnp.array([0.0, -100.0, -50.0, -200.0]),
    )
    roles, names = roles_of(moving)
    assert names[:3] == ["moves on distractors", "counts -1", "counts +1"]
    assert roles[0].distractor == 0.5
    assert roles[0].drift == pytest.approx(7.5)
    # A cell that follows f = tanh(32 x) integrates; one that may rise once only is irregular.
    rising = dataclasses.replace(
        policy,
        config=MMU(hidden=4),
        K_p=jnp.array([[0.0], [0.0], [0.0], [200.0]]),
        b_w=jnp.array([-100.0, -100.0, -200.0, 100.0]),
        K_w=policy.K_w.at[0, 0].set(1000.0).at[3, 0].set(0.0),
        N_w=policy.N_w.at[0, 0].set(-100.0),
    )
    rising = dataclasses.replace(rising, b_w=rising.b_w.at[0].set(100.0 * 33 - 1000.0 - 50.0))
    assert roles_of(rising)[1][0] == "irregular"


def test_pseudo_algorithm_of_an_integrator(policy):
    # With an identity block input, p = 32 x: the encoder writes the signal itself.
    integrator = dataclasses.replace(
        policy,
        config=MMU(hidden=4, block_activation="identity"),
        K_p=jnp.full((4, 1), 32.0),
        b_p=jnp.zeros(4),
        b_r=jnp.full(4, -100.0),
        K_w=jnp.zeros((4, 1)),
        b_w=jnp.full(4, 100.0),
    )
    roles, names = roles_of(integrator)
    assert names[0] == "counts both (integrator)"
    assert (roles[0].plus, roles[0].minus) == (1.0, -1.0)
    assert memory.describe(roles).splitlines()[2].startswith("    if the item is +1: M1 +1.00")


def test_an_lstm_is_probed_through_its_cells():
    lstm = Recurrent("lstm", hidden=2).init(1, 1, key=jax.random.key(0))
    inputs = jnp.array([1.0, 0.0, -1.0])[:, None]
    _, (_, cells) = read(lstm, inputs)
    np.testing.assert_allclose(jnp.cumsum(memory.writes(lstm, inputs), axis=0), cells, rtol=1e-5)


def test_a_carry_without_memory_is_told():
    with pytest.raises(TypeError, match=r"carry PyTreeDef\(\{\}\)"):
        memory.memory_of({})
