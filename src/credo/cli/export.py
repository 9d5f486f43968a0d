"""`credo export RUN [FILE]`."""

import dataclasses
import pathlib
from typing import Any

from .line import Line
from .names import fail


@dataclasses.dataclass
class Export:
    """A run's policy in one file that acts without JAX (`credo.Runner.load(FILE)`); the file is
    policy.safetensors of the run's folder if none is named."""

    run: str
    file: str | None = None
    _: dataclasses.KW_ONLY
    best: bool = False  # the policy with the highest test score, not the last generation's
    trust: bool = False  # the run was made elsewhere and names code of others: import it


def run(line: Line) -> None:
    """Write the file, and say where."""
    command = line.command(Export)
    line.done()
    from ..runs import export

    run = one_run("export", command.run, trust=command.trust, best=command.best)
    target = pathlib.Path(command.file) if command.file else run.path / "policy.safetensors"
    print(f"policy: {export.export(run, target)}")
    print(f'use it: policy = credo.Runner.load("{target}"); action = policy(observation)')


def one_run(command: str, path: str, **options: bool) -> Any:
    """The only run of a folder."""
    from ..runs import folder
    from ..runs.store import Run

    runs = folder.runs_in(path)
    if len(runs) > 1:
        first = f"credo {command} {runs[0]}"
        fail(f"{path} holds {len(runs)} runs: name one of them, as in {first}", "", map(str, runs))
    return Run(runs[0], **options)
