"""Many runs, one process per core: on two cores, two single-threaded runs beat one that uses
both. What is finished is not run again; what was stopped goes on."""

import contextlib
import dataclasses
import json
import pathlib
import subprocess
import sys
import threading
import time
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from . import checkpoint, config
from .loop import Interrupted, Run, RunError, Signals


@dataclasses.dataclass
class Job:
    """One run. `algorithm` is an object or the tree that `config.to_tree` makes of it."""

    path: pathlib.Path
    algorithm: Any
    generations: int
    seed: int
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

    def finished(self) -> bool:
        """Whether the champion on disk is the budget's. Raises if the folder holds another run."""
        if not (self.path / "config.json").exists():
            return False
        recorded = Run(self.path).config
        lines = config.differences(recorded["algorithm"], self.tree)
        if recorded["budget"]["generations"] > self.generations:
            lines.append(f"generations: {recorded['budget']['generations']} != {self.generations}")
        if recorded["seed"] != self.seed or lines:
            raise RunError(
                f"{self.path} holds a run with other settings ({'; '.join(lines) or 'seed'}): "
                "remove it or choose another folder"
            )
        champion = self.path / "champion.safetensors"
        if not champion.exists():
            return False
        done = int(checkpoint.read_metadata(champion)["generation"])
        if self.stop_at is not None:
            scores = Run(self.path).metrics.get("champion_score", [])
            if len(scores) and scores[-1] >= self.stop_at - 1e-6:
                return True
        return done >= self.generations

    def message(self) -> str:
        fields = dataclasses.asdict(self) | {"path": str(self.path), "algorithm": self.tree}
        return json.dumps(fields)


def run(jobs: list[Job], workers: int | None = None, *, title: str = "runs") -> None:
    """Train every unfinished job. Raises `RunError` with the failures after all have been tried,
    `Interrupted` after a signal: the workers save first."""
    waiting = [job for job in jobs if not job.finished()]
    if not waiting:
        return
    cores = config.available_cores()
    workers = min(workers or len(cores), len(waiting))
    failures: list[str] = []
    console = Console(file=sys.stderr)
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24))
    bar = Progress(
        *columns,
        TextColumn("{task.completed}/{task.total} {task.fields[text]}"),
        TimeElapsedColumn(),
        console=console,
        disable=not console.is_terminal,
    )
    task = bar.add_task(title, total=len(jobs), completed=len(jobs) - len(waiting), text="")
    queue, began, done = iter(list(waiting)), time.monotonic(), 0
    guard = threading.Lock()

    def work(core: int) -> None:
        nonlocal done
        process = _start(core)
        while not signals.received:
            with guard:
                job = next(queue, None)
            if job is None:
                break
            answer = _ask(process, job)
            with guard:
                if "error" in answer:
                    failures.append(f"{job.path}: {answer['error']}")
                done += 1
                left = (time.monotonic() - began) / done * (len(waiting) - done)
                bar.update(task, advance=1, text=f"left {left / 60:.1f} min")
                if not console.is_terminal:
                    print(
                        f"{title}: {done}/{len(waiting)} {job.path}, left {left / 60:.1f} min",
                        file=sys.stderr,
                        flush=True,
                    )
            if process.poll() is not None:
                _end(process)
                process = _start(core)
        _end(process)

    with Signals() as signals, bar:
        threads = [
            threading.Thread(target=work, args=(cores[i % len(cores)],), daemon=True)
            for i in range(workers)
        ]
        for thread in threads:
            thread.start()
        told = False
        while any(thread.is_alive() for thread in threads):
            if signals.received and not told:
                told = True
                for process in list(_processes):
                    if process.poll() is None:
                        process.send_signal(signals.received)
            time.sleep(0.05)
    if done < len(waiting) and not (signals.received or failures):
        failures.append(f"{len(waiting) - done} runs were never started: a worker could not start")
    if signals.received:
        raise Interrupted(
            "stopped and saved; the same command goes on where it was", 128 + signals.received
        )
    if failures:
        raise RunError(f"{len(failures)} of {len(waiting)} runs failed:\n" + "\n".join(failures))


_processes: list[subprocess.Popen] = []


def _start(core: int) -> subprocess.Popen:
    process = subprocess.Popen(
        [sys.executable, "-m", "credo.runs.worker", str(core)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # a Ctrl-C reaches the parent alone, which passes it on
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
        process.kill()  # else the next job might still be given to it
        return {"error": f"its process ended with exit code {process.wait()}"}


def _end(process: subprocess.Popen) -> None:
    assert process.stdin is not None
    assert process.stdout is not None
    with contextlib.suppress(BrokenPipeError):
        process.stdin.close()
    process.wait()
    process.stdout.close()
