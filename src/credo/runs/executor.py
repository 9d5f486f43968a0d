"""Many runs, one process per core: on two cores, two single-threaded runs beat one that uses
both. What is finished is not run again; what was stopped goes on."""

import contextlib
import dataclasses
import json
import os
import pathlib
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from . import checkpoint, config, log, screen, worker
from .budget import Budget
from .loop import Interrupted, Run, RunError
from .progress import clock
from .signals import Signals

TOLD = 60.0  # seconds between two lines on the runs under way, where there is no terminal
GRACE = 10.0  # seconds that a worker without a job has to end in
SAVE = 3600.0  # seconds that workers have to finish a generation and save, after a signal


@dataclasses.dataclass
class Job:
    """One run. `algorithm` is an object or the tree that `config.to_tree` makes of it."""

    path: pathlib.Path
    algorithm: Any
    generations: int | None
    seed: int
    frames: int | None = None  # with neither limit: the algorithm's default budget
    warm_start: str | None = None  # the run whose champion this one starts from
    stop_at: float | None = None
    wall_clock: float | None = None  # seconds
    checkpoint_every: float = 60.0  # seconds
    keep: int = 3
    tensorboard: bool = False

    @property
    def tree(self) -> dict[str, Any]:
        tree = (
            self.algorithm if isinstance(self.algorithm, dict) else config.to_tree(self.algorithm)
        )
        return json.loads(json.dumps(tree))

    @property
    def budget(self) -> Budget:
        algorithm, limited = self.algorithm, (self.generations, self.frames) != (None, None)
        if isinstance(algorithm, dict) and not limited:
            algorithm = config.find_class(algorithm["class"])  # for its default
        return Budget.of(algorithm, self.generations, self.frames, self.stop_at)

    def finished(self) -> bool:
        """Whether the champion on disk is the budget's. Raises if the folder holds another run."""
        if not (self.path / "config.json").exists():
            return False
        run = Run(self.path)
        lines = config.changed(run.config["algorithm"], self.tree)
        recorded, budget = Budget.read(run.config["budget"]), self.budget
        for name in ("generations", "frames"):
            old, new = getattr(recorded, name), getattr(budget, name)
            if old is not None and (new is None or old > new):
                lines.append(f"{name}: {old} != {new}")
        if run.config.get("warm_start") != self.warm_start:
            lines.append(f"warm start: {run.config.get('warm_start')} != {self.warm_start}")
        if run.config["seed"] != self.seed or lines:
            raise RunError(
                f"{self.path} holds a run with other settings ({'; '.join(lines) or 'seed'}): "
                "remove it or choose another folder"
            )
        champion = self.path / "champion.safetensors"
        row = log.last(self.path / "metrics.csv")
        if not champion.exists() or not row:
            return False
        if checkpoint.read_metadata(champion)["generation"] != row["generation"]:
            return False  # killed since: what the rows say is not what the champion is
        score = float(row["champion_score"])
        return budget.reached(int(row["generation"]), int(row["frames"]), score) is not None

    def message(self) -> str:
        budget = self.budget.record()
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        # Objects are the caller's own; a tree may be what a stranger recorded.
        own = {"trust": not isinstance(self.algorithm, dict)}
        fields |= {"path": str(self.path), "algorithm": self.tree}
        return json.dumps(fields | budget | own)

    def state(self) -> str:
        """How far it is, in a few words."""
        row = log.last(self.path / "metrics.csv")
        done = "starting"
        if row:
            done = self.budget.done(int(row["generation"]), int(row["frames"]))
        return f"{self.path.name} {done}"


@screen.calm()
def run(jobs: list[Job], workers: int | None = None, *, title: str = "runs") -> None:
    """Train every unfinished job. Raises `RunError` with the failures after all have been tried,
    `Interrupted` after a signal: the workers save first."""
    waiting = [job for job in jobs if not job.finished()]
    if not waiting:
        return
    cores = config.available_cores()
    workers = min(workers or len(cores), len(waiting))
    failures: list[str] = []
    queue, done, under_way = iter(list(waiting)), 0, list[Job]()
    guard = threading.Lock()

    over = threading.Event()

    def begun(core: int) -> subprocess.Popen | None:
        with guard:  # none is started once all are ended
            return None if over.is_set() or signals.received else _start(core)

    def work(core: int) -> None:
        nonlocal done
        process = begun(core)
        while process is not None and not signals.received:
            with guard:
                job = next(queue, None)
                if job is None:
                    break
                under_way.append(job)
            answer = _ask(process, job)
            with guard:
                under_way.remove(job)
                if "error" in answer:
                    failures.append(f"{job.path}: {answer['error']}")
                if not signals.received:  # else it was stopped and saved, not finished
                    done += 1
                    board.finished(job, done)
            if process.poll() is not None:
                _end(process)
                process = begun(core)
        if process is not None:
            _end(process)

    board = Board(title, len(jobs), len(waiting))
    with _no_orphans(guard, over), Signals(quiet=False, end=_kill_all) as signals, board:
        threads = [
            threading.Thread(target=work, args=(cores[i % len(cores)],), daemon=True)
            for i in range(workers)
        ]
        for thread in threads:
            thread.start()
        told = None
        while any(thread.is_alive() for thread in threads):
            if signals.received and told is None:
                told = time.monotonic()
                for process in list(_processes):
                    if process.poll() is None:
                        process.send_signal(signals.received)
            if told is not None and time.monotonic() - told > SAVE:
                _kill_all()
            with guard:
                board.show(under_way)
            time.sleep(0.05)
    if done < len(waiting) and not (signals.received or failures):
        failures.append(f"{len(waiting) - done} runs were never started: a worker could not start")
    if signals.received:
        raise Interrupted(
            "stopped and saved; the same command goes on where it was", 128 + signals.received
        )
    if failures:
        raise RunError(f"{len(failures)} of {len(waiting)} runs failed:\n" + "\n".join(failures))


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


def _kill_all() -> None:
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
