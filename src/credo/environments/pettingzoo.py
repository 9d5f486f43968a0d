"""PettingZoo, both ways.

Its teams as tasks of ours, played by a worker process:

    task = PettingZoo("mpe2.simple_spread_v3", kwargs={"N": 4})

Team tasks of ours as a PettingZoo `ParallelEnv`, for anybody's training code:

    env = to_pettingzoo(Meet())

Needs PettingZoo, and for `PettingZoo` the package of the task.
"""

import importlib.util
from typing import Any, ClassVar

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from . import names
from .base import AbstractEnvironment
from .foreign import AbstractForeignEnvironment

if importlib.util.find_spec("pettingzoo") is None:
    raise ModuleNotFoundError("teams of others need PettingZoo: `pip install 'credo[pettingzoo]'`")

from pettingzoo import ParallelEnv


def _makers(rewards: Any) -> Any:
    """Functions by the rewards' names as pairs of names."""
    pairs = rewards.items() if isinstance(rewards, dict) else rewards
    return tuple((name, names.name_of(maker)) for name, maker in pairs)


class PettingZoo(AbstractForeignEnvironment):
    """A PettingZoo `ParallelEnv` with Box actions whose copies are stepped in a worker process.

    Every agent of `possible_agents` has a row, in that order. Observations are flattened as in
    `Gymnasium`, and padded with zeros to the largest of the team. An action is as long as the
    largest of the team; each agent is given as much of it as its own Box holds, scaled so that -1
    is its low and 1 its high. Who is not there observes 0, is paid 0, and its action is ignored.

    Rewards: `local` `[agents]`, what the environment pays each agent, and `global`, its mean over
    all rows, unless the task names its own: in `info["rewards"]`, a dict of every agent that acted
    (looked up in one step when the task is opened), or by `rewards`.

    An agent's own termination ends its value; who leaves by truncation is bootstrapped from its
    last observation. `terminated` of the episode: every agent that took part has terminated; an
    episode that is over otherwise was truncated. Learners take who is not there at the start for
    one that is. The time limit is `max_episode_steps` or the environment's own `max_cycles`,
    whichever is less, or 1,000 steps if there is none. Episodes that
    fail are treated as in `Gymnasium`.
    """

    id: str = eqx.field(static=True, converter=names.name_of)
    """"mpe2.simple_spread_v3" (a module with parallel_env), "package.module:name" of a function or
    class that makes a ParallelEnv, that class or function itself, or "sisl/multiwalker-v9" (an id
    that PettingZoo knows). Where it takes continuous_actions, that is True unless `kwargs` says
    otherwise."""
    api: ClassVar[str] = "pettingzoo"
    reported: ClassVar[str] = "global"
    rewards: tuple[tuple[str, str], ...] = eqx.field(static=True, default=(), converter=_makers)
    """Who pays the reward of a name: {"global": arrived}, and `arrived(env, rewards, infos)`
    returns one number for the team, or a dict by agent of a private reward. It is given the
    environment behind the step, and what the step returned. A plain function of a module (its name
    is recorded); one of a notebook, or a lambda, needs in_process=True."""
    shared: tuple[str, ...] = eqx.field(static=True, default=("global",), converter=tuple)
    """Rewards in `info["rewards"]` that are one number for the team; the others are private."""

    def __check_init__(self):
        alone = [name for name, maker in self.rewards if names.here_alone(maker)]
        if alone and not self.here:
            raise ValueError(
                f"what pays the reward {alone[0]!r} cannot be imported by a worker: define the "
                "function at the top of a module, or give in_process=True"
            )

    def _paid(self):
        return {"rewards": [list(pair) for pair in self.rewards], "shared": list(self.shared)}

    @property
    def signals(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self._sizes()["signals"])

    @property
    def reward_shapes(self) -> dict[str, tuple[int, ...]]:
        team = (self._sizes()["agents"],)
        return {name: team if private else () for name, private in self._sizes()["signals"]}


class ParallelTeam(ParallelEnv):
    """One copy of a team task in JAX, with agents "agent_0", "agent_1" and so on.

    Each agent is paid `signal`: its own share of one that is private, the same for all of one that
    is shared. `info["rewards"]` has all signals, and `info["active"]` is False for an agent that
    the task ignores at the next step; all agents stay until the episode ends, because PettingZoo
    lets none come back. Observations are float32, actions lie in [-1, 1] and are clipped to it.
    """

    def __init__(
        self, env: AbstractEnvironment, signal: str | None = None, render_mode: str | None = None
    ):
        name = type(env).__name__
        if env.agents is None:
            raise ValueError(f"{name} has one agent: give a team task, or use GymnasiumEnvironment")
        if signal is None:
            signal = "local" if "local" in env.signals else env.signals[0]
        if signal not in env.signals:
            raise ValueError(f"no reward signal {signal!r}: there is {', '.join(env.signals)}")
        modes = ["rgb_array"] if hasattr(env, "render") else []
        self.metadata = {"name": name, "render_modes": modes, "is_parallelizable": True}
        self.env, self.signal, self.render_mode = env, signal, render_mode
        self.possible_agents = [f"agent_{k}" for k in range(env.agents)]
        self.agents: list[str] = []
        box = gymnasium.spaces.Box
        self.observation_spaces = {
            agent: box(*env.obs_range, (env.obs_size,), np.float32)
            for agent in self.possible_agents
        }
        self.action_spaces = {
            agent: box(-1.0, 1.0, (env.action_size,), np.float32) for agent in self.possible_agents
        }
        self.state_space = box(*env.obs_range, (env.agents * env.obs_size,), np.float32)
        self._reset = jax.jit(lambda key: env.reset(key=key))
        self._step = jax.jit(lambda state, action, key: env.step(state, action, key=key))
        self._random = np.random.default_rng()

    def observation_space(self, agent: str) -> gymnasium.spaces.Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.spaces.Space:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None):
        """**Returns:** observations and infos, by agent. Without a seed, the next episode."""
        if seed is not None:
            self._random = np.random.default_rng(seed)
        episode = int(self._random.integers(2**31))
        reset_key, self._key = jax.random.split(jax.random.key(episode))
        self._state, self._now = self._reset(reset_key)
        self._steps, self.agents = 0, list(self.possible_agents)
        return self._by_agent(np.array(self._now.obs)), self._infos()

    def step(self, actions: dict[str, np.ndarray]):
        """**Returns:** observations, rewards, terminations, truncations and infos, by agent."""
        if not self.agents:
            raise gymnasium.error.ResetNeeded("call reset() before the first step of an episode")
        missing = [agent for agent in self.agents if agent not in actions]
        if missing:
            raise ValueError(f"no action for {', '.join(missing)}: give one for every agent")
        given = np.stack([np.asarray(actions[agent], np.float32) for agent in self.agents])
        key = jax.random.fold_in(self._key, self._steps)
        bounded = jnp.asarray(np.clip(given, -1.0, 1.0))
        self._state, self._now = self._step(self._state, bounded, key)
        self._steps += 1
        infos = self._infos()
        terminated, truncated = bool(self._now.terminated), bool(self._now.truncated)
        told = (
            self._by_agent(np.array(self._now.obs)),
            {agent: info["rewards"][self.signal] for agent, info in infos.items()},
            dict.fromkeys(self.possible_agents, terminated),
            dict.fromkeys(self.possible_agents, truncated),
            infos,
        )
        if terminated or truncated:
            self.agents = []
        return told

    def state(self) -> np.ndarray:
        """The observations of all agents, one after the other."""
        return np.array(self._now.obs).ravel()

    def render(self) -> np.ndarray:
        """The task's own picture, `[height, width, 3]`, uint8."""
        if self.render_mode not in self.metadata["render_modes"]:
            raise ValueError(
                f"render_mode is {self.render_mode!r}: {self.metadata['name']} draws "
                f"{self.metadata['render_modes'] or 'nothing'}"
            )
        env: Any = self.env  # `render` is an option of a task
        return np.asarray(env.render(self._state))

    def _infos(self) -> dict[str, dict[str, Any]]:
        """All rewards of each agent, and whether it acts at the next step."""
        n = len(self.possible_agents)
        rewards = {
            name: np.broadcast_to(np.asarray(reward), n).tolist()
            for name, reward in self._now.rewards.items()
        }
        active = self._now.active
        active = [True] * n if active is None else np.asarray(active).tolist()
        infos = [
            {"rewards": {name: rewards[name][k] for name in rewards}, "active": active[k]}
            for k in range(n)
        ]
        return self._by_agent(infos)

    def _by_agent(self, rows: Any) -> dict[str, Any]:
        """One of the rows for each agent."""
        return dict(zip(self.possible_agents, rows, strict=True))


def to_pettingzoo(
    env: AbstractEnvironment, signal: str | None = None, render_mode: str | None = None
) -> ParallelTeam:
    """A team task in JAX as a PettingZoo `ParallelEnv`.

    **Arguments:** `signal`, what agents are paid: by default `local` if the task has it, or else
    its first. `render_mode` "rgb_array" for a task with `render(state)`, which gives a picture.
    """
    return ParallelTeam(env, signal, render_mode)
