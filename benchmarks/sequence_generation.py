"""One generation of 21-deep Sequence Classification: 100 MMUs of 5 cells × 10 sequences.

Credo's sequence path against NumPy vectorised over population and sequences. Both play the same
networks on the same sequences, one after the other, and must agree; the median of the ratios of
neighbouring runs counts.
"""

import time

import equinox as eqx
import jax
import numpy as np

from credo.algorithms.neuroevolution import Neuroevolution
from credo.compilation import jit
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.wrappers import Given
from credo.networks.mmu import MMU
from credo.rollout import evaluate

POPULATION, SEQUENCES, ROUNDS, GOAL, GOAL_STEPS = 100, 10, 15, 8.0, 30e6


def numpy_fitness(w, inputs, targets, scored, lengths):
    """Fitness `[pop, sequences]` of an MMU population; weights `[pop, out, in]`, inputs
    `[sequences, time]`. All networks and all sequences advance together."""

    def sigmoid(z):
        return 0.5 * np.tanh(0.5 * z) + 0.5

    pop, (n, _) = len(w["b_y"]), inputs.shape
    transposed = {
        name: np.ascontiguousarray(np.swapaxes(a, 1, 2)) for name, a in w.items() if a.ndim == 3
    }
    bias = {name: a[:, None, :] for name, a in w.items() if a.ndim == 2}
    # One product for all four uses of memory, and one for the three of the output.
    n_all = np.concatenate([transposed[f"N_{g}"] for g in "iprw"], axis=2)
    r_all = np.concatenate([transposed[f"R_{g}"] for g in "irw"], axis=2)
    k_all = np.concatenate([transposed[f"K_{g}"] for g in "iprw"], axis=2)
    b_all = np.concatenate([bias[f"b_{g}"] for g in "iprw"], axis=2)
    h_size = w["b_i"].shape[1]
    m = np.broadcast_to(bias["m_0"], (pop, n, h_size)).copy()
    y = np.zeros((pop, n, 1), np.float32)
    fitness = np.zeros((pop, n), np.float32)
    for t in range(int(lengths.max())):
        x = inputs[None, :, t, None]
        z = x * k_all + m @ n_all + b_all
        zy = y * r_all
        i = sigmoid(z[..., :h_size] + zy[..., :h_size])
        p = sigmoid(z[..., h_size : 2 * h_size])
        r = sigmoid(z[..., 2 * h_size : 3 * h_size] + zy[..., h_size : 2 * h_size])
        g = sigmoid(z[..., 3 * h_size :] + zy[..., 2 * h_size :])
        h = r * m + p * i
        m = m + g * np.tanh(h)
        y = sigmoid(h @ transposed["Z_y"] + bias["b_y"])
        product = np.clip((2 * y[..., 0] - 1) * targets[None, :, t], -1, 1)
        reward = product + (scored[None, :, t] & (product >= 1))
        fitness += np.where(t < lengths, reward, 0).astype(np.float32)
    return fitness


def main() -> None:
    task = SequenceClassification(depth=21)
    algorithm = Neuroevolution(task, MMU(hidden=5))
    state = jit(algorithm.init)(key=jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), SEQUENCES)
    sequences = jax.vmap(lambda key: task.sample(key=key))(keys)
    play = jit(lambda given, population: evaluate(given, population, SEQUENCES, key=keys[0]))
    whole = jit(algorithm.generation)

    w = {
        name: np.asarray(getattr(state.population, name))
        for name in vars(state.population)
        if eqx.is_array(getattr(state.population, name))
    }
    arrays = [np.asarray(a) for a in (sequences.inputs[..., 0], sequences.targets)]
    arrays += [np.asarray(a) for a in (sequences.scored, sequences.length)]
    given = Given(task, sequences)

    ours = np.asarray(play(given, state.population).returns["fitness"])
    theirs = numpy_fitness(w, *arrays)
    agree = np.mean(np.abs(ours - theirs) < 1e-2 * (1 + np.abs(theirs)))
    jax.block_until_ready(whole(state, key=jax.random.key(2)))

    times = {"credo": [], "generation": [], "numpy": []}
    for _ in range(ROUNDS):
        for name, run in (
            ("credo", lambda: play(given, state.population)),
            ("generation", lambda: whole(state, key=jax.random.key(2))),
            ("numpy", lambda: numpy_fitness(w, *arrays)),
        ):
            began = time.perf_counter()
            jax.block_until_ready(run())
            times[name].append(time.perf_counter() - began)
    steps = POPULATION * float(arrays[3].sum())
    ratio = np.median(np.array(times["numpy"]) / np.array(times["credo"]))
    ms = {name: 1e3 * np.median(t) for name, t in times.items()}
    rate = steps / ms["credo"] / 1e3
    rows = (
        ("NumPy, vectorised over both", f"{ms['numpy']:.1f} ms", ""),
        ("Credo, the same evaluation", f"{ms['credo']:.1f} ms", f"{rate:.0f}M network-steps/s"),
        ("Credo, with breeding and test", f"{ms['generation']:.1f} ms", ""),
        ("ratio of the first two", f"{ratio:.1f} ×", f"goal {GOAL:.0f} ×, {GOAL_STEPS / 1e6:.0f}M"),
        ("fitness values that agree", f"{100 * agree:.1f} %", "rounding grows in chaotic networks"),
    )
    print("one generation of 21-deep classification, 100 networks × 10 sequences, one core")
    for name, value, remark in rows:
        print(f"  {name:<32}{value:>10}  {remark}")


if __name__ == "__main__":
    main()
