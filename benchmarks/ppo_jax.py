"""PPO on Pendulum-v1 of gymnax, in JAX: environment frames per CPU second of one core.

Beside PPO of rejax, which is one compiled program for all rounds. For both: 32 copies for 200
frames, 10 epochs, minibatches of 64 frames, actor and critic of 2 × 64 units. Nobody tests. CPU
seconds are of a contender's process, after compilation. Needs gymnax; `make test-all` makes an
environment that has it.
"""

import time

import jax

from . import peers

ROUNDS, GOAL = 20, 0.9


def measure(rounds: int) -> float:
    """Frames per CPU second of Credo's generations, after two."""
    from credo.algorithms.ppo import PPO
    from credo.environments.gymnax import Gymnax

    sizes = {"horizon": 6_400, "copies": 32, "batch_size": 64, "epochs": 10}
    ppo = PPO.ppo(Gymnax("Pendulum-v1"), **sizes, test_every=10**9)
    state, began = ppo.init(key=jax.random.key(0)), 0.0
    for i in range(rounds + 2):
        if i == 2:
            began = time.process_time()
        state, _ = ppo.generation(state, key=jax.random.key(i))
        jax.block_until_ready(state)
    return rounds * 6_400 / (time.process_time() - began)


def main() -> None:
    try:
        ours = measure(ROUNDS)
    except ModuleNotFoundError as error:
        print(f"  (not measured: {error})")
        return
    print(f"  ppo: {ours:.0f} frames per CPU second")
    rejax = peers.ask("rejax", "rejax_ppo.py", str(ROUNDS))
    if rejax is not None:
        theirs = rejax["frames_per_second"]
        print(f"  rejax: {theirs:.0f}; ratio {ours / theirs:.2f} (goal {GOAL})")


if __name__ == "__main__":
    main()
