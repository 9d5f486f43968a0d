"""Whether what was learned is still made of numbers."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import keystr, tree_flatten_with_path
from jaxtyping import Array, Bool, PyTree

from ..compilation import jit

# Parts of a state that are weights of networks that learn, with their optimisers. A population is
# not among them: a genome that mutation broke is not chosen, and what was chosen is the champion.
PARTS = ("champion", "learner", "learners", "actor", "critic", "optimizer")


def broken(state: PyTree) -> str | None:
    """The weights that are not finite, in words; None if all are. Metrics may be NaN, weights
    not. One program for each structure of a state, and one transfer from the device."""
    kept = {part: getattr(state, part) for part in PARTS if hasattr(state, part)}
    kept = eqx.filter(kept, eqx.is_inexact_array)
    sound = np.asarray(_finite(kept))
    if sound.all():
        return None
    names = [path for path, _ in tree_flatten_with_path(kept)[0]]
    told = list(dict.fromkeys(_words(names[i]) for i in np.flatnonzero(~sound)))
    more = f" and {len(told) - 3} more" if len(told) > 3 else ""
    return ", ".join(told[:3]) + more


@jit
def _finite(tree: PyTree) -> Bool[Array, " leaves"]:
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)])


def _words(path: tuple[Any, ...]) -> str:
    """`learners[0].actor.weights['W_0']` as "the actor of learner 0"."""
    part, *rest = [keystr((key,)).strip("[].'") for key in path]
    if part == "learners":
        part, rest = f"learner {rest[0]}", rest[1:]
    elif part == "learner":
        part = "the learner"
    else:
        return f"the {part}"
    return f"the {rest[0].replace('_', ' ')} of {part}" if rest else part
