"""`credo check TASK`."""

import dataclasses
from typing import Any

from ..runs.ending import say
from .line import Line


@dataclasses.dataclass
class Check:
    """Look for mistakes in a task. Flags of the task, such as --max-episode-steps, change it."""

    task: str
    _: dataclasses.KW_ONLY
    kwargs: dict[str, Any] = dataclasses.field(default_factory=dict)
    """NAME=VALUE …: what a task of Gymnasium or PettingZoo is made with."""
    rewards: tuple[str, ...] = ()
    """Rewards of the task by name, the first is what training maximises; of a team of PettingZoo
    NAME=MODULE:FUNCTION …, rewards of your own. None given: the task's own."""


def run(line: Line) -> None:
    """List what is wrong; exit code 1 if anything is."""
    command = line.command(Check)
    from ..environments import checks
    from ..environments.host import AbstractHostEnvironment
    from . import tasks

    line.skipped = {"id"}  # the task is a word
    env = line.take(tasks.task(command.task, command.kwargs, command.rewards), "env.")
    line.done()
    if isinstance(env, AbstractHostEnvironment):
        say(f"{command.task}: it is opened and plays for {checks.HOST_SECONDS:g} seconds, at most")
    problems = tasks.problems(env)
    for problem in problems:
        print(f"- {problem}")
    print(f"{command.task}: {len(problems)} problem{'s' * (len(problems) != 1)} found")
    raise SystemExit(1 if problems else 0)
