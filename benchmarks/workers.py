"""What a generation costs beside its simulators, with 2, 8 and 64 workers: locally and on Ray.

Each worker plays one episode of two members at a time, `STEPS` steps of a simulator that sleeps; so
the simulators take the same time however many there are. What is over is ours: on the driver, that
of its processor; in a worker, that of its core, of which this machine may have too few for 64.
`python -m benchmarks.workers [ray] [WORKERS …]`.
"""

import os
import sys
import time

import jax
import numpy as np

from credo import playing
from credo.compilation import float32
from credo.environments.gymnasium import Gymnasium
from credo.evolution.breeder import draw
from credo.networks.mlp import MLP
from credo.playing import players

STEPS, GENERATIONS, WARM = 20, 10, 3
PAUSES = (0.001, 0.01, 0.1)  # seconds
NETWORK = MLP(hidden=(128, 128), activation="tanh")
GOAL = 15.0  # ms that a generation of ten members may take longer on Ray


def generation(task: Gymnasium, members: int, number: int) -> playing.Part:
    """One episode of each of some members, whose transitions are kept."""
    key = jax.random.key(number)
    population = draw(NETWORK, task.sizes, members, key=key)
    worlds, keys = map(np.asarray, playing.draw((members, 1), False, key))
    return playing.Part(task, population, worlds, keys, 1, record=True)


def measured(place: str, workers: int, members: int, pause: float) -> tuple[float, float]:
    """Seconds of a generation, and those of the driver's processor, beside its simulators."""
    task = Gymnasium("benchmarks.sleeper:Sleeper", {"pause": pause}, max_episode_steps=STEPS)
    parts = [generation(task, members, i) for i in range(WARM + GENERATIONS)]
    with float32(), players.using(workers, place):
        players._CURRENT.players._patience = 0.0
        for part in parts[:WARM]:
            players.ask(part).result()
        wall, cpu = time.perf_counter(), time.process_time()
        for part in parts[WARM:]:
            players.ask(part).result()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    asleep = STEPS * pause * (members / workers if workers > 1 else members)
    return wall / GENERATIONS - asleep, cpu / GENERATIONS


def main() -> None:
    words = sys.argv[1:] if sys.argv[0].endswith("workers.py") else []
    numbers = [int(word) for word in words if word.isdigit()] or [2, 8, 64]
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    import ray

    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    ray.init(num_cpus=max(numbers), include_dashboard=False, object_store_memory=10**9)
    print("workers: ms of a generation beside its simulators, and of the driver's processor")
    costs = {place: measured(place, 2, 10, 0.001)[0] * 1e3 for place in ("local", "ray")}
    more = costs["ray"] - costs["local"]
    print(
        f"  10 members, 2 workers: local {costs['local']:.1f}, ray {costs['ray']:.1f}: "
        f"{more:.1f} more (goal {GOAL})"
    )
    rows = []
    for number in numbers:
        for pause in PAUSES:
            wall, cpu = measured("ray", number, 2 * number, pause)
            rows.append((number, cpu))
            print(
                f"  ray, {number:2d} workers, {pause * 1e3:3.0f} ms a step: "
                f"{wall * 1e3:7.1f}, driver {cpu * 1e3:6.1f}"
            )
    ray.shutdown()
    counts, cpus = np.array(rows).T
    each, fixed = np.polyfit(counts, cpus * 1e3, 1)
    print(f"  driver: {fixed:.1f} ms a generation and {each:.2f} ms a worker of two members")


if __name__ == "__main__":
    main()
