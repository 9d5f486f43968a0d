"""When a run ends."""

import dataclasses
from typing import Any

import numpy as np

from ..learners.share import AbstractShare
from .options import RunOptions
from .record import RunError

DEFAULT = {"generations": 1000}


@dataclasses.dataclass(frozen=True)
class Budget:
    """A run ends after the first generation that reaches one of these. None: no such limit.

    Frames are environment steps of everything that plays; a team's joint step is one. Raises
    `ValueError` without a limit of generations or of frames.
    """

    generations: int | None = None
    frames: int | None = None  # environment steps of everything that played
    stop_at: float | None = None  # champion score

    def __post_init__(self):
        if self.generations is None and self.frames is None:
            raise ValueError("a run needs a budget: give generations, frames or both")

    @classmethod
    def of(cls, algorithm: Any, options: RunOptions, old: "Budget | None" = None) -> "Budget":
        """As the options say; or else `old`, that of a run which goes on, or the `default_budget`
        of the algorithm, an object or a class."""
        if options.generations is not None or options.frames is not None:
            return cls(options.generations, options.frames, options.stop_at)
        budget = old or cls(**getattr(algorithm, "default_budget", DEFAULT))
        if options.stop_at is None:
            return budget
        return dataclasses.replace(budget, stop_at=options.stop_at)

    def require_task(self, algorithm: Any) -> None:
        """Raise `ValueError` if a run ends within the generations of its Info-max, whose fitness is
        not that of the task."""
        infomax = getattr(algorithm, "infomax", None)
        if infomax is None or self.generations is None:
            return
        if self.generations <= (first := infomax.generations):
            raise ValueError(
                f"infomax.generations is {first} of a run of {self.generations}: networks evolve "
                f"for the task in what comes after; give {first + 1} generations or more, or "
                "fewer of infomax"
            )

    @property
    def stop_score(self) -> np.float32:
        """NaN without one: no comparison with it ever stops."""
        # The mean of 49 of 50 in float32 is a little less than 0.98.
        return np.float32(np.nan if self.stop_at is None else self.stop_at - 1e-6)

    def reached(self, generation: int, frames: int, score: float = -np.inf) -> str | None:
        """Which limit ends the run, in words; None as long as it goes on."""
        if self.frames is not None and frames >= self.frames:
            return f"{frames:,} of {self.frames:,} frames"
        if self.generations is not None and generation >= self.generations:
            return f"{generation} of {self.generations} generations"
        if score >= self.stop_score:
            return f"champion score {score:.4g} of {self.stop_at:.4g}"
        return None

    def done(self, generation: int, frames: int) -> str:
        """How far a run is, in the unit of its budget."""
        if self.frames is not None:
            return f"{short(frames)}/{short(self.frames)} frames"
        return f"generation {generation}/{self.generations}"

    def where(self, generation: int, frames: int) -> str:
        """Where a run stopped, for a message."""
        if self.generations is None:
            return f"generation {generation}, {frames:,} of {self.frames:,} frames,"
        return f"generation {generation} of {self.generations}"

    def share(self, generation: int, frames: int) -> float:
        """How far a run is, from 0 to 1."""
        shares = generation / (self.generations or np.inf), frames / (self.frames or np.inf)
        return min(1.0, max(shares))

    def refuse_smaller(self, old: "Budget", generation: int, frames: int, path: Any) -> None:
        """Raise `RunError` if this is no more than the run at `path` with the budget `old` was to
        do, or has done."""
        for name, done in (("generations", generation), ("frames", frames)):
            new, before, told = getattr(self, name), getattr(old, name), None
            if new is not None and before is not None and new < before:
                told = f"this run's budget is {before} {name}"
            elif new is not None and before is None and new < done:
                told = f"this run has done {done} {name}"
            if told is not None:
                raise RunError(f"{path}: {told}: a new budget must be larger, not {new}")


def fitted(algorithm: Any, budget: Budget) -> Any:
    """`limited` to a budget, and with a replay buffer that is no larger than what it can fill: as
    long as that never wraps, its capacity changes no bit. What is recorded stays the user's number;
    in use is the next power of two, so that budgets of about the same size are one program.

    It needs `most_frames`, an upper bound of the frames of one generation.
    """
    algorithm = limited(algorithm, budget)
    capacity = getattr(algorithm, "replay_capacity", None)
    most = getattr(algorithm, "most_frames", None)
    if capacity is None or most is None:
        return algorithm
    bounds = [capacity]
    if budget.generations is not None:
        bounds.append(budget.generations * most)
    if budget.frames is not None:
        bounds.append(budget.frames - 1 + most)  # the last generation begins before the limit
    rows = min(capacity, 1 << (max(1, min(bounds)) - 1).bit_length())
    return dataclasses.replace(algorithm, replay_capacity=rows)


def limited(algorithm: Any, budget: Budget) -> Any:
    """`algorithm` whose learners have their share of frames until the budget is spent: their rounds
    alone may be a sixth of it. What is recorded stays what the user said."""
    share = getattr(algorithm, "share", None)
    if not isinstance(share, AbstractShare) or budget.frames is None:
        return algorithm
    until = min(float(budget.frames), np.inf if share.until is None else share.until)
    share = dataclasses.replace(share, until=until)
    return dataclasses.replace(algorithm, share=share)


def short(number: float) -> str:
    """1234567 as `1.23M`."""
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if number >= size:
            return f"{number / size:.3g}{unit}"
    return f"{number:.3g}"
