"""How long `credo train` takes until its first fitness is on the screen: with an empty compilation
cache and with a warm one."""

import os
import pathlib
import subprocess
import sys
import tempfile
import time

GOALS = {"cold": 12.0, "warm": 6.0}
COMMAND = [sys.executable, "-m", "credo", "train", "neuroevolution", "sequence-classification"]


def main() -> None:
    print("first useful line of `credo train neuroevolution sequence-classification`, one core")
    with tempfile.TemporaryDirectory() as folder:
        for name, goal in GOALS.items():
            run = pathlib.Path(folder) / name
            process = subprocess.Popen(
                [*COMMAND, "--path", str(run), "--generations", "100000"],
                stderr=subprocess.PIPE,
                text=True,
                env=os.environ | {"CREDO_CACHE": f"{folder}/cache"},
            )
            began, marks = time.perf_counter(), []
            assert process.stderr is not None
            for word in ("is starting", "fitness"):
                while word not in process.stderr.readline() and process.poll() is None:
                    pass
                marks.append(time.perf_counter() - began)
            process.kill()
            process.wait()
            imports, seconds = marks
            print(
                f"  {name} cache  {seconds:5.1f} s: {imports:.1f} until it says that it starts "
                f"(imports, the task, the first state), {seconds - imports:.1f} of compiling and "
                f"playing (goal {goal:.0f} s)"
            )


if __name__ == "__main__":
    main()
