r"""A team of your own: a PettingZoo environment that names its rewards.

    cd examples
    credo check own_team:Carry
    credo train merl own_team:Carry --fitness global --learners.0.signal local \
        --episodes 4 --workers 20 --frames 3e5

Three agents find a box and carry it to the right. The box moves only while all three hold it. Each
agent is paid for every step towards the box (`local`, dense); the team is paid once, at the end,
for the share of the way that the box was carried (`global`, sparse). The local reward says where
the box is and nothing about where it should go.
"""

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

AGENTS, STEPS, SPEED, REACH = 3, 50, 0.1, 0.25  # distances in half widths of the field


class Carry(ParallelEnv):
    metadata = {"name": "carry", "render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode=None, max_cycles=STEPS):
        self.render_mode, self.max_cycles = render_mode, max_cycles
        self.possible_agents = [f"agent_{k}" for k in range(AGENTS)]
        observations, actions = Box(-2.0, 2.0, (4 + 2 * AGENTS,)), Box(-1.0, 1.0, (2,))
        self.observation_spaces = dict.fromkeys(self.possible_agents, observations)
        self.action_spaces = dict.fromkeys(self.possible_agents, actions)

    def observation_space(self, agent):
        return self.observation_spaces[agent]

    def action_space(self, agent):
        return self.action_spaces[agent]

    def reset(self, seed=None, options=None):
        random = np.random.default_rng(seed)
        self.agents, self.steps = list(self.possible_agents), 0
        self.places = random.uniform(-1.0, 1.0, (AGENTS, 2))
        self.box = self.start = random.uniform([-0.8, -0.8], [0.0, 0.8])
        return self._by_agent(self._observations()), self._by_agent([{}] * AGENTS)

    def step(self, actions):
        moves = SPEED * np.clip([actions[agent] for agent in self.agents], -1.0, 1.0)
        before = self._distances()
        if (before < REACH).all():  # all hold it: it goes where they pull together
            self.box = np.clip(self.box + moves.mean(axis=0), -1.0, 1.0)
        self.places = np.clip(self.places + moves, -1.0, 1.0)
        self.steps += 1
        over = self.steps >= self.max_cycles
        local = before - self._distances()
        carried = (self.box[0] - self.start[0]) / (1.0 - self.start[0])
        rewards = {"global": float(max(carried, 0.0)) if over else 0.0}
        told = (
            self._by_agent(self._observations()),
            self._by_agent(local.tolist()),  # what each agent is paid is its `local` reward
            self._by_agent([False] * AGENTS),
            self._by_agent([over] * AGENTS),
            self._by_agent([{"rewards": rewards}] * AGENTS),
        )
        self.agents = [] if over else self.agents
        return told

    def render(self):
        picture = np.full((200, 200, 3), 255, np.uint8)
        y, x = np.mgrid[1:-1:200j, -1:1:200j]
        for place, color in [(self.box, (200, 60, 40)), *((p, (40, 90, 160)) for p in self.places)]:
            picture[np.hypot(x - place[0], y - place[1]) < 0.05] = color
        return picture

    def _distances(self):
        return np.linalg.norm(self.places - self.box, axis=1)

    def _observations(self):
        """By agent: where it is, the box, and the way to the box for itself and for the others."""
        to_box = self.box - self.places
        ways = [np.roll(to_box, -k, axis=0) for k in range(AGENTS)]
        return np.float32(np.hstack([self.places, np.tile(self.box, (AGENTS, 1)), *ways]))

    def _by_agent(self, rows):
        return dict(zip(self.possible_agents, rows, strict=True))
