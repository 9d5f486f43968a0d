"""What adapters of other people's JAX environments have in common."""

import contextlib
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

MOST_STEPS = 1000  # of an episode, where neither the environment nor its user names a limit


@contextlib.contextmanager
def permissive() -> Iterator[None]:
    """Others' code relies on dtypes and ranks that JAX may be told to refuse, and what it or its
    packages deprecate concerns nobody here."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(jax.numpy_dtype_promotion("standard"))
        stack.enter_context(jax.numpy_rank_promotion("allow"))
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")
        yield


@contextlib.contextmanager
def making() -> Iterator[None]:
    """Others' constructors: their constants are computed now, also where a program that needs them
    is being traced."""
    with permissive(), jax.ensure_compile_time_eval():
        yield


def pairs(settings: Any) -> tuple[tuple[str, Any], ...]:
    """Settings by name in one order, that can be hashed; lists in them become tuples."""
    return tuple((name, _frozen(x)) for name, x in sorted(dict(settings).items()))


def _frozen(x: Any) -> Any:
    return tuple(map(_frozen, x)) if isinstance(x, list) else x


def like(new: PyTree, old: PyTree) -> PyTree:
    """A tree of numbers as arrays of the dtypes of another one."""
    return jax.tree.map(lambda x, y: jnp.asarray(x, jnp.asarray(y).dtype), new, old)


def flat(x: PyTree) -> Float[Array, " n"]:
    """All numbers of a tree, one after the other."""
    return jnp.concatenate([jnp.ravel(part).astype(jnp.float32) for part in jax.tree.leaves(x)])


def scaled(action: Float[Array, " act"], low: Any, high: Any, shape: tuple[int, ...]) -> Array:
    """An action in [-1, 1] as that of a Box, of which -1 is the low and 1 the high."""
    low, high = (np.broadcast_to(np.asarray(x, np.float32), shape) for x in (low, high))
    return low + (action.reshape(shape) + 1.0) / 2.0 * (high - low)


def chosen(
    action: Float[Array, " act"], choices: Sequence[int], allowed: Bool[Array, " options"] | None
) -> Int[Array, " choices"]:
    """Of every choice the option with the largest number, of those that are `allowed`; None: all.
    The first option where none is allowed."""
    options = action[: sum(choices)]
    if allowed is not None:
        options = jnp.where(allowed, options, -jnp.inf)
    ends = np.cumsum(choices)
    parts = [options[end - n : end] for n, end in zip(choices, ends, strict=True)]
    return jnp.stack([jnp.argmax(part) for part in parts])
