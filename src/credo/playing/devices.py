"""Several devices of one machine: members of a population that play in JAX are shared out among
them.

A mesh of devices is what `using` puts into JAX's own context, so that every program knows it and is
compiled for it. Within, a function decorated by `shared` runs on each device for some members, in a
loop of its own; everything else of a program runs on all of them alike, on copies of the same
arrays, so that no sum is added up in another order.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from jaxtyping import PyTree

from .. import tree
from ..environments.host import AbstractHostEnvironment

AXIS = "members"
LEAST = 2  # members of a device: one alone is another program, which may differ in the last bit
ALIKE = PartitionSpec()  # the same on every device


def require(number: int | None, task: Any) -> None:
    """Raise `ValueError` unless JAX has so many devices, and the task is one that they can play."""
    if number is None or number == 1:
        return
    if isinstance(task, AbstractHostEnvironment):
        raise ValueError(
            f"devices is {number}, and {type(task).__name__} does not run in JAX: its episodes are "
            "shared out among processes (--processes)"
        )
    found = jax.local_devices()
    if number > len(found):
        kind = found[0].platform
        advice = f"give at most {len(found)}"
        if kind == "cpu":
            flag = f"XLA_FLAGS=--xla_force_host_platform_device_count={number}"
            advice = f"install credo[cuda] for GPUs; {flag} divides the CPU, to try it"
        raise ValueError(f"devices is {number}, and JAX has {len(found)} ({kind}): {advice}")


@contextlib.contextmanager
def using(number: int | None) -> Iterator[None]:
    """In here this thread plays on so many devices (`require`); None or 1: on the default one."""
    if number is None or number == 1:
        yield
        return
    own = jax.local_devices()[:number]
    with jax.set_mesh(jax.make_mesh((number,), (AXIS,), (AxisType.Auto,), devices=own)):
        yield


def everywhere(state: PyTree) -> PyTree:
    """The arrays of `state`, of JAX or NumPy, on every device of the mesh in use, if there is one.
    Where they lie is a part of what a program is compiled for."""
    found = jax.sharding.get_mesh()
    if AXIS not in found.axis_names:
        return state
    kinds = (jax.Array, np.ndarray, np.generic)
    arrays, rest = eqx.partition(state, lambda x: isinstance(x, kinds))
    return eqx.combine(jax.device_put(arrays, NamedSharding(found, ALIKE)), rest)


def shared(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """`function(task, members, ...)`, for some members on each device of the mesh in use.

    **Arguments:** `members`: leaves `[members, ...]`, or `[1, ...]` for what all have in common;
    the first is one of each member. Every leaf of the result has a first axis that is a multiple of
    `members`, member by member.
    """

    @functools.wraps(function)
    def call(task: Any, members: PyTree, *how: Any) -> PyTree:
        # Inside of one that is shared out already the axis is no longer this one's to divide.
        found = jax.sharding.get_abstract_mesh()
        if AXIS not in found.auto_axes or tree.size(members) <= LEAST:
            return function(task, members, *how)
        return _shared(function, found.shape[AXIS], task, members, how)

    return call


def _shared(function, devices: int, task: Any, members: PyTree, how: tuple[Any, ...]) -> PyTree:
    n = tree.size(members)
    each = max(math.ceil(n / devices), LEAST)
    index = np.minimum(np.arange(devices * each), n - 1)  # the last one again fills the rest
    (mine, ours), rest = eqx.partition((members, (task, how)), eqx.is_array)
    mine = jax.tree.map(lambda x: x[index] if len(x) == n else x, _alike(mine))
    specs = jax.tree.map(lambda x: PartitionSpec(AXIS) if len(x) > 1 else ALIKE, mine)

    def part(mine, ours):
        members, (task, how) = eqx.combine((mine, ours), rest)
        return function(task, members, *how)

    # A loop's first values are the same everywhere and its last ones are not, hence no `check_vma`.
    out = {"out_specs": PartitionSpec(AXIS), "check_vma": False}
    done = _alike(jax.shard_map(part, in_specs=(specs, ALIKE), **out)(mine, ours))
    return jax.tree.map(lambda x: x[: len(x) // len(index) * n], done)


def _alike(arrays: PyTree) -> PyTree:
    """The same arrays on all devices, whole: nothing before or behind is divided too, so that sums
    are added up in the same order."""
    return jax.tree.map(lambda x: jax.lax.with_sharding_constraint(x, ALIKE), arrays)
