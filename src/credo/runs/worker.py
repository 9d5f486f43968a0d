"""A process that trains one run after another: a job per line of JSON in, an answer per line out.
Started by `executor`; it ends when its input does."""

import json
import os
import pathlib
import sys


def main() -> None:
    os.sched_setaffinity(0, {int(sys.argv[1])})  # before JAX counts its threads
    sys.path.insert(0, os.getcwd())
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever prints must not look like an answer

    from . import config, loop

    for line in sys.stdin:
        job = json.loads(line)
        path = pathlib.Path(job["path"])
        try:
            if (path / "config.json").exists():
                loop.resume(
                    path,
                    generations=job["generations"],
                    stop_at=job["stop_at"],
                    wall_clock=job["wall_clock"],
                    tensorboard=False,
                    progress=False,
                )
            else:
                loop.train(
                    config.from_tree(job["algorithm"]),
                    generations=job["generations"],
                    seed=job["seed"],
                    path=path,
                    stop_at=job["stop_at"],
                    wall_clock=job["wall_clock"],
                    tensorboard=False,
                    progress=False,
                )
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
