"""TD3 of SBX (Stable-Baselines3 in JAX): updates per CPU second.

Run by the benchmarks in an environment that has sbx-rl: `python sbx_td3.py update SECONDS`.
"""

import json
import sys
import time

import gymnasium
import numpy as np
from sbx import TD3

if __name__ == "__main__":
    length = float(sys.argv[2])
    env = gymnasium.make("HalfCheetah-v5")
    model = TD3(
        "MlpPolicy",
        env,
        batch_size=256,
        policy_kwargs={"net_arch": [256, 256]},
        learning_starts=100,
        train_freq=1,
    )
    model.learn(300)
    buffer, rng = model.replay_buffer, np.random.default_rng(0)
    for _ in range(5_000):
        obs, next_obs = rng.normal(size=(2, 1, 17))
        action = rng.uniform(-1, 1, (1, 6))
        buffer.add(obs, next_obs, action, np.zeros(1), np.zeros(1), [{}])
    block = 50  # gradient steps of one call, which SBX compiles for
    model.train(block, 256)
    began, cpu, n = time.perf_counter(), time.process_time(), 0
    while time.perf_counter() - began < length:
        model.train(block, 256)
        n += block
    print(json.dumps({"update": n / (time.process_time() - cpu)}))
