"""Making an environment of others by its name, and what to warn of when it is made.

No JAX here: a worker process imports this.
"""

import functools
import importlib
import inspect
import sys
import warnings
from typing import Any

import gymnasium

from . import names
from .names import Fault

MOST_STEPS = 1000  # of an episode, where neither the task nor its user names a limit
NO_LIMIT = (
    f"it names no time limit: an episode is truncated after {MOST_STEPS:,} steps; set "
    "max_episode_steps, on the command line --max-episode-steps 1000, say, or as an attribute of "
    "the environment"
)
LASTING = {
    "NormalizeObservation": "set normalize_observations of the algorithm, which keeps the "
    "statistics with the policy",
    "NormalizeReward": "scale the reward by a constant, for example by the learner's reward_scale",
}
"""Wrappers whose state outlives an episode, by class name, and what to use instead."""


def most_steps(limits: list[int | None], warnings: list[str]) -> int:
    """The least of the limits that there are; a warning if there is none."""
    known = [int(limit) for limit in limits if limit is not None]
    if not known:
        warnings.append(NO_LIMIT)
    return min(known, default=MOST_STEPS)


def called(id: str, kwargs: dict[str, Any], kind: type) -> Any:
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


def registered(id: str, kwargs: dict[str, Any], max_episode_steps: int | None) -> gymnasium.Env:
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


def lasting(env: Any) -> list[str]:
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
