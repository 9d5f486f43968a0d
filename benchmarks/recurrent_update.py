"""Updates of TD3 with memory per second of one core: GRUs of 64 units for the actor and before
each critic, 16 windows of 64 rows behind 16 of burn-in, a HalfCheetah's sizes.

Beside eager PyTorch, whose GRU is a kernel of its own; and the same update without memory.
"""

import jax
import jax.numpy as jnp
import numpy as np

from credo.learners.base import learn
from credo.learners.td3 import TD3, TD3_NETWORK
from credo.networks.recurrent import Recurrent
from credo.replay import Replay, Sampling, extend
from credo.types import Transition

from . import peers
from .td3_update import seconds

OBS, ACT, EPISODES, LENGTH, UPDATES, ROUNDS, GOAL = 17, 6, 20, 1000, 40, 5, 1.5
NETWORK = Recurrent("gru", 64, "tanh", "fan_in", span=128)
LEARNER = TD3(batch_size=1024)
SAMPLING = Sampling(window=64, burn_in=16)


def filled(memory: int) -> Replay:
    """Episodes of 1,000 random frames."""
    rng, n = np.random.default_rng(0), EPISODES * LENGTH
    obs, next_obs = (rng.normal(size=(n, OBS)).astype(np.float32) for _ in range(2))
    action = rng.uniform(-1, 1, (n, ACT)).astype(np.float32)
    rewards = {"reward": rng.normal(size=n).astype(np.float32)}
    over = np.arange(n) % LENGTH == LENGTH - 1
    kept = rng.normal(size=(n, memory)).astype(np.float32) if memory else None
    rows = Transition(obs, action, rewards, next_obs, np.zeros(n, bool), over, None, kept)
    return extend(Replay.empty(jax.tree.map(lambda x: jnp.asarray(x[0]), rows), n), rows)


def rate(network, replay: Replay) -> float:
    """Updates per second, the best of some rounds: others may use the machine too."""
    state, best = LEARNER.init(network, OBS, ACT, key=jax.random.key(0)), np.inf
    how = {"signal": "reward", "sampling": SAMPLING}
    for i in range(1 + ROUNDS):
        key = jax.random.key(i)
        took = seconds(lambda key=key: learn(LEARNER, state, replay, UPDATES, **how, key=key))
        best = min(best, took) if i else best  # the first compiles
    return UPDATES / best


def main() -> None:
    ours = rate(NETWORK, filled(64))
    print(f"  with memory: {ours:.1f} updates per second")
    print(f"  without, 1,024 frames: {rate(TD3_NETWORK, filled(0)):.1f}")
    torch = peers.ask("torch", "torch_recurrent_td3.py", "10")
    if torch is not None:
        theirs = torch["updates_per_second"]
        ratio = ours / theirs
        print(f"  eager PyTorch: {theirs:.1f}; ratio {ratio:.2f} (goal {GOAL})")


if __name__ == "__main__":
    main()
