"""BPTT: back-propagation through time (Werbos 1990) on labelled sequences, as Khadka (2019),
section 3.4, trains an MMU by gradient: Adam, L2, smooth L1, whole sequences.

The section prints no box; it says: Adam with rate 0.01 and L2 0.1, smooth L1, batches of 1000,
Kaiming-normal weights, sequences padded to one length. Departures, and what it leaves open:

- Padding never counts. The author's program scored it.
- Loss points: a question of Sequence Classification is a signal; on Sequence Recall the turn of a
  corridor is asked at each of its steps, and 0, undecided, while directions are shown. That is
  `AbstractSequenceTask.lesson`. A tie of Sequence Classification is class +1, as for evolution.
- A mistake is measured in units of an output in [0, 1], as in the author's program: half the
  distance of answers in [-1, 1].
- Every update draws fresh sequences. The author's program drew a training set once
  (`train_size`) and made one update per pass over it, of a sum where the mean is usual; against a
  sum of thousands of terms L2 of 0.1 is next to nothing (`as_coded`).
- One encoding of each task for both trainers, and the MMU of equations 3.1-3.5: the author's
  gradient version had other inputs on Sequence Recall, no biases, and did not read its memory.
"""

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, ClassVar, Literal, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .. import require, tree
from ..compilation import float32, jit
from ..environments.base import AbstractSequenceTask, cross_entropy
from ..learners.base import adam, adam_state
from ..networks.base import AbstractNetwork, AbstractPolicy
from ..networks.mmu import MMU
from ..rollout import evaluate
from ..types import Metrics, Sequence

LONG = 1000  # steps from which on not every carry is kept


class BPTTState(eqx.Module):
    """What BPTT knows between two generations."""

    champion: AbstractPolicy  # the network
    optimizer: optax.OptState
    done: Int[Array, ""]  # updates
    examples: PRNGKeyArray  # what a fixed training set is drawn from


class BPTT(eqx.Module):
    """Train one `network` on the labelled sequences of `env` by gradient descent.

    A generation is `updates` steps of Adam and a test. One network that learns from one sequence
    is one *reinforcement instance*: a generation has `updates`·`batch_size`. Weights start as the
    network draws them; the presets have it draw Kaiming-normal ones.
    """

    default_budget: ClassVar[dict[str, int]] = {"generations": 1_000}

    env: AbstractSequenceTask
    network: AbstractNetwork = MMU()
    batch_size: int = eqx.field(static=True, default=1000)  # sequences per update, at least 1
    updates: int = eqx.field(static=True, default=1)  # of Adam per generation, at least 1
    train_size: int | None = eqx.field(static=True, default=None)
    """Sequences in a training set that is drawn once, at least `batch_size`; None: fresh sequences
    for every update."""
    learning_rate: float = 0.01  # of Adam, at least 0
    decay: float = 1.0  # factor of the learning rate from one update to the next, in [0, 1]
    l2: float = 0.1
    """This times the weights is added to the gradient, at least 0 (torch: weight_decay of Adam)."""
    max_norm: float | None = None  # to which the gradient with its L2 is clipped, ≥ 0; None: not
    reduction: Literal["mean", "sum"] = eqx.field(static=True, default="mean")
    """How the losses of all questions in a batch become one number."""
    loss: Literal["smooth_l1", "cross_entropy"] = eqx.field(static=True, default="smooth_l1")
    """The loss of one answer: smooth L1 of outputs in [0, 1], as in the dissertation, or
    cross-entropy in nats, which reads an output as the probability of class +1."""
    checkpoint: int | None = eqx.field(static=True, default=None)
    """Steps from one stored carry to the next, at least 1; what lies between is computed again for
    the gradient. Memory is least near √steps. None: 1 up to 1000 steps, then √steps."""
    test_episodes: int = eqx.field(static=True, default=50)  # fresh sequences per test, ≥ 1

    def __check_init__(self):
        if not isinstance(self.env, AbstractSequenceTask):
            raise ValueError(
                f"{type(self.env).__name__} has no labelled sequences to learn from: give a "
                "sequence task (SequenceClassification, SequenceRecall, or one of your own)"
            )
        require.fits(self.env, self.network)
        for name in ("batch_size", "updates", "test_episodes"):
            require.at_least(name, getattr(self, name), 1)
        require.at_least("checkpoint", self.checkpoint, 1)
        for name in ("learning_rate", "l2", "max_norm"):
            require.at_least(name, getattr(self, name), 0)
        require.within("decay", self.decay, 0, 1)
        require.choice("reduction", self.reduction, ("mean", "sum"))
        require.choice("loss", self.loss, ("smooth_l1", "cross_entropy"))
        if self.train_size is not None and self.train_size < self.batch_size:
            raise ValueError(
                f"train_size is {self.train_size}: a batch of {self.batch_size} different "
                "sequences does not fit in; give more, or a smaller batch_size"
            )

    @classmethod
    def as_written(cls, env: AbstractSequenceTask, network: AbstractNetwork, **overrides) -> Self:
        """The settings of section 3.4."""
        return cls(env, kaiming(network), **overrides)

    @classmethod
    def as_coded(cls, env: AbstractSequenceTask, network: AbstractNetwork, **overrides) -> Self:
        """The settings of the author's program for Sequence Classification: 1000 sequences drawn
        once, all in one update, their losses summed. (For Sequence Recall it drew 10,000.)"""
        return cls.as_written(env, network, **{"train_size": 1000, "reduction": "sum"} | overrides)

    @classmethod
    def ours(cls, env: AbstractSequenceTask, network: AbstractNetwork, **overrides) -> Self:
        """The best settings found for 200 generations (docs/notes/gradient.md has what was tried):
        50 updates on batches of 20 in place of one on 1000, no L2, a clipped gradient, a rate that
        falls (for longer runs `decay` nearer to 1). An MMU starts with its write gate closed."""
        if isinstance(network, MMU):
            network = replace(network, start_weights="closed")
        settings = {"batch_size": 20, "updates": 50, "l2": 0.0, "max_norm": 0.1}
        settings |= {"learning_rate": 0.02, "decay": 0.9998}
        return cls.as_written(env, network, **settings | overrides)

    @classmethod
    def presets(cls) -> dict[str, Callable[..., Self]]:
        """Settings by name, for the command line."""
        return {"as-written": cls.as_written, "as-coded": cls.as_coded, "ours": cls.ours}

    @float32()
    def init(self, *, key: PRNGKeyArray) -> BPTTState:
        """A fresh network."""
        network_key, examples_key = jax.random.split(key)
        champion = self.network.init(*self.env.sizes, key=network_key)
        return BPTTState(champion, adam_state(champion), jnp.int32(0), examples_key)

    @float32()
    def generation(self, state: BPTTState, *, key: PRNGKeyArray) -> tuple[BPTTState, Metrics]:
        """`updates` steps of Adam, and a test of the network on fresh sequences. With cross-entropy
        the metric `bits` is its sum over a sequence of the batches, on average, in bits."""
        learn_key, test_key = jax.random.split(key)
        state, losses, frames, questions = descend(self, state, key=learn_key)
        test = evaluate(self.env, tree.single(state.champion), self.test_episodes, key=test_key)
        metrics = {
            "loss": jnp.mean(losses),
            "champion_score": jnp.mean(test.of(self.env.reported)),
            "frames": jnp.sum(frames),
            "instances": jnp.int32(self.updates * self.batch_size),
            "updates": jnp.int32(self.updates),
        }
        if self.loss == "cross_entropy":
            summed = losses if self.reduction == "sum" else losses * questions
            metrics["bits"] = jnp.mean(summed) / (self.batch_size * math.log(2))
        return state, metrics

    def batch(self, examples: PRNGKeyArray, *, key: PRNGKeyArray) -> Sequence:
        """Sequences `[batch, time, ...]`: fresh ones, or different ones of the training set."""
        if self.train_size is None:
            keys = jax.random.split(key, self.batch_size)
        else:
            rows = jax.random.choice(key, self.train_size, (self.batch_size,), replace=False)
            keys = jax.vmap(lambda row: jax.random.fold_in(examples, row))(rows)
        return jax.vmap(lambda key: self.env.sample(key=key))(keys)


def kaiming(network: AbstractNetwork) -> Any:
    """The same network, its weights drawn Kaiming-normal (He et al. 2015), its biases 0."""
    known = "initializer" in {field.name for field in fields(network)}
    return replace(network, **{"initializer": "kaiming"} if known else {})


@jit
def descend(bptt: BPTT, state: BPTTState, *, key) -> tuple[BPTTState, Array, Array, Array]:
    """`updates` steps of Adam. **Returns:** the state; of each batch the loss, environment steps,
    and the weight of all questions, `[updates]`."""
    dynamic, static = eqx.partition(state, eqx.is_array)

    def update(dynamic, key):
        state = eqx.combine(dynamic, static)
        batch = bptt.batch(state.examples, key=key)
        loss, gradient = eqx.filter_value_and_grad(loss_of)(state.champion, bptt, batch)
        # L2 as torch has it: no decay beside Adam (AdamW), but part of what Adam normalises.
        weights = eqx.filter(state.champion, eqx.is_inexact_array)
        gradient = jax.tree.map(lambda g, w: g + bptt.l2 * w, gradient, weights)
        rate = bptt.learning_rate * bptt.decay ** state.done.astype(jnp.float32)
        champion, optimizer = adam(state.champion, gradient, state.optimizer, rate, bptt.max_norm)
        state = replace(state, champion=champion, optimizer=optimizer, done=state.done + 1)
        questions = jnp.sum(jax.vmap(bptt.env.lesson)(batch)[1])
        return eqx.filter(state, eqx.is_array), (loss, jnp.sum(batch.length), questions)

    keys = jax.random.split(key, bptt.updates)
    dynamic, (losses, frames, questions) = jax.lax.scan(update, dynamic, keys)
    return eqx.combine(dynamic, static), losses, frames, questions


def loss_of(policy: AbstractPolicy, bptt: BPTT, batch: Sequence) -> Float[Array, ""]:
    """Smooth L1 (Girshick 2015, equation 3), or cross-entropy, of the answers that were asked
    for."""
    targets, asked = jax.vmap(bptt.env.lesson)(batch)
    answers = respond(policy, batch.inputs, bptt.checkpoint)
    answers = answers if targets.ndim == answers.ndim else answers[..., 0]
    if bptt.loss == "cross_entropy":
        total = jnp.sum(asked * cross_entropy(answers, targets))
    else:
        total = jnp.sum(asked * optax.huber_loss(0.5 * (answers - targets)))
    return total if bptt.reduction == "sum" else total / jnp.sum(asked)


def respond(
    policy: AbstractPolicy, inputs: Float[Array, "batch time in"], checkpoint: int | None = None
) -> Float[Array, "batch time act"]:
    """The answers of one policy at every step, for gradients.

    Of the forward pass only carries are kept, one every `checkpoint` steps; what a step computes
    is computed again on the way back, which is faster than to store and to load it. In segments
    of √steps memory grows with √steps, for one more forward pass.
    """
    n, steps, _ = inputs.shape
    size = checkpoint or (1 if steps <= LONG else math.isqrt(steps - 1) + 1)
    each = jax.vmap(policy)

    def step(carry, x):
        action, carry = each(x, carry)
        return carry, action

    def segment(carry, xs):
        return jax.lax.scan(jax.checkpoint(step), carry, xs)

    keys = jax.random.split(jax.random.key(0), n)
    carry = jax.vmap(lambda key: policy.start(key=key))(keys)
    xs = jnp.moveaxis(inputs, 1, 0)
    if size == 1:
        return jnp.swapaxes(segment(carry, xs)[1], 0, 1)
    # Steps behind the end fill the last segment; their answers are not asked for.
    count = -(-steps // size)
    xs = jnp.pad(xs, ((0, count * size - steps), (0, 0), (0, 0)))
    xs = xs.reshape(count, size, *xs.shape[1:])
    answers = jax.lax.scan(jax.checkpoint(segment), carry, xs)[1]
    return jnp.swapaxes(answers.reshape(count * size, *answers.shape[2:])[:steps], 0, 1)
