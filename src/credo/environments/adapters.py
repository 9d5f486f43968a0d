"""How to speak to one environment of others: its spaces as sizes, its answers as rows of arrays.

`Single` speaks to a `gymnasium.Env`, `Team` to a PettingZoo `ParallelEnv`. No JAX here: a worker
process imports this.
"""

import functools
import importlib
import inspect
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy as np

from . import names
from .names import Fault

MOST_STEPS = 1000  # of an episode, where neither the task nor its user names a limit
NO_LIMIT = (
    f"it names no time limit: an episode is truncated after {MOST_STEPS:,} steps; set "
    "max_episode_steps, on the command line --max-episode-steps 1000, say"
)
LASTING = {
    "NormalizeObservation": "set normalize_observations of the algorithm, which keeps the "
    "statistics with the policy",
    "NormalizeReward": "scale the reward by a constant, for example by the learner's reward_scale",
}
"""Wrappers whose state outlives an episode, by class name, and what to use instead."""


def _most_steps(limits: list[int | None], warnings: list[str]) -> int:
    """The least of the limits that there are; a warning if there is none."""
    known = [int(limit) for limit in limits if limit is not None]
    if not known:
        warnings.append(NO_LIMIT)
    return min(known, default=MOST_STEPS)


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
            return _registered(name or module, kwargs, spec["max_episode_steps"])
        maker = names.resolve(id, gymnasium.Env)
        hear_mujoco()
        env = maker(**kwargs)
        if not isinstance(env, gymnasium.Env):
            raise Fault(f"is a {type(env).__name__}", "name what makes a gymnasium.Env")
        return env

    def __init__(self, env: gymnasium.Env, spec: dict[str, Any]):
        self.warnings = _lasting(env) + _left_out(env.observation_space)
        self.max_steps = self._limit(env, spec["max_episode_steps"])
        acts = _actions(env.action_space)
        self.action_size, self.choices, self._choose = acts.size, list(acts.choices), acts.read
        self.actions = _described(env.action_space)
        self._options, seen = sum(acts.choices), _shown_mask(env.observation_space)
        self._seen = seen is not None and seen.shape == (self._options,)
        self.masked = bool(acts.choices) and (self._seen or _masks(env))
        flat = _flat(env.observation_space, first="action_mask" if self._seen else None)
        if self.masked and not self._seen:
            flat = flat.behind(self._options)
        self.obs_size, self._write, self.obs_dtype = flat.size, flat.write, flat.dtype
        self.obs_range, self.image = flat.bounds, flat.image
        self.observations = _choice(env.observation_space)
        self.said: dict[int, Any] = {}  # by copy: its last observation, as it came
        self._masks: dict[int, np.ndarray] = {}  # by copy: which options it allows next

    def _limit(self, env: gymnasium.Env, limit: int | None) -> int:
        """Steps of an episode: the least of the user's limit and of every `TimeLimit` wrapper."""
        limits = [limit]
        while isinstance(env, gymnasium.Wrapper):
            if isinstance(env, gymnasium.wrappers.TimeLimit):
                limits.append(env._max_episode_steps)
            env = env.env
        return _most_steps(limits, self.warnings)

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
        told = _told(obs if self._seen else info, self.masked)
        mask = None if told is None or over else _mask(told, self.choices)
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


def _told(says: Any, masked: bool) -> Any:
    """The `action_mask` in an observation or an info; None: it has none. Raises `Fault` of one that
    was not there in the first reset."""
    told = says.get("action_mask") if isinstance(says, Mapping) else None
    if told is not None and not masked:
        raise Fault(
            "returned an action_mask in step and none in reset",
            "give it in both, so that learners know that there is one",
        )
    return told


def _mask(told: Any, choices: Sequence[int]) -> np.ndarray:
    """An `action_mask` as one row of truth values, an option each. Several choices may have theirs
    in a tuple, as Gymnasium samples by them."""
    mask = np.concatenate(told) if isinstance(told, tuple) else np.asarray(told)
    if mask.shape != (sum(choices),) or mask.dtype.kind not in "biu":
        options = f"{choices[0]} actions" if len(choices) == 1 else f"{sum(choices)} options"
        raise Fault(
            f"returned an action_mask of shape {mask.shape} and dtype {mask.dtype}",
            f"give one number, 0 or 1, for each of the {options}",
        )
    mask = mask.astype(bool)
    if not all(part.any() for part in np.split(mask, np.cumsum(choices)[:-1])):
        part = "" if len(choices) == 1 else " for one of its choices"
        raise Fault(f"allows no action: its action_mask is 0 everywhere{part}", "allow one, or end")
    return mask


def _shown_mask(space: Any) -> Any:
    """The space of `action_mask` in a Dict of observations; None if there is none."""
    spaces = getattr(space, "spaces", {})
    return spaces.get("action_mask") if isinstance(spaces, dict) else None


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
            env = _called(id, kwargs, pettingzoo.ParallelEnv)
        if not isinstance(env, pettingzoo.ParallelEnv):
            raise Fault(
                f"is a {type(env).__name__}",
                "name what makes a pettingzoo.ParallelEnv; pettingzoo.utils.aec_to_parallel turns "
                "an AECEnv into one",
            )
        return env

    def __init__(self, env: Any, spec: dict[str, Any]):
        self.warnings = _lasting(env)
        self.max_steps = self._cycles(env, spec["max_episode_steps"])
        self.names: list[str] = list(getattr(env, "possible_agents", ()))
        if not self.names:
            raise Fault("has no possible_agents", "name there every agent that an episode may have")
        self.agents = len(self.names)
        self._rows = {name: k for k, name in enumerate(self.names)}
        self._learn_actions(env)
        spaces = [env.observation_space(name) for name in self.names]
        kinds = [(str(space), str(told)) for space, told in zip(spaces, self.actions, strict=True)]
        self.lengths = [_flat(_without_mask(s) if _shown_mask(s) else s).size for s in spaces]
        self.groups = [list(dict.fromkeys(kinds)).index(kind) for kind in kinds]
        self._seen = [_shown_mask(space) is not None for space in spaces]
        self.masked = self._uneven or any(self._seen) or (bool(self.choices) and _masks(env))
        flats = [self._flat(space, seen) for space, seen in zip(spaces, self._seen, strict=True)]
        self.obs_size = max(flat.size for flat in flats)
        self.obs_dtype = "uint8" if all(x.dtype == "uint8" for x in flats) else "float32"
        self.obs_range = [_padded(flat, self.obs_size) for flat in flats]
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
        self._acts = [_actions(space) for space in spaces]
        self.actions = [_described(space) for space in spaces]
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

    def _flat(self, space: Any, seen: bool) -> "_Flat":
        """An agent's observations, behind what it may do if there is such a thing."""
        flat = _flat(_without_mask(space) if seen else space)
        return flat.behind(sum(self.choices)) if self.masked else flat

    def _cycles(self, env: Any, limit: int | None) -> int:
        """PettingZoo has no wrapper for time limits; `max_cycles` is its custom."""
        return _most_steps([limit, getattr(env.unwrapped, "max_cycles", None)], self.warnings)

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
                said = _behind_mask(said)
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
            told = _told(obs.get(name) if self._seen[k] else infos.get(name), self.masked)
            if told is not None and name in here:
                self._masks[i, k] = _mask(told, self._acts[k].choices)


def _without_mask(space: Any) -> gymnasium.Space:
    """What a Dict of observations has beside `action_mask`: that alone, if it is one thing."""
    rest = {key: part for key, part in space.spaces.items() if key != "action_mask"}
    return next(iter(rest.values())) if len(rest) == 1 else gymnasium.spaces.Dict(rest)


def _behind_mask(said: Any) -> Any:
    """Of an observation what `_without_mask` has of its space."""
    if not isinstance(said, Mapping):
        raise Fault(f"returned an observation of type {type(said).__name__}", "return a dict")
    rest = {key: part for key, part in said.items() if key != "action_mask"}
    return next(iter(rest.values())) if len(rest) == 1 else rest


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


def _called(id: str, kwargs: dict[str, Any], kind: type) -> Any:
    """What `package.module:name`, or a module's `parallel_env`, makes."""
    name, _, entry = id.partition(":")
    id = f"{name}:{entry or 'parallel_env'}"
    if names.find(id) is None and not names.here_alone(id):
        raise Fault(
            f"is no team task: {name} has no {entry or 'parallel_env'}",
            "name a module of PettingZoo, such as mpe2.simple_spread_v3, or as package.module:name "
            "what makes a ParallelEnv",
        )
    maker = names.resolve(id, kind)
    # mpe2 hides the arguments of its parallel_env behind **kwargs.
    makers = [maker] if entry else [maker, getattr(sys.modules[name], "raw_env", maker)]
    if any("continuous_actions" in inspect.signature(m).parameters for m in makers):
        kwargs = {"continuous_actions": True} | kwargs
    return maker(**kwargs)


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


def _registered(id: str, kwargs: dict[str, Any], max_episode_steps: int | None) -> gymnasium.Env:
    """One environment of an id in Gymnasium's registry; the module of its class is imported first,
    so that MuJoCo is there to be heard."""
    with warnings.catch_warnings():  # -v4 tasks are asked for on purpose
        warnings.filterwarnings("ignore", r".*is out of date", DeprecationWarning)
        try:
            entry = gymnasium.spec(id).entry_point
        except gymnasium.error.NameNotFound as error:
            raise Fault(
                f"is unknown to Gymnasium here ({error})",
                "look at the id, and whether its package is installed; if a module registers it "
                f"when it is imported, name that too, as in my_module:{id}",
            ) from error
        if isinstance(entry, str):
            importlib.import_module(entry.partition(":")[0])
        hear_mujoco()
        return gymnasium.make(id, max_episode_steps, disable_env_checker=True, **kwargs)


def hear_mujoco() -> None:
    """MuJoCo would write its warnings to a file in the working directory, once for every copy."""
    mujoco = sys.modules.get("mujoco")
    if mujoco is not None and mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_tell)


@functools.cache  # each once
def _tell(warning: str) -> None:
    """Print a warning of MuJoCo to the error stream."""
    if "'settotalmass' is deprecated" not in warning:  # in Gymnasium's half_cheetah.xml
        print(f"MuJoCo: {warning}", file=sys.stderr)


def _lasting(env: Any) -> list[str]:
    """Warnings of wrappers whose state outlives an episode."""
    kinds: dict[str, None] = {}
    for _ in range(100):  # layers
        kinds |= {cls.__name__: None for cls in type(env).__mro__}
        env = getattr(env, "__dict__", {}).get("env")
    return [
        f"its wrapper {name} keeps statistics from episode to episode, in every copy its own, so "
        f"that training, tests and later use are different tasks: leave it out and {instead}"
        for name, instead in LASTING.items()
        if name in kinds
    ]


class _Flat(NamedTuple):
    """An observation space as one row of numbers.

    Box: flattened. Discrete: one-hot. What is made of them: one after the other.
    """

    size: int
    dtype: str  # "uint8" if it is made of Boxes of uint8 alone, else "float32"
    low: np.ndarray  # [size], float64
    high: np.ndarray
    write: Callable[[Any, np.ndarray], None]  # an observation into a row
    image: tuple[int, ...] | None = None  # where the first image begins, and its shape

    @property
    def bounds(self) -> list[Any]:
        """The least and the largest of each number; one number where all are the same."""
        return [x[0] if x.size and (x == x[0]).all() else x.tolist() for x in self[2:4]]

    def behind(self, n: int) -> "_Flat":
        """The same row behind n numbers, from 0 to 1, that others write."""
        low, high = np.append(np.zeros(n), self.low), np.append(np.ones(n), self.high)
        image = self.image and (n + self.image[0], *self.image[1:])
        write = lambda obs, row: self.write(obs, row[n:])  # noqa: E731
        return _Flat(n + self.size, self.dtype, low, high, write, image)


def _flat(space: gymnasium.Space, said: str = "an observation", first: str | None = None) -> _Flat:
    """How observations of `space` become a row; of a Dict that with the part `first` in front.
    `said` names them in a `Fault`, which is raised of a space that NumPy cannot hold (Graph,
    Sequence)."""
    spaces = gymnasium.spaces
    if not _told_in_numbers(space):
        raise Fault(
            f"has the observation space {space}",
            "use a Box, a Discrete, or a Dict or Tuple of them",
        )
    if isinstance(space, spaces.Box):
        low, high = (np.float64(bound).ravel() for bound in (space.low, space.high))
        small = space.dtype == np.uint8
        write = _box_writer(space, said)
        image = (0, *space.shape) if len(space.shape) == 3 else None
        return _Flat(low.size, "uint8" if small else "float32", low, high, write, image)
    if isinstance(space, spaces.Dict):
        parts = {key: part for key, part in space.spaces.items() if _told_in_numbers(part)}
        if first is not None:
            parts = {first: parts[first]} | parts
        return _joined(space, parts, Mapping, said)
    if isinstance(space, spaces.Tuple):
        return _joined(space, dict(enumerate(space.spaces)), (tuple, list), said)

    def write_other(obs: Any, row: np.ndarray) -> None:
        if not space.contains(obs):
            raise Fault(
                f"returned {said} of {obs!r}",
                f"its observation_space is {space}: make the two agree",
            )
        row[:] = spaces.flatten(space, obs)

    size, hot = spaces.flatdim(space), not isinstance(space, spaces.Text)
    low, high = (0.0, 1.0) if hot else (-np.inf, np.inf)
    return _Flat(size, "float32", np.full(size, low), np.full(size, high), write_other)


def _told_in_numbers(space: Any) -> bool:
    """Whether a space is one, or is made of such, that an array can hold; of a Dict some part."""
    if isinstance(space, gymnasium.spaces.Dict):
        return any(map(_told_in_numbers, space.spaces.values()))
    try:
        return isinstance(space, gymnasium.Space) and space.is_np_flattenable
    except NotImplementedError:  # of a space of its own that does not say
        return False


def _left_out(space: Any) -> list[str]:
    """Warnings of parts of a Dict of observations that are no numbers, such as a text of MiniGrid:
    policies do not see them."""
    parts = getattr(space, "spaces", None)
    if not isinstance(parts, Mapping):
        return []
    left = [key for key, part in parts.items() if not _told_in_numbers(part)]
    if len(left) == len(parts):
        return []
    return [f"its observation {key!r} is no array of numbers, and is left out" for key in left]


def _box_writer(space: Any, said: str) -> Callable[[Any, np.ndarray], None]:
    """The shape decides; every kind of real number is cast. Bounds are not looked at."""
    shape, small = space.shape, space.dtype == np.uint8

    def write(obs: Any, row: np.ndarray) -> None:
        obs = np.asarray(obs)
        if obs.shape != shape:
            raise Fault(
                f"returned {said} of shape {obs.shape}",
                f"its observation_space says {shape}: make the two agree",
            )
        if obs.dtype.kind not in "fuib":
            raise Fault(f"returned {said} of dtype {obs.dtype}", "return real numbers")
        if small and obs.dtype != np.uint8 and row.dtype == np.uint8:
            whole = obs.astype(np.uint8)
            if not np.array_equal(whole, obs):
                raise Fault(
                    f"returned {said} of dtype {obs.dtype} that uint8 cannot hold",
                    "its observation_space says uint8: make the two agree",
                )
            obs = whole
        row[:] = obs.ravel()

    return write


def _joined(space: Any, parts: dict[Any, Any], kind: Any, said: str) -> _Flat:
    """The parts of a Dict or Tuple, one after the other, each by its own rule."""
    flats = {key: _flat(part, f"{said} with {key!r}") for key, part in parts.items()}
    writes, at, image = [], 0, None
    for key, flat in flats.items():
        writes.append((key, slice(at, at + flat.size), flat.write))
        if flat.image and not image:
            image = (at + flat.image[0], *flat.image[1:])
        at += flat.size

    def write(obs: Any, row: np.ndarray) -> None:
        if not isinstance(obs, kind) or len(obs) != len(space.spaces):
            told = f"the keys {list(obs)}" if isinstance(obs, Mapping) else _kind(obs)
            raise Fault(
                f"returned {said} of {told}",
                f"its observation_space says {list(parts)}: make the two agree",
            )
        for key, place, write_part in writes:
            if kind is Mapping and key not in obs:
                raise Fault(
                    f"returned {said} without {key!r}",
                    f"its observation_space says {list(parts)}: make the two agree",
                )
            write_part(obs[key], row[place])

    small = all(flat.dtype == "uint8" for flat in flats.values())
    low, high = (
        np.concatenate([np.zeros(0), *bounds])
        for bounds in ([x.low for x in flats.values()], [x.high for x in flats.values()])
    )
    return _Flat(at, "uint8" if small and flats else "float32", low, high, write, image)


def _kind(x: Any) -> str:
    """Type and length of what was returned, for a message."""
    length = f" and length {len(x)}" if isinstance(x, (tuple, list)) else ""
    return f"type {type(x).__name__}{length}"


def _padded(flat: _Flat, size: int) -> list[Any]:
    """Bounds of an agent's observation that is padded with zeros to `size` numbers."""
    pad = (0, size - flat.size)
    return flat._replace(low=np.pad(flat.low, pad), high=np.pad(flat.high, pad)).bounds


def _choice(space: gymnasium.Space) -> dict[str, int] | None:
    """A Discrete as JSON; None for what is none."""
    if not isinstance(space, gymnasium.spaces.Discrete):
        return None
    return {"n": int(space.n), "start": int(space.start)}


def _described(space: Any) -> dict[str, Any]:
    """An action space as JSON, for `credo.runner`."""
    spaces = gymnasium.spaces
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = [[key, _described(part)] for key, part in _parts(space)]
        return {"parts": parts, "dict": isinstance(space, spaces.Dict)}
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        form = {"shape": list(space.shape), "dtype": str(space.dtype)}
        nvec, start = (x.ravel().tolist() for x in _vector(space))
        return {"nvec": nvec, "start": start, **form}
    if not isinstance(space, spaces.Box):
        return _choice(space) or {}
    low, high = (np.float64(bound).ravel().tolist() for bound in (space.low, space.high))
    return {"low": low, "high": high, "shape": list(space.shape), "dtype": str(space.dtype)}


def _parts(space: Any) -> list[tuple[Any, gymnasium.Space]]:
    """Those of a Dict or a Tuple."""
    spaces = space.spaces
    return list(spaces.items() if isinstance(spaces, Mapping) else enumerate(spaces))


def _vector(space: Any) -> tuple[np.ndarray, np.ndarray]:
    """Options of each choice of a MultiDiscrete or a MultiBinary, and the first option of each."""
    if isinstance(space, gymnasium.spaces.MultiDiscrete):
        return np.asarray(space.nvec), np.asarray(space.start)
    return np.full(space.shape, 2), np.zeros(space.shape, space.dtype)


class _Acts(NamedTuple):
    """An action space as numbers in [-1, 1]: those of its choices, one for each option, and behind
    them those of its Boxes."""

    size: int
    choices: tuple[int, ...]  # options of each
    read: Callable[[np.ndarray], Any]  # actions [n, act] as the space's own, one by one


def _actions(space: gymnasium.Space) -> _Acts:
    """How actions are told. Box: -1 is its low, 1 its high. Discrete, MultiDiscrete, MultiBinary:
    of each choice the entry that is largest. Dict, Tuple: those of its parts."""
    choices = tuple(_options(space))
    cursor = [0, sum(choices)]  # where the next choice begins, and the next Box
    read = _reader(space, cursor)
    return _Acts(cursor[1], choices, read)


def _options(space: Any) -> list[int]:
    """Options of each choice in a space, in order. Raises `Fault` of a space that has others."""
    spaces = gymnasium.spaces
    if isinstance(space, spaces.Dict | spaces.Tuple):
        return [n for _, part in _parts(space) for n in _options(part)]
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        return [int(n) for n in _vector(space)[0].ravel()]
    if isinstance(space, spaces.Discrete):
        return [int(space.n)]
    if isinstance(space, spaces.Box):
        return []
    raise Fault(
        f"has the action space {space}",
        "use a Box, a Discrete, a MultiDiscrete, a MultiBinary, or a Dict or Tuple of them",
    )


def _reader(space: Any, cursor: list[int]) -> Callable[[np.ndarray], Any]:
    """What reads actions of a space from numbers at `cursor`, which is moved on."""
    spaces = gymnasium.spaces
    if isinstance(space, spaces.Dict | spaces.Tuple):
        keys, parts = zip(*_parts(space), strict=True)
        readers = [_reader(part, cursor) for part in parts]
        made = dict if isinstance(space, spaces.Dict) else lambda pairs: tuple(x for _, x in pairs)
        return lambda actions: [
            made(zip(keys, own, strict=True))
            for own in zip(*(read(actions) for read in readers), strict=True)
        ]
    if isinstance(space, spaces.Box):
        return _scaled(space, cursor)
    return _chosen(space, cursor)


def _chosen(space: Any, cursor: list[int]) -> Callable[[np.ndarray], np.ndarray]:
    """Of a Discrete, a MultiDiscrete or a MultiBinary."""
    sizes, start = _options(space), cursor[0]
    cursor[0] += sum(sizes)
    if isinstance(space, gymnasium.spaces.Discrete):
        first, end = space.start, cursor[0]
        return lambda actions: np.argmax(actions[:, start:end], axis=1) + first
    ends, firsts = np.cumsum(sizes) + start, _vector(space)[1]

    def read(actions: np.ndarray) -> np.ndarray:
        each = [
            np.argmax(actions[:, end - n : end], axis=1) for end, n in zip(ends, sizes, strict=True)
        ]
        own = np.stack(each, axis=1).reshape(-1, *space.shape) + firsts
        return own.astype(space.dtype)

    return read


def _scaled(space: Any, cursor: list[int]) -> Callable[[np.ndarray], np.ndarray]:
    """Of a Box."""
    low, high = (np.float64(bound).ravel() for bound in (space.low, space.high))
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise Fault(
            f"has an action space without bounds: {space}",
            "give its Box a finite low and high: actions in [-1, 1] are scaled to them",
        )
    center, half = (low + high) / 2, (high - low) / 2
    shape, dtype = space.shape, space.dtype
    whole, at, end = not np.issubdtype(dtype, np.floating), cursor[1], cursor[1] + low.size
    cursor[1] = end

    def read(actions: np.ndarray) -> np.ndarray:
        own = np.minimum(np.maximum(center + half * actions[:, at:end], low), high)
        own = np.rint(own) if whole else own
        return own.astype(dtype).reshape(-1, *shape)

    return read


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
