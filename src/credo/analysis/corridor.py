"""Baselines and upper bound of the passive T-maze, exact, in units of `success`."""

from ..environments.passive_tmaze import PassiveTMaze
from ..types import Bound


def baselines(env: PassiveTMaze) -> dict[str, float]:
    """Whoever walks and does not remember the sign sees the same at the junction, whichever side is
    right; a random policy walks all the way in one of 2^`length` episodes."""
    return {"walks without memory": 0.5, "random": 0.5 * 2.0**-env.length}


def upper_bound(env: PassiveTMaze) -> Bound:
    """Whoever remembers the sign is always right."""
    return Bound(1.0, "optimal")
