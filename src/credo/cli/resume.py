"""`credo resume RUN`."""

import dataclasses
import pathlib
from typing import Any

from ..runs.options import RunOptions
from .line import Line, shorts
from .names import fail

BEGUN = {"seed": "a run's seed stays: start another with `credo train`"}
BEGUN |= dict.fromkeys(("frames", "generations", "stop_at"), "a budget is a flag: --frames 2e6")


@dataclasses.dataclass
class Resume:
    """Go on with a run, or with every unfinished run of a folder that --seeds made."""

    run: str
    _: dataclasses.KW_ONLY
    set: dict[str, Any] = dataclasses.field(default_factory=dict)
    """FIELD=VALUE, such as learner.actor_lr=1e-4: go on with another setting, which is recorded."""
    trust: bool = False  # the run was made elsewhere and names code of others: import it
    without_replay: bool = False  # start with an empty replay buffer, where its files are damaged
    options: RunOptions = RunOptions()  # noqa: RUF009


def run(line: Line) -> None:
    """Go on; several runs in processes of their own."""
    command = line.command(Resume)
    line.done()
    from ..executors import local
    from ..runs import config, folder, loop
    from ..runs.store import Run

    runs = folder.runs_in(command.run)
    for name in command.set.keys() & BEGUN.keys():
        fail(f"--set {name}: {BEGUN[name]}")
    for path in runs if command.set else ():  # nothing was begun yet
        algorithm = Run(path, trust=command.trust).algorithm
        command.set = _in_full(algorithm, command.set)
        try:
            config.replaced(algorithm, command.set)
        except ValueError as error:
            fail(f"--set: {error}")
    again: Any = {name: getattr(command, name) for name in ("set", "trust", "without_replay")}
    if len(runs) == 1:
        loop.resume(runs[0], command.options, **again)
    else:
        jobs = [local.Job.resumed(path, command.options, **again) for path in runs]
        local.run(jobs, title=pathlib.Path(command.run).name)
    for path in runs:
        print(Run(path, trust=command.trust).summary)


def _in_full(algorithm: Any, changes: dict[str, Any]) -> dict[str, Any]:
    """Changes by the paths of fields, which short names such as gamma stand for."""
    line = Line("resume", [])
    line.take(algorithm)
    meant = {
        name: [path for path in line.flags if name.replace("_", "-") in shorts(path)]
        for name in changes.keys() - line.flags.keys()
    }
    return {path: x for name, x in changes.items() for path in meant.get(name) or [name]}
