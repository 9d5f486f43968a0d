"""Baselines and upper bounds of tasks in which one thing is remembered at a time, exact, in units
of `success`."""

from ..environments.distracted_cue import DistractedCue
from ..environments.endless_tmaze import EndlessTMaze
from ..environments.passive_tmaze import PassiveTMaze
from ..types import Bound


def baselines(env: PassiveTMaze | EndlessTMaze | DistractedCue) -> dict[str, float]:
    """Whoever does not remember the sign sees the same when it is asked for, whichever answer is
    right. In a passive T-maze a random policy walks all the way in one of 2^`length` episodes; in
    an endless one whoever remembers its first sign for ever is right once, and then by chance."""
    if isinstance(env, DistractedCue):
        return {"constant": 0.5}
    if isinstance(env, EndlessTMaze):
        n = env.corridors
        return {"walks without memory": 0.5**n, "remembers the first sign": 0.5 ** (n - 1)}
    return {"walks without memory": 0.5, "random": 0.5 * 2.0**-env.length}


def upper_bound(env: PassiveTMaze | EndlessTMaze | DistractedCue) -> Bound:
    """Whoever remembers the last sign is always right."""
    return Bound(1.0, "optimal")
