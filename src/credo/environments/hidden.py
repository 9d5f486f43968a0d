"""Tasks of which a policy sees a part: what is hidden it must remember or work out.

Without velocities a physical task is the standard test of memory (Heess et al. 2015, "Memory-based
control with recurrent neural networks", section 4; Ni et al. 2022, "Recurrent model-free RL can be
a strong baseline for many POMDPs", table 1): two positions in a row say what one velocity did.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray, PyTree

from ..types import TimeStep
from .base import AbstractEnvironment, AbstractTask
from .host import AbstractCopies, AbstractHostEnvironment, HostStep
from .wrappers import AbstractHostWrapper, AbstractWrappedCopies, AbstractWrapper

VELOCITIES = {
    "Pendulum": (2,),
    "InvertedPendulum": (2, 3),
    "InvertedDoublePendulum": (5, 6, 7),
    "Hopper": tuple(range(5, 11)),
    "HalfCheetah": tuple(range(8, 17)),
    "Walker2d": tuple(range(8, 17)),
    "Swimmer": tuple(range(3, 8)),
    "Reacher": (6, 7),
    "MountainCarContinuous": (1,),
}
"""Entries of an observation that are velocities, of tasks of Gymnasium without their version."""


def hidden(env: AbstractEnvironment | AbstractHostEnvironment, entries: str | tuple[int, ...]):
    """A task without some entries of its observations, which are counted from 0; "velocities":
    without those that are velocities, where it is known which (`VELOCITIES`).

    **Raises:** `ValueError` if there are no such entries, or no others.
    """
    if isinstance(entries, str):
        entries = _velocities(env) if entries == "velocities" else _numbers(entries)
    entries = tuple(sorted(set(entries)))
    if isinstance(env, AbstractHostEnvironment):
        return HiddenHostEntries(env, entries)
    return HiddenEntries(env, entries)


def _velocities(env: AbstractTask) -> tuple[int, ...]:
    name = str(getattr(env.unwrapped, "id", type(env.unwrapped).__name__))
    short = name.partition("-v")[0]
    # A task that is made with settings of its own may tell more, or less.
    if short not in VELOCITIES or getattr(env.unwrapped, "kwargs", ()):
        raise ValueError(
            f"it is not known which observations of {name} are velocities: give their numbers, "
            f"counted from 0, as in 2,3; known are {', '.join(sorted(VELOCITIES))}, without "
            "settings of their own"
        )
    return VELOCITIES[short]


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise ValueError(
            f"hide is {text!r}: give numbers of entries, counted from 0, as in 2,3; or velocities"
        ) from None


class Hiding(eqx.Module):
    """What both kinds of task have in common."""

    env: eqx.AbstractVar[Any]
    entries: eqx.AbstractVar[tuple[int, ...]]

    def __check_init__(self):
        n = self.env.obs_size
        if not self.entries or not 0 <= min(self.entries) <= max(self.entries) < n:
            raise ValueError(f"hides entries {self.entries}: there are 0 … {n - 1}")
        if min(self.entries) < self.env.barrable:
            raise ValueError(
                f"hides entries {self.entries}: the first {self.env.barrable} say which actions "
                "are allowed, and a policy has to know"
            )
        if len(self.entries) == n:
            raise ValueError(f"hides all {n} entries of an observation: leave one or more")

    @property
    def image(self) -> None:
        """None: of an image some entries may be hidden."""

    @property
    def kept(self) -> np.ndarray:
        """Entries that are told."""
        return np.setdiff1d(np.arange(self.env.obs_size), self.entries)

    @property
    def obs_size(self) -> int:
        return self.env.obs_size - len(self.entries)

    @property
    def obs_range(self) -> tuple[Any, Any]:
        low, high = self.env.obs_range
        return (low[self.kept] if np.ndim(low) else low, high[self.kept] if np.ndim(high) else high)


class HiddenEntries(Hiding, AbstractWrapper):
    """A task in JAX without these entries of its observations."""

    env: AbstractEnvironment  # the task of which a part is hidden
    entries: tuple[int, ...] = eqx.field(static=True)  # counted from 0, in order

    def reset(self, *, key: PRNGKeyArray) -> tuple[PyTree, TimeStep]:
        state, first = self.env.reset(key=key)
        return state, dataclasses.replace(first, obs=first.obs[..., self.kept])

    def step(self, state: PyTree, action: Array, *, key: PRNGKeyArray) -> tuple[PyTree, TimeStep]:
        state, now = self.env.step(state, action, key=key)
        return state, dataclasses.replace(now, obs=jnp.asarray(now.obs)[..., self.kept])


class HiddenHostEntries(Hiding, AbstractHostWrapper):
    """The same outside JAX."""

    env: AbstractHostEnvironment  # the task of which a part is hidden
    entries: tuple[int, ...] = eqx.field(static=True)  # counted from 0, in order

    def task_record(self) -> dict[str, Any]:
        other = {"obs_size": self.obs_size, "observations": None, "shown": None}
        return self.env.task_record() | other

    def around(self, inner: AbstractCopies) -> "HiddenCopies":
        return HiddenCopies(inner, self.kept)


class HiddenCopies(AbstractWrappedCopies):
    """Copies whose observations are told in part."""

    def __init__(self, inner: AbstractCopies, kept: np.ndarray):
        self.inner, self.n, self._kept = inner, inner.n, kept

    def reset(self, seeds: np.ndarray, active: np.ndarray) -> np.ndarray:
        return self.inner.reset(seeds, active)[..., self._kept]

    def step(self, actions: np.ndarray, active: np.ndarray) -> HostStep:
        now = self.inner.step(actions, active)
        return dataclasses.replace(now, obs=now.obs[..., self._kept])
