"""`credo sweep FILE.toml`: search settings of `credo train`, and write the best ones for it."""

import contextlib
import dataclasses
import os
import pathlib
from collections.abc import Iterator

from .. import require
from ..executors import Place
from ..runs.record import RunError
from ..sweep.plan import Plan
from ..sweep.space import Drawn, corners
from . import settings
from .line import Line
from .names import fail
from .sweep_file import NAME, File, Trials, checked, settle
from .train import require_seeds


@dataclasses.dataclass
class Sweep:
    """Search settings of credo train, with several seeds a trial. FILE is TOML: fixed settings as
    credo train --config reads them, [ranges] of flags, and [sweep] with any of the flags below that
    say how to search. A folder in place of FILE goes on with the sweep in it."""

    file: str = ""
    _: dataclasses.KW_ONLY
    path: pathlib.Path | None = None
    """Folder of the sweep, new, empty, or begun with this file: then it goes on. None: runs/ and
    the name of the file."""
    jobs: int | None = None
    """Runs at a time, at least 1; no result depends on it. None: one per core, or elsewhere as many
    as there is room for."""
    best: pathlib.Path | None = None
    """Write the settings of the best trial so far to this TOML file, for credo train --config, and
    train nothing. None: search."""
    trust: bool = False
    """Import the code that FILE names. Without this such a file is refused: to import a module is
    to execute it."""
    place: Place = Place()  # noqa: RUF009

    def __post_init__(self):
        require.at_least("jobs", self.jobs, 1)

    def __call__(self, line: Line) -> None:
        """Search, or write the best settings there are."""
        file, folder = self._found() if self.file else (File("", {}, {}, {}), pathlib.Path())
        line.filed = file.said(self.trust)
        plan = line.take(Plan())
        line.done()
        if not self.file:
            line.end()
        trials = checked(file, trust=self.trust)
        if self.best:
            _write_best(folder, self.best, trials, plan)
        else:
            self._search(folder, file, trials, plan)

    def _found(self) -> tuple[File, pathlib.Path]:
        """The file, and the folder of its sweep: each may be named by the other. What is best is
        read in the folder."""
        given = pathlib.Path(self.file)
        begun = given.is_dir()
        folder = self.path or (given if begun else pathlib.Path("runs") / given.stem)
        home = given if begun and not self.best else folder
        if not (begun or self.best):
            return File.read(self.file), folder
        if not (home / NAME).exists():
            fail(f"{home} is no sweep: it has no {NAME}; begin one: credo sweep FILE.toml")
        return File.read(str(home / NAME)), folder

    def _search(self, folder: pathlib.Path, file: File, trials: Trials, plan: Plan) -> None:
        """Search in a folder that this process owns meanwhile; then say what was found."""
        from ..sweep import journal, page, search
        from . import tasks

        def make(drawn: Drawn) -> search.Setup:
            command, algorithm = trials.made(drawn)
            return search.Setup(algorithm, command.options, command.seed, command.from_)

        journal.imported()  # before anything is written
        command, algorithm = trials.made(next(corners(trials.ranges)))
        require_seeds(command.seed, plan.seeds + 1)  # the last one is for --best
        tasks.require_sound(command.task, algorithm.env)
        seeds = range(command.seed, command.seed + plan.seeds)
        what = f"{command.algorithm} on {command.task}"
        with _owned(folder):
            settle(folder, file, plan, trust=self.trust)
            book = journal.Journal(folder, plan, trials.ranges, owned=True)
            how = {"on": self.place, "workers": self.jobs, "again": f"credo sweep {folder}"}
            searching = search.Search(folder, book, make, **how)
            searching.run(lambda: page.write(folder, book, what, seeds))
            written = page.write(folder, book, what, seeds)
            top = journal.best(book.trials, plan)
        if top is not None:
            print(f"best: trial {top.number}, {top.value:.4g} over seeds {_told(seeds)}")
            for name, value in top.drawn.items():
                print(f"  {name} = {value}")
            print(f"its settings, for fresh seeds: credo sweep {folder} --best best.toml")
        print(f"page: {written}")


def _write_best(folder: pathlib.Path, target: pathlib.Path, trials: Trials, plan: Plan) -> None:
    """Write the best trial's settings, with a seed that no trial had; say how to report it."""
    from ..sweep import journal

    known = journal.Journal(folder, plan, trials.ranges).trials
    top = journal.best(known, plan)
    if top is None:
        raise RunError(f"no trial of {folder} is complete: go on with credo sweep {folder}")
    command, algorithm = trials.made(top.drawn)
    seeds = range(command.seed, command.seed + plan.seeds)
    complete = sum(trial.state == journal.COMPLETE for trial in known)
    told = [
        f"Trial {top.number} of {folder}, the best of {complete} complete ones: {top.value:.4g}, "
        f"the interquartile mean over seeds {_told(seeds)}.",
        f"These seeds chose it, so that number flatters. Report others, from {seeds.stop} on:",
        f"  credo train --config {target} --seeds 10",
    ]
    fresh = dataclasses.replace(command, seed=seeds.stop)
    head = "".join(f"# {line}\n" for line in told)
    target.write_text(head + settings.written(fresh, algorithm), "utf-8")
    print(f"wrote {target}", *told, sep="\n")


def _told(seeds: range) -> str:
    return f"{seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else str(seeds[0])


@contextlib.contextmanager
def _owned(folder: pathlib.Path) -> Iterator[None]:
    """Own the folder of a sweep, a new or an empty one. Raises `RunError` if anything else is in
    it, and `RunLocked` if another process owns it."""
    from ..runs.lock import lock

    there = set(os.listdir(folder)) if folder.exists() else set()
    other = sorted(there - {"lock", f".{NAME}.draft.toml"})
    if other and NAME not in there:
        raise RunError(
            f"{folder} is not empty and no sweep (it holds {', '.join(other[:3])}): give a new or "
            "an empty folder with --path"
        )
    with lock(folder):
        yield
