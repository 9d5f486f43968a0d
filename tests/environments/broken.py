"""Gymnasium environments for the tests of the worker, most of them broken. No JAX here."""

import os
import sys
import time

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete


class Tiny(gymnasium.Env):
    """Observes its action and a number of its seed; a fault happens in `where`, at step `at`."""

    observation_space = Box(-9.0, 9.0, (2,), np.float64)
    action_space = Box(np.float32([-2.0]), np.float32([4.0]))

    def __init__(self, fault="", where="step", at=2):
        self.fault, self.where, self.at = fault, where, at

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._answer("reset", np.zeros(1)), {}

    def step(self, action):
        self.steps += 1
        return self._answer("step", action), 1.5, self.steps == 6, False, {}

    def _answer(self, where, action):
        obs = np.append(action, self.np_random.random())
        if where == self.where and (where == "reset" or self.steps == self.at):
            return getattr(self, f"_{self.fault}", lambda obs: obs)(obs)
        return obs

    def _raises(self, obs):
        raise ValueError("the bridge is out")

    def _leaves(self, obs):
        sys.exit(3)

    def _dies(self, obs):
        os._exit(7)

    def _hangs(self, obs):
        time.sleep(600)

    def close(self):
        raise RuntimeError("the door is stuck")  # what a broken environment adds to its fault

    def _nan(self, obs):
        return obs * np.nan

    def _shape(self, obs):
        return obs[:1]

    def _prints(self, obs):
        os.write(1, b"noise" * 1000)
        print("noise" * 1000, flush=True)
        return obs


class Clock(Tiny):
    """Limited by Gymnasium: truncated at step 4."""

    def __new__(cls, **kwargs):
        return gymnasium.wrappers.TimeLimit(Tiny(**kwargs), 4)


class Reward(Tiny):
    def __init__(self, reward):
        super().__init__()
        self.reward = reward

    def step(self, action):
        obs, _, *rest = super().step(action)
        return obs, self.reward, *rest


class OldStep(Tiny):
    def step(self, action):
        obs, reward, terminated, _, info = super().step(action)
        return obs, reward, terminated, info


class Unseeded(Tiny):
    def reset(self, *, seed=None, options=None):
        return super().reset(seed=None, options=options)


class Unbounded(Tiny):
    action_space = Box(-np.inf, np.inf, (1,), np.float32)


class Grid(gymnasium.Env):
    """Observations of two axes that show the choice made and whether JAX was imported."""

    observation_space = Box(0, 255, (2, 3), np.uint8)
    action_space = Discrete(3, start=5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.arange(6, dtype=np.uint8).reshape(2, 3), {}

    def step(self, action):
        obs = np.array([[action, "jax" in sys.modules, 0], [1, 2, 3]], np.uint8)
        return obs, int(action), False, False, {}


class Numbered(Grid):
    """A Discrete observation, and a whole-numbered Box as action."""

    observation_space = Discrete(4, start=-1)
    action_space = Box(-3, 3, (2,), np.int64)

    def reset(self, *, seed=None, options=None):
        return 2, {}

    def step(self, action):
        assert action.dtype == np.int64
        return -1, float(action[0] * 10 + action[1]), False, False, {}


class Wide(Tiny):
    """Says what it was told, in a message larger than a pipe holds."""

    observation_space = Box(-1.0, 1.0, (30_000,), np.float32)
    action_space = Box(-1.0, 1.0, (30_000,), np.float32)

    def _answer(self, where, action):
        return np.zeros(30_000) if where == "reset" else action


class Asks(Grid):
    action_space = gymnasium.spaces.Text(3)


class NoEnv:
    pass


class Says(Tiny):
    """Observes what it is told to, in the space that it is told to have."""

    def __init__(self, space, obs):
        super().__init__()
        self.observation_space, self.obs = SPACES[space], OBSERVATIONS[obs]

    def _answer(self, where, action):
        return self.obs


SPACES = {
    "dict": gymnasium.spaces.Dict(
        {
            "pos": Box(-1, 1, (2,)),
            "kind": Discrete(3),
            "sub": gymnasium.spaces.Tuple([Box(0, 9, ())]),
        }
    ),
    "box": Box(-1, 1, (2,)),
    "bytes": Box(0, 255, (2,), np.uint8),
}
POS = np.array([0.25, 5.0])  # float64, and outside
OBSERVATIONS = {
    "float64": {"pos": POS, "kind": 1, "sub": (np.int64(3),)},
    "list": {"pos": [0.25, 5], "kind": np.int64(1), "sub": [3.0]},
    "shape": {"pos": POS[:1], "kind": 1, "sub": (3,)},
    "kind": {"pos": POS, "kind": 7, "sub": (3,)},
    "missing": {"pos": POS, "kind": 1},
    "other": {"pos": POS, "kind": 1, "sup": (3,)},
    "inner": {"pos": POS, "kind": 1, "sub": (3, 4)},
    "strings": ["0.5", "1"],
    "complex": [1j, 0],
    "objects": np.array([None, 1], object),
    "whole": np.array([3.0, 255.0]),
    "part": np.array([0.5, 1.0]),
    "box": np.array([0.5, 5.0]),
}


class Answers(Tiny):
    """Says of a step what it is told to: an expression by name."""

    def __init__(self, **said):
        super().__init__()
        said = {"reward": "0.0", "terminated": "False", "truncated": "False"} | said
        self.said = [eval(expression, {"np": np}) for expression in said.values()]

    def step(self, action):
        return super().step(action)[0], *self.said, {}


class Words(gymnasium.Space):
    """No array holds it, and it does not say so."""

    def sample(self, mask=None, probability=None):
        return "go"

    def contains(self, x):
        return isinstance(x, str)


class Worded(Grid):
    """Observations of which one is a text, as in MiniGrid."""

    observation_space = gymnasium.spaces.Dict({"mission": Words(), "at": Box(-1, 1, (2,))})

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return {"mission": "go", "at": np.float32([0.25, 0.5])}, {}

    def step(self, action):
        return {"mission": "go", "at": np.float32([0.25, 0.5])}, 0.0, False, False, {}


class Masked(gymnasium.Env):
    """Pays the action that was taken; `where` it says which are allowed: 0 and 3, then 1 and 2."""

    action_space = Discrete(4, start=10)

    def __init__(self, where="obs", never=-1):
        self.where, self.never = where, never
        mask = {"action_mask": gymnasium.spaces.MultiBinary(4)} if where == "obs" else {}
        self.observation_space = gymnasium.spaces.Dict({"x": Box(-1, 1, (1,)), **mask})

    def _answer(self):
        mask = np.array([1, 0, 0, 1] if self.steps % 2 == 0 else [0, 1, 1, 0], np.int8)
        mask = mask * (self.steps != self.never)
        obs = {"x": np.zeros(1, np.float32)}
        return (
            (obs | {"action_mask": mask}, {})
            if self.where == "obs"
            else (
                obs,
                {"action_mask": mask},
            )
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._answer()

    def step(self, action):
        self.steps += 1
        obs, info = self._answer()
        return obs, float(action), self.steps == 4, False, info


def running(limit=4):
    """A factory, and wrappers that keep statistics."""
    env = gymnasium.wrappers.NormalizeObservation(Tiny())
    return gymnasium.wrappers.TimeLimit(gymnasium.wrappers.NormalizeReward(env), limit)


class Slow(Tiny):
    """Every step takes a while, and there are many."""

    def step(self, action):
        time.sleep(0.02)
        return super().step(action)[0], 0.0, False, False, {}
