"""Many runs, one process per core: on two cores, two single-threaded runs beat one that uses
both. What is finished is not run again; what was stopped goes on. Runs on several devices are
trained by this process (see `devices`).

Workers get one job after another over a pipe (see `worker`). Each is a child as environments have
them: whatever it started ends with it, after its last job, after an error, after a second Ctrl-C,
and when this process is killed. A worker that fails takes one job with it: that one is told, and a
new worker takes the next.
"""

import contextlib
import json
import pathlib
import select
import subprocess
from collections.abc import Sequence
from typing import Any, NamedTuple

from ..environments import processes
from ..environments.processes import Child
from ..runs.signals import Signals
from . import devices, worker
from .board import Board
from .jobs import Ending, Job
from .places import Place
from .worker import SAVE

GRACE = 10.0  # seconds that a worker without a job has to end in


def train(jobs: Sequence[Job], workers: int | None, place: Place, title: str) -> Ending:
    """Train jobs in processes of this machine, `workers` at a time; None: one per core that this
    process may use."""
    if (number := max(job.options.devices or 1 for job in jobs)) > 1:
        return devices.train(jobs, min(number, workers or number), title)
    crew = _Crew(jobs, title)
    number = crew.work(min(workers or len(processes.cores()), len(jobs)))
    return Ending(crew.failures, number)


class _Worker(NamedTuple):
    """A process that has a job."""

    process: Any  # a `Child`, whose streams are pipes
    job: Job


class _Crew:
    """Workers that take jobs until there are none.

    - `queue`: jobs that no worker had yet; `under_way`: workers with their jobs.
    - `failures`: what its worker said of each job that failed, by the folder of its run.
    """

    def __init__(self, jobs: Sequence[Job], title: str):
        self.queue, self.board = iter(jobs), Board(title, len(jobs))
        self.under_way, self.failures = list[_Worker](), dict[pathlib.Path, str]()
        self.signals = Signals(quiet=False, end=self.end)

    def work(self, number: int) -> int:
        """Do all jobs with this many workers; the signal that ended it, or 0."""
        asked = False
        try:
            with self.signals:
                self.board.start()
                for _ in range(number):
                    self.give(None)
                while self.under_way:
                    if self.signals.received and not asked:
                        asked = True
                        for one in self.under_way:
                            one.process.terminate()  # by which they save
                    self.listen()
                    self.board.show(one.job for one in self.under_way)
        finally:
            self.end()
            self.board.stop()
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
                self.failures[job.path] = answer["error"]
            if not self.signals.received:  # else it was stopped and saved, not finished
                self.board.over(job)
            if "error" in answer:
                _end(process)
                process = None
            self.give(process)

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
