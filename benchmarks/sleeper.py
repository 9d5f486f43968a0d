"""A simulator that takes its time and no core: what a machine room full of them would cost."""

import time

import gymnasium
import numpy as np


class Sleeper(gymnasium.Env):
    """Sizes of HalfCheetah; a step takes `pause` seconds."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (17,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (6,), np.float32)

    def __init__(self, pause: float):
        self.pause = pause

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(17, np.float32), {}

    def step(self, action):
        time.sleep(self.pause)
        return np.full(17, action.mean(), np.float32), 0.0, False, False, {}
