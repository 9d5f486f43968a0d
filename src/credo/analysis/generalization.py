"""Generalization: finished policies on sequences unlike those of their training."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..compilation import jit
from ..rollout import play_sequences


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
    sequences = jax.tree.map(lambda x: x[None], sequences)
    return jnp.mean(play_sequences(task, policies, sequences).returns["success"], axis=1)
