"""Two questions to any policy with memory: how long does it last, and which of its cells count?

Both play fresh episodes and read the reward by which the task judges a champion, with no more
training. What a cell counts for is found as Khadka (2019), section 3.2.3, did (Table 3.1): by
holding it at zero.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from .. import tree
from ..environments.base import AbstractEnvironment
from ..networks.base import AbstractPolicy
from ..rollout import evaluate
from .memory import Masked, known_memory

TIMES = (1, 2, 5, 10)
"""How many times as long as in training, unless said otherwise."""


class Reach(NamedTuple):
    """What policies score where memory has to last longer."""

    times: int  # as long as in training
    changed: str  # the settings of the task that say so
    scores: Float[np.ndarray, "policies episodes"]


def reach(
    task: Any,
    policies: Any,
    times: Sequence[int] = TIMES,
    episodes: int = 100,
    *,
    key: PRNGKeyArray,
) -> list[Reach]:
    """The horizon curve: scores against the time for which something has to be remembered.

    **Arguments:** `policies`: a population; `times`: how many times as long as in `task`, each at
    least 1, all with the same `key`.

    **Raises:** `ValueError` if the task has no setting for it.
    """
    found = []
    for n in times:
        longer = task.longer(n)
        if longer is None:
            name = getattr(task, "id", type(task.unwrapped).__name__)
            raise ValueError(
                f"{name} has no setting that says for how long something has to be remembered; "
                "T-mazes and sequence tasks have one, and a task of your own by a method "
                "longer(times)"
            )
        played = evaluate(longer, policies, episodes, key=key).returns[task.reported]
        scores = np.asarray(played, np.float64).reshape(*played.shape[:2], -1).mean(axis=2)
        found.append(Reach(n, changed(task.longer(1), longer), scores))
    return found


def changed(task: Any, longer: Any) -> str:
    """The settings that differ, of the task itself, such as `length 200`; where none does, those
    that would."""
    one, other = task.unwrapped, longer.unwrapped
    two = one.longer(2)
    fields = [f.name for f in dataclasses.fields(one)]
    names = [name for name in fields if repr(getattr(one, name)) != repr(getattr(two, name))]
    values = [getattr(other, name) for name in names]
    told = [f"{x:,}" if isinstance(x, int | float) else str(x) for x in values]
    return ", ".join(map(" ".join, zip(names, told, strict=True)))


class Worth(NamedTuple):
    """What the cells of a memory are worth, in the score of the task."""

    score: float  # with all of them
    without: Float[np.ndarray, " cells"]  # with one of them held at zero
    alone: Float[np.ndarray, " cells"]  # with all others held at zero
    nothing: float  # with all of them held at zero


def worth_of_cells(
    task: AbstractEnvironment, policy: AbstractPolicy, episodes: int = 20, *, key: PRNGKeyArray
) -> Worth | None:
    """Scores with each cell of the memory held at zero, with all others held there, and with all of
    them; every time in the same episodes. Of a team the same cell of all its agents.

    What several cells hold together is in none of them: then it costs nothing to be without any
    one, and `alone` says more. None: no memory is known in this policy.
    """
    memory = known_memory(policy.start(key=jax.random.key(0)))
    if memory is None or memory.ndim not in (1, 2) or not memory.size:
        return None
    cells = memory.shape[-1]
    one, every = np.eye(cells, dtype=bool), np.ones((1, cells), bool)
    keep = jnp.asarray(np.concatenate([every, ~one, one, ~every]))
    copies = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (len(keep), *x.shape[1:])), tree.single(policy)
    )
    masked = Masked(copies, keep, jnp.zeros((len(keep), cells), memory.dtype))
    played = evaluate(task, masked, episodes, key=key).returns[task.reported]
    scores = np.asarray(played, np.float64).reshape(len(keep), -1).mean(axis=1)
    without, alone = scores[1 : cells + 1], scores[cells + 1 : -1]
    return Worth(float(scores[0]), without, alone, float(scores[-1]))
