"""TD3 as most people write it: Gymnasium and eager PyTorch, one update per frame.

Run by the benchmarks in an environment that has torch and gymnasium[mujoco]:
`python torch_td3.py update SECONDS` or `python torch_td3.py hopper SECONDS`; prints a JSON line.
"""

import copy
import json
import sys
import time

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

BATCH, WIDTH, GAMMA, TAU, NOISE, CLIP, DELAY = 256, 256, 0.99, 0.005, 0.2, 0.5, 2


def mlp(inputs, outputs):
    layers = [nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(WIDTH, outputs))


class Buffer:
    def __init__(self, obs_size, action_size, capacity=1_000_000):
        self.size, self.capacity = 0, capacity
        shapes = ((obs_size,), (action_size,), (1,), (obs_size,), (1,))
        self.rows = [np.zeros((capacity, *shape), np.float32) for shape in shapes]

    def add(self, *row):
        for column, value in zip(self.rows, row, strict=True):
            column[self.size % self.capacity] = value
        self.size += 1

    def sample(self):
        index = np.random.randint(0, min(self.size, self.capacity), BATCH)
        return [torch.from_numpy(column[index]) for column in self.rows]


class TD3:
    def __init__(self, obs_size, action_size):
        self.actor = mlp(obs_size, action_size)
        self.critics = nn.ModuleList(mlp(obs_size + action_size, 1) for _ in range(2))
        self.target_actor = copy.deepcopy(self.actor)
        self.target_critics = copy.deepcopy(self.critics)
        self.actor_opt = torch.optim.Adam(self.actor.parameters(), lr=3e-4)
        self.critic_opt = torch.optim.Adam(self.critics.parameters(), lr=3e-4)
        self.steps = 0

    def update(self, obs, action, reward, next_obs, terminated):
        with torch.no_grad():
            noise = (torch.randn_like(action) * NOISE).clamp(-CLIP, CLIP)
            next_action = (torch.tanh(self.target_actor(next_obs)) + noise).clamp(-1, 1)
            x = torch.cat([next_obs, next_action], 1)
            q = torch.min(*(critic(x) for critic in self.target_critics))
            target = reward + GAMMA * (1 - terminated) * q
        x = torch.cat([obs, action], 1)
        loss = sum(F.mse_loss(critic(x), target) for critic in self.critics)
        self.critic_opt.zero_grad()
        loss.backward()
        self.critic_opt.step()
        self.steps += 1
        if self.steps % DELAY == 0:
            x = torch.cat([obs, torch.tanh(self.actor(obs))], 1)
            loss = -self.critics[0](x).mean()
            self.actor_opt.zero_grad()
            loss.backward()
            self.actor_opt.step()
            with torch.no_grad():
                for target, source in (
                    (self.target_actor, self.actor),
                    (self.target_critics, self.critics),
                ):
                    for old, new in zip(target.parameters(), source.parameters(), strict=True):
                        old.lerp_(new, TAU)


def update(seconds):
    learner, buffer = TD3(17, 6), Buffer(17, 6, 20_000)
    rng = np.random.default_rng(0)
    for _ in range(20_000):
        buffer.add(
            rng.normal(size=17), rng.uniform(-1, 1, 6), rng.normal(), rng.normal(size=17), 0.0
        )
    for _ in range(50):
        learner.update(*buffer.sample())
    began, cpu, n = time.perf_counter(), time.process_time(), 0
    while time.perf_counter() - began < seconds:
        learner.update(*buffer.sample())
        n += 1
    return n / (time.process_time() - cpu)


def hopper(seconds):
    import gymnasium

    env = gymnasium.make("Hopper-v5")
    learner, buffer = TD3(11, 3), Buffer(11, 3)
    obs, _ = env.reset(seed=0)
    frames, began, cpu = 0, None, 0.0
    while began is None or time.perf_counter() - began < seconds:
        if frames == 2_000:
            began, cpu = time.perf_counter(), time.process_time()
        with torch.no_grad():
            action = torch.tanh(learner.actor(torch.from_numpy(obs.astype(np.float32))[None]))
        action = np.clip(action[0].numpy() + np.random.normal(0, 0.1, 3), -1, 1)
        next_obs, reward, terminated, truncated, _ = env.step(action)
        buffer.add(obs, action, reward, next_obs, float(terminated))
        obs = env.reset()[0] if terminated or truncated else next_obs
        frames += 1
        if frames > 1_000:
            learner.update(*buffer.sample())
    return (frames - 2_000) / (time.process_time() - cpu)


if __name__ == "__main__":
    torch.set_num_threads(1)
    kind, length = sys.argv[1], float(sys.argv[2])
    print(json.dumps({kind: {"update": update, "hopper": hopper}[kind](length)}))
