"""Baselines and upper bounds: what a result on one of Credo's tasks is worth.

A success rate of .3 means nothing beside 0 and 1: remembering one signal solves a third of 21-deep
Sequence Classification where ties are free. Both are in units of the reward that the task reports
(of rovers, of the global reward). How they are found stands in the module of each task:

| task | module | found by |
|---|---|---|
| Sequence Classification, Sequence Recall | `sequences` | counting, exact |
| Extended T-Maze | `tmaze` | counting, exact |
| passive and endless T-maze, Distracted Cue | `corridor` | exact |
| server fleet | `fleet` | 1,000 episodes of scripted fleets and of an oracle |
| rovers | `planner` | scripted teams in 50 worlds, and a bound that is proven for each |
"""

from types import ModuleType

from ..environments.distracted_cue import DistractedCue
from ..environments.endless_tmaze import EndlessTMaze
from ..environments.extended_tmaze import ExtendedTMaze
from ..environments.passive_tmaze import PassiveTMaze
from ..environments.rover import Rover
from ..environments.sequence_classification import SequenceClassification
from ..environments.sequence_recall import SequenceRecall
from ..environments.server_fleet import ServerFleet
from ..types import Bound
from . import corridor, fleet, planner, sequences, tmaze

EXACT: dict[type, ModuleType] = {
    SequenceClassification: sequences,
    SequenceRecall: sequences,
    ExtendedTMaze: tmaze,
    PassiveTMaze: corridor,
    EndlessTMaze: corridor,
    DistractedCue: corridor,
}
"""Tasks whose numbers are counted, in seconds at most; those of the others are played."""

DEEPEST = 5  # T-maze that is counted in seconds

PLAYED: dict[type, ModuleType] = {ServerFleet: fleet, Rover: planner}


def exact(env: object) -> bool:
    """Whether baselines and upper bound of this task are known, and counted exactly."""
    if type(env) not in EXACT:  # what derives from one may pay other rewards
        return False
    if isinstance(env, SequenceClassification):
        return env.persistence == 0.5  # the count is over equally likely sequences
    if isinstance(env, ExtendedTMaze):
        return env.depth <= DEEPEST and (env.robots == 1 or env.partner is None)
    return True


def baselines(env: object) -> dict[str, float]:
    """Mean returns of random, constant and scripted policies, by name; none of them learns.

    **Raises:** `TypeError` if none are known for such a task, `ValueError` if none are for these
    settings of it.
    """
    return _of(env).baselines(env)


def upper_bound(env: object) -> Bound:
    """The mean return that no policy exceeds. Raises `TypeError` as `baselines` does."""
    return _of(env).upper_bound(env)


def best_baseline(env: object) -> tuple[str, float]:
    """The best of `baselines`: its name and its mean return."""
    found = baselines(env)
    name = max(found, key=lambda name: found[name])
    return name, found[name]


def _of(env: object) -> ModuleType:
    modules = EXACT | PLAYED
    if type(env) not in modules:
        raise TypeError(
            f"no baselines are known for {type(env).__name__}: "
            f"give a {', '.join(cls.__name__ for cls in modules)}"
        )
    return modules[type(env)]
