"""PettingZoo teams for the tests of their worker, most of them broken. No JAX here."""

import sys

import numpy as np
from broken import Tiny
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv


class Pair(ParallelEnv):
    """Two unlike agents that observe their action; `a` also sees a number of the seed.

    `leave` has (agent, step, "terminated" or "truncated"), `join` (agent, step); without either
    both stay to the end. A fault of `Tiny` happens to the observation of `b`.
    """

    metadata = {"name": "pair"}
    possible_agents = ["a", "b"]
    observations = {"a": Box(-9.0, 9.0, (3,), np.float64), "b": Box(-9.0, 9.0, (2, 1))}
    actions = {"a": Box(np.float32([-2, 0]), np.float32([4, 1])), "b": Box(-1, 1, (1,))}

    def __init__(self, fault="", where="step", at=2, leave=(), join=()):
        self.fault, self.where, self.at = fault, where, at
        self.leave, self.join = ({tuple(event) for event in events} for events in (leave, join))

    def observation_space(self, agent):
        return self.observations[agent]

    def action_space(self, agent):
        return self.actions[agent]

    def reset(self, seed=None, options=None):
        self.random, self.steps = np.random.default_rng(seed), 0
        late = {agent for agent, _ in self.join}
        self.agents = [agent for agent in self.possible_agents if agent not in late]
        return self._observe("reset", {"a": np.zeros(2), "b": np.zeros(1)}), {}

    def step(self, actions):
        assert set(actions) == set(self.agents)
        self.steps += 1
        acted = self.agents
        rewards = {agent: float(actions[agent].sum()) for agent in acted}
        ends = {
            kind: {agent: (agent, self.steps, kind) in self.leave for agent in acted}
            for kind in ("terminated", "truncated")
        }
        obs = self._observe("step", actions)
        self.agents = [agent for agent in acted if not any(end[agent] for end in ends.values())]
        for agent, step in self.join:
            if step == self.steps:
                self.agents.append(agent)
                obs[agent] = np.full(self.observations[agent].shape, 7.0)
        return obs, rewards, ends["terminated"], ends["truncated"], {}

    def _observe(self, where, actions):
        obs = {}
        for agent in self.agents:
            if agent == "a":
                obs["a"] = np.append(actions["a"], self.random.random())
            else:
                obs["b"] = np.full((2, 1), actions["b"])
        if self.fault and where == self.where and (where == "reset" or self.steps == self.at):
            obs["b"] = getattr(Tiny, f"_{self.fault}")(self, obs["b"])
        return obs

    def close(self):
        raise RuntimeError("the door is stuck")


class Limited(Pair):
    max_cycles = 4


class Unseeded(Limited):
    def reset(self, seed=None, options=None):
        return super().reset(None, options)


class Watchful(Limited):
    """Says whether JAX was imported."""

    def step(self, actions):
        obs, rewards, *rest = super().step(actions)
        return obs, dict.fromkeys(rewards, float("jax" in sys.modules)), *rest


class Unlike(Limited):
    actions = {"a": Discrete(3), "b": Box(-1, 1, (1,))}


class Forgetful(Limited):
    """Leaves out what it says of `b` in one of its answers, or says it of a stranger."""

    def __init__(self, part):
        super().__init__()
        self.part = part

    def step(self, actions):
        answer = list(super().step(actions))
        if self.part == 5:
            self.agents = ["a", "c"]
        elif self.part == 6:
            answer[1] = [0.0, 0.0]
        else:
            del answer[self.part]["b"]
        return tuple(answer)


class Nobody(Limited):
    possible_agents = []


class Movable(Limited):
    """As of mpe2: Box actions only when it is asked for them."""

    def __init__(self, continuous_actions=False):
        super().__init__()
        if not continuous_actions:
            self.actions = {"a": Discrete(3), "b": Discrete(3)}


def parallel_env(**kwargs):
    return Limited(**kwargs)


def a_number():
    return 7


class Dies(ParallelEnv):
    """`a` dies at its first step with reward 1, and `b` goes on to the end, unpaid."""

    metadata = {"name": "dies"}
    possible_agents = ["a", "b"]
    max_cycles = 4

    def __init__(self, how="terminated"):
        self.how = how

    def observation_space(self, agent):
        return Box(-1, 1, (2,), np.float32)

    def action_space(self, agent):
        return Box(-1, 1, (1,), np.float32)

    def _see(self):
        both = {"a": np.float32([1, 0]), "b": np.float32([0, 1])}
        return {agent: both[agent] for agent in self.agents}

    def reset(self, seed=None, options=None):
        self.agents, self.steps = ["a", "b"], 0
        return self._see(), {}

    def step(self, actions):
        self.steps += 1
        seen, acted = self._see(), self.agents
        ends = [{x: x == "a" and self.how == kind for x in acted} for kind in ("terminated", "cut")]
        self.agents = [x for x in acted if not (ends[0][x] or ends[1][x])]
        return seen, {x: float(x == "a") for x in acted}, *ends, {}


class Named(Pair):
    """Names its rewards in infos; at step `at` it does what `wrong` says."""

    max_cycles = 4

    def __init__(self, wrong="", at=2, **kwargs):
        super().__init__(**kwargs)
        self.wrong, self.turn = wrong, at

    def step(self, actions):
        obs, rewards, *ends, _ = super().step(actions)
        acted = list(rewards)
        told = {x: {"global": float(self.steps), "dense": 10.0 * k} for k, x in enumerate(acted)}
        if self.steps == self.turn and self.wrong:
            getattr(self, f"_{self.wrong}")(told)
        return obs, rewards, *ends, {x: {"rewards": told[x]} for x in acted if told[x] is not None}

    def _differ(self, told):
        told["b"]["global"] = 7.0

    def _silent(self, told):
        told["b"] = None

    def _private(self, told):
        del told["b"]["dense"]

    def _new(self, told):
        told["b"]["other"] = 1.0

    def _one(self, told):  # what all share one may say
        del told["a"]["global"]

    def _nobody(self, told):
        del told["a"]["global"], told["b"]["global"]

    def _text(self, told):
        told["b"]["dense"] = "1.0"


class Late(Named):
    """Names rewards from its second step alone."""

    def step(self, actions):
        *answer, infos = super().step(actions)
        return *answer, infos if self.steps > 1 else {}


def arrived(env, rewards, infos):
    """One number for the team."""
    return 100.0 * env.steps


def each(env, rewards, infos):
    """A number for each."""
    return {agent: reward + 0.5 for agent, reward in rewards.items()}


def fickle(env, rewards, infos):
    return 1.0 if env.steps < 2 else {"a": 1.0}
