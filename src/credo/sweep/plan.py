"""How a sweep searches. Declared here and nowhere else: the table `[sweep]` of its file, and flags.

Nothing here imports JAX or Optuna.
"""

import dataclasses
from typing import Literal

from .. import require


@dataclasses.dataclass(frozen=True)
class Plan:
    """How a sweep searches. All of it but `trials` is settled with the first trial.

    Raises `ValueError` for a value outside its range.
    """

    trials: int = 20
    """Trials in all, at least 1: each is one drawing of the ranges. A sweep goes on with more."""

    seeds: int = 3
    """Runs of each trial, at least 1, with seeds that are the same in all trials: the file's
    `seed`, 0 by default, and those after it."""

    sampler: Literal["tpe", "random"] = "tpe"
    """What draws trials: tpe, tree-structured Parzen estimators, which learn from the trials
    before; random, which does not."""

    startup: int = 10
    """Trials, the first, that tpe draws at random and that are never pruned, at least 1."""

    prune: bool = True
    """Give up a trial after its first seed, its second and so on, if its value so far is worse than
    the median of the trials before it with as many seeds."""

    direction: Literal["maximize", "minimize"] = "maximize"
    """Whether a larger value is better, or a smaller one."""

    metric: str = "champion_score"
    """Column of a run's metrics.csv that is its score, such as champion_score, the test of the
    champion on fresh episodes. A trial's value is the interquartile mean over its seeds."""

    last: float = 0.1
    """Share of a run's generations, the last, whose mean is its score, above 0 and at most 1; one
    generation at least."""

    together: int = 4
    """Trials of a round, at least 1. They are drawn together and know nothing of one another's
    results, so it says how many can be trained at the same time; results depend on it, and not on
    the number of processes."""

    seed: int = 0
    """Seed of the sampler, 0 to 2^32 - 1. Seeds of runs are another matter (see `seeds`)."""

    def __post_init__(self):
        require.literals(self)
        for name in ("trials", "seeds", "startup", "together"):
            require.at_least(name, getattr(self, name), 1)
        require.within("seed", self.seed, 0, 2**32 - 1)
        if not 0 < self.last <= 1:
            raise ValueError(f"last is {self.last}: it must be above 0 and at most 1")
        if not self.metric:
            raise ValueError("metric is '': name a column of metrics.csv, such as champion_score")

    def better(self, a: float, b: float) -> bool:
        """Whether the value `a` is better than `b`."""
        return a > b if self.direction == "maximize" else a < b

    def round_of(self, number: int) -> range:
        """The trials, by number, that are drawn together with this one."""
        first = number - number % self.together
        return range(first, min(first + self.together, self.trials))
