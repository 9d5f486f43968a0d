"""The contract of environments that live outside JAX: NumPy, a simulator, a worker process."""

import abc
import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt32


class EnvironmentFailure(RuntimeError):
    """An environment raised, ended its process, hung, or returned what it must not.

    The message names the environment, the copy, the step and the seed, and says what to do.
    """


class UnfitEnvironment(EnvironmentFailure, ValueError):
    """What was named cannot be opened as a task: id, kwargs, spaces or time limit do not fit."""


def failure_of(play: Callable[[], Any]) -> EnvironmentFailure | None:
    """How an environment fails while it is played, for checks that list what is wrong."""
    try:
        play()
    except EnvironmentFailure as failure:
        return failure
    return None


@dataclasses.dataclass
class HostStep:
    """What `n` copies say after one step, in arrays of its own that no later step writes to. Rows
    of copies that were not active are finite and mean nothing.

    For a team, observations and private rewards have an axis of agents, and `active` says who acts
    at the next step. An agent that leaves has its last reward and observation in that very step;
    while it is away both are 0.

    In a copy that `failed` the episode broke in this step: it is over, and worth nothing.
    """

    obs: Shaped[np.ndarray, "n *agents obs"]  # float32, or uint8 if the task's obs_dtype says so
    rewards: dict[str, Float[np.ndarray, "n *agents"]]
    terminated: Bool[np.ndarray, " n"]  # the task ended: do not bootstrap
    truncated: Bool[np.ndarray, " n"]  # the clock ran out: do bootstrap
    active: Bool[np.ndarray, "n agents"] | None = None
    failed: Bool[np.ndarray, " n"] | None = None  # None: no copy did
    gone: Bool[np.ndarray, "n agents"] | None = None  # this agent itself terminated in this step

    @property
    def ended(self) -> Bool[np.ndarray, "n *agents"]:
        """For whom the task ended: do not bootstrap. Of a team by agent."""
        if self.active is None:
            return self.terminated
        ended = np.repeat(self.terminated[:, None], self.active.shape[1], axis=1)
        return ended if self.gone is None else ended | self.gone


class AbstractCopies(abc.ABC):
    """`n` copies of one environment, stepped together."""

    n: int
    failed: Bool[np.ndarray, " n"] | None = None
    """Which active copies the last `reset` found broken: they have no episode. None: none."""

    @abc.abstractmethod
    def reset(self, seeds: UInt32[np.ndarray, " n"], active: Bool[np.ndarray, " n"]) -> np.ndarray:
        """A fresh episode in every active copy; its seed decides all that is random in it.

        **Returns:** observations `[n, obs]`, of a team `[n, agents, obs]`, float32.
        """

    @abc.abstractmethod
    def step(
        self, actions: Float[np.ndarray, "n *agents act"], active: Bool[np.ndarray, " n"]
    ) -> HostStep:
        """One step of every active copy; the others cost nothing. Actions lie in [-1, 1]."""

    def failure_text(self, i: int) -> str:
        """Why the last episode of copy `i` that failed did."""
        return "unknown"


class AbstractHostEnvironment(eqx.Module):
    """A task outside JAX: a config compared by value, whose `copies` play it."""

    if TYPE_CHECKING:  # a type checker would take an AbstractVar for a field
        obs_size: ClassVar[int]
        action_size: ClassVar[int]
        max_steps: ClassVar[int]
        signals: ClassVar[tuple[str, ...]]
    else:
        obs_size: eqx.AbstractVar[int]
        action_size: eqx.AbstractVar[int]
        max_steps: eqx.AbstractVar[int]  # no episode is longer
        signals: eqx.AbstractVar[tuple[str, ...]]  # names of the rewards, as in a JAX task
    agents: ClassVar[int | None] = None
    discrete: ClassVar[bool] = False  # the largest of an action's entries is taken
    obs_dtype: ClassVar[str] = "float32"  # or "uint8"
    if TYPE_CHECKING:
        obs_range: ClassVar[tuple[Any, Any]]
    else:
        obs_range = (-np.inf, np.inf)  # the least and the largest of the observed numbers
    warnings: ClassVar[tuple[str, ...]] = ()  # what its users should know
    at_once: ClassVar[int | None] = None  # most copies that play at the same time; None: all

    def turns(self, active: Bool[np.ndarray, " n"]) -> list[Bool[np.ndarray, " n"]]:
        """Who of the active copies plays together, in order: all, or `at_once` at a time."""
        turn = (np.cumsum(active) - 1) // (self.at_once or active.size)
        return [active & (turn == k) for k in range(max(turn.max(), 0) + 1)]

    @property
    def reported(self) -> str:
        """The reward signal by which a champion is judged."""
        return self.signals[-1]

    @property
    def sizes(self) -> tuple[int, ...]:
        """As of a JAX task: numbers in an observation and in an action, of a team the agents."""
        team = () if self.agents is None else (self.agents,)
        return self.obs_size, self.action_size, *team

    @property
    def reward_shapes(self) -> dict[str, tuple[int, ...]]:
        """Of each reward of one copy: () or, of one that is private to each agent, (agents,)."""
        return dict.fromkeys(self.signals, ())

    def task_record(self) -> dict[str, Any]:
        """What a run records of its task; `actions`: how the task itself takes an action, None
        for numbers in [-1, 1] as they are."""
        agents = {"agents": self.agents, "discrete": self.discrete}
        sizes = {"obs_size": self.obs_size, "action_size": self.action_size}
        return {**sizes, **agents, "actions": None, "observations": None}

    @abc.abstractmethod
    def copies(self, n: int) -> AbstractCopies:
        """`n` copies, kept open for the life of this process: asking again returns the same."""
