"""`ea Swimmer-v5` on every core: steps per second and core, beside those of the physics alone.

The physics is a bare loop over one environment of Gymnasium, on each core at once, which takes the
actions that the members of the run's last generation take: what a step costs MuJoCo depends on
them (at random ones a fifth less). Ours computes them, by a network for each member. Steps of tests
count, and the clock runs from the end of one generation to the end of the last: what is between
them, breeding and records, is in it. Nothing of the first generations, which compile and start
processes.
"""

import csv
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np

EPISODES, TESTS, STEPS = 10, 5, 1_000  # of a generation; all last until the time limit
WARM, COUNTED = 40, 60  # generations: by then their actions cost what those of the last one do
GOAL = 0.7  # of the physics

RAW = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
import gymnasium, numpy as np
env = gymnasium.make("Swimmer-v5")
episodes = np.load(sys.argv[2])
began = None
for turn in range(1 + 2 * len(episodes)):
    env.reset(seed=turn % len(episodes))
    for action in episodes[turn % len(episodes)]:
        env.step(action)
    began = began or time.perf_counter()  # the first episode is not counted
print(2 * episodes.shape[0] * episodes.shape[1] / (time.perf_counter() - began))
"""


def physics(cores: list[int], actions: pathlib.Path) -> float:
    """Steps per second and core of bare loops, one on each core at once."""
    told = [[sys.executable, "-c", RAW, str(core), str(actions)] for core in cores]
    running = [subprocess.Popen(line, stdout=subprocess.PIPE, text=True) for line in told]
    return sum(float(one.communicate()[0]) for one in running) / len(cores)


def ours(cores: list[int], path: pathlib.Path) -> float:
    """Steps per second and core of a run."""
    flags = ["--generations", str(WARM + COUNTED), "--path", str(path)]
    command = [sys.executable, "-m", "credo", "train", "ea", "Swimmer-v5", *flags]
    subprocess.run(command, check=True, capture_output=True)
    rows = list(csv.DictReader((path / "timing.csv").open()))
    clock = [
        (int(row["generation"]), float(row["seconds"])) for row in rows
    ]  # one about every 10 s
    (first, began), (last, ended) = next(at for at in clock if at[0] >= WARM), clock[-1]
    return (last - first) * (EPISODES + TESTS) * STEPS / (ended - began) / len(cores)


def parts(path: pathlib.Path, record: bool) -> list[Any]:
    """An episode of every member of a run's last generation, with its number as the seed."""
    import jax

    from credo import Run, playing
    from credo.runs import loop

    run = Run(path)
    algorithm = run.algorithm
    population = jax.tree.map(np.asarray, loop._load(run, algorithm).state.population)
    worlds = np.arange(EPISODES, dtype=np.uint32)[:, None]
    keys = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(0), worlds.shape)))
    return [playing.Part(algorithm.env, population, worlds, keys, 1, record)]


def taken(path: pathlib.Path) -> np.ndarray:
    """What they do: `[members, steps, actions]`."""
    from credo import playing

    rows = playing.play(parts(path, record=True))[0].rows
    assert rows is not None
    return rows[1].reshape(EPISODES, STEPS, -1)


def walk(path: pathlib.Path, actions: np.ndarray) -> None:
    """Say what one step of one member costs a process that plays all of them, layer upon layer."""
    import gymnasium

    from credo import playing
    from credo.environments import foreign, worker
    from credo.environments.host import Episodes
    from credo.playing import crew

    crew.enlist()
    foreign.spare(True)
    given, every = parts(path, record=False), np.ones(EPISODES, bool)
    env, seeds = given[0].env, given[0].worlds[:, 0]
    sweeps = np.ascontiguousarray(actions.swapaxes(0, 1))
    alone = gymnasium.make("Swimmer-v5")
    held, copies = worker.Environments(env.spec(), EPISODES), env.copies(EPISODES)

    def physics():
        for seed in range(EPISODES):
            alone.reset(seed=seed)
            for action in actions[seed]:
                alone.step(action)

    def stepped(many):
        many.reset(seeds, every)
        for sweep in sweeps:
            many.step(sweep, every)

    def episodes():
        told = Episodes(env, EPISODES, record=False)
        told.begin(seeds, every)
        for sweep in sweeps:
            told.advance(sweep)

    layers = {
        "MuJoCo and Gymnasium": physics,
        "actions in, observations out": lambda: stepped(held),
        "what fails is named": lambda: stepped(copies),
        "episodes and their returns": episodes,
        "networks": lambda: playing.play(given),
    }
    below = 0.0
    for name, layer in layers.items():
        seconds = []
        for _ in range(3):
            began = time.perf_counter()
            layer()
            seconds.append(time.perf_counter() - began)
        cost = min(seconds) / actions.shape[0] / actions.shape[1] * 1e6
        print(f"  {name:30s} {cost - below:5.1f} us, together {cost:.1f}")
        below = cost


def main() -> None:
    pinned = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    cores, rates, raws = sorted(os.sched_getaffinity(0)), [], []
    with tempfile.TemporaryDirectory() as folder:
        actions = pathlib.Path(folder, "actions.npy")
        try:
            for turn in ("first", "second"):
                path = pathlib.Path(folder, turn)
                rates.append(ours(cores, path))
                np.save(actions, taken(path))
                raws.append(physics(cores, actions))
            print(f"one step of one of {EPISODES} members, in one process that plays", flush=True)
            program = "from benchmarks.rollouts import *; walk(pathlib.Path(sys.argv[1]), "
            program += "np.load(sys.argv[2]))"
            subprocess.run([sys.executable, "-c", program, str(path), str(actions)], check=True)
        finally:
            os.sched_setaffinity(0, pinned)
    rate, raw = np.mean(rates), np.mean(raws)
    print(f"rollouts: ea Swimmer-v5 on {len(cores)} cores, steps per second and core, two turns")
    print(f"  physics alone  {raw:8,.0f} ({raws[0]:,.0f}; {raws[1]:,.0f})")
    print(f"  ours           {rate:8,.0f} ({rates[0]:,.0f}; {rates[1]:,.0f})")
    print(f"  ratio {rate / raw:.2f} (goal {GOAL})")


if __name__ == "__main__":
    main()
