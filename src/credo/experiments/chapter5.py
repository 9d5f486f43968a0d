"""Chapters 5 and 6 on MuJoCo: the runs that their figures and tables share, and their scores."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from .. import tree
from ..algorithms.erl import ERL
from ..algorithms.off_policy import OffPolicy
from ..algorithms.ppo import PPO
from ..analysis import attribution, statistics
from ..environments.gymnasium import Gymnasium, close_all
from ..environments.wrappers import delayed as with_delay
from ..networks.exploration import Explorer, GaussianNoise
from ..networks.mlp import MLP, ResidualCritic
from ..report.sections import Curve, Figure, Reference, Table, Text
from ..rollout import evaluate
from ..runs.store import Run
from .base import Cell

BUDGETS = ("smoke", "quick", "full", "million", "published")
TASKS = ("HalfCheetah-v5", "Swimmer-v5", "Reacher-v5", "Ant-v5", "Hopper-v5", "Walker2d-v5")
STAND_IN = "InvertedPendulum-v5"  # for every task at smoke, with tiny networks
TINY = 5_000  # frames: a run that is shorter shows no result
ALGORITHMS = {"erl": ERL.erl, "ea": ERL.ea, "ddpg": OffPolicy.ddpg, "ppo": PPO.ppo}
EPISODES, RANDOM_EPISODES = 10, 100  # that measure a final champion, and a random policy
SMOOTHED = 10  # generations; the author's undisclosed moving average
POINTS = 100  # of a learning curve


class Plan(NamedTuple):
    """The runs of a cell."""

    frames: int
    runs: int
    updates_per_frame: float = 1.0


PLANS = {
    "smoke": Plan(600, 2),
    "quick": Plan(50_000, 2, 0.25),
    "full": Plan(300_000, 2),
    "million": Plan(1_000_000, 5),
    "published": Plan(2_000_000, 5),
}
PLANS_OF_TASKS = {
    ("full", "Swimmer-v5"): Plan(500_000, 3, 0.1),
    ("full", "Humanoid-v5"): Plan(100_000, 2),
    # Hopper has 4M in chapter 5, and 5M and 1.5M in chapter 6: runs of 5M hold them all.
    ("published", "Hopper-v5"): Plan(5_000_000, 5),
    ("published", "Ant-v5"): Plan(6_000_000, 5),
    ("published", "Walker2d-v5"): Plan(8_000_000, 5),
    ("published", "Humanoid-v5"): Plan(1_000_000, 5),
}
TD3_FULL_RUNS = 3

# Scores of others. `AT_1M`: final evaluations at 1M frames of v1 (TD3's authors, 10 seeds), v2
# (ERL as rerun by a later paper) and v4 tasks (FlashSAC, 5 seeds, the best published learner).
AT_1M = {
    "TD3": {
        "HalfCheetah": 9567.0,
        "Hopper": 3391.0,
        "Walker2d": 4413.0,
        "Ant": 4243.0,
    },
    "ERL rerun": {
        "HalfCheetah": 8684.0,
        "Hopper": 2288.0,
        "Walker2d": 2188.0,
        "Ant": 3716.0,
        "Swimmer": 350.0,
    },
    "FlashSAC": {
        "HalfCheetah": 14465.0,
        "Hopper": 4064.0,
        "Walker2d": 7346.0,
        "Ant": 7590.0,
        "Humanoid": 12606.0,
    },
}
CEILINGS = {  # that follow from the task itself
    "Reacher": 0.0,  # every reward is a cost
    "InvertedPendulum": 1000.0,  # 1 per step
    # 10 per step, less the tip's squared distance (2 - 1.2)² from its goal above reach
    "InvertedDoublePendulum": 9360.0,
}
VERSIONS = {
    "HalfCheetah": "its reward is that of v2",
    "Swimmer": "its reward is that of v2",
    "Reacher": "the distance is paid after the step instead of before it, and one number of the "
    "observation that was always 0 is gone",
    "Ant": "no bonus is paid for the step of a fall, contact forces are observed and always cost",
    "Hopper": "no bonus is paid for the step of a fall",
    "Walker2d": "no bonus is paid for the step of a fall, and both feet have the same friction",
    "Pendulum": "the published numbers are of the same version",
    "InvertedPendulum": "nothing is paid for the step of the fall",
    "InvertedDoublePendulum": "no bonus is paid for the step of the fall, and two numbers of the "
    "observation that were always 0 are gone",
    "Humanoid": "no bonus is paid for the step of a fall, contacts cost, and numbers of the "
    "observation that were always 0 are gone",
}


# ------------------------------------------------------------------------------------------ cells


def tasks(budget: str, of: tuple[str, ...] = TASKS) -> tuple[str, ...]:
    """The tasks of an experiment at a budget."""
    return {"smoke": (STAND_IN,), "quick": of[:2]}.get(budget, of)


def plan(budget: str, task: str) -> Plan:
    return PLANS_OF_TASKS.get((budget, task), PLANS[budget])


def cell(
    label: str,
    build: Callable[..., Any],
    task: str,
    budget: str,
    *,
    delayed: bool = False,
    planned: Plan | None = None,
    generations: int | None = None,
    stop_at: float | None = None,
    first_seed: int = 0,
    **overrides: Any,
) -> Cell:
    """Runs of what `build(env, **overrides)` makes, named by label and task."""
    runs = planned or plan(budget, task)
    env: Any = Gymnasium(task)
    if delayed:
        env = with_delay(env)
    algorithm = build(env, **overrides)
    if hasattr(algorithm, "updates_per_frame"):
        algorithm = dataclasses.replace(algorithm, updates_per_frame=runs.updates_per_frame)
    if budget == "smoke":
        algorithm = shrunk(algorithm)
    name = f"{label} {task}" + " delayed" * delayed
    return Cell(name, algorithm, generations, runs.runs, first_seed, runs.frames, stop_at)


def td3(task: str, budget: str) -> Cell:
    """TD3 with the constants of its authors, alone."""
    chosen = plan(budget, task)
    if budget == "full":
        chosen = chosen._replace(runs=TD3_FULL_RUNS)
    return cell("td3", OffPolicy.td3, task, budget, planned=chosen)


def td3_gamma(task: str, budget: str, gamma: float) -> Cell:
    """The same at another discount."""
    if gamma == 0.99:
        return td3(task, budget)
    learner = dataclasses.replace(OffPolicy.td3(Gymnasium(task)).learner, gamma=gamma)
    return cell(f"td3 gamma {gamma:g}", OffPolicy.td3, task, budget, learner=learner)


def erl_cells(budget: str) -> list[Cell]:
    """ERL by Table 5.1, a cell per task."""
    return [cell("erl", ERL.erl, task, budget) for task in tasks(budget)]


def shrunk(algorithm: Any) -> Any:
    """The same with tiny networks, batches and tests: it learns nothing, in seconds."""
    fields: dict[str, Any] = {
        "network": dataclasses.replace(algorithm.network, hidden=(8,)),
        "replay_capacity": 10_000,
        "sync_period": 1,
        "warmup_frames": 50,
        "start_frames": 200,
        "test_episodes": 2,
    }
    if isinstance(algorithm, ERL):
        fields["learners"] = tuple(map(_small, algorithm.learners))
    else:
        fields["test_every"] = 200
    if isinstance(algorithm, OffPolicy):
        fields["learner"] = _small(algorithm.learner)
    known = {field.name for field in dataclasses.fields(algorithm)}
    return dataclasses.replace(algorithm, **{k: v for k, v in fields.items() if k in known})


def _small(learner: Any) -> Any:
    if isinstance(learner.critic, ResidualCritic):
        critic = dataclasses.replace(learner.critic, width=8)
    else:
        branches = (4, 4) if learner.critic.branches else ()
        critic = dataclasses.replace(learner.critic, hidden=(8,), branches=branches)
    return dataclasses.replace(learner, critic=critic, batch_size=16)


# ---------------------------------------------------------------------------------------- scores


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    """Scores of every cell."""
    return {name: outcome(name, cell) for name, cell in runs.items()}


def outcome(name: str, runs: list[Run], axis: str = "frames") -> dict[str, Any]:
    """Scores of the runs of a cell: curves over `axis`, the last test, and the final champions on
    fresh episodes that they share."""
    metrics = [run.metrics for run in runs]
    env = runs[0].algorithm.env
    played = evaluate(
        env,
        tree.stack(*(run.champion for run in runs)),
        EPISODES,
        key=jax.random.key(20_000),  # runs have seeds below 10,000
    )
    xs = [over(run, m, axis) for run, m in zip(runs, metrics, strict=True)]
    scores = [m["champion_score"] for m in metrics]
    grid = attribution.axis(xs, POINTS)
    smooth = [statistics.moving_average(score, SMOOTHED) for score in scores]
    updates = [m["updates"].sum() / m["frames"][-1] if "updates" in m else np.nan for m in metrics]
    floor = random_returns(env.unwrapped)
    close_all()  # simulators of dozens of episodes
    return {
        "task": task_of(env),
        "label": label_of(name),
        axis: grid.astype(int).tolist(),
        "score": [
            attribution.plain(attribution.on_grid(x, y, grid), 2)
            for x, y in zip(xs, scores, strict=True)
        ],
        "last": attribution.plain([score[-1] for score in scores], 2),
        "last smoothed": attribution.plain([score[-1] for score in smooth], 2),
        "final": attribution.plain(played.of(env.reported), 2),
        "played": [int(m["frames"][-1]) for m in metrics],
        "updates per frame": attribution.plain(updates, 3),
        "floor": attribution.plain(floor, 2),
    }


def over(run: Run, metrics: dict[str, np.ndarray], axis: str) -> np.ndarray:
    """`frames` or `episodes` at the end of every generation."""
    if axis == "episodes" and "episodes" not in metrics:
        return metrics["generation"] * run.algorithm.episodes
    return metrics[axis]


def task_of(env: Any) -> str:
    return env.unwrapped.id


def label_of(name: str) -> str:
    """A cell's name without its task: `erl`, `td3 gamma 0`."""
    return " ".join(word for word in name.split() if not word[:1].isupper())


def random_returns(env: Any, episodes: int = RANDOM_EPISODES) -> tuple[float, float]:
    """Mean return of actions drawn uniformly from [-1, 1], and its standard error."""
    if env not in _FLOORS:
        actor = MLP(hidden=()).init(env.obs_size, env.action_size, key=jax.random.key(0))
        policy = Explorer(actor, GaussianNoise(), jnp.bool_(True), env.action_size)
        played = evaluate(env, tree.stack(policy), episodes, key=jax.random.key(21_000))
        returns = np.asarray(played.of(env.reported)[0], np.float64)
        mean, error = statistics.mean_and_standard_error(returns)
        _FLOORS[env] = float(mean), float(error)
    return _FLOORS[env]


_FLOORS: dict[Any, tuple[float, float]] = {}


# ----------------------------------------------------------------------------------------- pages


def tasks_in(measured: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(found["task"] for found in measured.values()))


def of_task(measured: dict[str, Any], task: str) -> list[dict[str, Any]]:
    return [found for found in measured.values() if found["task"] == task]


def known(table: dict[str, float], task: str) -> float | None:
    """What is known about a task, whatever its version."""
    return table.get(task.partition("-")[0])


def curves(
    title: str,
    found: Iterable[dict[str, Any]],
    *references: Reference,
    axis: str = "frames",
    caption: str = "",
) -> Figure:
    """Champion scores as they were logged, a curve per cell."""
    found = list(found)
    floor = Reference("random policy", found[0]["floor"][0])
    return Figure(
        title,
        axis,
        "return of the champion",
        [Curve(cell["label"], cell[axis], cell["score"]) for cell in found],
        references=(floor, *references),
        caption=caption,
    )


def by_task(measured: dict[str, Any], *references: Reference) -> list[Figure]:
    return [curves(task, of_task(measured, task), *references) for task in tasks_in(measured)]


def scores(
    measured: dict[str, Any],
    published: dict[str, str] | None = None,
    reference: dict[str, dict[str, float]] | None = None,
    caption: str = "",
    interval: bool = False,
) -> Table:
    """Scores of every cell, beside floor, published value and what others reached.

    **Arguments:** `published`: by the name of the cell. `reference`: columns, by their title; of
    each the value by task. By default those of others at 1M frames. `interval`: also the 95 %
    confidence interval of the mean, which chapter 6 gives.
    """
    if reference is None:
        reference = {f"{who}, 1M frames": values for who, values in AT_1M.items()}
    reference = {
        title: values
        for title, values in (reference | {"ceiling": CEILINGS}).items()
        if any(known(values, task) is not None for task in tasks_in(measured))
    }
    rows = []
    for name, cell in measured.items():
        final = [_mean(run) for run in cell["final"]]
        rows.append(
            [
                cell["task"],
                cell["label"],
                number(cell["floor"][0]),
                (published or {}).get(name, "–"),
                spread(final),
                middle(final),
                *([confidence(final)] if interval else []),
                f"{spread(cell['last'])} / {number(np.mean(cell['last smoothed']))}",
                f"{np.mean(cell['played']):,.0f}",
                _mean(cell["updates per frame"]),
                *(known(values, cell["task"]) for values in reference.values()),
            ]
        )
    return Table(
        "Return, mean ± standard deviation over runs",
        [
            "task",
            "algorithm",
            "floor",
            "published",
            "final champion",
            "median (range)",
            *(["95 % interval of the mean"] if interval else []),
            "last test, raw / smoothed",
            "frames",
            "updates per frame",
            *reference,
        ],
        rows,
        caption=f"Final champion: {EPISODES} fresh episodes without noise. Last test: the "
        f"published protocol, as logged; smoothed over {SMOOTHED} generations, as the author did "
        "(of a learner alone, a generation is an episode). "
        f"Floor: actions drawn uniformly, mean of {RANDOM_EPISODES} episodes. {caption}".strip(),
    )


def about(measured: dict[str, Any], *paragraphs: str) -> Text:
    """What to know before comparing: versions, frames, stand-ins."""
    of = {task.partition("-")[0]: task for task in tasks_in(measured)}
    differences = "; ".join(f"{task}: {VERSIONS[name]}" for name, task in of.items())
    stand_in = [
        f"{STAND_IN} with tiny networks stands in for the published tasks: this page shows that "
        "everything runs, and no result."
    ] * (
        STAND_IN in of.values() and max(max(x.get("played", [0])) for x in measured.values()) < TINY
    )
    return Text(
        "How to read it",
        [
            *stand_in,
            "Frames are the steps of everybody that acted, population and learners; those of tests "
            "are not counted. A run that has ended keeps its last score in the figures.",
            f"The dissertation used v2 of the tasks. Here {differences}. Scores of different "
            "versions are near, not equal.",
            *paragraphs,
        ],
    )


def spread(x: Any) -> str:
    """Mean ± standard deviation over runs."""
    x = np.array(x, np.float64)
    digits = _digits(x.mean())
    error = f" ± {x.std(ddof=1):,.{digits}f}" if len(x) > 1 else ""
    return f"{x.mean():,.{digits}f}{error}"


def middle(x: Any) -> str:
    """Median and range over runs."""
    x = np.array(x, np.float64)
    return f"{number(np.median(x))} ({number(x.min())}…{number(x.max())})"


def confidence(x: Any) -> str:
    """95 % confidence interval of the mean over runs, by Student's t."""
    x = np.array(x, np.float64)
    if len(x) < 2:
        return "–"
    mean, error = (float(y) for y in statistics.mean_and_standard_error(x))
    half = float(scipy.stats.t.ppf(0.975, len(x) - 1)) * error
    return f"{number(mean - half)} … {number(mean + half)}"


def number(x: Any) -> str:
    return f"{float(x):,.{_digits(x)}f}"


def _digits(x: Any) -> int:
    """Behind the point: enough for three or four in all."""
    return 2 if abs(x) < 10 else 1 if abs(x) < 1000 else 0


def _mean(returns: list[float | None]) -> float:
    return float(np.mean(np.array(returns, np.float64)))
