"""A task of a job array of Slurm, which trains the run of its line. Slurm starts this file itself.

Some time before its limit Slurm sends SIGUSR1 to the task's first process, which is this one: the
run is told to save, and the task is put back into the queue, to go on later. SIGTERM, by which
Slurm ends a task that is cancelled or preempted, reaches every process of the task, and is not
passed on: to a run a second signal means to stop at once. The standard library, and no more, is
imported here.
"""

import json
import os
import pathlib
import signal
import subprocess
import sys
from typing import Any

JOBS, SETUP, FAILED = "jobs.jsonl", "setup.json", "{}.failed"  # the last with the line's number
STOPPED = (128 + signal.SIGTERM, -signal.SIGTERM)  # exit codes of a run that was told to save
NO_TIME = "no generation ended before the limit of time: give a longer one, --slurm time=…"
ALL_CORES = "all-cores"  # an argument of a worker, which settles on one core otherwise


def main(folder: pathlib.Path, index: int) -> int:
    """Train the run of this line of `jobs.jsonl`; an exit code. Why it failed is written to a file
    beside, for the command that submitted the array."""
    line = (folder / JOBS).read_text("utf-8").splitlines()[index]
    path = pathlib.Path(json.loads(line)["path"])
    failed, before = folder / FAILED.format(index), newest(path)
    failed.unlink(missing_ok=True)
    answer, code, late = _trained(folder, line)
    if code == 0:
        error = answer.get("error")
    elif late:
        if newest(path) > before:
            return subprocess.run(["scontrol", "requeue", _own_name()]).returncode
        error = NO_TIME
    elif code in STOPPED:
        return STOPPED[0]
    else:
        error = f"its process ended with exit code {code}"
    if error is None:
        return 0
    failed.write_text(error, "utf-8")
    print(f"credo: {path}: {error}", file=sys.stderr)
    return 1


def newest(path: pathlib.Path) -> int:
    """The generation of a run's newest checkpoint; -1 if there is none."""
    return max((int(x.name) for x in path.glob("checkpoints/[0-9]*")), default=-1)


def _trained(folder: pathlib.Path, line: str) -> tuple[dict[str, Any], int, bool]:
    """A worker's answer, `{}` if it gave none, its exit code, and whether it was stopped because of
    the limit of time."""
    late, workers = list[int](), list[subprocess.Popen[str]]()

    def stop(number: int, _: Any) -> None:
        late.append(number)
        for worker in workers:
            worker.terminate()  # by which it saves

    signal.signal(signal.SIGUSR1, stop)
    signal.signal(signal.SIGTERM, lambda *_: None)  # a worker would inherit that it is ignored
    pipe, command = subprocess.PIPE, [sys.executable, "-P", __file__, str(folder), "worker"]
    workers.append(subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True))
    if late:  # the signal came before there was a worker
        workers[0].terminate()
    told, _ = workers[0].communicate(line + "\n")
    return json.loads(told or "{}"), workers[0].returncode, bool(late)


def _own_name() -> str:
    """This task's, as `scontrol` knows it."""
    return f"{os.environ['SLURM_ARRAY_JOB_ID']}_{os.environ['SLURM_ARRAY_TASK_ID']}"


def _work(folder: pathlib.Path) -> None:
    """Be a worker (see `worker`). It finds modules where the command that submitted it does."""
    sys.path[:] = json.loads((folder / SETUP).read_text("utf-8"))["path"]
    from credo.environments import processes

    many = int(os.environ.get("SLURM_CPUS_PER_TASK", "1")) > 1
    processes.serve("credo.executors.worker", sys.path, True, [ALL_CORES] * many)


if __name__ == "__main__":
    where = pathlib.Path(sys.argv[1])
    if sys.argv[2:] == ["worker"]:
        _work(where)
    else:
        raise SystemExit(main(where, int(os.environ["SLURM_ARRAY_TASK_ID"])))
