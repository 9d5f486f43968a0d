"""What adapters of other people's JAX environments have in common.

Their automatic resets are not used: an episode ends where it ends, and `terminated` and `truncated`
are told apart.
"""

import abc
import contextlib
import io
import math
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from .. import require
from .base import AbstractEnvironment

MOST_STEPS = 1000  # of an episode, where neither the environment nor its user names a limit


@contextlib.contextmanager
def permissive() -> Iterator[None]:
    """Others' code relies on dtypes and ranks that JAX may be told to refuse, and what it or its
    packages deprecate is no concern here."""
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


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Others' packages, some of which print what else they could not find. JaxMARL also sets both
    streams to those that the process began with."""
    streams = {name: getattr(sys, name) for name in ("stdout", "stderr", "__stdout__")}
    sys.stdout = sys.__stdout__ = io.StringIO()  # pyright: ignore[reportAttributeAccessIssue]
    try:
        with permissive():
            yield
    finally:
        for name, stream in streams.items():
            setattr(sys, name, stream)


def pairs(settings: Any) -> tuple[tuple[str, Any], ...]:
    """Settings by name in one order, that can be hashed; lists in them become tuples."""
    return tuple((name, _frozen(x)) for name, x in sorted(dict(settings).items()))


def _frozen(x: Any) -> Any:
    return tuple(map(_frozen, x)) if isinstance(x, list) else x


def like(new: PyTree, old: PyTree) -> PyTree:
    """A tree of numbers and random keys as arrays of the dtypes of another one."""

    def cast(x: Any, y: Any) -> Any:
        dtype = jnp.asarray(y).dtype
        return x if jnp.issubdtype(dtype, jax.dtypes.prng_key) else jnp.asarray(x, dtype)

    return jax.tree.map(cast, new, old)


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


def image_in(tree: PyTree) -> tuple[int, int, int, int] | None:
    """Of what `flat` puts one after the other the first part with three axes: where it begins, and
    its height, width and channels. None: there is none."""
    start = 0
    for part in jax.tree.leaves(tree):
        if len(part.shape) == 3:
            height, width, channels = map(int, part.shape)
            return start, height, width, channels
        start += math.prod(part.shape)
    return None


class Form(NamedTuple):
    """What all episodes of an environment have in common."""

    obs_size: int  # of the largest observation, without a mask
    action_size: int
    choices: tuple[int, ...] = ()
    masked: bool = False
    max_steps: int = MOST_STEPS
    image: tuple[int, int, int, int] | None = None  # as `image_in`, without a mask


class AbstractOther(AbstractEnvironment):
    """A task of another package in JAX, by its name there.

    Of discrete actions the largest number is taken, of those that are allowed. Where not all are,
    every observation begins with a mask of them, 1 for what is allowed and 0 else.
    """

    id: str = eqx.field(static=True)  # as its package names it
    kwargs: tuple[tuple[str, Any], ...] = eqx.field(static=True, converter=pairs, default=())
    """Settings of the environment by name; others stay."""
    max_episode_steps: int | None = eqx.field(static=True, default=None)
    """A limit below the environment's own, at least 1; None: that one, or 1,000 without one."""

    def __check_init__(self):
        require.at_least("max_episode_steps", self.max_episode_steps, 1)

    @property
    @abc.abstractmethod
    def _made(self) -> Any:
        """The environment, with its `form`. `ValueError` where it cannot be made."""

    @property
    def form(self) -> Form:
        return self._made.form

    @property
    def choices(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.form.choices

    @property
    def masked(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.form.masked

    @property
    def obs_size(self) -> int:
        return self.form.obs_size + self.barrable

    @property
    def image(self) -> tuple[int, int, int, int] | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        if self.form.image is None:
            return None
        start, height, width, channels = self.form.image
        return start + self.barrable, height, width, channels

    @property
    def action_size(self) -> int:
        return self.form.action_size

    @property
    def max_steps(self) -> int:
        return min(self.max_episode_steps or self.form.max_steps, self.form.max_steps)
