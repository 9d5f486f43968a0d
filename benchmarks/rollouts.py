"""`ea Swimmer-v5` on every core: steps per second and core, beside those of the physics alone.

The physics is a bare loop over one environment of Gymnasium, on each core at once. Both act by
numbers in [-1, 1]; ours computes them by a network for each member. Steps of tests count, and the
clock runs from the end of one generation to the end of the last: what is between them, breeding
and records, is in it. Nothing of the first generations, which compile and start processes.
"""

import csv
import os
import pathlib
import subprocess
import sys
import tempfile

EPISODES, TESTS, STEPS = 10, 5, 1_000  # of a generation; all last until the time limit
WARM, COUNTED = 8, 60  # generations
GOAL = 0.7  # of the physics

RAW = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
import gymnasium, numpy as np
env = gymnasium.make("Swimmer-v5")
actions = np.random.default_rng(0).uniform(-1, 1, (1000, 2)).astype(np.float32)
steps, began = 0, None
while began is None or time.perf_counter() - began < float(sys.argv[2]):
    env.reset(seed=steps)
    for action in actions:
        env.step(action)
    began = began or time.perf_counter()  # the first episode is not counted
    steps += 1000
print((steps - 1000) / (time.perf_counter() - began))
"""


def physics(cores: list[int], seconds: float) -> float:
    """Steps per second and core of bare loops, one on each core at once."""
    told = [[sys.executable, "-c", RAW, str(core), str(seconds)] for core in cores]
    running = [subprocess.Popen(line, stdout=subprocess.PIPE, text=True) for line in told]
    return sum(float(one.communicate()[0]) for one in running) / len(cores)


def ours(cores: list[int]) -> float:
    """Steps per second and core of a run."""
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder, "run")
        flags = ["--generations", str(WARM + COUNTED), "--path", str(path)]
        command = [sys.executable, "-m", "credo", "train", "ea", "Swimmer-v5", *flags]
        subprocess.run(command, check=True, capture_output=True)
        rows = list(csv.DictReader((path / "timing.csv").open()))
    clock = [(int(row["generation"]), float(row["seconds"])) for row in rows]  # one about every 10 s
    (first, began), (last, ended) = next(at for at in clock if at[0] >= WARM), clock[-1]
    return (last - first) * (EPISODES + TESTS) * STEPS / (ended - began) / len(cores)


def main() -> None:
    pinned = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    cores = sorted(os.sched_getaffinity(0))
    try:
        before, rate, after = physics(cores, 10), ours(cores), physics(cores, 10)
    finally:
        os.sched_setaffinity(0, pinned)
    raw = (before + after) / 2
    print(f"rollouts: ea Swimmer-v5 on {len(cores)} cores, steps per second and core")
    print(f"  physics alone  {raw:8,.0f} ({before:,.0f} before, {after:,.0f} after)")
    print(f"  ours           {rate:8,.0f} = {rate / raw:.2f} of it (goal {GOAL})")


if __name__ == "__main__":
    main()
