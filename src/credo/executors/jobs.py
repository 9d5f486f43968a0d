"""One run of many: what it is, whether it is done, and how a worker is told of it."""

import dataclasses
import functools
import json
import pathlib
from typing import Any, NamedTuple

from ..runs import checkpoint, config, log, record
from ..runs.budget import Budget
from ..runs.options import RunOptions
from ..runs.record import RunError
from ..runs.store import CHAMPION, Run
from .worker import SAVE

PATIENCE = SAVE + 100.0  # seconds that a run of a cluster waits for an earlier try that is saving


@dataclasses.dataclass(frozen=True)
class Job:
    """One run, to be begun, or gone on with if its folder holds it already.

    - `algorithm`: an object, or the tree that `config.to_tree` makes of it.
    - `options`: budget, checkpoints and loggers. Raises `ValueError` if it has callbacks, which are
      objects of this process.
    - `warm_start`: the run whose champion this one starts from; None: none.
    - `again`: what `resume` is told of a run that exists (see `resumed`); None: a run as `train`
      makes it.
    """

    path: pathlib.Path
    algorithm: Any
    seed: int
    options: RunOptions
    warm_start: str | None = None
    again: dict[str, Any] | None = None

    def __post_init__(self):
        object.__setattr__(self, "path", pathlib.Path(self.path))
        if self.options.callbacks:
            raise ValueError(
                "callbacks stay in this process, and several runs have processes of their own: "
                "train them one after the other, or give loggers"
            )

    @classmethod
    def resumed(cls, path: pathlib.Path, options: RunOptions, *, trust: bool = False, **told: Any):
        """A run that exists, to be gone on with as `credo.resume` does: `told` are its `set` and
        `without_replay`."""
        config = Run(path, trust=trust).config
        again = {"trust": trust, **told}
        start = config.get("warm_start")
        return cls(path, config["algorithm"], config["seed"], options, start, again)

    @functools.cached_property
    def tree(self) -> dict[str, Any]:
        """The algorithm as JSON."""
        return (
            self.algorithm if isinstance(self.algorithm, dict) else config.to_tree(self.algorithm)
        )

    @functools.cached_property
    def budget(self) -> Budget:
        """What the run is to reach."""
        if self.again is not None:
            old = Budget(**record.read(self.path)["budget"])
            return Budget.of(self.algorithm, self.options, old)
        kind, asked = self.algorithm, (self.options.generations, self.options.frames)
        if isinstance(kind, dict) and asked == (None, None):
            kind = config.find_class(kind["class"])  # which knows its default budget
        return Budget.of(kind, self.options)

    def finished(self) -> bool:
        """Whether the champion on disk is the budget's. Raises `RunError` if the folder holds
        another run."""
        if not (self.path / record.NAME).exists():
            return False
        run = Run(self.path)
        if self.again is None:
            self._require_same(run)
        row = log.last(self.path / log.METRICS)
        if not (self.path / CHAMPION).exists() or not row:
            return False
        if checkpoint.read_metadata(self.path / CHAMPION)["generation"] != row["generation"]:
            return False  # killed since: what the rows say is not what the champion is
        done = int(row["generation"]), int(row["frames"])
        if self.again is not None:
            self.budget.refuse_smaller(Budget(**run.config["budget"]), *done, self.path)
        return self.budget.reached(*done, float(row["champion_score"])) is not None

    def _require_same(self, run: Run) -> None:
        """Raise if the folder holds a run that this job is not."""
        lines = config.changed(run.config["algorithm"], self.tree)
        recorded = Budget(**run.config["budget"])
        for name in ("generations", "frames"):
            old, new = getattr(recorded, name), getattr(self.budget, name)
            if old is not None and (new is None or old > new):
                lines.append(f"{name}: {old} != {new}")
        if run.config.get("warm_start") != self.warm_start:
            lines.append(f"warm start: {run.config.get('warm_start')} != {self.warm_start}")
        if run.config["seed"] != self.seed or lines:
            raise RunError(
                f"{self.path} holds a run with other settings ({'; '.join(lines) or 'seed'}): "
                "remove it or choose another folder"
            )

    def message(self, patience: float = 0.0) -> str:
        """What a worker is told, as a line of JSON.

        `patience`: seconds that it waits for another process which has the run, as one that is
        still saving where an earlier try of the job began.
        """
        # Objects are the caller's own; a tree may be what a stranger recorded.
        again = (
            {"trust": not isinstance(self.algorithm, dict)} if self.again is None else self.again
        )
        options = self.options
        if self.again is None:
            options = options.changed(dataclasses.asdict(self.budget))
        told = {"path": str(self.path), "algorithm": self.tree, "seed": self.seed}
        told |= {"warm_start": self.warm_start, "options": options.record(), "again": again}
        told |= {"patience": patience}
        return json.dumps(told)

    def state(self) -> str:
        """How far it is, in a few words."""
        row = log.last(self.path / log.METRICS)
        done = "starting"
        if row:
            done = self.budget.done(int(row["generation"]), int(row["frames"]))
        return f"{self.path.name} {done}"


class Ending(NamedTuple):
    """How the training of some jobs ended.

    `failures`: why jobs failed, by the folders of their runs. `signal`: the number of the signal
    that stopped it, everything saved; 0: none did. `pending`: what is still to happen elsewhere, in
    words; "": nothing. `lost`: why the place is gone, in words; "": it is not.
    """

    failures: dict[pathlib.Path, str]
    signal: int = 0
    pending: str = ""
    lost: str = ""


class RunsFailed(RunError):
    """Some of many runs failed, and all were tried. `failures`: as in `Ending`."""

    def __init__(self, failures: dict[pathlib.Path, str], total: int):
        told = "\n".join(f"{path}: {why}" for path, why in failures.items())
        super().__init__(f"{len(failures)} of {total} runs failed:\n{told}")
        self.failures = failures


class Pending(RunError):
    """Runs were handed over to a cluster, or are with it since an earlier command: this one ends
    here, and has not failed."""

    code = 0
