"""A process that trains one run after another: a job per line of JSON in, an answer per line out.

It is started by `local` and ends when its input does, or with its parent. A job is what
`Job.message` says; an answer is `{"ok": path}`, or `{"error": words}` with which the process goes
on. On Linux it computes on one core; what is printed goes to stderr.
"""

import contextlib
import ctypes
import json
import os
import pathlib
import signal
import sys
import threading
import time
from typing import Any

GRACE = 60.0  # seconds to save in, once the parent is gone
PR_SET_PDEATHSIG = 1


def command(core: int) -> list[str]:
    """What starts a worker. Its path is the parent's, as JSON: a folder may have a colon in its
    name, and a script may have added to the path."""
    path = [os.path.abspath(entry) for entry in sys.path if entry or os.path.exists(".")]
    start = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    start += "import credo.executors.worker as worker; worker.main(int(sys.argv[2]))"
    return [sys.executable, "-c", start, json.dumps(path), str(core)]


def _end_with_parent(parent: int) -> None:
    """Save and end when the parent is gone: the answer would not be read. Whatever this process
    started goes with it."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE)
    if os.getpgrp() == os.getpid():  # the group is ours alone
        os.killpg(0, signal.SIGKILL)
    os._exit(128 + signal.SIGTERM)


def _ask_for_death(parent: int) -> None:
    """Have the system send SIGTERM when the parent dies: on Linux at once, elsewhere within the
    second that `_end_with_parent` sleeps."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != parent:  # it died before it was asked for
        raise SystemExit(128 + signal.SIGTERM)


def main(core: int) -> None:
    """Take jobs until there are none. Ends with 128 + n after signal n, saved."""
    if hasattr(os, "sched_setaffinity"):  # not on macOS
        os.sched_setaffinity(0, {core})  # before JAX counts its threads
    parent = os.getppid()
    _ask_for_death(parent)
    threading.Thread(target=_end_with_parent, args=(parent,), daemon=True).start()
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever prints must not look like an answer

    import jax

    from ..runs import loop

    def answer(told: dict[str, Any]) -> None:
        answers.write(json.dumps(told) + "\n")
        answers.flush()

    before = None
    for line in sys.stdin:
        job = json.loads(line)
        if job["algorithm"] != before:
            jax.clear_caches()  # programs of an earlier cell would pile up
            before = job["algorithm"]
        try:
            _train(job)
            answer({"ok": job["path"]})
        except loop.Interrupted as stop:
            answer({"error": str(stop)})
            raise SystemExit(stop.code) from None
        except Exception as error:  # the parent reports it; the next job may still succeed
            answer({"error": f"{type(error).__name__}: {error}"})


def _train(job: dict[str, Any]) -> None:
    """Begin a run, or go on with the one in its folder."""
    from ..runs import config, loop, options, record

    path, told = pathlib.Path(job["path"]), options.RunOptions.read(job["options"])
    if (path / record.NAME).exists():
        # Its settings are those of the job: the parent looked (`Job.finished`).
        loop.resume(path, told, **job["again"])
    else:
        algorithm = config.from_tree(job["algorithm"], trust=job["again"]["trust"])
        loop.train(algorithm, told, path=path, seed=job["seed"], warm_start=job["warm_start"])
