"""A process that trains one run after another: a job per line of JSON in, an answer per line out.

It is started by `local` and ends when its input does; with its parent, or after SIGTERM, a run
under way is saved (see `environments.processes`). A job is what `Job.message` says; an answer is
`{"ok": path}`, or `{"error": words}`. On Linux it computes on one core; what is printed goes to
stderr.
"""

import contextlib
import json
import os
import pathlib
import sys
import time
import warnings
from typing import Any

from ..environments import processes
from .array import ALL_CORES

SAVE = 3600.0  # seconds to finish a generation and save in, after a signal or the parent's end
POLL = 0.5  # seconds between two looks whether a run is free


def main() -> None:
    """Take jobs until there are none. Ends with 128 + n after signal n, saved."""
    if sys.argv[1:] != [ALL_CORES]:
        processes.settle()
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever prints must not look like an answer

    import jax

    from ..runs.ending import say
    from ..runs.loop import Interrupted

    warnings.showwarning = lambda message, *_args, **_kw: say(f"warning: {message}")
    before = None
    for line in sys.stdin:
        job, stop = json.loads(line), None
        if job["algorithm"] != before:
            jax.clear_caches()  # programs of an earlier cell would pile up
            before = job["algorithm"]
        try:
            train_when_free(job)
            answer = {"ok": job["path"]}
        except Interrupted as error:
            answer, stop = {"error": str(error)}, error.code
        except Exception as error:  # the parent reports it
            answer = {"error": f"{type(error).__name__}: {error}"}
        with contextlib.suppress(BrokenPipeError):  # the parent is gone; what was saved stays
            print(json.dumps(answer), file=answers, flush=True)
        if stop is not None:
            raise SystemExit(stop)


def train_when_free(job: dict[str, Any], **changes: Any) -> None:
    """Train once no other process has the run; `changes` are fields of its options. Raises
    `RunLocked` if one still has it after the job's `patience` in seconds."""
    from ..runs.ending import say
    from ..runs.lock import RunLocked

    until, told = time.monotonic() + job["patience"], False
    while True:
        try:
            return _train(job, changes)
        except RunLocked as error:
            if time.monotonic() >= until:
                raise
            if not told:
                told = True
                say(f"credo: waiting for it: {error}")
        time.sleep(POLL)


def _train(job: dict[str, Any], changes: dict[str, Any]) -> None:
    """Begin a run, or go on with the one in its folder."""
    from ..runs import config, loop, options, record

    path = pathlib.Path(job["path"])
    told = options.RunOptions.read(job["options"]).changed(changes)
    if (path / record.NAME).exists():
        # Its settings are those of the job: the parent looked (`Job.finished`).
        loop.resume(path, told, **job["again"])
    else:
        algorithm = config.from_tree(job["algorithm"], trust=job["again"]["trust"])
        loop.train(algorithm, told, path=path, seed=job["seed"], warm_start=job["warm_start"])
