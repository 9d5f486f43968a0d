"""DQN of Stable-Baselines3: environment frames per CPU second.

Run by the benchmarks in an environment that has it: `python sb3_dqn.py SECONDS`; prints a JSON
line. Sizes are those of `benchmarks/dqn.py`.
"""

import json
import sys
import time

import torch
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback


class Clock(BaseCallback):
    """Starts with the first update, and ends after so many CPU seconds."""

    def __init__(self, start, length):
        super().__init__()
        self.start, self.length = start, length

    def _on_step(self):
        if self.num_timesteps == self.start:
            self.began = time.process_time()
        if self.num_timesteps <= self.start or time.process_time() - self.began < self.length:
            return True
        frames = self.num_timesteps - self.start
        self.rate = frames / (time.process_time() - self.began)
        return False


if __name__ == "__main__":
    torch.set_num_threads(1)
    model = DQN(
        "MlpPolicy",
        "CartPole-v1",
        learning_rate=5e-4,
        buffer_size=100_000,
        learning_starts=1_000,
        batch_size=128,
        tau=0.005,
        train_freq=1,
        gradient_steps=1,
        target_update_interval=1,
        policy_kwargs={"net_arch": [256, 256]},
    )
    clock = Clock(1_100, float(sys.argv[1]))
    model.learn(10**9, callback=clock)
    print(json.dumps({"frames_per_second": clock.rate}))
