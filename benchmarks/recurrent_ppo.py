"""PPO with memory on Pendulum-v1: environment frames per CPU second of one core.

Beside RecurrentPPO of sb3-contrib. For both: an LSTM of 64 units for the policy and a memory of
its own for the critic, which has 2 × 64 units behind it; rounds of 10 episodes of 200 frames, 10
epochs, minibatches of 512 frames. Ours follows the policy back through windows of 64 frames, theirs
through whole episodes where a minibatch has room for them.

CPU seconds are of a contender's process and its live children, after the first rounds.
"""

import jax

from credo.algorithms.ppo import PPO
from credo.environments.gymnasium import Gymnasium
from credo.networks.recurrent import Recurrent

from . import peers
from .erl_hopper import cpu_seconds

SECONDS, GOAL = 20.0, 2.0
NETWORK = Recurrent("lstm", 64, "tanh", "fan_in")


def measure(seconds: float) -> float:
    """Frames per CPU second of Credo's generations, after two that learned."""
    ppo = PPO(
        Gymnasium("Pendulum-v1"),
        NETWORK,
        horizon=2_000,
        copies=10,
        batch_size=512,
        window=64,
        test_every=10**9,
    )
    state = ppo.init(key=jax.random.key(0))
    began, first, i = 0.0, 0, 0
    while i < 3 or cpu_seconds() - began < seconds:
        if i == 2:
            began, first = cpu_seconds(), int(state.frames)
        state, _ = ppo.generation(state, key=jax.random.key(i))
        jax.block_until_ready(state)
        i += 1
    return (int(state.frames) - first) / (cpu_seconds() - began)


def main() -> None:
    ours = measure(SECONDS)
    print(f"  with memory: {ours:.0f} frames per CPU second")
    sb3 = peers.ask("sb3", "sb3_recurrent_ppo.py", str(SECONDS))
    if sb3 is not None:
        theirs = sb3["frames_per_second"]
        print(f"  RecurrentPPO: {theirs:.0f}; ratio {ours / theirs:.2f} (goal {GOAL})")


if __name__ == "__main__":
    main()
