"""A stand-in for Slurm: its commands as far as Credo uses them, and tasks that run here.

`sbatch`, `squeue` and `scontrol` are this file under their names; what they know lies in a folder:
`<array>/array.json`, `<array>/script`, and the state of each task in `<array>/<task>`.
"""

import json
import os
import pathlib
import re
import shlex
import signal
import subprocess
import sys

LISTED = ("PENDING", "RUNNING")


class Slurm:
    """A cluster whose tasks run when a test says so, one at a time."""

    def __init__(self, folder: pathlib.Path):
        self.folder = folder
        bin = folder / "bin"
        bin.mkdir(parents=True)
        for name in ("sbatch", "squeue", "scontrol"):
            words = [sys.executable, "-S", __file__, str(folder), name]
            (bin / name).write_text(f'#!/bin/sh\nexec {shlex.join(words)} "$@"\n')
            (bin / name).chmod(0o755)

    def install(self, monkeypatch) -> None:
        """Put the commands before all others."""
        monkeypatch.setenv("PATH", f"{self.folder / 'bin'}{os.pathsep}{os.environ['PATH']}")

    def arrays(self) -> list[int]:
        """The numbers of all arrays that were submitted."""
        return sorted(int(path.parent.name) for path in self.folder.glob("*/array.json"))

    def states(self, number: int) -> dict[int, str]:
        """The state of each task of an array."""
        folder = self.folder / str(number)
        tasks = json.loads((folder / "array.json").read_text())["tasks"]
        return {task: (folder / str(task)).read_text() for task in tasks}

    def run(self, number: int, task: int, during=lambda process: None) -> int:
        """Run a task once, and do something `during` that, for which its first process is given;
        what it ends with. Like Slurm it starts the script in a session of its own."""
        folder = self.folder / str(number)
        array, state = json.loads((folder / "array.json").read_text()), folder / str(task)
        assert state.read_text() == "PENDING"
        env = os.environ | {"SLURM_ARRAY_JOB_ID": str(number), "SLURM_ARRAY_TASK_ID": str(task)}
        env |= {"SLURM_CPUS_PER_TASK": array["options"]["cpus-per-task"]}
        state.write_text("RUNNING")
        with open(array["options"]["output"].replace("%a", str(task)), "a") as output:
            streams = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": output}
            command = ["bash", str(folder / "script")]
            with subprocess.Popen(command, env=env, start_new_session=True, **streams) as process:
                during(process)
                code = process.wait()
            for left in (signal.SIGTERM, signal.SIGKILL):  # whatever of it is still there
                try:
                    os.killpg(process.pid, left)
                except ProcessLookupError:
                    break
        if state.read_text() == "RUNNING":  # or it was put back into the queue
            state.write_text("FAILED" if code else "COMPLETED")
        return code

    def requeue(self, number: int, task: int) -> None:
        """What Slurm does by itself with the task of a node that failed."""
        (self.folder / str(number) / str(task)).write_text("PENDING")


def sbatch(folder: pathlib.Path, parsable: str, script: str) -> None:
    """Put an array into the queue, and print its number."""
    assert parsable == "--parsable"
    text, options = pathlib.Path(script).read_text(), {}
    assert text.startswith("#!/bin/bash\n")
    for line in re.findall(r"^#SBATCH --(.*)$", text, re.MULTILINE):
        name, _, value = shlex.split(line)[0].partition("=")
        options[name] = value
    if options.get("partition") == "nowhere":
        raise SystemExit("sbatch: error: invalid partition specified: nowhere")
    first, last = re.fullmatch(r"(\d+)-(\d+)(?:%\d+)?", options["array"]).groups()
    tasks = list(range(int(first), int(last) + 1))
    number = 1 + sum(1 for _ in folder.glob("*/array.json"))
    home = folder / str(number)
    home.mkdir()
    for task in tasks:
        (home / str(task)).write_text("PENDING")
    (home / "script").write_text(text)  # the file that was given may be gone when a task runs
    (home / "array.json").write_text(json.dumps({"options": options, "tasks": tasks}))
    print(number)


def squeue(folder: pathlib.Path, *flags: str) -> None:
    """The tasks that wait or run."""
    assert flags == ("--me", "--noheader", "--array", "--format=%j %K")
    print("somebody's interactive shell N/A")
    for file in sorted(folder.glob("*/array.json")):
        array = json.loads(file.read_text())
        for task in array["tasks"]:
            if (file.parent / str(task)).read_text() in LISTED:
                print(array["options"]["job-name"], task)


def scontrol(folder: pathlib.Path, requeue: str, name: str) -> None:
    """Put a running task back into the queue."""
    assert requeue == "requeue"
    state = folder / name.replace("_", "/")
    assert state.read_text() == "RUNNING"
    state.write_text("PENDING")


if __name__ == "__main__":
    commands = {"sbatch": sbatch, "squeue": squeue, "scontrol": scontrol}
    commands[sys.argv[2]](pathlib.Path(sys.argv[1]), *sys.argv[3:])
