"""DQN on CartPole-v1: environment frames per CPU second of one core.

Beside DQN of Stable-Baselines3. For both: one copy of the environment, an update of 128 transitions
for every frame, 2 × 256 units, a target that follows by 0.005 per update, returns of one step. CPU
seconds are of a contender's process and its live children, after the first updates.
"""

import jax

from credo.algorithms.off_policy import OffPolicy
from credo.environments.gymnasium import Gymnasium
from credo.replay import Sampling

from . import peers
from .erl_hopper import cpu_seconds

SECONDS, GOAL = 20.0, 5.0


def measure(seconds: float) -> float:
    """Frames per CPU second of Credo's generations, after some that learned."""
    never = {"test_every": 10**9, "replay_capacity": 100_000}
    dqn = OffPolicy.dqn(Gymnasium("CartPole-v1"), sampling=Sampling(), **never)
    state, i = dqn.init(key=jax.random.key(0)), 0
    began, first = 0.0, 0
    while not first or cpu_seconds() - began < seconds:
        if not first and int(state.frames) > 1_100:
            began, first = cpu_seconds(), int(state.frames)
        state, _ = dqn.generation(state, key=jax.random.key(i))
        jax.block_until_ready(state)
        i += 1
    return (int(state.frames) - first) / (cpu_seconds() - began)


def main() -> None:
    ours = measure(SECONDS)
    print(f"  dqn: {ours:.0f} frames per CPU second")
    sb3 = peers.ask("sb3", "sb3_dqn.py", str(SECONDS))
    if sb3 is not None:
        theirs = sb3["frames_per_second"]
        print(f"  Stable-Baselines3: {theirs:.0f}; ratio {ours / theirs:.2f} (goal {GOAL})")


if __name__ == "__main__":
    main()
