"""How to speak to one environment of others: its spaces as sizes, its answers as rows of arrays.

`Single` speaks to a `gymnasium.Env`, `Team` to a PettingZoo `ParallelEnv`. No JAX here: a worker
process imports this.
"""

import importlib
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np

from . import names
from .makers import called, hear_mujoco, lasting, most_steps, registered
from .names import Fault
from .spaces import (
    Flat,
    as_actions,
    as_choice,
    as_flat,
    as_shown,
    behind_mask,
    described,
    left_out,
    mask_row,
    padded_bounds,
    shown_mask,
    told_mask,
    without_mask,
)


class Single:
    """What all copies of a Gymnasium environment have in common, taken from the first.

    Of the options of a Discrete action the largest is taken: the largest that is allowed, where
    `action_mask` of a Dict observation, or of `info`, says which are. Then observations begin with
    that.
    """

    agents: ClassVar[int | None] = None
    groups: ClassVar[None] = None
    lengths: ClassVar[None] = None
    names: ClassVar[None] = None
    signals: ClassVar[list[tuple[str, bool]]] = [("reward", False)]  # name, private to an agent

    @staticmethod
    def make(spec: dict[str, Any]) -> gymnasium.Env:
        """One environment, by its Gymnasium id, as `package.module:name` of a class or of a
        function that makes one, or by an id that a module registers when it is imported:
        `package.module:Name-v0`."""
        id, kwargs, (module, _, name) = spec["id"], spec["kwargs"], spec["id"].partition(":")
        if not name or (names.find(id) is None and not names.here_alone(id)):
            if name:
                importlib.import_module(module)
            names.register(spec.get("registered"))
            return registered(name or module, kwargs, spec["max_episode_steps"])
        maker = names.resolve(id, gymnasium.Env)
        hear_mujoco()
        env = maker(**kwargs)
        if not isinstance(env, gymnasium.Env):
            raise Fault(f"is a {type(env).__name__}", "name what makes a gymnasium.Env")
        return env

    def __init__(self, env: gymnasium.Env, spec: dict[str, Any]):
        self.warnings = lasting(env) + left_out(env.observation_space)
        self.max_steps = self._limit(env, spec["max_episode_steps"])
        acts = as_actions(env.action_space)
        self.action_size, self.choices, self._choose = acts.size, list(acts.choices), acts.read
        self.actions = described(env.action_space)
        self._options, seen = sum(acts.choices), shown_mask(env.observation_space)
        self._seen = seen is not None and seen.shape == (self._options,)
        if seen is not None and not self._seen:
            self.warnings.append(
                f"it has an action_mask of shape {seen.shape} and {self._options} options to "
                "choose from: that mask is told as any other numbers, and not followed"
            )
        self.masked = bool(acts.choices) and (self._seen or _masks(env))
        self.asks = self.masked
        flat = as_flat(env.observation_space, first="action_mask" if self._seen else None)
        if self.masked and not self._seen:
            flat = flat.behind(self._options)
        self.obs_size, self._write, self.obs_dtype = flat.size, flat.write, flat.dtype
        self.obs_range, self.image = flat.bounds, flat.image
        self.observations = as_choice(env.observation_space)
        self.shown = as_shown(env.observation_space, "action_mask" if self._seen else None)
        self.said: dict[int, Any] = {}  # by copy: its last observation, as it came
        self._masks: dict[int, np.ndarray] = {}  # by copy: which options it allows next

    def _limit(self, env: gymnasium.Env, limit: int | None) -> int:
        """Steps of an episode: the least of the user's limit, of every `TimeLimit` wrapper, and of
        what the environment itself has as `max_episode_steps`."""
        own: Any = getattr(env.unwrapped, "max_episode_steps", None)
        whole = isinstance(own, int | np.integer) and not isinstance(own, bool)
        limits = [limit, int(own) if whole and own >= 1 else None]
        while isinstance(env, gymnasium.Wrapper):
            if isinstance(env, gymnasium.wrappers.TimeLimit):
                limits.append(env._max_episode_steps)
            env = env.env
        return most_steps(limits, self.warnings)

    def reset(self, env: gymnasium.Env, seed: int, frame: Any, i: int) -> None:
        """A fresh episode of copy `i`, written to its row of the frame."""
        result = env.reset(seed=seed)
        _count(result, 2, "reset", "(observation, info)")
        self.said[i] = result[0]
        self._write(result[0], frame.obs[i])
        if self.choices:
            self._allow(result[0], result[1], frame, i)

    def step(self, env: gymnasium.Env, action: Any, frame: Any, i: int) -> bool:
        """One step of copy `i`, written to its row; whether the episode is over."""
        result = env.step(action)
        _count(result, 5, "step", "(observation, reward, terminated, truncated, info)")
        obs, reward, terminated, truncated, info = result
        self.said[i] = obs
        self._write(obs, frame.obs[i])
        frame.rewards["reward"][i] = _number(reward)
        terminated, truncated = _flag("terminated", terminated), _flag("truncated", truncated)
        frame.terminated[i], frame.truncated[i] = terminated, truncated
        over = terminated or truncated
        if self.choices:
            self._allow(obs, info, frame, i, over)
        return over

    def _allow(self, obs: Any, info: Any, frame: Any, i: int, over: bool = False) -> None:
        """Remember what copy `i` allows next, as far as it says, and tell it. Behind the end of an
        episode it need not say anything."""
        told = told_mask(obs if self._seen else info, self.masked)
        mask = None if told is None or over else mask_row(told, self.choices)
        self._masks.pop(i, None)
        if mask is not None:
            self._masks[i] = mask
        if self.masked:
            frame.obs[i, : self._options] = True if mask is None else mask

    def read(self, actions: np.ndarray) -> Any:
        """The copies' own actions for `[n, act]`, of those that their masks allow."""
        if self._masks:
            actions = actions.copy()
            for i, mask in self._masks.items():
                actions[i, : self._options][~mask] = -np.inf
        return self._choose(actions)


def _masks(env: Any) -> bool:
    """Whether an environment says in `info`, or in that of an agent, which actions it allows: it is
    asked once. One that cannot be reset fails again, and is heard, when it is played."""
    try:
        said = env.reset(seed=0)
    except Exception:
        return False
    info = said[1] if isinstance(said, tuple) and len(said) == 2 else None
    if not isinstance(info, Mapping):
        return False
    return any(isinstance(x, Mapping) and "action_mask" in x for x in (info, *info.values()))


class Team:
    """What all copies of a `ParallelEnv` have in common, taken from the first.

    Agents keep the order of `possible_agents`. Observations are padded with zeros to the largest,
    and of an action each agent is given as much as its own space holds. All have Boxes, or all
    choices, whose observations begin with what is allowed if agents have an `action_mask`, in a
    Dict observation or in `info`, or not all the same options. The rewards' names are looked up in
    one step of the first copy (`_Pay`).
    """

    observations: ClassVar[None] = None
    image: ClassVar[None] = None

    @staticmethod
    def make(spec: dict[str, Any]) -> Any:
        """One environment: of a module's `parallel_env`, as `package.module:name`, or by its id in
        PettingZoo's registry."""
        pettingzoo, id, kwargs = importlib.import_module("pettingzoo"), spec["id"], spec["kwargs"]
        if id in getattr(pettingzoo, "parallel_registry", ()):  # since 1.27
            env = pettingzoo.make("parallel", id, **kwargs)
        else:
            env = called(id, kwargs, pettingzoo.ParallelEnv)
        if not isinstance(env, pettingzoo.ParallelEnv):
            raise Fault(
                f"is a {type(env).__name__}",
                "name what makes a pettingzoo.ParallelEnv; pettingzoo.utils.aec_to_parallel turns "
                "an AECEnv into one",
            )
        return env

    def __init__(self, env: Any, spec: dict[str, Any]):
        self.warnings = lasting(env)
        self.max_steps = self._cycles(env, spec["max_episode_steps"])
        self.names: list[str] = list(getattr(env, "possible_agents", ()))
        if not self.names:
            raise Fault("has no possible_agents", "name there every agent that an episode may have")
        self.agents = len(self.names)
        self._rows = {name: k for k, name in enumerate(self.names)}
        self._learn_actions(env)
        spaces = [env.observation_space(name) for name in self.names]
        kinds = [(str(space), str(told)) for space, told in zip(spaces, self.actions, strict=True)]
        parts = [without_mask(s) if shown_mask(s) else s for s in spaces]
        self.lengths = [as_flat(part).size for part in parts]
        self.groups = [list(dict.fromkeys(kinds)).index(kind) for kind in kinds]
        self._seen = [shown_mask(space) is not None for space in spaces]
        self.asks = bool(self.choices) and (any(self._seen) or _masks(env))
        self.masked = self._uneven or any(self._seen) or self.asks
        self.shown = [as_shown(part) for part in parts]
        flats = [self._flat(space, seen) for space, seen in zip(spaces, self._seen, strict=True)]
        self.obs_size = max(flat.size for flat in flats)
        self.obs_dtype = "uint8" if all(x.dtype == "uint8" for x in flats) else "float32"
        self.obs_range = [padded_bounds(flat, self.obs_size) for flat in flats]
        self.said: dict[int, Any] = {}  # by copy: its last observations, as they came
        self._writes = [(flat.size, flat.write) for flat in flats]
        self._masks: dict[tuple[int, int], np.ndarray] = {}  # by copy and agent: what it may do
        self._owing: dict[int, set[str]] = {}  # by copy: who was there and has not terminated
        self._pay = _Pay(self._rows, spec)
        self._pay.learn(env, *self._first_step(env))
        self.signals = self._pay.signals

    def _learn_actions(self, env: Any) -> None:
        """Each agent's actions, and the choices that all of them are told by."""
        spaces = [env.action_space(name) for name in self.names]
        self._acts = [as_actions(space) for space in spaces]
        self.actions = [described(space) for space in spaces]
        self.action_size = max(acts.size for acts in self._acts)
        kinds = {acts.choices for acts in self._acts}
        self._uneven = len(kinds) > 1
        alone = all(
            acts.size == sum(acts.choices) and len(acts.choices) == 1 for acts in self._acts
        )
        if self._uneven and not alone:
            raise Fault(
                f"has the action spaces {', '.join(sorted({str(space) for space in spaces}))}",
                "a team needs Boxes, or a Discrete for each agent, or the same choices for all: "
                "wrap it in an environment that has them",
            )
        self.choices = [max(sum(kind) for kind in kinds)] if alone else list(kinds.pop())

    def _flat(self, space: Any, seen: bool) -> Flat:
        """An agent's observations, behind what it may do if there is such a thing."""
        flat = as_flat(without_mask(space) if seen else space)
        return flat.behind(sum(self.choices)) if self.masked else flat

    def _cycles(self, env: Any, limit: int | None) -> int:
        """PettingZoo has no wrapper for time limits; `max_cycles` is its custom."""
        return most_steps([limit, getattr(env.unwrapped, "max_cycles", None)], self.warnings)

    def _first_step(self, env: Any) -> tuple[list[str], Any, Any]:
        """Who acted in a first step with the middle of every Box, or the first options that are
        allowed, their rewards and infos."""
        first = env.reset(seed=0)
        _count(first, 2, "reset", "(observations, infos)")
        acted = self._here(env)
        if not acted:
            return [], {}, {}
        if self.choices:
            self._remember(first[0], first[1], acted, 0)
        middle = self.read(np.zeros((1, self.agents, self.action_size), np.float32))[0]
        result = env.step({name: middle[self._rows[name]] for name in acted})
        _count(result, 5, "step", TEAM_STEP)
        return acted, result[1], result[4]

    def read(self, actions: np.ndarray) -> list[tuple[np.ndarray, ...]]:
        """Actions `[n, agents, act]` in [-1, 1] as each copy's, agent by agent."""
        if self._masks:
            actions = actions.copy()
            for (i, k), mask in self._masks.items():
                actions[i, k, : mask.size][~mask] = -np.inf
        own = [acts.read(actions[:, k, : acts.size]) for k, acts in enumerate(self._acts)]
        return list(zip(*own, strict=True))

    def reset(self, env: Any, seed: int, frame: Any, i: int) -> None:
        result = env.reset(seed=seed)
        _count(result, 2, "reset", "(observations, infos)")
        here = self._here(env)
        self.said[i] = result[0]
        self._write(result[0], here, frame, i)
        self._allow(result[0], result[1], here, frame, i)
        self._owing[i] = set(here)

    def step(self, env: Any, action: Any, frame: Any, i: int) -> bool:
        acted = self._here(env)
        result = env.step({name: action[self._rows[name]] for name in acted})
        _count(result, 5, "step", TEAM_STEP)
        obs, rewards, terminations, truncations, infos = result
        owing, left = self._owing[i], set()
        self._pay(env, acted, rewards, infos, frame.rewards, i)
        for name in acted:
            terminated = _flag("a termination", _said("termination", terminations, name))
            if terminated:
                owing.discard(name)
                frame.gone[i, self._rows[name]] = True
            truncated = _flag("a truncation", _said("truncation", truncations, name))
            if terminated or truncated:
                left.add(name)
        here = [name for name in self._here(env) if name not in left]
        owing.update(here)
        # Who leaves may say a last word: the observation that a learner bootstraps from.
        self.said[i] = obs
        self._write(obs, [*here, *(name for name in left if name in obs)], frame, i)
        self._allow(obs, infos, here, frame, i)
        frame.active[i, [self._rows[name] for name in here]] = True
        frame.terminated[i] = not here and not owing
        frame.truncated[i] = not here and bool(owing)
        return not here

    def _here(self, env: Any) -> list[str]:
        """Agents that are in the episode now; `Fault` of one that is no possible agent."""
        strangers = [name for name in env.agents if name not in self._rows]
        if strangers:
            raise Fault(f"has the agent {strangers[0]!r}", "name every agent in possible_agents")
        return list(env.agents)  # a copy: some environments change theirs

    def _write(self, obs: Any, names: list[str], frame: Any, i: int) -> None:
        """Observations of these agents, each to its row of copy `i`; the others stay 0."""
        for name in names:
            k = self._rows[name]
            size, write = self._writes[k]
            said = _said("observation", obs, name)
            if self._seen[k]:
                said = behind_mask(said)
            write(said, frame.obs[i, k, :size])

    def _allow(self, obs: Any, infos: Any, here: list[str], frame: Any, i: int) -> None:
        """Remember what the agents of copy `i` may do next, and tell them. Who is not there may do
        anything."""
        if self.choices:
            self._remember(obs, infos, here, i)
        if self.masked:
            for k, acts in enumerate(self._acts):
                options = self._masks.get((i, k), np.ones(sum(acts.choices), bool))
                frame.obs[i, k, : sum(self.choices)] = 0
                frame.obs[i, k, : options.size] = options

    def _remember(self, obs: Any, infos: Any, here: list[str], i: int) -> None:
        """What the agents of copy `i` may do next."""
        for name, k in self._rows.items():
            self._masks.pop((i, k), None)
            told = told_mask(obs.get(name) if self._seen[k] else infos.get(name), self.masked)
            if told is not None and name in here:
                self._masks[i, k] = mask_row(told, self._acts[k].choices)


TEAM_STEP = "(observations, rewards, terminations, truncations, infos)"


class _Pay:
    """The named rewards of a team, and how they are read from what a step returns.

    `info["rewards"]`, a dict by name, of every agent that acted; a function per name, if the task
    was given one; and for what neither says: `local` is the environment's own reward, `global` the
    mean of it over all agents. Names in `shared`, and what a function says as one number, are one
    number for the team; every other reward is private.
    """

    def __init__(self, rows: dict[str, int], spec: dict[str, Any]):
        self._rows = rows
        self._shared = frozenset(spec.get("shared", ("global",)))
        self._made = {name: names.resolve(at) for name, at in spec.get("rewards") or ()}
        self._told: tuple[str, ...] = ()  # by info
        self.signals: list[tuple[str, bool]] = []  # name, private to an agent

    def learn(self, env: Any, acted: list[str], rewards: Any, infos: Any) -> None:
        """Which rewards there are, from one step."""
        told = _named(infos, acted[0]) if acted else None
        private = {"global": False, "local": True}
        private |= {name: name not in self._shared for name in told or ()}
        for name, pay in self._made.items():
            private[name] = not acted or isinstance(pay(env, dict(rewards), dict(infos)), Mapping)
        self.signals = list(private.items())
        self._told = tuple(name for name in told or () if name not in self._made)
        self._private = private
        self._mean = "global" not in {*self._told, *self._made}
        self._own = "local" not in {*self._told, *self._made}

    def __call__(
        self, env: Any, acted: list[str], rewards: Any, infos: Any, paid: dict[str, Any], i: int
    ) -> None:
        """Write the rewards of copy `i`, `paid[name]` `[n]` or `[n, agents]`."""
        local = paid["local"][i] if self._own else np.zeros(len(self._rows))
        for name in acted:
            local[self._rows[name]] = _number(_said("reward", rewards, name))
        if self._mean:
            paid["global"][i] = local.mean()
        if self._told:
            self._read(acted, infos, paid, i)
        elif acted and _named(infos, acted[0]) is not None:
            raise Fault("names rewards in an info, and named none in its first step", NAMED)
        for name, pay in self._made.items():
            self._call(name, pay(env, dict(rewards), dict(infos)), paid[name], i)

    def _read(self, acted: list[str], infos: Any, paid: dict[str, Any], i: int) -> None:
        """Rewards that the infos of all who acted name, written to copy `i`: a private one of each
        agent, a shared one of any, as long as no two of them differ."""
        common: dict[str, Any] = {}
        for agent in acted:
            said = _named(infos, agent)
            if said is None:
                raise Fault(f"returned no info[{'rewards'!r}] of {agent!r}", NAMED)
            for name in self._told:
                if self._private[name]:
                    if name not in said:
                        raise Fault(f"returned no reward {name!r} in the info of {agent!r}", NAMED)
                    paid[name][i, self._rows[agent]] = _number(said[name])
                elif name in said:
                    reward = _number(said[name])
                    if common.setdefault(name, reward) != reward:
                        raise Fault(
                            f"returned the reward {name!r} as {common[name]!r} and, of {agent!r}, "
                            f"as {reward!r}",
                            "a shared reward is one number for the team: say the same of every "
                            f"agent, or give PettingZoo(..., shared=()) without {name!r}",
                        )
            strange = [name for name in said if name not in self._private]
            if strange:
                raise Fault(f"names the reward {strange[0]!r}, which its first step did not", NAMED)
        for name in self._told:
            if not self._private[name]:
                if name not in common:
                    raise Fault(f"returned no reward {name!r} in any info", NAMED)
                paid[name][i] = common[name]

    def _call(self, name: str, said: Any, paid: np.ndarray, i: int) -> None:
        """A reward that a function of the task pays, written to copy `i`: one number, or a dict by
        agent."""
        if isinstance(said, Mapping) != self._private[name]:
            kinds = "a dict by agent" if self._private[name] else "one number"
            raise Fault(
                f"was paid {name!r} as a {type(said).__name__}",
                f"let its function return {kinds} at every step, as at the first",
            )
        if not self._private[name]:
            paid[i] = _number(said)
            return
        for agent, reward in said.items():
            if agent not in self._rows:
                raise Fault(f"was paid {name!r} for {agent!r}", "name agents of possible_agents")
            paid[i, self._rows[agent]] = _number(reward)


NAMED = (
    'give info["rewards"], a dict with the same names at every step, to every agent that acted; '
    "what all share one of them may say"
)


def _named(infos: Any, agent: str) -> Mapping[str, Any] | None:
    """`info["rewards"]` of one agent, if it has such a dict."""
    info = infos.get(agent) if isinstance(infos, dict) else None
    said = info.get("rewards") if isinstance(info, dict) else None
    return said if isinstance(said, dict) else None


def _said(what: str, said: Any, name: str) -> Any:
    """What is said of one agent."""
    if isinstance(said, dict) and name in said:
        return said[name]
    if not isinstance(said, Mapping):
        raise Fault(f"returned {what}s in a {type(said).__name__}", "return a dict by agent")
    if name not in said:
        raise Fault(
            f"returned no {what} of {name!r}", "return one for every agent that was or is there"
        )
    return said[name]


def _count(result: Any, n: int, where: str, parts: str) -> None:
    """Raise `Fault` unless `result` is a tuple of `n`; `parts` says of what."""
    if not (isinstance(result, tuple) and len(result) == n):
        count = f"{len(result)} values" if isinstance(result, tuple) else type(result).__name__
        raise Fault(f"returned {count} from {where}", f"return {parts}")


def _number(reward: Any) -> float:
    """A real number of whatever type, no string among them."""
    if isinstance(reward, (float, int)):
        return reward
    told = np.asarray(reward)
    if told.shape != () or told.dtype.kind not in "fuib":
        raise Fault(f"returned the reward {reward!r}", "return one number")
    return reward


def _flag(name: str, said: Any) -> bool:
    """A truth value, as Python or NumPy have it, or 0 or 1; also in an array of one."""
    if isinstance(said, (bool, np.bool_)):
        return bool(said)
    told = np.asarray(said)
    if told.size != 1 or told.dtype.kind not in "biu" or told.flat[0] not in (0, 1):
        raise Fault(f"returned {said!r} for {name}", "return True or False")
    return bool(told.flat[0])


APIS: dict[str, type[Single] | type[Team]] = {"gymnasium": Single, "pettingzoo": Team}
