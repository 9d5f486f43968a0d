"""Many runs of tasks in JAX in this process, one at a time on each of several devices.

Each run has a thread and a device of its own. What is computed is the program of a run by itself,
so it has the bits of one that was trained alone on such a device, waits for no other and fails
alone. It is one process, since JAX takes most of the memory of every GPU that a process sees.
"""

import json
import pathlib
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from queue import SimpleQueue
from typing import Any

import jax

from ..playing.devices import require
from ..runs import config
from ..runs.signals import Signals
from . import worker
from .board import Board
from .jobs import Ending, Job


def train(jobs: Sequence[Job], number: int, title: str) -> Ending:
    """Train jobs on the first `number` devices. After a signal all are saved.

    **Raises:** `ValueError` if JAX has not so many, or a task is not played on them.
    """
    for job in jobs:
        require(number, _task(job))
    free = SimpleQueue[Any]()  # devices
    for device in jax.local_devices()[:number]:
        free.put(device)
    # After a second signal the threads are waited for, until `Signals` ends the process.
    with Signals(quiet=False) as signals, ThreadPoolExecutor(number) as pool:
        tries = {pool.submit(_train, job, free, signals): job for job in jobs}
        return Ending(_failures(tries, signals, Board(title, len(jobs))), signals.received)


def _task(job: Job) -> Any:
    """What a run is trained on, as an object; None if that cannot be told without code of others,
    whose tasks outside JAX have a class of ours."""
    if not isinstance(job.algorithm, dict):
        return job.algorithm.env
    try:
        return config.from_tree(job.algorithm.get("env"), trust=False)
    except ValueError:  # its own run says why
        return None


def _failures(
    tries: dict[Future[str], Job], signals: Signals, board: Board
) -> dict[pathlib.Path, str]:
    """Wait for all, and show how far they are; why runs failed, by their folders."""
    left, failures = set(tries), {}
    board.start()
    try:
        while left:
            done, left = wait(left, 0.05, FIRST_COMPLETED)
            for job, error in [(tries[one], one.result()) for one in done]:
                failures |= {job.path: error} if error else {}
                if not signals.received:  # else it was stopped and saved, not finished
                    board.over(job)
            board.show(job for one, job in tries.items() if one.running())
    finally:
        board.stop()
    return failures


def _train(job: Job, free: SimpleQueue[Any], signals: Signals) -> str:
    """Train one on a free device, if nothing has been stopped; why it failed, or ""."""
    if signals.received:
        return ""
    told, device = json.loads(job.message()), free.get()
    told["options"] |= {"devices": None}  # it has this one
    try:
        with jax.default_device(device):
            # Signals come to the main thread alone: this one asks for them after each dispatch.
            worker.train_when_free(told, callbacks=(lambda *_: signals.received > 0,))
    except Exception as error:  # whoever gave the jobs reports it
        return f"{type(error).__name__}: {error}"
    finally:
        free.put(device)
    return ""
