"""VMAS's discovery with its default five agents and random actions: environment steps per CPU
second, at each number of worlds.

Run by the benchmarks in an environment that has vmas: `python vmas_discovery.py SECONDS WORLDS …`;
prints a JSON line. Its targets come back once they are covered, so no episode ends.
"""

import json
import sys
import time

import torch
import vmas


def rate(worlds, seconds):
    env = vmas.make_env("discovery", num_envs=worlds, device="cpu", seed=0)
    env.reset()

    def steps(n):
        for _ in range(n):
            env.step([env.get_random_action(agent) for agent in env.agents])

    steps(5)
    began, cpu, n = time.perf_counter(), time.process_time(), 0
    while time.perf_counter() - began < seconds:
        steps(5)
        n += 5
    return n * worlds / (time.process_time() - cpu)


if __name__ == "__main__":
    torch.set_num_threads(1)
    length, *sizes = sys.argv[1:]
    print(json.dumps({worlds: rate(int(worlds), float(length)) for worlds in sizes}))
