"""Processes that play shares of episodes, and what one of them does."""

import abc
import dataclasses
import pickle
from collections.abc import Callable
from typing import Any, ClassVar

import jax

from ..compilation import enable_cache, float32
from ..environments import foreign, processes
from ..environments.host import EnvironmentFailure
from . import Part, Share, play

Answer = tuple[str, Any]
"""What came of a share: "outcome", and the outcomes of its slices with how their episodes ended; or
a word for what was raised, and what it said."""


@dataclasses.dataclass
class Batch:
    """What is played together: parts in arrays of NumPy, what must be known to open their task, and
    a share for each process."""

    parts: list[Part]
    told: Any
    shares: list[Share]


class AbstractCrew(abc.ABC):
    """Processes that hold nothing but what they were given last."""

    number: int
    """How many play at the same time."""
    tries: ClassVar[int]
    """How often a share is given out whose process dies."""
    instead: ClassVar[str]
    """Why what cannot be sent to them must not be played here; "" if it may."""

    @abc.abstractmethod
    def awake(self) -> bool:
        """Whether somebody is there to whom a lone share can be given at no cost."""

    @abc.abstractmethod
    def begin(self, batch: Batch) -> None:
        """Be ready for the shares of a batch."""

    @abc.abstractmethod
    def give(self, batch: Batch, k: int, spared: bool) -> None:
        """Have share `k` of a batch played. `spared`: the task must not end the process. Raises
        `pickle.PicklingError`, `AttributeError` or `TypeError` if it cannot be sent."""

    @abc.abstractmethod
    def take(self, k: int) -> Answer | None:
        """What came of share `k`; None if its process is dead."""

    def lost(self) -> str:
        """Why the last process that died did, in words; "" where that is not known."""
        return ""

    @abc.abstractmethod
    def close(self) -> None:
        """End what is under way."""


def enlist() -> None:
    """Make this process one that plays: on one core, and in one thread, for which a second would
    only have to be waited for at every step."""
    processes.settle()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    enable_cache()
    foreign.judged_elsewhere()


def answer(load: Callable[[], tuple[list[Part], Any]], spared: bool) -> Answer:
    """Play the slices that are loaded, of a task of which so much is told."""
    env: Any
    try:
        parts, told = load()
        env = parts[0].env
        foreign.know(env, told)
    except (ImportError, AttributeError, pickle.PicklingError) as error:
        # A class of the user's script, which this process did not run.
        return "unknown", f"{type(error).__name__}: {error}"
    try:
        foreign.spare(not spared)
        news = foreign.tally(env).news
        news.clear()
        with float32():
            return "outcome", (play(parts), news)
    except EnvironmentFailure as error:
        return "failure", str(error)
    except Exception as error:  # whoever asked reports it
        return "error", f"{type(error).__name__}: {error}"
