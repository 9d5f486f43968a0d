"""Measurements that several experiments share: rows and series of the runs of a cell.

Each function makes a measurement, to be named in `Experiment.measures`: `final(episodes=10)` plays
the final champions, `scores()` reads what their runs logged. The champion is the best policy of a
run, as it was tested.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .. import tree
from ..algorithms.lineage import MAKERS
from ..analysis import attribution, bounds, statistics
from ..environments.gymnasium import close_all
from ..environments.rover import Rover
from ..environments.wrappers import DelayedHostReward
from ..networks.exploration import Explorer, GaussianNoise
from ..networks.mlp import MLP
from ..report.rows import Row, Series
from ..report.run_page import learner_names
from ..rollout import evaluate
from ..runs.loop import Run
from .base import Measure, Trained

FINAL_KEY, BASELINE_KEY = 20_000, 21_000  # runs have seeds below 10,000
SMOOTHED = 10  # generations; the author's undisclosed moving average


def undelayed(env: Any) -> Any:
    """The task whose returns are those of `env`: a delay changes only when rewards are paid."""
    return env.env if isinstance(env, DelayedHostReward) else env


def where(measure: Measure, **labels: Any) -> Measure:
    """A measurement of cells with these labels alone; `name=None`: that have none of the name."""

    def of_some(cell: Trained) -> Iterable[Row | Series]:
        chosen = all(cell.labels.get(name) == value for name, value in labels.items())
        return measure(cell) if chosen else ()

    return of_some


# --------------------------------------------------------------------------- the final champions


def returns(
    env: Any, policies: PyTree, episodes: int, key: int = FINAL_KEY, reward: str | None = None
) -> np.ndarray:
    """A reward of the task, or what it reports, of `[policies, episodes]`, without noise, in the
    same worlds."""
    played = evaluate(env, policies, episodes, key=jax.random.key(key)).of(reward or env.reported)
    close_all()  # simulators of dozens of episodes
    return np.asarray(played)


def final(
    metric: str = "return",
    episodes: int = 10,
    digits: int = 2,
    each: bool = True,
    reward: str | None = None,
) -> Measure:
    """The final champions on fresh episodes that they share: a row for `each` episode, or the
    mean over all. `reward`: a reward of the task; None: what it reports."""

    def measure(cell: Trained) -> list[Row]:
        played = returns(cell.env, cell.champions, episodes, reward=reward)
        if each:
            return cell.rows(metric, played, digits, episode=None)
        return cell.rows(metric, np.mean(played, axis=1), digits)

    return measure


# --------------------------------------------------------------------------- what their runs logged


def over(run: Run, axis: str) -> np.ndarray:
    """`frames` (environment steps) or `episodes` at the end of every generation, so far."""
    metrics = run.metrics
    if axis == "episodes" and axis not in metrics:
        return metrics["generation"] * run.algorithm.episodes
    return metrics[axis]


def scores(x: str = "frames", points: int = 100, digits: int = 2) -> Measure:
    """Series "test score" of the champions' tests, on a grid over `x` that all runs share: each
    point has the last test that was over by then. `x`: "frames" or "episodes". `points`: of the
    grid, at most."""

    def measure(cell: Trained) -> list[Series]:
        xs = [over(run, x) for run in cell.runs]
        grid = attribution.axis(xs, points)
        tested = [run.metrics["champion_score"] for run in cell.runs]
        values = [attribution.on_grid(at, y, grid) for at, y in zip(xs, tested, strict=True)]
        return cell.series("test score", (x, grid.astype(int)), values, digits)

    return measure


def last_tests(cell: Trained) -> list[Row]:
    """The last test of each run, "last test" as logged and "last test, smoothed" over `SMOOTHED`
    generations, in units of the task's return."""
    tested = [run.metrics["champion_score"] for run in cell.runs]
    smoothed = [statistics.moving_average(x, SMOOTHED)[-1] for x in tested]
    last = cell.rows("last test", [x[-1] for x in tested], 2)
    return last + cell.rows("last test, smoothed", smoothed, 2)


def effort(cell: Trained) -> list[Row]:
    """Frames that each run took, and gradient updates for each of them."""
    metrics = [run.metrics for run in cell.runs]
    updates = [m["updates"].sum() / m["frames"][-1] if "updates" in m else np.nan for m in metrics]
    frames = cell.rows("frames", [int(m["frames"][-1]) for m in metrics])
    return frames + cell.rows("updates per frame", updates, 3)


def first(metric: str, level: float, x: str) -> Measure:
    """Where on `x`, "frames" or "episodes", a test first reached `level`: a row `metric` for each
    run, null for runs in which none did."""

    def measure(cell: Trained) -> list[Row]:
        found = []
        for run in cell.runs:
            reached = np.flatnonzero(run.metrics["champion_score"] >= level)
            found.append(int(over(run, x)[reached[0]]) if reached.size else None)
        return cell.rows(metric, found)

    return measure


def lineage(cell: Trained) -> list[Row | Series]:
    """Who made the champions of hybrids: which operator changed them last, which learner their
    weights come from, and how workers were allocated."""
    found = attribution.summary([run.metrics for run in cell.runs])
    names, at = learner_names(cell.cell.algorithm.learners), ("frames", found["frames"])
    return [
        *cell.series("last changed by", at, found["makers"], operator=MAKERS),
        *cell.series("ancestry", at, found["ancestry"], ancestor=[*names, "first draw"]),
        *cell.series("allocation so far", at, found["allocation"], learner=names),
        *cell.rows("allocation", found["allocated"], learner=names),
        *cell.rows("injected", found["injected"], learner=names),
        *cell.rows("fate", found["fates"], learner=names, fate=attribution.FATES),
    ]


def of_portfolio(cell: Trained) -> list[Row | Series]:
    """The same, of cells with more than one learner."""
    learners = getattr(cell.cell.algorithm, "learners", ())
    return lineage(cell) if len(learners) > 1 else []


# ------------------------------------------------------------------------------------- baselines


def of_task(numbers: Callable[[Any], dict[str, float]]) -> Measure:
    """Numbers of a cell's task, without a seed: baselines, bounds."""
    return lambda cell: [cell.fact(*found) for found in numbers(undelayed(cell.env)).items()]


@functools.cache
def random_actions(env: Any, episodes: int = 100) -> dict[str, float]:
    """Mean return of actions drawn uniformly from [-1, 1], and its standard error."""
    actor = MLP(hidden=()).init(env.obs_size, env.action_size, key=jax.random.key(0))
    policy = Explorer(actor, GaussianNoise(), jnp.bool_(True), env.action_size)
    played = returns(env, tree.single(policy), episodes, BASELINE_KEY)[0].astype(np.float64)
    mean, error = statistics.mean_and_standard_error(played)
    return {"random": round(float(mean), 2), "random, s.e.": round(float(error), 2)}


def rover_baselines(env: Rover) -> dict[str, float]:
    """Mean shares of POIs in 50 worlds: of teams that act by their sensors alone (random, straight,
    greedy), of a planner that knows every position (scripted), and a proven upper bound (bound)."""
    return _rover_baselines(dataclasses.replace(env, rewards=("global",)))


@functools.cache
def _rover_baselines(env: Rover) -> dict[str, float]:
    found = bounds.baselines(env) | {"bound": bounds.upper_bound(env).value}
    return {name: round(value, 3) for name, value in found.items()}
