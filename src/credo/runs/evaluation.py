"""What `credo evaluate` prints: a champion on fresh episodes."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from .. import tree
from ..analysis import counting, floors
from ..environments.host import AbstractHostEnvironment
from ..environments.sequence_classification import SequenceClassification
from ..rollout import evaluate
from ..types import Evaluation
from .loop import Run

EPISODES, HOST_EPISODES = 1000, 20  # a task outside JAX is slower by orders of magnitude
STREAMED = 1000  # deeper sequences are streamed: memory does not grow with their length


def in_turn(task: Any, policies: Any, episodes: int, *, key: PRNGKeyArray) -> Evaluation:
    """`evaluate`, outside JAX `HOST_EPISODES` at a time: each takes a simulator of its own."""
    if not issubclass(type(task), AbstractHostEnvironment) or episodes <= HOST_EPISODES:
        return evaluate(task, policies, episodes, key=key)
    turns = [
        evaluate(task, policies, HOST_EPISODES, key=jax.random.fold_in(key, i))
        for i in range(-(-episodes // HOST_EPISODES))
    ]
    return jax.tree.map(lambda *xs: jnp.concatenate(xs, axis=1)[:, :episodes], *turns)


def describe(run: Run, task: Any, episodes: int | None, seed: int) -> Iterator[str]:
    """Lines about the champion on `task`, which may differ from the one it was trained on.
    `episodes`: None for `EPISODES`, or `HOST_EPISODES` of a task outside JAX."""
    if episodes is None:
        host = issubclass(type(task), AbstractHostEnvironment)
        episodes = HOST_EPISODES if host else EPISODES
    policies = tree.stack(run.champion)
    key = jax.random.fold_in(jax.random.key(seed), 1_000_003)  # not a key of any training run
    streamed = isinstance(task, SequenceClassification) and task.persistence == 0.5
    if streamed and task.depth > STREAMED:
        streams = min(episodes, 20)
        lengths = counting.longest_correct(
            policies,
            task.depth,
            streams,
            min_gap=task.min_gap,
            max_gap=task.max_gap,
            ties=task.ties,
            key=key,
        )[0]
        yield f"{run.path}: {streams} streams of {task.depth:,} signals"
        yield f"  success          {np.mean(np.asarray(lengths) >= task.depth):.3f}"
        yield f"  signals right    median {int(np.median(lengths)):,}, worst {int(lengths.min()):,}"
        return
    evaluation = in_turn(task, policies, episodes, key=key)
    yield f"{run.path}: {episodes} fresh episodes"
    for name in task.signals:
        values = np.asarray(evaluation.returns[name][0], np.float64)
        error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
        yield f"  {name:<16} {values.mean():.4g} ± {error:.2g}"
    yield f"  steps            {np.mean(evaluation.steps):.1f}"
    if floors.known(task):
        name, value = floors.floor(task)
        yield f"  floor            {value:.3g} ({name}), ceiling {floors.CEILING:.3g}"
