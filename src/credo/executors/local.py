"""Many runs, one process per core: on two cores, two single-threaded runs beat one that uses
both. What is finished is not run again; what was stopped goes on.

A thread for each worker gives it one job after another over a pipe (see `worker`). A worker leads a
process group of its own, so that whatever an environment starts ends with it: after its last job,
after an error, after a second Ctrl-C, and when this process is killed. A worker that dies takes one
job with it: that one is told, and a new worker takes the next.
"""

import contextlib
import dataclasses
import functools
import json
import os
import pathlib
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ..runs import checkpoint, config, log, record, screen
from ..runs.budget import Budget
from ..runs.loop import Interrupted
from ..runs.options import RunOptions
from ..runs.progress import clock
from ..runs.record import RunError
from ..runs.signals import Signals
from ..runs.store import CHAMPION, Run
from . import worker

TOLD = 60.0  # seconds between two lines on the runs under way, where there is no terminal
GRACE = 10.0  # seconds that a worker without a job has to end in
SAVE = 3600.0  # seconds that workers have to finish a generation and save, after a signal


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
            return Budget.read(record.read(self.path)["budget"]).going_on(self._kind, self.options)
        return Budget.of(self._kind, self.options)

    @property
    def _kind(self) -> Any:
        """Who knows the default budget."""
        asked = (self.options.generations, self.options.frames) != (None, None)
        if asked or not isinstance(self.algorithm, dict) or self.again is not None:
            return self.algorithm
        return config.find_class(self.algorithm["class"])

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
            self._require_larger(run, *done)
        return self.budget.reached(*done, float(row["champion_score"])) is not None

    def _require_same(self, run: Run) -> None:
        """Raise if the folder holds a run that this job is not."""
        lines = config.changed(run.config["algorithm"], self.tree)
        recorded = Budget.read(run.config["budget"])
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

    def _require_larger(self, run: Run, generation: int, frames: int) -> None:
        """Raise if the run has done more than it is asked to do."""
        try:
            self.budget.refuse_smaller(Budget.read(run.config["budget"]), generation, frames)
        except ValueError as error:
            raise RunError(f"{self.path}: {error}") from None

    def message(self) -> str:
        """What a worker is told, as a line of JSON."""
        # Objects are the caller's own; a tree may be what a stranger recorded.
        again = (
            {"trust": not isinstance(self.algorithm, dict)} if self.again is None else self.again
        )
        options = self.options
        if self.again is None:
            options = options.changed(self.budget.record())
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
    crew = _Crew(waiting, Board(title, len(jobs), len(waiting)))
    number = crew.work(min(workers or len(config.available_cores()), len(waiting)))
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


class _Crew:
    """Threads, each with a worker's process, that take jobs until there are none."""

    def __init__(self, jobs: Sequence[Job], board: "Board"):
        self.total, self.board = len(jobs), board
        self.queue, self.done, self.under_way = iter(jobs), 0, list[Job]()
        self.failures: list[str] = []
        self.guard, self.over = threading.Lock(), threading.Event()
        self.signals = Signals(quiet=False, end=_kill_all)

    def work(self, number: int) -> int:
        """Do all jobs with this many workers; the signal that ended it, or 0."""
        cores = config.available_cores()
        with _no_orphans(self.guard, self.over), self.signals, self.board:
            threads = [
                threading.Thread(target=self._take, args=(cores[i % len(cores)],), daemon=True)
                for i in range(number)
            ]
            for thread in threads:
                thread.start()
            told = None
            while any(thread.is_alive() for thread in threads):
                if self.signals.received and told is None:
                    told = time.monotonic()
                    _pass_on(self.signals.received)
                if told is not None and time.monotonic() - told > SAVE:
                    _kill_all()
                with self.guard:
                    self.board.show(self.under_way)
                time.sleep(0.05)
        received = self.signals.received
        if self.done < self.total and not (received or self.failures):
            left = self.total - self.done
            self.failures.append(f"{left} runs were never started: a worker could not start")
        return received

    def _take(self, core: int) -> None:
        """One job after the other, in a process that is replaced if it dies."""
        process = self._begun(core)
        while process is not None and not self.signals.received:
            with self.guard:
                job = next(self.queue, None)
                if job is None:
                    break
                self.under_way.append(job)
            answer = _ask(process, job)
            with self.guard:
                self.under_way.remove(job)
                if "error" in answer:
                    self.failures.append(f"{job.path}: {answer['error']}")
                if not self.signals.received:  # else it was stopped and saved, not finished
                    self.done += 1
                    self.board.finished(job, self.done)
            if process.poll() is not None:
                _end(process)
                process = self._begun(core)
        if process is not None:
            _end(process)

    def _begun(self, core: int) -> subprocess.Popen | None:
        """A worker; none once all are ended."""
        with self.guard:
            return None if self.over.is_set() or self.signals.received else _start(core)


class Board:
    """How many runs are done, and how far those under way are. A bar on a terminal, else lines."""

    def __init__(self, title: str, total: int, waiting: int):
        self.title, self.waiting = title, waiting
        self.console = Console(file=sys.stderr)
        self.bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.completed}/{task.total} {task.fields[text]}"),
            TimeElapsedColumn(),
            console=self.console,
            disable=not self.console.is_terminal,
        )
        self.task = self.bar.add_task(title, total=total, completed=total - waiting, text="")
        self.began = self.shown = time.monotonic()
        self.left = ""

    def __enter__(self):
        """Show the bar."""
        self.bar.start()
        return self

    def __exit__(self, *_):
        self.bar.stop()

    def finished(self, job: Job, done: int) -> None:
        """`job` is the run number `done` of those that were waiting."""
        left = (time.monotonic() - self.began) / done * (self.waiting - done)
        self.left = f"left {clock(left)}"
        self.bar.update(self.task, advance=1, text=self.left)
        self._print(f"{done}/{self.waiting} {job.path}, {self.left}")

    def show(self, under_way: list[Job]) -> None:
        """Look how far they are, now and then."""
        terminal = self.console.is_terminal
        if time.monotonic() - self.shown < (1.0 if terminal else TOLD) or not under_way:
            return
        self.shown = time.monotonic()
        states = ", ".join(job.state() for job in under_way)
        self.bar.update(self.task, text=f"{self.left} {states}".strip())
        self._print(states)

    def _print(self, text: str) -> None:
        if not self.console.is_terminal:
            print(f"{self.title}: {text}", file=sys.stderr, flush=True)


_processes: list[subprocess.Popen] = []


def _start(core: int) -> subprocess.Popen:
    """A worker that computes on this core alone."""
    process = subprocess.Popen(
        worker.command(core),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        # A Ctrl-C reaches the parent alone, which passes it on; and what a worker starts is in a
        # group with it, and ends with it.
        start_new_session=True,
    )
    _processes.append(process)
    return process


def _ask(process: subprocess.Popen, job: Job) -> dict[str, Any]:
    """The answer of a worker; without one its process has ended when this returns."""
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdin.write(job.message() + "\n")
        process.stdin.flush()
        return json.loads(process.stdout.readline())
    except (OSError, json.JSONDecodeError):
        with contextlib.suppress(subprocess.TimeoutExpired):  # it may be about to end by itself
            process.wait(0.5)
        _kill(process)  # else the next job might still be given to it
        return {"error": f"its process ended with exit code {process.returncode}"}


def _end(process: subprocess.Popen) -> None:
    """Let a worker end, which it does when nothing more can come, and see to it."""
    assert process.stdin is not None
    assert process.stdout is not None
    with contextlib.suppress(BrokenPipeError):
        process.stdin.close()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(GRACE)
    _kill(process)
    process.stdout.close()


def _kill(process: subprocess.Popen) -> None:
    """End a worker and whatever it started, in a bounded time."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        if process.poll() is None or _leads(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.kill()
        process.wait(GRACE)
    with contextlib.suppress(ValueError):
        _processes.remove(process)


def _leads(group: int) -> bool:
    """Whether processes are left in the group that a worker led. While there are, its number is
    given to no other process."""
    try:
        os.killpg(group, 0)
    except (ProcessLookupError, PermissionError):
        return False
    return True


def _pass_on(number: int) -> None:
    """Send a signal to every worker that is there."""
    for process in list(_processes):
        if process.poll() is None:
            process.send_signal(number)


def _kill_all() -> None:
    """End all workers of this process, of whichever `run` they are."""
    for process in list(_processes):
        _kill(process)


@contextlib.contextmanager
def _no_orphans(guard: threading.Lock, over: threading.Event) -> Iterator[None]:
    """No worker is left, however the block ends: by an error or a second Ctrl-C too. `over`: that
    it ended, told to whoever starts one."""
    try:
        yield
    finally:
        with guard:
            over.set()
        _kill_all()
