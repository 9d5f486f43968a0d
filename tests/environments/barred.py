"""Tasks that forbid actions, and end the run of whoever plays one all the same. No JAX here."""

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple
from pettingzoo import ParallelEnv

N = 4


class Barred(gymnasium.Env):
    """Of four actions two are allowed, drawn anew at every step; pays 1 for the larger of them.
    `where` says which: `obs`, `info`."""

    action_space = Discrete(N, start=2)

    def __init__(self, where="obs", steps=10):
        self.where, self.most = where, steps
        mask = {"action_mask": MultiBinary(N)} if where == "obs" else {}
        self.observation_space = Dict({"a first": Box(-1, 1, (1,)), **mask})

    def _answer(self):
        self.allowed = np.zeros(N, np.int8)
        self.allowed[self.np_random.choice(N, 2, replace=False)] = 1
        obs, mask = {"a first": np.float32([0.5])}, {"action_mask": self.allowed}
        return (obs | mask, {}) if self.where == "obs" else (obs, mask)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._answer()

    def step(self, action):
        if not self.allowed[action - 2]:
            raise ValueError(f"{action} was not allowed")
        paid = float(action - 2 == np.flatnonzero(self.allowed).max())
        self.steps += 1
        obs, info = self._answer()
        return obs, paid, False, self.steps == self.most, info


class Several(gymnasium.Env):
    """Two choices, of three and of two options, that `info` allows in part; pays for both."""

    action_space = MultiDiscrete([3, 2])
    observation_space = Box(-1, 1, (1,))

    def __init__(self, split=False):
        self.split = split

    def _answer(self):
        self.allowed = self.np_random.integers(0, 2, 5).astype(np.int8)
        self.allowed[self.np_random.integers(3)] = self.allowed[3 + self.np_random.integers(2)] = 1
        mask = (self.allowed[:3], self.allowed[3:]) if self.split else self.allowed
        return np.zeros(1, np.float32), {"action_mask": mask}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._answer()

    def step(self, action):
        first, second = self.allowed[:3], self.allowed[3:]
        if not (first[action[0]] and second[action[1]]):
            raise ValueError(f"{action} was not allowed")
        best = [np.flatnonzero(part).max() for part in (first, second)]
        paid = int((action == best).sum())
        self.steps += 1
        obs, info = self._answer()
        return obs, float(paid), False, self.steps == 10, info


class Mixed(gymnasium.Env):
    """Pays for what it is told in a Dict of several kinds of actions, and returns it."""

    observation_space = Box(-9, 9, (1,))
    action_space = Dict(
        {
            "box": Box(np.float32([0.0]), np.float32([10.0])),
            "which": Discrete(3, start=-1),
            "pair": Tuple((MultiBinary(2), Box(-1, 1, (1,)))),
        }
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        if not self.action_space.contains(action):
            raise ValueError(f"{action} is none of mine")
        bits, box = action["pair"]
        told = 100 * int(action["which"]) + 1000 * int(bits[0]) + 2000 * int(bits[1])
        paid = action["box"][0] + told + box[0]
        return np.zeros(1, np.float32), float(paid), False, False, {}


class Team(ParallelEnv):
    """Two agents, one with three actions and one with two, of which `mask` allows some: in Dict
    observations, in infos, or all. Pays each 1 for its largest allowed action."""

    metadata = {"name": "barred"}
    possible_agents = ["a", "b"]
    max_cycles = 5

    def __init__(self, where="obs"):
        self.where = where

    def action_space(self, agent):
        return Discrete(3 if agent == "a" else 2)

    def observation_space(self, agent):
        own = Box(-1, 1, (2 if agent == "a" else 1,))
        if self.where != "obs":
            return own
        n = int(self.action_space(agent).n)
        return Dict({"observation": own, "action_mask": MultiBinary(n)})

    def _answer(self):
        obs, infos = {}, {}
        for agent in self.agents:
            n = self.action_space(agent).n
            mask = self.random.integers(0, 2, n).astype(np.int8)
            mask[self.random.integers(n)] = 1
            self.allowed[agent] = np.ones(n) if self.where == "nowhere" else mask
            own = np.full(2 if agent == "a" else 1, 0.5, np.float32)
            obs[agent] = {"observation": own, "action_mask": mask} if self.where == "obs" else own
            infos[agent] = {"action_mask": mask} if self.where == "info" else {}
        return obs, infos

    def reset(self, seed=None, options=None):
        self.random, self.steps, self.allowed = np.random.default_rng(seed), 0, {}
        self.agents = list(self.possible_agents)
        return self._answer()

    def step(self, actions):
        rewards = {}
        for agent, action in actions.items():
            if not self.allowed[agent][action]:
                raise ValueError(f"{action} was not allowed to {agent}")
            rewards[agent] = float(action == np.flatnonzero(self.allowed[agent]).max())
        self.steps += 1
        over = self.steps == self.max_cycles
        obs, infos = self._answer()
        ends = dict.fromkeys(self.possible_agents, over)
        if over:
            self.agents = []
        return obs, rewards, dict.fromkeys(self.possible_agents, False), ends, infos
