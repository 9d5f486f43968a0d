"""`credo resume RUN`: to the run's own budget or a larger one, as it was or with other settings."""

import dataclasses
import pathlib
from typing import Any

from ..executors import Place
from ..runs.ending import say
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
    """FIELD=VALUE, such as learning_rate=1e-4 or gamma=0.95: go on with another setting of the
    algorithm. Weights, population and replay buffer stay; the run's record says what was changed
    when. A run that is finished needs a larger budget with it."""
    trust: bool = False
    """Import the code that the run's record names, although the run was made elsewhere: to import a
    module is to execute it."""
    without_replay: bool = False
    """Go on with an empty replay buffer if its files are damaged; else a run whose buffer cannot be
    read is not resumed."""
    place: Place = Place()  # noqa: RUF009
    options: RunOptions = RunOptions()  # noqa: RUF009

    def __call__(self, line: Line) -> None:
        """Go on, with several runs in processes of their own or elsewhere, and print a summary of
        each."""
        for name in [name for name, _ in line.given if name in CATALOGUE["short"]]:
            setting = name.replace("-", "_")
            fail(f"--{name} is a setting of the run's algorithm: give it as --set {setting}=VALUE")
        line.done()
        from .. import executors
        from ..runs import folder, loop
        from ..runs.store import Run

        runs = folder.runs_in(self.run)
        for path in runs if self.set else ():  # nothing was begun yet
            self.set = _settings(Run(path, trust=self.trust).algorithm, self.set)
        again: Any = {name: getattr(self, name) for name in ("set", "trust", "without_replay")}
        jobs = [executors.Job.resumed(path, self.options, **again) for path in runs]
        for job in [job for job in jobs if self.set and job.finished()]:
            more = "give a larger --generations or --frames with it"
            say(f"credo: --set is not used: {job.path} is finished and trains no more; {more}")
            again["set"] = {}
        if len(runs) == 1 and self.place.on == "local":
            loop.resume(runs[0], self.options, **again)
        else:
            executors.run(jobs, on=self.place, title=pathlib.Path(self.run).name)
        for path in runs:
            print(Run(path, trust=self.trust).summary)


def _settings(algorithm: Any, changes: dict[str, Any]) -> dict[str, Any]:
    """Changes by the paths of the fields that names such as gamma or elite_fraction stand for. One
    that the algorithm cannot have ends the command, before anything was begun."""
    from ..runs import config

    for name in changes.keys() & BEGUN.keys():
        fail(f"--set {name}: {BEGUN[name]}")
    line = Line("resume", [])
    line.take(algorithm)
    found = {}
    for name, value in changes.items():
        flag = name.replace("_", "-")
        meant = [path for path, f in line.flags.items() if flag in (shorts(path) | {f.name})]
        bare = hasattr(getattr(algorithm, "breeder", None), name.partition(".")[0])
        paths = [name] if name in line.flags else meant or ["breeder." * bare + name]
        found |= dict.fromkeys(paths, value)
    try:
        config.replaced(algorithm, found)
    except ValueError as error:
        fail(f"--set: {error}")
    return found
