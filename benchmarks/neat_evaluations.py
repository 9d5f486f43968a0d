"""Evaluations of networks that NEAT needs until one solves XOR, or double pole balancing without
velocities, beside those of Stanley & Miikkulainen (2002), sections 4.1 and 4.3.

`python -m benchmarks.neat_evaluations [xor] [double-pole] [--runs 20] [--seed 100]`

XOR: population 150, at most 100 generations; solved when all four answers of one network are on the
right side, as in the authors' program.
The paper: 4,755 ± 2,553 evaluations, all of 100 runs.

Double pole: population 1,000, at most 100 generations; solved when the champion of a species, one
in each generation (`chosen`), keeps the poles up for 100,000 steps, and for 1,000 from at least 200
of 625 starts, at each of which position, velocity, angle of the long pole and its velocity have one
of five values. The paper: 33,184 evaluations, 20 runs.
"""

import argparse
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from credo import rollout, tree
from credo.algorithms.neat import NEAT, NEATState, divided, expressed
from credo.compilation import jit
from credo.environments.double_pole import DoublePole
from credo.environments.probes import Xor
from credo.evolution.augment import Augmentation
from credo.evolution.genome import Compatibility
from credo.networks.graph import Graph

LONG, STARTS, ENOUGH = 100_000, (0.05, 0.25, 0.5, 0.75, 0.95), 200
SPREAD = {"x": 4.32, "v": 2.7, "angle": 0.12566304, "spin": 0.30019504}  # of a start, ± half of it
Solved = Callable[[NEATState, NEATState], bool]  # by a generation, and what it made
PAPER = {"xor": "4,755 ± 2,553, 100 of 100 runs", "double-pole": "33,184, 20 of 20 runs"}


def xor() -> tuple[NEAT, Solved]:
    """The algorithm, and whether a generation has a solution: one genome suffices."""
    network = Graph(hidden=10, recurrent=False, passes=6)
    algorithm = NEAT(Xor(), network, connections=50, episodes=1, test_episodes=1)

    def solved(before: NEATState, _: NEATState) -> bool:
        networks = expressed(algorithm, before.population)
        played = rollout.evaluate(Xor(), networks, 1, key=jax.random.key(0))
        return bool(jnp.any(played.returns["success"] == 1.0))

    return algorithm, solved


def double_pole() -> tuple[NEAT, Solved]:
    """The same, with the settings of section 4.1 for a population of 1,000; one champion is tested
    in each generation."""
    algorithm = NEAT(
        DoublePole(),
        Graph(hidden=20),
        population_size=1000,
        connections=100,
        episodes=1,
        test_episodes=1,
        compatibility=Compatibility(weights=3.0),
        threshold=4.0,
        elsewhere=0.05,
        mutation=Augmentation(connection=0.3, strength=1.0, fresh=2.0),
        species=100,
    )

    @jit
    def stands(champion: Any, env: DoublePole) -> Any:
        """For how many steps."""
        played = rollout.evaluate(env, tree.single(champion), 1, key=jax.random.key(0))
        return played.returns["balanced"][0, 0]

    values = np.array(list(itertools.product(STARTS, repeat=4))) - 0.5
    starts = jnp.asarray(values * list(SPREAD.values()), jnp.float32)

    @jit
    def generalises(champion: Any) -> Any:
        """From how many of the 625 starts it stands for 1,000 steps."""

        def stands_from(start: Any) -> Any:
            return stands(champion, DoublePole(**dict(zip(SPREAD, start, strict=True))))

        return jnp.sum(jax.vmap(stands_from)(starts) >= 1000)

    checked = np.full(
        algorithm.species, -np.inf
    )  # the best fitness of a species when it was tested

    def solved(before: NEATState, _: NEATState) -> bool:
        networks = expressed(algorithm, before.population)
        played = rollout.evaluate(algorithm.env, networks, 1, key=jax.random.key(0))
        fitness = np.asarray(played.returns["fitness"][:, 0])
        member = np.asarray(divided(algorithm, before, jnp.asarray(fitness))[0])
        checked[~np.asarray(before.species.alive)] = -np.inf
        champion = chosen(fitness, member, checked)
        one = tree.take(networks, champion)
        for steps in (1000, LONG):
            if stands(one, DoublePole(max_steps=steps)) < steps:
                return False
        return int(generalises(one)) >= ENOUGH

    return algorithm, solved


def chosen(fitness: np.ndarray, member: np.ndarray, checked: np.ndarray) -> int:
    """Whom the authors' program tests: the champion of the best species that has become better
    since it was tested; if there is none, of the best. Notes in `checked` that it was."""
    best = np.full(len(checked), -np.inf)
    np.maximum.at(best, member, fitness)
    better = np.flatnonzero(best > checked)
    species = better[np.argmax(best[better])] if len(better) else int(np.argmax(best))
    checked[species] = best[species]
    return int(np.argmax(np.where(member == species, fitness, -np.inf)))


TASKS = {"xor": xor, "double-pole": double_pole}


def evaluations(name: str, seed: int, most: int = 100) -> tuple[int | None, int]:
    """How many networks one run evaluates until one is a solution, None if there is none after
    `most` generations; and its generations."""
    algorithm, solved = TASKS[name]()
    state = algorithm.init(key=jax.random.fold_in(jax.random.key(seed), 0))
    for g in range(1, most + 1):
        before, key = state, jax.random.fold_in(jax.random.key(seed), g)
        state, _ = algorithm.generation(state, key=key)
        if solved(before, state):
            return g * algorithm.population_size, g
    return None, most


def main(names: list[str], runs: int, seed: int) -> None:
    for name in names:
        counts, begun = [], time.perf_counter()
        for one in range(seed, seed + runs):
            count, generations = evaluations(name, one)
            counts.append(count)
            told = f"{count or 'not solved'}, {generations} generations"
            print(f"  {name}, seed {one}: {told}", flush=True)
        found = [count for count in counts if count]
        told = f"{np.mean(found):,.0f} ± {np.std(found, ddof=1):,.0f}" if len(found) > 1 else found
        seconds = time.perf_counter() - begun
        print(
            f"{name}: {told} evaluations, {len(found)} of {runs} runs, {seconds:.0f} s; "
            f"published {PAPER[name]}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[*TASKS, []], default=[])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=100)
    told = parser.parse_args()
    main(told.names or list(TASKS), told.runs, told.seed)
