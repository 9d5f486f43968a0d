"""Generations of chapter 4: a robot with memory in the Extended T-Maze, and a fleet of ten servers
around one memory.

Runs are made by two processes, one pinned to each of two cores; what they evaluate together is the
figure. Beside it, one core alone, and for scale the matrix product of one network's gates, many at
a time, as the evaluation has them.
"""

import multiprocessing
import os
import time

import jax
import jax.numpy as jnp

from credo import tree
from credo.algorithms.ccea import CCEA, drafted
from credo.algorithms.neuroevolution import Neuroevolution
from credo.compilation import jit
from credo.environments.extended_tmaze import ExtendedTMaze
from credo.environments.server_fleet import ServerFleet
from credo.networks.dmmu import DMMU
from credo.networks.mmu import MMU
from credo.rollout import evaluate

SECONDS = 6.0  # of measuring
PATIENCE = 600.0  # seconds for the other process to compile and measure
GOALS = {"T-maze": 5e6, "server fleet": 1e6}  # network-steps per second on two cores


def tmaze():
    """Evaluation of a generation of CCEA, and its network-steps."""
    ccea = CCEA.ccea(ExtendedTMaze(depth=2), MMU(hidden=20, output_activation="tanh"))
    state = ccea.init(key=jax.random.key(0))
    teams = drafted(ccea, state.populations, ccea.drawn(key=jax.random.key(1)))

    def play(key):
        return evaluate(ccea.env, teams, ccea.simulations, key=key).returns

    return play, tree.size(teams) * ccea.simulations * ccea.env.max_steps


def fleet():
    """Evaluation of a generation of Algorithm 5, and its network-steps: one per server."""
    algorithm = Neuroevolution.dmmu(ServerFleet(), DMMU(hidden=30))
    state = algorithm.init(key=jax.random.key(0))
    env, episodes = algorithm.env, algorithm.episodes

    def play(key):
        return evaluate(env, state.population, episodes, key=key).returns

    return play, algorithm.population_size * episodes * env.max_steps * env.servers


TASKS = {"T-maze": tmaze, "server fleet": fleet}
# Networks played at a time, lanes of each, inputs and outputs of the gates.
SHAPES = {"T-maze": (100, 35, 24, 80), "server fleet": (2, 10, 90, 120)}


def products(name: str) -> float:
    """Network-steps per second of nothing but the gates' matrix product."""
    pop, lanes, inputs, outputs = SHAPES[name]
    w = jax.random.normal(jax.random.key(0), (pop, inputs, outputs))
    x = jax.random.normal(jax.random.key(1), (pop, lanes, inputs))
    times = 200_000 // (pop * lanes)

    @jit
    def play(w, x):
        def again(_, x):
            return jnp.tanh(jnp.einsum("pli,pio->plo", x, w)[..., :1]) + x

        return jax.lax.fori_loop(0, times, again, x)

    return _rate(lambda key: play(w, x), pop * lanes * times)


def _rate(play, steps: int) -> float:
    jax.block_until_ready(play(jax.random.key(2)))
    began, n = time.perf_counter(), 0
    while time.perf_counter() - began < SECONDS:
        jax.block_until_ready(play(jax.random.key(n)))
        n += 1
    return n * steps / (time.perf_counter() - began)


def _on(core: int, name: str, start, rates) -> None:
    os.sched_setaffinity(0, {core})
    play, steps = TASKS[name]()
    jax.block_until_ready(play(jax.random.key(2)))
    start.wait(PATIENCE)
    rates.put(_rate(play, steps))


def together(name: str, cores: list[int]) -> float:
    """Network-steps per second of one process on each core, added up."""
    spawn = multiprocessing.get_context("spawn")
    start, rates = spawn.Barrier(len(cores)), spawn.Queue()
    processes = [
        spawn.Process(target=_on, args=(core, name, start, rates), daemon=True) for core in cores
    ]
    for process in processes:
        process.start()
    return sum(rates.get(timeout=PATIENCE) for _ in processes)


def permitted() -> list[int]:
    """Up to two cores; `benchmarks` itself is pinned to one of them."""
    pinned = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    cores = sorted(os.sched_getaffinity(0))[-2:]
    os.sched_setaffinity(0, pinned)
    return cores


def main() -> None:
    cores = permitted()
    for name, goal in GOALS.items():
        alone, both, bound = together(name, cores[-1:]), together(name, cores), products(name)
        print(f"a generation's evaluation, {name}")
        rows = (
            ("one core alone", f"{alone / 1e6:.2f}M", "network-steps/s"),
            (
                f"{len(cores)} cores, a process on each",
                f"{both / 1e6:.2f}M",
                f"goal {goal / 1e6:g}M",
            ),
            ("the gates' products alone", f"{bound / 1e6:.2f}M", f"{alone / bound:.0%} of it"),
        )
        for label, value, remark in rows:
            print(f"  {label:<32}{value:>10}  {remark}")


if __name__ == "__main__":
    main()
