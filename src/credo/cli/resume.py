"""`credo resume RUN`."""

import dataclasses
import pathlib
from typing import Any

from ..runs.options import RunOptions
from .line import Line, shorts
from .names import CATALOGUE, fail

BEGUN = {"seed": "a run's seed stays: start another with `credo train`"}
BEGUN |= dict.fromkeys(("frames", "generations", "stop_at"), "a budget is a flag: --frames 2e6")


@dataclasses.dataclass
class Resume:
    """Go on with a run, or with every unfinished run of a folder that --seeds made."""

    run: str
    _: dataclasses.KW_ONLY
    set: dict[str, Any] = dataclasses.field(default_factory=dict)
    """FIELD=VALUE, such as learning_rate=1e-4 or gamma=0.95: go on with another setting, which is
    recorded."""
    trust: bool = False  # the run was made elsewhere and names code of others: import it
    without_replay: bool = False  # start with an empty replay buffer, where its files are damaged
    options: RunOptions = RunOptions()  # noqa: RUF009


def run(line: Line) -> None:
    """Go on; several runs in processes of their own."""
    command = line.command(Resume)
    for name in [name for name, _ in line.given if name in CATALOGUE["short"]]:
        setting = name.replace("-", "_")
        fail(f"--{name} is a setting of the run's algorithm: give it as --set {setting}=VALUE")
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

    def meant(name: str) -> list[str]:
        flags = {path: shorts(path) | {flag.name} for path, flag in line.flags.items()}
        found = [path for path, names in flags.items() if name.replace("_", "-") in names]
        inside = getattr(algorithm, "breeder", None)  # its fields need no prefix
        bare = hasattr(inside, name.partition(".")[0])
        return found or [f"breeder.{name}" if bare else name]

    return {
        path: value
        for name, value in changes.items()
        for path in ([name] if name in line.flags else meant(name))
    }
