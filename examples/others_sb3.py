"""Stable-Baselines3 trains on a task of ours: PPO balances two poles.

    pip install stable-baselines3
    python examples/others_sb3.py --frames 100000

Every task of one agent is a Gymnasium environment: `credo.environments.gymnasium.TASKS` has their
ids, and `gymnasium.make` takes their fields.
"""

import argparse

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

import credo.environments.gymnasium  # noqa: F401 registers our tasks


def make() -> Monitor:
    """Two poles whose velocities are seen; 1 is paid for each of at most 1,000 steps."""
    return Monitor(gymnasium.make("credo/DoublePole-v0", velocities=True, signal="balanced"))


def main(frames: int) -> None:
    """Train for so many frames, and say what five episodes return before and after."""
    model = PPO("MlpPolicy", make(), n_steps=min(2048, frames), seed=0, device="cpu")
    before, _ = evaluate_policy(model, make(), n_eval_episodes=5)
    model.learn(frames)
    after, _ = evaluate_policy(model, make(), n_eval_episodes=5)
    print(f"Stable-Baselines3, {frames} frames: steps balanced {before:.0f} -> {after:.0f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=100_000)
    main(parser.parse_args().frames)
