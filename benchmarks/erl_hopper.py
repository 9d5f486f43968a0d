"""ERL on Hopper with one update per frame: environment frames per CPU second of one core.

Beside TD3 of Gymnasium and eager PyTorch, and ERL of EvoRL. For all: 2 × 256 ReLU, batch 256, TD3,
one critic update per frame. Both ERLs: population 10, two elites, one episode per fitness and one
of the learner per generation, no tests. EvoRL plays the Hopper of Brax, the others that of MuJoCo.

Only frames before the end of an episode count. EvoRL plays on to the time limit, so its frames per
second depend on how long episodes are; it is compared at Credo's length, and its own is given, as
is the most it could reach, when every episode lasts to the limit.

CPU seconds are of a contender's process and its live children, after compilation.
"""

import contextlib
import json
import os
import pathlib
import subprocess
import sys
import time
from dataclasses import replace

import jax

from credo.algorithms.erl import BREEDER, ERL
from credo.environments.base import AbstractEnvironment
from credo.environments.gymnasium import Gymnasium
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP

from . import peers

SECONDS, LIMIT = "20", 1_000
EPISODES = 11  # of a generation: one is the learner's
GOALS = {"torch": (1.3, 1.2), "evorl": (2.0, 1.6)}  # what we aim at, what it must be


def cpu_seconds() -> float:
    """Of this process and its live children, whom `os.times` leaves out."""
    ticks, me = 0, str(os.getpid())
    for stat in pathlib.Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has just ended
            _, parent, *rest = stat.read_text().rpartition(")")[2].split()
            if parent == me:
                ticks += int(rest[9]) + int(rest[10])  # utime and stime, fields 14 and 15
    return time.process_time() + ticks / os.sysconf("SC_CLK_TCK")


def measure(seconds: float, env: AbstractEnvironment | None = None) -> dict[str, float]:
    """Credo's generations for so many CPU seconds, after two that learned.

    **Arguments:** `env`: None: MuJoCo's Hopper.
    """
    network = MLP(hidden=(256, 256), activation="relu", initializer="uniform")
    erl = ERL(
        env or Gymnasium("Hopper-v5"),
        network,
        learners=(TD3(),),
        breeder=replace(BREEDER, elite_fraction=0.2),
        test_episodes=1,
        test_every=1_000_000,
    )
    key = jax.random.key(0)
    state = erl.init(key=key)

    def generation(state):
        key_now = jax.random.fold_in(key, int(state.generation) + 1)
        return jax.block_until_ready(erl.generation(state, key=key_now))

    state, metrics = generation(state)
    first, learned = cpu_seconds(), 0
    while learned < 2:
        state, metrics = generation(state)
        learned += int(metrics["updates"]) > 0
    frames, episodes, updates = int(state.frames), int(state.episodes), 0
    began = cpu_seconds()
    while (cpu := cpu_seconds() - began) < seconds:
        state, metrics = generation(state)
        updates += int(metrics["updates"])
    frames, episodes = int(state.frames) - frames, int(state.episodes) - episodes
    return {
        "rate": frames / cpu,
        "first": first,
        "length": frames / episodes,
        "ratio": updates / frames,
    }


def ours() -> dict[str, float]:
    """`measure` in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.erl_hopper", SECONDS]
    answer = subprocess.run(command, capture_output=True, text=True)
    if answer.returncode:
        raise RuntimeError(f"{command} failed:\n{answer.stderr[-2000:]}")
    return json.loads(answer.stdout.splitlines()[-1])


def line(name: str, rate: float, ratio: float | None = None, goals=(0.0, 0.0)) -> None:
    text = f"  {name:<44}{rate:8.0f} frames per CPU second"
    if ratio is not None:
        text += f"  Credo {ratio:.2f} ×  goal {goals[0]:g} ×, at least {goals[1]:g} ×"
    print(text, flush=True)


def main() -> None:
    print("ERL on Hopper, one update per frame, 2 × 256 units, batch 256, one core")
    print(f"  load of the machine before: {os.getloadavg()[0]:.1f}")
    credo = ours()
    line(f"Credo, episodes of {credo['length']:.0f} frames", credo["rate"])
    print(f"    {credo['ratio']:.3f} updates per frame; first fitness {credo['first']:.0f} CPU s")
    answer = peers.ask("torch", "torch_td3.py", "hopper", SECONDS)
    if answer:
        rate = answer["hopper"]
        line("torch: TD3, Gymnasium's Hopper", rate, credo["rate"] / rate, GOALS["torch"])
    evorl = peers.ask("evorl", "evorl_erl.py", SECONDS)
    if evorl:

        def rate_at(length: float) -> float:
            frames = EPISODES * length
            return frames / (evorl["collect"] + frames * evorl["update"])

        rate = rate_at(credo["length"])
        line("evorl: ERL, Brax's Hopper, our length", rate, credo["rate"] / rate, GOALS["evorl"])
        line(f"  its own episodes of {evorl['length']:.0f} frames", evorl["rate"])
        line(f"  episodes of {LIMIT:,}, computed", rate_at(LIMIT))
        print(
            f"    {evorl['ratio']:.3f} updates per frame, normalised to 1; "
            f"first fitness {evorl['first']:.0f} CPU s\n"
            f"    a generation plays {evorl['collect']:.2f} CPU s; "
            f"an update takes {1e3 * evorl['update']:.2f} ms"
        )
    print(f"  load of the machine after: {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    if len(sys.argv) == 1:
        main()
    else:
        print(json.dumps(measure(float(sys.argv[1]))))
