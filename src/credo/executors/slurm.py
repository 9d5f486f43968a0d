"""Runs as a job array of Slurm: one task for each, which the scheduler starts when there is room.

The script and a line for each run lie beside the runs, in `slurm/<name>/`; so do, once tasks ran,
what they print (`<task>.out`) and why they failed (`<task>.failed`). The name is made of what is in
the script and the lines, and Slurm's own name of the array has it: whoever submitted the script,
`squeue` says which runs are still to come.
"""

import hashlib
import json
import os
import pathlib
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..runs import files, screen
from ..runs.record import RunError
from . import array
from .jobs import PATIENCE, Ending, Job
from .places import WARNING, Place

SCRIPT = """\
#!/bin/bash
# {title}: {count}, one for each task of this array. It is submitted by sbatch.
{directives}

# Before the limit of time Slurm sends SIGUSR1 to this shell, which by then is the program below: it
# has its run saved, and puts the task back into the queue.
cd {home} || exit 1
exec {python} -P {program} {folder}
"""


def train(
    jobs: Sequence[Job], workers: int | None, place: Place, title: str, *, retry: bool = True
) -> Ending:
    """Write a job array for the jobs that Slurm does not have yet, `workers` at a time; None: as
    many as Slurm lets. Submit it if the place says so. Says what failed of earlier ones, which are
    among the jobs of the new one, unless these are not to be tried again (`retry`).

    Raises `RunError` if Slurm's commands are not there or fail.
    """
    there, failed = _earlier(jobs, _queue(place.submit))
    new = [job for job in jobs if _real(job) not in there]
    old = len(jobs) - len(new)
    told = [f"already queued or running: {_runs(old)}"] if old else []
    failures = {job.path: failed[_real(job)] for job in new if _real(job) in failed}
    if failures and retry:
        more = "\n".join(f"{path}: {why}" for path, why in failures.items())
        screen.say(f"credo: failed on Slurm and tried again:\n{more}")
        failures = {}
    new = [job for job in new if job.path not in failures]
    if new:
        script, count = _write(new, workers, place, title), _runs(len(new))
        if place.submit:
            number = _call("sbatch", "--parsable", str(script)).strip()
            told.insert(0, f"submitted {count} as job array {number} of Slurm, {script}")
        else:
            told.insert(0, f"wrote {script} for {count}: submit it by sbatch, or give --submit")
    return Ending(failures, pending="; ".join(told))


def _runs(count: int) -> str:
    return "1 run" if count == 1 else f"{count} runs"


def _real(job: Job) -> str:
    """The folder of a run, whatever links lead to it."""
    return os.path.realpath(job.path)


# What Slurm has already.


def _queue(needed: bool) -> set[tuple[str, str]]:
    """Tasks of this user that wait or run, as names of arrays and numbers of lines. Where Slurm's
    commands are not there, none, unless they are `needed`."""
    if not needed and shutil.which("squeue") is None:
        return set()
    lines = _call("squeue", "--me", "--noheader", "--array", "--format=%j %K").splitlines()
    return {(name, index) for name, _, index in (line.strip().rpartition(" ") for line in lines)}


def _earlier(jobs: Sequence[Job], queue: set[tuple[str, str]]) -> tuple[set[str], dict[str, str]]:
    """The folders of runs that Slurm still has, and why others failed when they were last tried."""
    there, failed = set[str](), dict[str, tuple[float, str]]()
    for folder, index, path in _lines(jobs):
        if (_name(folder), str(index)) in queue:
            there.add(path)
        file = folder / array.FAILED.format(index)
        if file.exists():
            found = file.stat().st_mtime, file.read_text("utf-8")
            failed[path] = max(failed.get(path, found), found)
    return there, {path: error for path, (_, error) in failed.items()}


def _lines(jobs: Sequence[Job]) -> Iterator[tuple[pathlib.Path, int, str]]:
    """Every line of an array that was written for these runs, or beside them: the array's folder,
    the number of the line, and the folder of its run."""
    above = {folder for job in jobs for folder in pathlib.Path(_real(job)).parents}
    for file in [x for folder in sorted(above) for x in folder.glob(f"slurm/*/{array.JOBS}")]:
        for index, line in enumerate(file.read_text("utf-8").splitlines()):
            yield file.parent, index, json.loads(line)["path"]


# What Slurm is given.


def _write(jobs: Sequence[Job], workers: int | None, place: Place, title: str) -> pathlib.Path:
    """Write an array beside the runs; its script."""
    lines = [json.loads(job.message(PATIENCE)) | {"path": _real(job)} for job in jobs]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    tasks = f"0-{len(jobs) - 1}" + (f"%{workers}" if workers else "")
    setup = {"path": [os.path.abspath(entry) for entry in sys.path]}
    told = json.dumps([text, tasks, place.slurm, setup, os.getcwd()])
    beside = os.path.commonpath([os.path.dirname(_real(job)) for job in jobs])
    folder = pathlib.Path(beside) / "slurm" / hashlib.sha256(told.encode()).hexdigest()[:10]
    files.write_text(folder / array.JOBS, text)
    files.write_json(folder / array.SETUP, setup)
    script = SCRIPT.format(
        title=title,
        count=_runs(len(jobs)),
        directives="\n".join(_directives(folder, tasks, place.slurm)),
        home=shlex.quote(os.getcwd()),
        python=shlex.quote(sys.executable),
        program=shlex.quote(os.path.abspath(array.__file__)),
        folder=shlex.quote(str(folder)),
    )
    files.write_text(folder / "array.sh", script)
    return folder / "array.sh"


def _name(folder: pathlib.Path) -> str:
    """Slurm's name of an array."""
    return f"credo-{folder.name}"


def _directives(folder: pathlib.Path, tasks: str, given: Mapping[str, Any]) -> Iterator[str]:
    """The lines for sbatch. What is `given` takes the place of ours; True stands for an option
    without a value, False for none."""
    ours = {"job-name": _name(folder), "array": tasks}
    ours |= {"output": f"{str(folder).replace('%', '%%')}/%a.out", "open-mode": "append"}
    ours |= {"cpus-per-task": 1, "requeue": True, "signal": WARNING}
    theirs = {name.replace("_", "-"): value for name, value in given.items()}
    for name, value in (ours | theirs).items():
        if value is True:
            yield f"#SBATCH --{name}"
        elif value is not False:
            words = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
            yield f"#SBATCH --{name}=" + (f'"{words}"' if re.search(r"\s", words) else words)


def _call(*command: str) -> str:
    """What a command of Slurm prints. Raises `RunError` if it is not there, or fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except FileNotFoundError as error:
        raise RunError(
            f"there is no {command[0]} on this machine: give the command where Slurm's are, or "
            "leave out --submit for a script to submit elsewhere"
        ) from error
    if done.returncode != 0:
        raise RunError(f"{command[0]} failed: {(done.stderr or done.stdout).strip()}")
    return done.stdout
