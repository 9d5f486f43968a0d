"""Gymnasium environments that fail now and then, hang, or leave processes behind. No JAX here."""

import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
from broken import Tiny
from gymnasium.spaces import Box


class Faulty(Tiny):
    def _holds(self, obs):
        re.match(r"(a+)+$", "a" * 60 + "b")  # within one call of C, for years

    def _leaves_a_child(self, obs):
        if os.fork() == 0:
            time.sleep(600)
        os._exit(9)

    def _large(self, obs):
        return obs + 1e39


class Rare(Faulty):
    """Fails in the episodes whose seed is a multiple of `every`."""

    def __init__(self, every=20, **kwargs):
        super().__init__(**kwargs)
        self.every, self.usual = every, self.fault

    def reset(self, *, seed=None, options=None):
        self.fault = "" if seed % self.every else self.usual
        return super().reset(seed=seed, options=options)


class Slow(Tiny):
    def __init__(self, opening=0.0, step=0.0):
        super().__init__()
        self.pause = step
        time.sleep(opening)

    def step(self, action):
        time.sleep(self.pause)
        return super().step(action)


class Parent(Faulty):
    """Starts a process of its own, with `mark` among its arguments."""

    def __init__(self, mark, detached=False, **kwargs):
        super().__init__(**kwargs)
        code = "import time; time.sleep(600)"
        self.child = subprocess.Popen(
            [sys.executable, "-c", code, mark], start_new_session=detached
        )


class Robot(Tiny):
    """There is one of it."""

    taken = 0

    def __init__(self):
        super().__init__()
        self.mine = Robot.taken == 0
        if not self.mine:
            raise OSError("the robot is in use")
        Robot.taken = 1

    def close(self):
        if self.mine:
            self.mine, Robot.taken = False, 0


class Picture(Tiny):
    """Observes bytes."""

    observation_space = Box(0, 255, (2, 2), np.uint8)

    def _answer(self, where, action):
        return np.full((2, 2), 200 + int(where == "step"), np.uint8)


class Alarming(Tiny):
    """Has a limit of time of its own, as graders have."""

    def step(self, action):
        signal.alarm(5)
        try:
            return super().step(action)
        finally:
            signal.alarm(0)
