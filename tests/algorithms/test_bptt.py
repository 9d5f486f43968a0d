"""BPTT: its gradient against finite differences and a plain scan, its loss and L2 by hand, that
padding never counts, what it compiles, and that it learns."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from compilations import compilations
from reading import read

from credo import rollout, tree
from credo.algorithms.bptt import BPTT, descend, kaiming, loss_of, respond
from credo.environments.probes import Copy, Meet, Remember
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_recall import SequenceRecall
from credo.environments.wrappers import Shortened
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent

CLASSIFICATION = SequenceClassification(depth=3, min_gap=1, max_gap=4)
RECALL = SequenceRecall(depth=2, min_corridor=1, max_corridor=4)
TASKS = {"classification": CLASSIFICATION, "recall": RECALL}
SMALL = BPTT.as_written(RECALL, MMU(hidden=3), batch_size=6, updates=2, test_episodes=8)
KEY = jax.random.key(0)


def drawn(task, n=6, seed=1):
    return jax.vmap(lambda key: task.sample(key=key))(jax.random.split(jax.random.key(seed), n))


def network(task, net=None):
    return (net or MMU(hidden=3)).init(*task.sizes, key=KEY)


def answers_one_by_one(policy, inputs):
    """`rollout.trace`, sequence by sequence."""
    return jnp.stack([read(policy, x)[0][:, 0] for x in inputs])


def gradient(policy, bptt, batch):
    return eqx.filter_jit(eqx.filter_grad(loss_of))(policy, bptt, batch)


def assert_close(a, b, **tolerance):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, **tolerance)


@pytest.mark.parametrize("checkpoint", [None, 1, 3, 4, 100])
def test_answers_are_those_of_the_policy_alone(checkpoint):
    batch = drawn(CLASSIFICATION)
    policy = network(CLASSIFICATION)
    np.testing.assert_allclose(
        respond(policy, batch.inputs, checkpoint)[..., 0],
        answers_one_by_one(policy, batch.inputs),
        atol=1e-6,
    )


@pytest.mark.parametrize("name", TASKS)
def test_the_gradient_is_that_of_a_plain_scan_and_of_finite_differences(name):
    task = TASKS[name]
    batch, policy = drawn(task), network(task)
    bptt = BPTT(task, MMU(hidden=3), batch_size=6)
    targets, asked = jax.vmap(task.lesson)(batch)

    def plain(policy):
        answers = jax.vmap(lambda x: read(policy, x)[0][:, 0])(batch.inputs)
        return jnp.sum(asked * optax.huber_loss(0.5 * answers, 0.5 * targets)) / jnp.sum(asked)

    ours = gradient(policy, bptt, batch)
    assert_close(ours, eqx.filter_grad(plain)(policy), atol=1e-6)
    for leaf in ("Z_y", "N_w", "K_p", "m_0"):
        step = 1e-2

        def moved(by, leaf=leaf):
            where = (0,) * getattr(policy, leaf).ndim
            there = eqx.tree_at(
                lambda p: getattr(p, leaf), policy, getattr(policy, leaf).at[where].add(by)
            )
            return float(loss_of(there, bptt, batch))

        slope = (moved(step) - moved(-step)) / (2 * step)
        assert float(getattr(ours, leaf).reshape(-1)[0]) == pytest.approx(slope, abs=2e-4)
    assert sum(float(jnp.sum(jnp.abs(x))) for x in jax.tree.leaves(ours)) > 0.01


@pytest.mark.parametrize(
    "net", [MMU(hidden=3), Recurrent("lstm", 3), Recurrent("gru", 3), MLP((3,))]
)
def test_segments_computed_twice_change_nothing(net):
    batch, policy = drawn(RECALL), network(RECALL, net)
    kept, segments = (
        gradient(policy, BPTT(RECALL, net, checkpoint=checkpoint), batch) for checkpoint in (1, 4)
    )
    assert_close(kept, segments, atol=1e-6)


def test_segments_need_less_memory():
    task = SequenceRecall(depth=2, min_corridor=200, max_corridor=300)
    net = MMU(hidden=4)
    batch, policy = drawn(task, 20), network(task, net)
    needed = {}
    for checkpoint in (1, 25):
        bptt = BPTT(task, net, checkpoint=checkpoint)
        weights, static = eqx.partition(policy, eqx.is_array)
        slope = jax.jit(
            jax.grad(
                lambda w, bptt=bptt, static=static: loss_of(eqx.combine(w, static), bptt, batch)
            )
        )
        needed[checkpoint] = slope.lower(weights).compile().memory_analysis().temp_size_in_bytes
    assert needed[25] < 0.5 * needed[1]


def test_long_sequences_are_cut_by_themselves():
    """By default from 1000 steps on: the carries of a segment are computed again."""

    def carries_kept(steps):
        inputs = jnp.zeros((1, steps, 1))
        policy = network(CLASSIFICATION)
        traced = jax.make_jaxpr(lambda x: respond(policy, x))(inputs)
        return [eqn.params["length"] for eqn in traced.eqns if eqn.primitive.name == "scan"]

    assert carries_kept(1000) == [1000]
    assert carries_kept(1001) == [32]


@pytest.mark.parametrize("name", TASKS)
def test_padding_never_matters(name):
    task = TASKS[name]
    batch, policy = drawn(task), network(task)
    padding = np.arange(task.max_steps)[None] >= np.asarray(batch.length)[:, None]
    assert padding.any()
    noise = jax.random.normal(KEY, batch.inputs.shape)
    other = dataclasses.replace(
        batch,
        inputs=jnp.where(padding[..., None], noise, batch.inputs),
        targets=jnp.where(padding, -batch.targets, batch.targets),
    )
    bptt = BPTT(task, MMU(hidden=3))
    assert float(loss_of(policy, bptt, other)) == float(loss_of(policy, bptt, batch))
    assert_close(gradient(policy, bptt, other), gradient(policy, bptt, batch), atol=1e-7)


def test_lessons_say_what_is_asked_and_where():
    maze = SequenceRecall(2, 1, 4).lay_out(jnp.array([1.0, -1.0]), jnp.array([3, 2]))
    targets, asked = SequenceRecall(2, 1, 4).lesson(maze)
    #                  directions | corridor of 3 | of 2 | padding
    assert targets[:7].tolist() == [0, 0, 1, 1, 1, -1, -1]
    assert asked.tolist() == [1, 1, 1, 1, 1, 1, 1, 0, 0, 0]
    signals, gaps = jnp.array([-1.0, 1.0, 1.0]), jnp.array([0, 1, 0])
    tie = SequenceClassification(3, 0, 2)
    targets, asked = tie.lesson(tie.lay_out(signals, gaps))
    assert asked.tolist() == [1, 0, 1, 1, 0, 0, 0]
    assert targets[jnp.array([0, 2, 3])].tolist() == [-1, 1, 1]  # a tie is class +1
    free = dataclasses.replace(tie, ties="free")
    assert free.lesson(free.lay_out(signals, gaps))[1].tolist() == [1, 0, 0, 1, 0, 0, 0]
    cut = Shortened(SequenceRecall(2, 1, 4), 1)
    assert int(jnp.sum(cut.lesson(dataclasses.replace(maze, length=jnp.int32(5)))[1])) == 5


class Constant(eqx.Module):
    """Answers the same whatever it hears."""

    answer: jax.Array

    def start(self, *, key):
        return None

    def __call__(self, obs, carry):
        return self.answer[None], carry


@pytest.mark.parametrize("answer", [0.0, 0.4, -1.0])
def test_the_loss_is_half_the_squared_distance_of_outputs_in_0_to_1(answer):
    batch = drawn(RECALL)
    targets, asked = (np.asarray(x) for x in jax.vmap(RECALL.lesson)(batch))
    by_hand = 0.5 * ((answer + 1) / 2 - (targets + 1) / 2) ** 2
    policy = Constant(jnp.float32(answer))
    mean, summed = BPTT(RECALL), BPTT(RECALL, reduction="sum")
    total = float((by_hand * asked).sum())
    assert float(loss_of(policy, summed, batch)) == pytest.approx(total, rel=1e-5)
    assert float(loss_of(policy, mean, batch)) == pytest.approx(total / asked.sum(), rel=1e-5)
    # Beyond a distance of 1 it is linear: answer 3 to targets of 0, 1 and -1 is 1.5, 1 and 2 away.
    far = np.select([targets == 0, targets == 1], [1.0, 0.5], 1.5)
    policy = Constant(jnp.float32(3.0))
    assert float(loss_of(policy, summed, batch)) == pytest.approx(float((far * asked).sum()))


def test_l2_is_part_of_what_adam_normalises():
    """Two steps against torch's definition, g + λw into Adam, written out; and the rate falls."""
    bptt = dataclasses.replace(SMALL, l2=0.3, learning_rate=0.02, decay=0.5)
    state = bptt.init(key=KEY)
    weights, rest = eqx.partition(state.champion, eqx.is_array)
    flat, unravel = jax.flatten_util.ravel_pytree(weights)
    w, m, v = np.asarray(flat, np.float64), 0.0, 0.0
    keys = jax.random.split(jax.random.key(3), 2)
    for t, key in enumerate(keys, start=1):
        batch = bptt.batch(state.examples, key=key)
        policy = eqx.combine(unravel(jnp.asarray(w, jnp.float32)), rest)
        g = np.asarray(jax.flatten_util.ravel_pytree(gradient(policy, bptt, batch))[0], np.float64)
        g = g + 0.3 * w
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        w = w - 0.02 * 0.5 ** (t - 1) * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
    after, losses, frames, _ = descend(bptt, state, key=jax.random.key(3))
    found, _ = jax.flatten_util.ravel_pytree(eqx.filter(after.champion, eqx.is_array))
    np.testing.assert_allclose(found, w, atol=2e-5)
    lengths = [int(jnp.sum(bptt.batch(state.examples, key=key).length)) for key in keys]
    assert frames.tolist() == lengths
    assert losses.shape == (2,)
    assert int(after.done) == 2


def test_a_training_set_is_drawn_once_and_batches_from_it_without_repeats():
    bptt = dataclasses.replace(SMALL, train_size=8)
    examples = bptt.init(key=KEY).examples
    every = {np.asarray(x).tobytes() for x in bptt_set(bptt, examples)}
    seen = set()
    for g in range(6):
        batch = np.asarray(bptt.batch(examples, key=jax.random.key(g)).inputs)
        kinds = {x.tobytes() for x in batch}
        assert kinds <= every
        seen |= kinds
    assert seen == every
    fresh = np.asarray(SMALL.batch(examples, key=KEY).inputs)
    assert not {x.tobytes() for x in fresh} <= every
    whole = dataclasses.replace(SMALL, train_size=6)
    a, b = (np.sort(whole.batch(examples, key=jax.random.key(g)).length) for g in (0, 1))
    assert a.tolist() == b.tolist()


def bptt_set(bptt, examples):
    """All sequences of the training set."""
    keys = jax.vmap(lambda i: jax.random.fold_in(examples, i))(jnp.arange(bptt.train_size))
    return jax.vmap(lambda key: bptt.env.sample(key=key))(keys).inputs


def test_metrics_count_what_was_learned_from():
    state = SMALL.init(key=KEY)
    after, metrics = SMALL.generation(state, key=jax.random.key(1))
    assert set(metrics) == {"loss", "champion_score", "frames", "instances", "updates"}
    assert all(jnp.shape(value) == () for value in metrics.values())
    assert (int(metrics["instances"]), int(metrics["updates"])) == (12, 2)
    assert 12 * 4 <= int(metrics["frames"]) <= 12 * 10
    test_key = jax.random.split(jax.random.key(1))[1]
    played = rollout.evaluate(RECALL, tree.stack(after.champion), 8, key=test_key)
    assert float(metrics["champion_score"]) == float(jnp.mean(played.returns["success"]))
    again, _ = SMALL.generation(SMALL.init(key=KEY), key=jax.random.key(1))
    assert_close(after.champion, again.champion, atol=0)


def test_presets_are_what_was_printed_and_what_was_coded():
    written = BPTT.as_written(RECALL, MMU(hidden=20))
    assert (written.learning_rate, written.l2, written.batch_size) == (0.01, 0.1, 1000)
    assert (written.updates, written.train_size, written.reduction) == (1, None, "mean")
    assert written.network == MMU(hidden=20, initializer="kaiming")
    coded = BPTT.as_coded(RECALL, Recurrent("gru"), l2=0.0)
    assert (coded.train_size, coded.reduction, coded.l2) == (1000, "sum", 0.0)
    assert coded.network == Recurrent("gru", initializer="kaiming")
    policy = written.init(key=KEY).champion
    assert float(jnp.std(policy.N_w)) == pytest.approx(np.sqrt(2 / 20), rel=0.1)
    assert not np.any(policy.b_w)
    assert set(BPTT.presets()) == {"as-written", "as-coded", "ours"}
    assert kaiming(Plain()) == Plain()
    ours = BPTT.ours(RECALL, MMU(hidden=20), updates=2)
    assert (ours.batch_size, ours.updates, ours.l2, ours.max_norm) == (20, 2, 0.0, 0.1)
    assert (ours.learning_rate, ours.decay) == (0.02, 0.9998)
    assert ours.network == MMU(hidden=20, initializer="kaiming", start_weights="closed")
    assert np.all(np.asarray(ours.init(key=KEY).champion.b_w) == -4.0)
    assert BPTT.ours(RECALL, Recurrent("gru")).network == Recurrent("gru", initializer="kaiming")


class Plain(eqx.Module):
    """A network that draws its weights as it likes."""


def test_nothing_compiles_after_the_first_generation():
    state, _ = SMALL.generation(SMALL.init(key=KEY), key=jax.random.key(0))
    with compilations() as events:
        for g in range(1, 4):
            state, _ = SMALL.generation(state, key=jax.random.key(g))
        other = dataclasses.replace(SMALL, learning_rate=0.1, l2=0.0)
        changed, _ = jax.block_until_ready(other.generation(state, key=jax.random.key(4)))
    assert events == []
    same, _ = SMALL.generation(state, key=jax.random.key(4))
    assert np.any(np.asarray(changed.champion.Z_y) != np.asarray(same.champion.Z_y))


@pytest.mark.parametrize("net", [MMU(hidden=4), Recurrent("gru", 4)])
def test_it_learns_to_remember(net):
    bptt = BPTT.as_written(Remember(delay=5), net, batch_size=32, updates=50, l2=0.0)
    state = bptt.init(key=KEY)
    for g in range(8):
        state, metrics = bptt.generation(state, key=jax.random.key(g))
    assert float(metrics["champion_score"]) == 1.0
    assert float(metrics["loss"]) < 0.05


def test_l2_as_printed_holds_the_network_at_nothing():
    """Half of the squared distance of undecided answers to 0 and 1 is ⅛."""
    bptt = BPTT.as_written(Remember(delay=5), MMU(hidden=4), batch_size=32, updates=50)
    state = bptt.init(key=KEY)
    for g in range(8):
        state, metrics = bptt.generation(state, key=jax.random.key(g))
    assert float(metrics["loss"]) == pytest.approx(0.125, abs=2e-3)


@pytest.mark.parametrize(
    ("env", "fields", "told"),
    [
        (Copy(), {}, "Copy has no labelled sequences to learn from: give a sequence task"),
        (Meet(), {}, "Meet has no labelled sequences"),
        (RECALL, {"batch_size": 0}, "batch_size is 0: it must be at least 1"),
        (RECALL, {"updates": 0}, "updates is 0"),
        (RECALL, {"checkpoint": 0}, "checkpoint is 0: it must be at least 1"),
        (RECALL, {"l2": -0.1}, "l2 is -0.1: it must be at least 0"),
        (RECALL, {"learning_rate": -1.0}, "learning_rate is -1.0"),
        (RECALL, {"decay": 1.5}, r"decay is 1.5: it must lie in \[0, 1\]"),
        (RECALL, {"reduction": "max"}, "reduction is 'max': it must be one of mean, sum"),
        (RECALL, {"train_size": 10}, "train_size is 10: a batch of 1000 different sequences"),
    ],
)
def test_bad_settings_say_what_is_allowed(env, fields, told):
    with pytest.raises(ValueError, match=told):
        BPTT(env, MMU(hidden=3), **fields)
