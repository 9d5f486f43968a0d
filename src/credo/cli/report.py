"""`credo report RUN [RUN …]`."""

import dataclasses
import os
import pathlib

from .line import Line


@dataclasses.dataclass
class Report:
    """One page about finished or running runs, or folders of runs; runs that differ only in their
    seed are one curve."""

    runs: tuple[str, ...]
    _: dataclasses.KW_ONLY
    output: str | None = None  # the page (or -o); None: report.html in the folder of the runs
    labels: tuple[str, ...] = ()  # names for the curves, in the order of the runs; none: our own


def run(line: Line) -> None:
    """Write the page, and say where."""
    command = line.command(Report)
    line.done()
    from ..report import run_page
    from ..runs import folder

    named = [pathlib.Path(path) for path in command.runs]
    runs = [run for path in named for run in folder.runs_in(path)]
    common = named[0] if len(named) == 1 else _common(named)
    target = pathlib.Path(command.output) if command.output else common / "report.html"
    labels = {"labels": command.labels} if command.labels else {}
    print(f"page: {run_page.write(runs, target, **labels)}")


def _common(paths: list[pathlib.Path]) -> pathlib.Path:
    """The folder in which all of these lie: a page about several runs belongs to none of them."""
    return pathlib.Path(os.path.relpath(os.path.commonpath([p.absolute().parent for p in paths])))
