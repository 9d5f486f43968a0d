"""Generations of NEAT on Sequence Recall, 100 networks × 10 sequences, beside neat-python.

Both on one core, recurrent networks, over as many generations from the first on; in Credo's is the
test of each champion, 50 episodes. The settings are each library's own for XOR: networks grow on
their own in either.
"""

import dataclasses
import json
import tempfile
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from credo.algorithms.neat import NEAT, NEATState
from credo.compilation import jit
from credo.environments.sequence_recall import SequenceRecall
from credo.networks.graph import Graph

from .peers import ask

DEPTH, SEQUENCES, GENERATIONS, TOGETHER, GOAL = 2, 10, 300, 20, 20.0


def sequences(task: SequenceRecall) -> list[list[tuple[list[float], float, bool]]]:
    """Some, step by step, without padding."""
    found = []
    for key in jax.random.split(jax.random.key(0), SEQUENCES):
        one = task.sample(key=key)
        parts = (np.asarray(x).tolist() for x in (one.inputs, one.targets, one.scored))
        found.append(list(zip(*parts, strict=True))[: int(one.length)])
    return found


def rate(cells: str, generations: int) -> float:
    """Generations per CPU second, the test of each champion included."""
    network = Graph(hidden=20, cells=cells)
    algorithm = NEAT(SequenceRecall(depth=DEPTH), network, population_size=100)
    algorithm = dataclasses.replace(algorithm, episodes=SEQUENCES)

    @jit
    def several(state: NEATState, start: Any) -> NEATState:
        """Generations in one program, as a run has them."""

        def step(state: NEATState, g: Any) -> tuple[NEATState, None]:
            key = jax.random.fold_in(jax.random.key(1), g)
            return algorithm.generation(state, key=key)[0], None

        return jax.lax.scan(step, state, start + jnp.arange(TOGETHER))[0]

    state = jax.block_until_ready(several(algorithm.init(key=jax.random.key(0)), jnp.int32(0)))
    begun = time.process_time()
    for start in range(TOGETHER, generations + TOGETHER, TOGETHER):
        state = jax.block_until_ready(several(state, jnp.int32(start)))
    return generations / (time.process_time() - begun)


def main() -> None:
    print(f"NEAT, 100 networks × {SEQUENCES} sequences of recall at depth {DEPTH}")
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump(sequences(SequenceRecall(depth=DEPTH)), file)
        file.flush()
        peer = ask("neat", "neat_python.py", file.name, str(GENERATIONS))
    ours = {cells: rate(cells, GENERATIONS) for cells in ("rnn", "lstm")}
    for cells, value in ours.items():
        print(f"  Credo, {cells}: {value:.1f} generations per CPU second")
    if peer:
        theirs = peer["generations per CPU second"]
        ratio = ours["rnn"] / theirs
        print(f"  neat-python, rnn: {theirs:.2f}; ratio {ratio:.0f} (goal {GOAL:.0f})")


if __name__ == "__main__":
    main()
