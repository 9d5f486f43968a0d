"""How to speak to one environment of others: its spaces as sizes, its answers as rows of arrays.

`Single` speaks to a `gymnasium.Env`, `Team` to a PettingZoo `ParallelEnv`. No JAX here: a worker
process imports this.
"""

import functools
import importlib
import inspect
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np

NO_LIMIT = (
    "set max_episode_steps, the steps after which an episode is truncated: on the command "
    "line --max-episode-steps 1000, say"
)


class Fault(Exception):
    """What an environment did wrong (`what`), and what to do about it (`fix`)."""

    def __init__(self, what: str, fix: str):
        super().__init__(what, fix)
        self.what, self.fix = what, fix


class Single:
    """What all copies of a Gymnasium environment have in common, taken from the first."""

    agents: ClassVar[int | None] = None
    obs_dtype: ClassVar[str] = "float32"
    signals: ClassVar[list[tuple[str, bool]]] = [("reward", False)]  # name, private to an agent
    actions: ClassVar[Any] = None
    observations: ClassVar[Any] = None
    warnings: ClassVar[list[str]] = []

    @staticmethod
    def make(spec: dict[str, Any]) -> gymnasium.Env:
        """One environment, by its Gymnasium id, as `package.module:Class`, or by an id that a
        module registers when it is imported: `package.module:Name-v0`."""
        module, _, name = spec["id"].partition(":")
        cls = getattr(importlib.import_module(module), name, None) if name.isidentifier() else None
        if cls is None:
            if name:
                importlib.import_module(module)
            return _registered(name or module, spec["kwargs"], spec["max_episode_steps"])
        _hear_mujoco()
        env = cls(**spec["kwargs"])
        if not isinstance(env, gymnasium.Env):
            raise Fault(f"is a {type(env).__name__}", "name a class derived from gymnasium.Env")
        return env

    def __init__(self, env: gymnasium.Env, limit: int | None):
        self.max_steps = _time_limit(env, limit)
        self.obs_size, self._write = _observations(env.observation_space)
        self.action_size, self.read = _actions(env.action_space)
        self.discrete = isinstance(env.action_space, gymnasium.spaces.Discrete)

    def reset(self, env: gymnasium.Env, seed: int, frame: Any, i: int) -> None:
        """A fresh episode of copy `i`, written to its row of the frame."""
        result = env.reset(seed=seed)
        _count(result, 2, "reset", "(observation, info)")
        self._write(result[0], frame.obs[i])

    def step(self, env: gymnasium.Env, action: Any, frame: Any, i: int) -> bool:
        """One step of copy `i`, written to its row; whether the episode is over."""
        result = env.step(action)
        _count(result, 5, "step", "(observation, reward, terminated, truncated, info)")
        obs, reward, terminated, truncated, _ = result
        self._write(obs, frame.obs[i])
        frame.rewards["reward"][i] = reward if isinstance(reward, (float, int)) else _number(reward)
        frame.terminated[i] = terminated
        frame.truncated[i] = truncated
        return terminated or truncated


class Team:
    """What all copies of a `ParallelEnv` have in common, taken from the first.

    Agents keep the order of `possible_agents`. Observations are padded with zeros to the largest,
    and of an action each agent is given as much as its own Box holds.
    """

    discrete = False
    obs_dtype: ClassVar[str] = "float32"
    signals: ClassVar[list[tuple[str, bool]]] = [("global", False), ("local", True)]
    actions: ClassVar[Any] = None
    observations: ClassVar[Any] = None
    warnings: ClassVar[list[str]] = []

    @staticmethod
    def make(spec: dict[str, Any]) -> Any:
        """One environment: of a module's `parallel_env`, as `package.module:name`, or by its id in
        PettingZoo's registry."""
        pettingzoo, id, kwargs = importlib.import_module("pettingzoo"), spec["id"], spec["kwargs"]
        if id in getattr(pettingzoo, "parallel_registry", ()):  # since 1.27
            env = pettingzoo.make("parallel", id, **kwargs)
        else:
            env = _called(id, kwargs)
        if not isinstance(env, pettingzoo.ParallelEnv):
            raise Fault(f"is a {type(env).__name__}", "name what makes a pettingzoo.ParallelEnv")
        return env

    def __init__(self, env: Any, limit: int | None):
        self.max_steps = _cycles(env, limit)
        self._names: list[str] = list(getattr(env, "possible_agents", ()))
        if not self._names:
            raise Fault("has no possible_agents", "name there every agent that an episode may have")
        self.agents = len(self._names)
        self._rows = {name: k for k, name in enumerate(self._names)}
        for name in self._names:
            _box(name, env.action_space(name))
        observations = [_observations(env.observation_space(name)) for name in self._names]
        actions = [_actions(env.action_space(name)) for name in self._names]
        self.obs_size = max(size for size, _ in observations)
        self.action_size = max(size for size, _ in actions)
        self._observations, self._actions = observations, actions
        self._owing: dict[int, set[str]] = {}  # by copy: who was there and has not terminated

    def read(self, actions: np.ndarray) -> list[tuple[np.ndarray, ...]]:
        """Actions `[n, agents, act]` in [-1, 1] as each copy's, agent by agent."""
        own = [read(actions[:, k, :size]) for k, (size, read) in enumerate(self._actions)]
        return list(zip(*own, strict=True))

    def reset(self, env: Any, seed: int, frame: Any, i: int) -> None:
        result = env.reset(seed=seed)
        _count(result, 2, "reset", "(observations, infos)")
        here = self._here(env)
        self._write(result[0], here, frame, i)
        self._owing[i] = set(here)

    def step(self, env: Any, action: Any, frame: Any, i: int) -> bool:
        acted = self._here(env)
        result = env.step({name: action[self._rows[name]] for name in acted})
        parts = "(observations, rewards, terminations, truncations, infos)"
        _count(result, 5, "step", parts)
        obs, rewards, terminations, truncations, _ = result
        owing, left, local = self._owing[i], set(), frame.rewards["local"][i]
        for name in acted:
            local[self._rows[name]] = _number(_said("reward", rewards, name))
            terminated = bool(_said("termination", terminations, name))
            if terminated:
                owing.discard(name)
                frame.gone[i, self._rows[name]] = True
            if terminated or bool(_said("truncation", truncations, name)):
                left.add(name)
        frame.rewards["global"][i] = local.mean()
        here = [name for name in self._here(env) if name not in left]
        owing.update(here)
        # Who leaves may say a last word: the observation that a learner bootstraps from.
        self._write(obs, [*here, *(name for name in left if name in obs)], frame, i)
        frame.active[i, [self._rows[name] for name in here]] = True
        frame.terminated[i] = not here and not owing
        frame.truncated[i] = not here and bool(owing)
        return not here

    def _here(self, env: Any) -> list[str]:
        strangers = [name for name in env.agents if name not in self._rows]
        if strangers:
            raise Fault(f"has the agent {strangers[0]!r}", "name every agent in possible_agents")
        return list(env.agents)  # a copy: some environments change theirs

    def _write(self, obs: Any, names: list[str], frame: Any, i: int) -> None:
        for name in names:
            k = self._rows[name]
            size, write = self._observations[k]
            write(_said("observation", obs, name), frame.obs[i, k, :size])


def _called(id: str, kwargs: dict[str, Any]) -> Any:
    """What `package.module:name`, or a module's `parallel_env`, makes."""
    name, _, entry = id.partition(":")
    module = importlib.import_module(name)
    maker = getattr(module, entry or "parallel_env", None)
    if maker is None:
        raise Fault(
            f"is no team task: {name} has no {entry or 'parallel_env'}",
            "name a module of PettingZoo, such as mpe2.simple_spread_v3, or as package.module:name "
            "what makes a ParallelEnv",
        )
    # mpe2 hides the arguments of its parallel_env behind **kwargs.
    makers = [maker] if entry else [maker, getattr(module, "raw_env", maker)]
    if any("continuous_actions" in inspect.signature(m).parameters for m in makers):
        kwargs = {"continuous_actions": True} | kwargs
    return maker(**kwargs)


def _said(what: str, said: Any, name: str) -> Any:
    """What is said of one agent."""
    if not isinstance(said, Mapping):
        raise Fault(f"returned {what}s in a {type(said).__name__}", "return a dict by agent")
    if name not in said:
        raise Fault(
            f"returned no {what} of {name!r}", "return one for every agent that was or is there"
        )
    return said[name]


def _box(name: str, space: gymnasium.Space) -> None:
    if not isinstance(space, gymnasium.spaces.Box):
        raise Fault(
            f"has the action space {space} for {name!r}",
            "a team needs Box actions: ask for continuous ones in kwargs (continuous_actions=True "
            "of mpe2, continuous=True of others), or wrap it in an environment that has them",
        )


def _cycles(env: Any, limit: int | None) -> int:
    """PettingZoo has no wrapper for time limits; `max_cycles` is its custom."""
    limits = [limit, getattr(env.unwrapped, "max_cycles", None)]
    limits = [int(limit) for limit in limits if limit is not None]
    if not limits:
        raise Fault("has no time limit: an episode might never end", NO_LIMIT)
    return min(limits)


def _registered(id: str, kwargs: dict[str, Any], max_episode_steps: int | None) -> gymnasium.Env:
    with warnings.catch_warnings():  # -v4 tasks are asked for on purpose
        warnings.filterwarnings("ignore", r".*is out of date", DeprecationWarning)
        entry = gymnasium.spec(id).entry_point
        if isinstance(entry, str):
            importlib.import_module(entry.partition(":")[0])
        _hear_mujoco()
        return gymnasium.make(id, max_episode_steps, disable_env_checker=True, **kwargs)


def _hear_mujoco() -> None:
    """MuJoCo would write its warnings to a file in the working directory, once for every copy."""
    mujoco = sys.modules.get("mujoco")
    if mujoco is not None and mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_tell)


@functools.cache  # each once
def _tell(warning: str) -> None:
    if "'settotalmass' is deprecated" not in warning:  # in Gymnasium's half_cheetah.xml
        print(f"MuJoCo: {warning}", file=sys.stderr)


def _time_limit(env: gymnasium.Env, limit: int | None) -> int:
    limits = [] if limit is None else [limit]
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, gymnasium.wrappers.TimeLimit):
            limits.append(env._max_episode_steps)
        env = env.env
    if not limits:
        raise Fault("has no time limit: an episode might never end", NO_LIMIT)
    return min(limits)


def _observations(space: gymnasium.Space) -> tuple[int, Callable[[Any, np.ndarray], None]]:
    """Size of a flat observation, and how to write one into a row of float32.

    Box: flattened. Discrete: one-hot. What is made of them: one after the other.
    """
    shape = space.shape

    def write_box(obs: Any, row: np.ndarray) -> None:
        obs = np.asarray(obs)
        if obs.shape != shape:
            raise Fault(
                f"returned an observation of shape {obs.shape}",
                f"its observation_space says {shape}: make the two agree",
            )
        row[:] = obs.ravel()

    def write_other(obs: Any, row: np.ndarray) -> None:
        if not space.contains(obs):
            raise Fault(
                f"returned the observation {obs!r}",
                f"its observation_space is {space}: make the two agree",
            )
        row[:] = gymnasium.spaces.flatten(space, obs)

    if not space.is_np_flattenable:
        raise Fault(
            f"has the observation space {space}",
            "use a Box, a Discrete, or a Dict or Tuple of them",
        )
    box = isinstance(space, gymnasium.spaces.Box)
    return gymnasium.spaces.flatdim(space), write_box if box else write_other


def _actions(space: gymnasium.Space) -> tuple[int, Callable[[np.ndarray], np.ndarray]]:
    """Size of an action, and how to turn actions `[n, act]` in [-1, 1] into the space's own.

    Box: -1 is its low, 1 its high. Discrete: the entry that is largest.
    """
    if isinstance(space, gymnasium.spaces.Discrete):
        start = space.start
        return int(space.n), lambda actions: np.argmax(actions, axis=1) + start
    if not isinstance(space, gymnasium.spaces.Box):
        raise Fault(f"has the action space {space}", "use a Box or a Discrete")
    low, high = (np.float64(bound).ravel() for bound in (space.low, space.high))
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise Fault(
            f"has an action space without bounds: {space}",
            "give its Box a finite low and high: actions in [-1, 1] are scaled to them",
        )
    center, half = (low + high) / 2, (high - low) / 2
    shape, dtype = space.shape, space.dtype
    whole = not np.issubdtype(dtype, np.floating)

    def read(actions: np.ndarray) -> np.ndarray:
        own = np.minimum(np.maximum(center + half * actions, low), high)
        own = np.rint(own) if whole else own
        return own.astype(dtype).reshape(-1, *shape)

    return low.size, read


def _count(result: Any, n: int, where: str, parts: str) -> None:
    if not (isinstance(result, tuple) and len(result) == n):
        count = f"{len(result)} values" if isinstance(result, tuple) else type(result).__name__
        raise Fault(f"returned {count} from {where}", f"return {parts}")


def _number(reward: Any) -> float:
    if np.shape(reward) != ():
        raise Fault(f"returned the reward {reward!r}", "return one number")
    return reward


APIS: dict[str, type[Single] | type[Team]] = {"gymnasium": Single, "pettingzoo": Team}
