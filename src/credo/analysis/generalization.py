"""Generalization: finished policies on sequences unlike those of their training."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from ..compilation import jit
from ..environments.wrappers import Given
from ..rollout import evaluate
from . import counting


@jit
def success_with_gap(
    task: Any, policies: PyTree, gap: Array, *, key: Array, episodes: int
) -> Float[Array, " policies"]:
    """Strict success of a population of policies when every gap (or corridor) has the same length.

    `gap` is data, so that a sweep compiles once. `task`'s longest gap must be the longest of the
    sweep. All policies answer the same sequences (Figures 3.5a and 3.10).
    """

    def sequence(key):
        signals = jax.random.rademacher(key, (task.depth,), jnp.float32)
        return task.lay_out(signals, jnp.full(task.depth, gap))

    sequences = jax.vmap(sequence)(jax.random.split(key, episodes))
    played = evaluate(Given(task, sequences), policies, episodes, key=key)
    return jnp.mean(played.returns["success"], axis=1)


def first_mistakes(
    policies: PyTree, depth: int, sequences: int = 1000, batches: int = 50, *, key: Array
) -> Int[np.ndarray, "policies sequences"]:
    """Signals of sequence classification answered right before the first mistake, at most `depth`.

    An answer must be right at every signal: success at depth d is a first mistake after signal d
    (Figure 3.5b). Sequences of one batch share their distractors; so there are many batches.
    """
    parts = [
        np.asarray(counting.longest_correct(policies, depth, sequences // batches, key=key))
        for key in jax.random.split(key, batches)
    ]
    return np.concatenate(parts, axis=1)
