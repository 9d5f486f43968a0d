"""Recurrent TD3 as most people write it in eager PyTorch: GRUs by `nn.GRU` for actor and critics,
windows of an episode, burn-in without a gradient.

Run by the benchmarks in an environment that has torch: `python torch_recurrent_td3.py SECONDS`;
prints a JSON line. Sizes are those of `benchmarks/recurrent_update.py`.
"""

import copy
import json
import sys
import time

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

OBS, ACT, UNITS, TOLD, WIDTH, WINDOWS, BURN_IN, WINDOW = 17, 6, 64, 32, 256, 16, 16, 64
GAMMA, TAU, NOISE, CLIP, DELAY, EPISODES, LENGTH = 0.99, 0.005, 0.2, 0.5, 2, 20, 1000


class Actor(nn.Module):
    def __init__(self):
        super().__init__()
        self.memory, self.out = nn.GRU(OBS, UNITS, batch_first=True), nn.Linear(UNITS, ACT)

    def forward(self, seen, start):
        with torch.no_grad():
            early, start = self.memory(seen[:, :BURN_IN], start)
        late, _ = self.memory(seen[:, BURN_IN:], start)
        return torch.tanh(self.out(torch.cat([early, late], 1)))


class Critic(nn.Module):
    def __init__(self):
        super().__init__()
        self.memory = nn.GRU(OBS + ACT, UNITS, batch_first=True)
        self.told = nn.Linear(UNITS, TOLD)
        layers = [nn.Linear(TOLD + OBS + ACT, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH)]
        self.value = nn.Sequential(*layers, nn.ReLU(), nn.Linear(WIDTH, 1))

    def sees(self, seen, done):
        inputs = torch.cat([seen, done], -1)
        with torch.no_grad():
            early, start = self.memory(inputs[:, :BURN_IN])
        late, _ = self.memory(inputs[:, BURN_IN:], start)
        return torch.cat([torch.tanh(self.told(torch.cat([early, late], 1))), seen], -1)

    def forward(self, sees, action):
        return self.value(torch.cat([sees, action], -1))


class TD3:
    def __init__(self):
        self.actor, self.critics = Actor(), nn.ModuleList(Critic() for _ in range(2))
        self.target_actor = copy.deepcopy(self.actor)
        self.target_critics = copy.deepcopy(self.critics)
        self.actor_opt = torch.optim.Adam(self.actor.parameters(), lr=3e-4)
        self.critic_opt = torch.optim.Adam(self.critics.parameters(), lr=3e-4)
        self.steps = 0

    def update(self, seen, action, reward, memory):
        """Of windows: one observation more than rows."""
        before = F.pad(action, (0, 0, 1, 0))  # what was done before each moment
        with torch.no_grad():
            noise = (torch.randn_like(action) * NOISE).clamp(-CLIP, CLIP)
            ahead = (self.target_actor(seen, memory)[:, 1:] + noise).clamp(-1, 1)
            q = [c(c.sees(seen, before)[:, 1:], ahead) for c in self.target_critics]
            target = (reward + GAMMA * torch.min(*q))[:, BURN_IN:]
        now, done = seen[:, :-1], before[:, :-1]
        told = [critic(critic.sees(now, done), action)[:, BURN_IN:] for critic in self.critics]
        loss = sum(F.mse_loss(x, target) for x in told)
        self.critic_opt.zero_grad()
        loss.backward()
        self.critic_opt.step()
        self.steps += 1
        if self.steps % DELAY == 0:
            critic = self.critics[0]
            sees = critic.sees(now, done).detach()
            loss = -critic(sees, self.actor(now, memory))[:, BURN_IN:].mean()
            self.actor_opt.zero_grad()
            loss.backward()
            self.actor_opt.step()
            pairs = ((self.target_actor, self.actor), (self.target_critics, self.critics))
            with torch.no_grad():
                for target, source in pairs:
                    for old, new in zip(target.parameters(), source.parameters(), strict=True):
                        old.lerp_(new, TAU)


def main() -> None:
    torch.set_num_threads(1)
    rng, learner = np.random.default_rng(0), TD3()
    obs = rng.normal(size=(EPISODES, LENGTH + 1, OBS)).astype(np.float32)
    action = rng.uniform(-1, 1, (EPISODES, LENGTH, ACT)).astype(np.float32)
    reward = rng.normal(size=(EPISODES, LENGTH, 1)).astype(np.float32)
    memory = rng.normal(size=(EPISODES, LENGTH, UNITS)).astype(np.float32)
    rows = np.arange(BURN_IN + WINDOW)

    def drawn():
        episode = rng.integers(EPISODES, size=(WINDOWS, 1))
        first = rng.integers(LENGTH - len(rows), size=(WINDOWS, 1))
        at = first + rows
        seen = obs[episode, np.concatenate([at, at[:, -1:] + 1], 1)]
        parts = (seen, action[episode, at], reward[episode, at])
        return *map(torch.from_numpy, parts), torch.from_numpy(memory[episode, first][None, :, 0])

    for _ in range(5):
        learner.update(*drawn())
    began, count = time.process_time(), 0
    while time.process_time() - began < float(sys.argv[1]):
        learner.update(*drawn())
        count += 1
    print(json.dumps({"updates_per_second": count / (time.process_time() - began)}))


if __name__ == "__main__":
    main()
