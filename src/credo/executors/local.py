"""Many runs, one process per core: on two cores, two single-threaded runs beat one that uses
both. What is finished is not run again; what was stopped goes on.

Workers get one job after another over a pipe (see `worker`). Each is a child as environments have
them: whatever it started ends with it, after its last job, after an error, after a second Ctrl-C,
and when this process is killed. A worker that fails takes one job with it: that one is told, and a
new worker takes the next.
"""

import contextlib
import dataclasses
import functools
import json
import pathlib
import select
import subprocess
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

from ..environments import processes
from ..environments.processes import Child
from ..runs import checkpoint, config, log, record, screen
from ..runs.budget import Budget
from ..runs.loop import Interrupted
from ..runs.options import RunOptions
from ..runs.progress import Line, clock
from ..runs.record import RunError
from ..runs.signals import Signals
from ..runs.store import CHAMPION, Run
from . import worker

TOLD = 60.0  # seconds between two lines on the runs under way, where there is no terminal
GRACE = 10.0  # seconds that a worker without a job has to end in
SAVE = 3600.0  # seconds to finish a generation and save in, after a signal or our end


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

    def message(self) -> str:
        """What a worker is told, as a line of JSON."""
        # Objects are the caller's own; a tree may be what a stranger recorded.
        again = (
            {"trust": not isinstance(self.algorithm, dict)} if self.again is None else self.again
        )
        options = self.options
        if self.again is None:
            options = options.changed(dataclasses.asdict(self.budget))
        told = {"path": str(self.path), "algorithm": self.tree, "seed": self.seed}
        told |= {"warm_start": self.warm_start, "options": options.record(), "again": again}
        return json.dumps(told)

    def state(self) -> str:
        """How far it is, in a few words."""
        row = log.last(self.path / log.METRICS)
        done = "starting"
        if row:
            done = self.budget.done(int(row["generation"]), int(row["frames"]))
        return f"{self.path.name} {done}"


@screen.calm()
def run(
    jobs: Sequence[Job],
    workers: int | None = None,
    *,
    title: str = "runs",
    again: str = "the same command",
) -> None:
    """Train every unfinished job.

    Says which runs a limit of the clock left unfinished, and how to go on with them.

    **Arguments:** `workers`: processes at a time, at least 1; None: one per core that this process
    may use. `title`: what stands before the line or bar that shows how far they are. `again`: what
    goes on with these jobs, in words; those that had not begun are among them.

    **Raises:** `RunError` if a folder holds another run, before anything is started, or with all
    failures once every job was tried; `Interrupted` after a signal: the workers save first.
    """
    waiting = [job for job in jobs if not job.finished()]
    for job in jobs:
        if job.again and job not in waiting:
            screen.say(f"{job.path} is finished: to go on give a larger --generations or --frames")
    if not waiting:
        return
    crew = _Crew(waiting, title)
    number = crew.work(min(workers or len(processes.cores()), len(waiting)))
    if number:
        raise Interrupted(f"stopped and saved; {again} goes on where it was", 128 + number)
    if crew.failures:
        told = "\n".join(crew.failures)
        raise RunError(f"{len(crew.failures)} of {len(waiting)} runs failed:\n{told}")
    if left := [job for job in waiting if not job.finished()]:
        names = ", ".join(job.state() for job in left)
        screen.say(
            f"credo: {len(left)} of {len(jobs)} runs are not finished for want of time ({names}): "
            f"go on with {again}"
        )


class _Worker(NamedTuple):
    """A process that has a job."""

    process: Any  # a `Child`, whose streams are pipes
    job: Job


class _Crew:
    """Workers that take jobs until there are none.

    - `queue`: jobs that no worker had yet; `under_way`: workers with their jobs; `done`: jobs that
      ended, well or not, of `total`.
    - `failures`: a line for each job that failed: its path and what its worker said.
    """

    def __init__(self, jobs: Sequence[Job], title: str):
        self.queue, self.total, self.done = iter(jobs), len(jobs), 0
        self.under_way, self.failures = list[_Worker](), list[str]()
        self.line = Line(title, self.total, 0, TOLD)
        self.began = self.line.last = time.monotonic()
        self.signals = Signals(quiet=False, end=self.end)

    def work(self, number: int) -> int:
        """Do all jobs with this many workers; the signal that ended it, or 0."""
        asked = False
        try:
            with self.signals:
                self.line.start(self.told())
                for _ in range(number):
                    self.give(None)
                while self.under_way:
                    if self.signals.received and not asked:
                        asked = True
                        for one in self.under_way:
                            one.process.terminate()  # by which they save
                    self.listen()
                    self.show()
        finally:
            self.end()
            self.line.stop()
        return self.signals.received

    def give(self, process: Any) -> None:
        """Give the next job to a worker, or to a new one; without a job it ends."""
        job = None if self.signals.received else next(self.queue, None)
        if job is None:
            _end(process)
            return
        process = process or _start()
        self.under_way.append(_Worker(process, job))
        with contextlib.suppress(BrokenPipeError):  # it is dead, and `listen` hears of it
            process.stdin.write(job.message() + "\n")
            process.stdin.flush()

    def listen(self) -> None:
        """Take the answers that are there, and give what is next."""
        ready = select.select([one.process.stdout for one in self.under_way], [], [], 0.05)[0]
        for one in [one for one in self.under_way if one.process.stdout in ready]:
            process, job = one
            answer = _answer(process)
            self.under_way.remove(one)
            if "error" in answer:
                self.failures.append(f"{job.path}: {answer['error']}")
            if not self.signals.received:  # else it was stopped and saved, not finished
                self.done += 1
                self.line.show(f"{self.told()} {job.path}", self.done)
            if "error" in answer:
                _end(process)
                process = None
            self.give(process)

    def show(self) -> None:
        """Say now and then how far they are."""
        if time.monotonic() - self.line.last > (1.0 if self.line.console.is_terminal else TOLD):
            states = ", ".join(one.job.state() for one in self.under_way)
            self.line.show(f"{self.told()} {states}", self.done)

    def told(self) -> str:
        """How many are done, and how long the others take."""
        if self.done == 0:
            return f"0/{self.total}"
        left = (time.monotonic() - self.began) / self.done * (self.total - self.done)
        return f"{self.done}/{self.total} left {clock(left)}"

    def end(self) -> None:
        """End all workers at once, and whatever they started."""
        _kill(*[one.process for one in self.under_way])


def _start() -> Child:
    """A worker, which computes on one core alone."""
    pipe = subprocess.PIPE
    how = {"grace": SAVE, "opening": True}
    return Child(worker.__name__, **how, stdin=pipe, stdout=pipe, text=True)


def _answer(process: Any) -> dict[str, Any]:
    """The answer of a worker; without one its process has ended when this returns."""
    try:
        return json.loads(process.stdout.readline())
    except json.JSONDecodeError:
        process.over(0.5)  # it may be about to end by itself
        _kill(process)
        return {"error": f"its process ended with exit code {process.returncode}"}


def _end(process: Any) -> None:
    """Let a worker end, if there is one: it does when nothing more can come."""
    if process is not None:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        process.over(GRACE)
        _kill(process)
        process.stdout.close()


def _kill(*processes: Any) -> None:
    """End workers at once, and whatever they started: guardians wait only if they are told once."""
    for _ in range(100):
        left = [process for process in processes if not process.over(0.0)]
        if not left:
            break
        for process in left:
            process.terminate()
        left[0].over(0.05)
    for process in processes:
        process.end(0.0)
