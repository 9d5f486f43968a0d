"""RecurrentPPO of sb3-contrib: environment frames per CPU second.

Run by the benchmarks in an environment that has sb3-contrib: `python sb3_recurrent_ppo.py SECONDS`;
prints a JSON line. Sizes are those of `benchmarks/recurrent_ppo.py`; the copies are stepped in this
process, which costs least.
"""

import json
import sys
import time

import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

COPIES, STEPS, BATCH, UNITS = 10, 200, 512, 64


class Clock(BaseCallback):
    """Starts behind the first round of frames and updates, and ends after so many CPU seconds."""

    def __init__(self, length):
        super().__init__()
        self.length, self.rounds, self.began, self.first = length, 0, 0.0, 0

    def _on_rollout_start(self):
        if self.rounds == 1:
            self.began, self.first = time.process_time(), self.num_timesteps
        self.rounds += 1
        if self.rounds > 2 and time.process_time() - self.began > self.length:
            self.rate = (self.num_timesteps - self.first) / (time.process_time() - self.began)

    def _on_step(self):
        return not hasattr(self, "rate")


if __name__ == "__main__":
    torch.set_num_threads(1)
    model = RecurrentPPO(
        "MlpLstmPolicy",
        make_vec_env("Pendulum-v1", n_envs=COPIES),
        n_steps=STEPS,
        batch_size=BATCH,
        n_epochs=10,
        policy_kwargs={"lstm_hidden_size": UNITS, "net_arch": {"pi": [], "vf": [64, 64]}},
    )
    clock = Clock(float(sys.argv[1]))
    model.learn(10**9, callback=clock)
    print(json.dumps({"frames_per_second": clock.rate}))
