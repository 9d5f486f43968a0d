"""A process that trains one run after another: a job per line of JSON in, an answer per line out.
Started by `executor`; it ends when its input does."""

import json
import os
import pathlib
import signal
import sys
import threading
import time


def _end_with_parent(parent: int) -> None:
    """Save and end when the parent is gone: nobody would read the answer."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os.kill(os.getpid(), signal.SIGTERM)


def main() -> None:
    if hasattr(os, "sched_setaffinity"):  # not on macOS
        os.sched_setaffinity(0, {int(sys.argv[1])})  # before JAX counts its threads
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()
    sys.path.insert(0, os.getcwd())
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever prints must not look like an answer

    import jax

    from . import config, loop

    before = None
    for line in sys.stdin:
        job = json.loads(line)
        if job["algorithm"] != before:
            jax.clear_caches()  # programs of an earlier cell would pile up
            before = job["algorithm"]
        path = pathlib.Path(job["path"])
        try:
            options = {
                name: job[name]
                for name in (
                    "generations",
                    "frames",
                    "stop_at",
                    "wall_clock",
                    "checkpoint_every",
                    "keep",
                    "tensorboard",
                )
            }
            if (path / "config.json").exists():
                loop.resume(path, progress=False, **options)
            else:
                algorithm = config.from_tree(job["algorithm"])
                start = {"seed": job["seed"], "warm_start": job["warm_start"]}
                loop.train(algorithm, path=path, progress=False, **start, **options)
            answer = {"ok": str(path)}
        except loop.Interrupted as stop:
            answers.write(json.dumps({"error": str(stop)}) + "\n")
            answers.flush()
            raise SystemExit(stop.code) from None
        except Exception as error:  # the parent reports it; the next job may still succeed
            answer = {"error": f"{type(error).__name__}: {error}"}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
