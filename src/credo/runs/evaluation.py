"""What `credo evaluate` prints: a champion on fresh episodes."""

import pathlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from .. import tree
from ..analysis import bounds, counting, probes
from ..compilation import float32
from ..environments.host import AbstractHostEnvironment
from ..environments.sequence_classification import SequenceClassification
from ..rollout import evaluate
from ..types import Evaluation
from .store import Run

EPISODES, HOST_EPISODES = 1000, 20  # a task outside JAX is slower by orders of magnitude
TIMES = (1, 2, 5, 10, 100)  # as long as in training, of a horizon curve
STREAMED = 1000  # deeper sequences are streamed: memory does not grow with their length


def in_turn(task: Any, policies: Any, episodes: int, *, key: PRNGKeyArray) -> Evaluation:
    """`evaluate`, outside JAX `HOST_EPISODES` at a time: each takes a simulator of its own."""
    if not issubclass(type(task), AbstractHostEnvironment) or episodes <= HOST_EPISODES:
        return evaluate(task, policies, episodes, key=key)
    turns = [
        evaluate(task, policies, HOST_EPISODES, key=jax.random.fold_in(key, i))
        for i in range(-(-episodes // HOST_EPISODES))
    ]
    return jax.tree.map(lambda *xs: jnp.concatenate(xs, axis=1)[:, :episodes], *turns)


class Score(NamedTuple):
    """What one reward came to, in the task's own units: returns over episodes that ended."""

    mean: float
    error: float  # standard error of the mean over episodes; NaN of a single one
    agents: tuple[float, ...] = ()  # of a private signal, each agent's mean


class Result(NamedTuple):
    """A champion on fresh episodes."""

    episodes: int  # that came to their end
    failed: int  # that did not: their returns are NaN, and they are left out
    scores: dict[str, Score]
    steps: float  # in an episode, on average


@float32()
def played(run: Run, task: Any, episodes: int | None, seed: int) -> Result:
    """Fresh episodes of a run's champion on `task`, which may differ from
    the one it was trained on. `episodes`: None for `EPISODES`, or `HOST_EPISODES` of a task outside
    JAX."""
    if episodes is None:
        host = issubclass(type(task), AbstractHostEnvironment)
        episodes = HOST_EPISODES if host else EPISODES
    evaluation = in_turn(task, tree.single(run.champion), episodes, key=_key(seed))
    returns = {name: np.asarray(evaluation.returns[name][0], np.float64) for name in task.signals}
    whole = ~np.any([np.isnan(x.reshape(episodes, -1)).any(1) for x in returns.values()], axis=0)
    scores = {name: _score(values[whole]) for name, values in returns.items()}
    steps = np.asarray(evaluation.steps[0], np.float64)[whole]
    n = int(whole.sum())
    return Result(n, episodes - n, scores, float(steps.mean()) if n else float("nan"))


def describe(
    run: Run, task: Any, episodes: int | None, seed: int
) -> tuple[list[str], Result | None]:
    """What `played` finds, in lines for people. Sequences so deep that they are streamed have no
    result beside them.

    **Arguments:** as `played`: `episodes`, at least 1, or None for the default of the task; `seed`
    of the fresh episodes, which no training run has, whatever its own seed.
    """
    if _streamed(task):
        return list(_stream(run, task, episodes, seed)), None
    result = played(run, task, episodes, seed)
    return list(_lines(run, task, result)), result


def horizon(
    run: Run, task: Any, times: Sequence[int], episodes: int | None, seed: int
) -> Iterator[str]:
    """Lines about a champion where something has to be remembered for longer than in training.

    **Arguments:** `times`: how many times as long as in `task`, at least 1; none: `TIMES`.
    `episodes`: of each; None: 100. `seed` as in `played`.
    """
    episodes, title = episodes or 100, f"{run.path}: {task.reported} in "
    for n in sorted(set(times)) or TIMES:
        with float32():
            policies = tree.single(run.champion)
            (found,) = probes.reach(task, policies, (n,), episodes, key=_key(seed))
        if title:
            yield f"{title}{episodes} fresh episodes of each"
            title = ""
        score = _score(found.scores[0])
        error = "" if np.isnan(score.error) else f" ± {score.error:.2g}"
        yield f"  {f'× {n:,}':<10} {f'{score.mean:.4g}{error}':<18} {found.changed}"


def _score(values: np.ndarray) -> Score:
    """Of one signal's returns `[episodes]`, or `[episodes, agents]` of a private one. The agents of
    one episode are no independent draws: their mean is one value."""
    agents = tuple(values.mean(axis=0).tolist()) if values.ndim == 2 and len(values) else ()
    team = values.mean(axis=1) if values.ndim == 2 else values
    n, nan = len(team), float("nan")
    error = float(team.std(ddof=1) / np.sqrt(n)) if n > 1 else nan
    return Score(float(team.mean()) if n else nan, error, agents)


def _lines(run: Run, task: Any, result: Result) -> Iterator[str]:
    """What `played` found, for people."""
    many = "episode" if result.episodes == 1 else "episodes, mean ± standard error over episodes"
    yield f"{run.path}: {result.episodes} fresh {many}"
    if result.failed:
        all_of = result.episodes + result.failed
        yield f"  {result.failed} of {all_of} episodes failed and are left out"
    for name, score in result.scores.items():
        yield _line(name, score) + (
            f" (mean of {len(score.agents)} agents)" if score.agents else ""
        )
        for k, mean in enumerate(score.agents):
            yield f"    agent {k:<8} {mean:.4g}"
    yield f"  steps            {result.steps:.1f}"
    if bounds.exact(task):
        name, value = bounds.best_baseline(task)
        yield f"  baseline         {value:.3g} ({name})"
        yield f"  upper bound      {bounds.upper_bound(task).value:.3g}"


def summary(path: pathlib.Path, results: list[Result]) -> Iterator[str]:
    """Several runs together, in lines for people: a run's mean is one value, and ± is the standard
    error over runs."""
    yield f"{path}: {len(results)} runs, mean ± standard error over runs"
    for name in results[0].scores:
        yield _line(name, _score(np.array([result.scores[name].mean for result in results])))


def _line(name: str, score: Score) -> str:
    error = "" if np.isnan(score.error) else f" ± {score.error:.2g}"
    return f"  {name:<16} {score.mean:.4g}{error}"


def _key(seed: int) -> PRNGKeyArray:
    """The key of fresh episodes."""
    return jax.random.fold_in(jax.random.key(seed), 1_000_003)  # not a key of any training run


def _streamed(task: Any) -> bool:
    """Whether episodes are so long that they are streamed."""
    ours = isinstance(task, SequenceClassification) and task.persistence == 0.5
    return ours and task.depth > STREAMED


def _stream(
    run: Run, task: SequenceClassification, episodes: int | None, seed: int
) -> Iterator[str]:
    """Lines about the champion on sequences of any length, whose memory does not grow with it."""
    streams = min(episodes or EPISODES, 20)
    lengths = counting.longest_correct(
        tree.single(run.champion),
        task.depth,
        streams,
        min_gap=task.min_gap,
        max_gap=task.max_gap,
        ties=task.ties,
        key=_key(seed),
    )[0]
    yield f"{run.path}: {streams} streams of {task.depth:,} signals"
    yield f"  success          {np.mean(np.asarray(lengths) >= task.depth):.3f}"
    yield f"  signals right    median {int(np.median(lengths)):,}, worst {int(lengths.min()):,}"
