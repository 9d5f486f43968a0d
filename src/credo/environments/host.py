"""The contract of environments that live outside JAX: NumPy, a simulator, a worker process."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt32

from .base import AbstractTask


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
    spoiled: Bool[np.ndarray, " n"] | None = None
    """Whose episode the last `step` lost through no fault of its own, with the process of all: it
    can be played again. None: nobody's."""

    @abc.abstractmethod
    def reset(self, seeds: UInt32[np.ndarray, " n"], active: Bool[np.ndarray, " n"]) -> np.ndarray:
        """A fresh episode in every active copy; its seed decides all that is random in it.

        **Returns:** observations `[n, obs]`, of a team `[n, agents, obs]`, of the task's obs_dtype.
        """

    @abc.abstractmethod
    def step(
        self, actions: Float[np.ndarray, "n *agents act"], active: Bool[np.ndarray, " n"]
    ) -> HostStep:
        """One step of every active copy; the others cost nothing. Actions lie in [-1, 1]."""

    def failure_text(self, i: int) -> str:
        """Why the last episode of copy `i` that failed did."""
        return "unknown"


class InTurn(AbstractCopies):
    """`n` copies of which no more play at the same time than `inner` has."""

    def __init__(self, inner: AbstractCopies, n: int):
        self.inner, self.n = inner, n
        self._seats = np.zeros(0, np.int64)  # who plays
        self._whys: dict[int, str] = {}

    def reset(self, seeds: np.ndarray, active: np.ndarray) -> np.ndarray:
        """As for all copies, but whose episode is not over and who is not active loses it."""
        self._seats = lanes = np.flatnonzero(active)
        if lanes.size > self.inner.n:
            raise ValueError(
                f"{lanes.size} episodes were to begin at once: at_once allows {self.inner.n}, so "
                "play them in turn"
            )
        some = self._some(np.asarray(seeds, np.uint32))
        obs = self.inner.reset(some, np.arange(self.inner.n) < lanes.size)
        failed = self.inner.failed
        self.failed = None if failed is None else self._all(failed)
        self._keep(self.failed)
        return self._all(obs)

    def step(self, actions: np.ndarray, active: np.ndarray) -> HostStep:
        if not np.isin(np.flatnonzero(active), self._seats).all():
            raise ValueError("a step was asked of a copy that is not playing: reset it first")
        now = self.inner.step(self._some(actions), self._some(active))
        now = HostStep(**jax.tree.map(self._all, vars(now)))
        spoiled = self.inner.spoiled
        self.spoiled = None if spoiled is None else self._all(spoiled)
        self._keep(now.failed)
        return now

    def failure_text(self, i: int) -> str:
        """By the number of the copy, not of its seat."""
        return self._whys.get(i, "unknown")

    def _some(self, x: np.ndarray) -> np.ndarray:
        """What is said to those who play, in the order of their seats."""
        some = np.zeros((self.inner.n, *np.shape(x)[1:]), np.asarray(x).dtype)
        some[: self._seats.size] = np.asarray(x)[self._seats]
        return some

    def _all(self, x: np.ndarray) -> np.ndarray:
        """What those who play say, in rows of all copies; the others have zeros."""
        rows = np.zeros((self.n, *x.shape[1:]), x.dtype)
        rows[self._seats] = x[: self._seats.size]
        return rows

    def _keep(self, failed: np.ndarray | None) -> None:
        """Remember why copies failed, by their own numbers."""
        for seat, lane in enumerate(self._seats.tolist()):
            if failed is not None and failed[lane]:
                self._whys[lane] = self.inner.failure_text(seat)


def sound(env: Any, returns: Any) -> Any:
    """Of the returns of a test those that are numbers: of a task outside JAX, episodes that failed
    are left out, unless all did."""
    if not isinstance(env, AbstractHostEnvironment):
        return returns
    kept = np.isfinite(np.asarray(returns))
    return returns if kept.all() or not kept.any() else np.asarray(returns)[kept]


class AbstractHostEnvironment(AbstractTask):
    """A task outside JAX: a config compared by value, whose `copies` play it."""

    obs_dtype: ClassVar[str] = "float32"  # or "uint8"
    warnings: ClassVar[tuple[str, ...]] = ()  # what its users should know

    @property
    def at_once(self) -> int | None:
        """Most copies that play at the same time; None: all. A field of those that can choose."""
        return None

    def turns(self, active: Bool[np.ndarray, " n"]) -> list[Bool[np.ndarray, " n"]]:
        """Who of the active copies plays together, in order: all, or `at_once` at a time."""
        turn = (np.cumsum(active) - 1) // (self.at_once or active.size)
        return [active & (turn == k) for k in range(max(turn.max(), 0) + 1)]

    @property
    def reward_shapes(self) -> dict[str, tuple[int, ...]]:
        """Of each reward of one copy: () or, of one that is private to each agent, (agents,)."""
        return dict.fromkeys(self.signals, ())

    def task_record(self) -> dict[str, Any]:
        """What a run records of its task; `actions`: how the task itself takes an action, None
        for numbers in [-1, 1] as they are."""
        names = ("obs_size", "action_size", "agents", "choices", "masked")
        sizes = {name: getattr(self, name) for name in names}
        return {**sizes, "actions": None, "observations": None}

    @abc.abstractmethod
    def copies(self, n: int) -> AbstractCopies:
        """`n` copies, kept open for the life of this process: asking again returns the same."""


class Episodes:
    """One episode of each of `n` copies, as it is played: its length, its returns by reward and,
    of those that are to `record`, its transitions. Played in turn, each turn is `begin` and then
    `advance` while it is `ongoing`. Those that last longer than their `limit` are cut short.

    An episode is lost, with a return of NaN and no transitions, if it failed or if its policy said
    NaN or inf. `active`: whose episode is under way. `again`: after a turn, whose episode was lost
    with another's, and is to be played in a turn of its own.
    """

    def __init__(
        self,
        env: AbstractHostEnvironment,
        n: int,
        record: Bool[np.ndarray, " n"] | bool,
        limit: Int[np.ndarray, " n"] | None = None,
    ):
        self.ongoing, self.active, most = False, np.zeros(n, bool), env.max_steps
        self._limits = np.minimum(np.full(n, most) if limit is None else limit, most)
        self._least, self._most = int(self._limits.min()), int(self._limits.max())
        self.steps = np.zeros(n, np.int32)
        self._env, self._copies = env, env.copies(n)
        self._record = np.broadcast_to(record, n)
        self._records = bool(self._record.any())
        self._lost, self.again = np.zeros((2, n), bool)
        self._sums = {name: np.zeros((n, *shape)) for name, shape in env.reward_shapes.items()}
        self._turns: list[tuple[np.ndarray, tuple[Any, ...]]] = []

    def begin(self, seeds: UInt32[np.ndarray, " n"], turn: Bool[np.ndarray, " n"]) -> np.ndarray:
        """Start the episodes of a turn: their first observations, `[n, ...]`."""
        self._acting = None
        if self._env.agents is not None:
            self._acting = np.ones((turn.size, self._env.agents), bool)
        self._obs = self._copies.reset(seeds, turn)
        self.again = np.zeros(turn.size, bool)
        self.active = self._less(turn, self._copies.failed)
        self._rows, self._valid, self._done = [], [], 0
        self.ongoing = True
        return self._obs

    def advance(
        self,
        actions: Float[np.ndarray, "n *agents act"],
        memory: Float[np.ndarray, "n *agents memory"] | None = None,
    ) -> np.ndarray:
        """One step of the turn: the next observations. `memory`: what policies remembered before
        it, if that is to be recorded."""
        active, finite = self.active, np.isfinite(actions)
        if not finite.all():
            self._lost |= active & ~finite.reshape(active.size, -1).all(axis=1)
            actions = np.where(finite, actions, np.float32(0.0))
        now, everyone = self._copies.step(actions, active), active.all()
        for name, reward in now.rewards.items():
            if not everyone:
                lanes = active.reshape(-1, *[1] * (reward.ndim - 1))
                reward = np.where(lanes, reward, 0.0)
            self._sums[name] += reward
        self.steps += active
        self._done += 1
        over = now.truncated
        if self._least <= self._done < self._env.max_steps:
            over = over | ((self._limits <= self._done) & ~now.terminated)
        if self._records:
            ends = (now.ended, over, self._acting, memory)
            self._rows.append((self._obs, actions, now.rewards, now.obs, *ends))
            self._valid.append(active & self._record)
        if now.failed is not None and self._copies.spoiled is not None:
            self.again |= active & self._copies.spoiled
        active = self._less(active, now.failed)
        self.active = active & ~(now.terminated | over)
        self._obs, self._acting = now.obs, now.active
        self.ongoing = bool(self._done < self._most and self.active.any())
        if self._records and not self.ongoing:
            self._turns.append(self._kept())
        if not self.ongoing and self.again.any():
            self._lost &= ~self.again
            self.steps[self.again] = 0
            for total in self._sums.values():
                total[self.again] = 0.0
        return self._obs

    def _less(self, active: np.ndarray, failed: np.ndarray | None) -> np.ndarray:
        """Those whose episode goes on."""
        if failed is None:
            return active
        self._lost |= active & failed
        return active & ~failed

    def _kept(self) -> tuple[np.ndarray, tuple[Any, ...]]:
        """How many rows of a turn are of each copy; and the rows, episode by episode, as learners
        see them."""
        valid = np.stack(self._valid, axis=1) & ~self._lost[:, None]

        def kept(*steps: np.ndarray) -> np.ndarray:
            x = np.stack(steps, axis=1)[valid]
            return x.astype(np.float32) if x.dtype == np.float64 else x

        return valid.sum(axis=1), jax.tree.map(kept, *self._rows)

    def returns(self) -> dict[str, Float[np.ndarray, "n *agents"]]:
        """Sum of every reward in each episode; NaN of one that is lost."""
        for total in self._sums.values():
            total[self._lost] = np.nan
        return self._sums

    def rows(self, lanes: slice = slice(None)) -> tuple[Any, ...]:
        """The fields of a `Transition`, all episodes of some copies one behind the other, turn by
        turn."""
        turns = []
        for counts, rows in self._turns:
            before, mine = counts[: lanes.start or 0].sum(), counts[lanes].sum()
            turns.append(jax.tree.map(lambda x, a=before, n=mine: x[a : a + n], rows))
        return turns[0] if len(turns) == 1 else jax.tree.map(lambda *xs: np.concatenate(xs), *turns)
