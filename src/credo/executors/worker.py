"""A process that trains one run after another: a job per line of JSON in, an answer per line out.

It is started by `local`, as a child that ends with its parent (see `environments.processes`). A job
is what `Job.message` says; an answer is `{"ok": path}`, or `{"error": words}`. When nothing more
can come in, a run under way is saved and the process ends. On Linux it computes on one core; what
is printed goes to stderr.
"""

import json
import os
import pathlib
import queue
import signal
import sys
import threading
from typing import Any


def main() -> None:
    """Take jobs until there are none. Ends with 128 + n after signal n, saved."""
    if hasattr(os, "sched_setaffinity"):  # not on macOS
        os.sched_setaffinity(0, {int(sys.argv[1])})  # before JAX counts its threads
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever prints must not look like an answer
    jobs, busy = queue.SimpleQueue(), threading.Event()
    threading.Thread(target=_listen, args=(jobs, busy), daemon=True).start()

    import jax

    from ..runs.loop import Interrupted

    before = None
    while line := jobs.get():
        job, stop = json.loads(line), None
        if job["algorithm"] != before:
            jax.clear_caches()  # programs of an earlier cell would pile up
            before = job["algorithm"]
        busy.set()
        try:
            _train(job)
            answer = {"ok": job["path"]}
        except Interrupted as error:
            answer, stop = {"error": str(error)}, error.code
        except Exception as error:  # the parent reports it
            answer = {"error": f"{type(error).__name__}: {error}"}
        busy.clear()
        print(json.dumps(answer), file=answers, flush=True)
        if stop is not None:
            raise SystemExit(stop)


def _listen(jobs: queue.SimpleQueue[bytes], busy: threading.Event) -> None:
    """Hand on what comes in. Its end ends a run that is under way, saved: the parent stops, or is
    gone."""
    # Unbuffered: Python cannot end while a thread waits in a buffered read.
    with open(0, "rb", buffering=0, closefd=False) as lines:
        for line in lines:
            jobs.put(line)
    jobs.put(b"")
    if busy.is_set():
        os.kill(os.getpid(), signal.SIGTERM)


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
