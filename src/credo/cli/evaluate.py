"""`credo evaluate RUN`."""

import dataclasses
import pathlib
from typing import Any

from .line import Line
from .names import fail


@dataclasses.dataclass
class Evaluate:
    """Fresh episodes for a run's policy, or for those of every run of a folder that --seeds made.
    Flags of the task change the task: credo evaluate RUN --depth 101."""

    run: str
    _: dataclasses.KW_ONLY
    episodes: int | None = None  # fresh ones, at least 1; None: 1000, outside JAX 20
    seed: int = 0  # 0 to 2^32 - 1, of the episodes
    best: bool = False  # the policy with the highest test score, not the last generation's
    trust: bool = False  # the run was made elsewhere and names code of others: import it
    kwargs: dict[str, Any] = dataclasses.field(default_factory=dict)
    """NAME=VALUE …: what a task of Gymnasium or PettingZoo is made with."""

    def __post_init__(self):
        in_range(self)


def in_range(command: Any) -> None:
    """Raise `ValueError` if there are no episodes, or if they have no seeds."""
    if command.episodes is not None and command.episodes < 1:
        raise ValueError(f"episodes is {command.episodes}: it must be at least 1")
    if not 0 <= command.seed < 2**32:
        raise ValueError(f"seed is {command.seed}: a seed must lie in 0 … {2**32 - 1}")


def run(line: Line) -> None:
    """Play, run by run, and say what came of all of them."""
    command = line.command(Evaluate)
    from ..runs import evaluation, folder
    from ..runs.store import Run

    results = []
    for path in folder.runs_in(command.run):
        run = Run(path, trust=command.trust, best=command.best)
        task = _task(line, run.algorithm.env, command.kwargs)
        line.done()
        lines, result = evaluation.describe(run, task, command.episodes, command.seed)
        print("\n".join(lines))
        results += [] if result is None else [result]
    if len(results) > 1:
        print("\n".join(evaluation.summary(pathlib.Path(command.run), results)))


def _task(line: Line, env: Any, kwargs: dict[str, Any]) -> Any:
    """A run's task with what was typed, if its policy can act there."""
    from .tasks import with_settings

    task = line.take(with_settings(env, kwargs), "env.")
    if task != env and task.sizes != env.sizes:
        words = ("numbers in an observation", "numbers in an action", "agents")
        sizes = zip(words, task.sizes, env.sizes, strict=False)  # who plays alone has two
        told = [f"{now} {what}" for what, now, then in sizes if now != then]
        fail(f"with these flags the task has {', and '.join(told)}: its champion cannot act there")
    return task
