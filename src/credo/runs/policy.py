"""A run's best policy as a plain callable, in the units of its own task."""

import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from ..environments.foreign import AbstractForeignEnvironment
from ..environments.wrappers import DelayedHostReward, DelayedReward
from ..networks.team import Team
from ..runner import Units
from . import checkpoint, config


class Policy:
    """A trained policy: `action = policy(observation)`, its memory kept between calls."""

    def __init__(self, policy: PyTree, task: Mapping[str, Any] | None = None, *, raw: bool = False):
        """**Arguments:**

        - `task`: the record of a task, as `config.json` has it under "task"; None: observations are
          taken as they are and actions lie in [-1, 1].
        - `raw`: actions in [-1, 1] whatever the task.
        """
        arrays, self._static = eqx.partition(policy, eqx.is_array)
        self._arrays = arrays
        self._play = jax.jit(
            lambda arrays, obs, carry: eqx.combine(arrays, self._static)(obs, carry)
        )
        task = task if task is None or not raw else {**task, "actions": None}
        self._units = None if task is None else Units(task)
        self.reset()

    def reset(self, seed: int = 0) -> None:
        """Forget: call at the start of every episode. `seed` decides what the policy draws, if it
        draws."""
        self._carry = eqx.combine(self._arrays, self._static).start(key=jax.random.key(seed))

    def __call__(self, observation: Any, mask: Any = None) -> Any:
        """What to do now, as `credo.runner.Runner` says it.

        **Arguments:**

        - `observation`: as the task gives it: an array of any shape, the integer of a Discrete, of
          a team `[agents, obs_size]` or an entry for each agent, None for one that is not there.
        - `mask`: in a Discrete which of its entries are allowed; None: all.

        **Returns:** in a Box of Gymnasium an array of its shape, dtype and units; in a Discrete an
        integer; of a team of PettingZoo a list of these; else float32 in [-1, 1].

        **Raises:** `ValueError` for an observation of another size, or with NaN or inf in it.
        """
        if self._units is None:
            return self._step(np.asarray(observation, np.float32))
        return self._units.act(observation, self._step, mask)

    def _step(self, obs: np.ndarray) -> np.ndarray:
        action, self._carry = self._play(self._arrays, jnp.asarray(obs), self._carry)
        return np.asarray(action)


def of(run: Any, raw: bool = False) -> Policy:
    """The best policy of a `Run` in its task's units; `raw`: with actions in [-1, 1]."""
    task = run.config.get("task") if raw else task_of(run)
    return Policy(champion(run), task, raw=raw)


def champion(run: Any) -> PyTree:
    """The policy in a run's folder. Where its record tells the task's sizes and its networks are
    Credo's own, no environment is opened, and nothing of somebody's own is imported."""
    tree, task = run.config["algorithm"], run.config.get("task")
    names = [tree["class"], *_classes(tree.get("network"))]
    if task is None or len(names) < 2 or not all(name.startswith("credo.") for name in names):
        return run.champion
    like = _network_alone(tree, task)
    return checkpoint.import_policy(run.path / "champion.safetensors", like)


def _network_alone(tree: dict[str, Any], task: Mapping[str, Any]) -> PyTree:
    """What an algorithm's policy looks like, from its record and that of the task."""
    units = Units({**task, "actions": None})  # looks at the sizes
    sizes = (units.obs_size, units.action_size)
    network: Any = config.from_tree(tree["network"])
    if units.agents is not None and not network.team:  # CCEA has a population for each agent
        network = Team(trunk=(), head=network, sharing="nothing")
    team = (units.agents,) if network.team else ()
    like = eqx.filter_eval_shape(network.init, *sizes, *team, key=jax.random.key(0))
    if not tree.get("normalize_observations", False):
        return like
    from ..networks.normalized import Normalized  # pyright: ignore[reportMissingImports]

    shape = jax.ShapeDtypeStruct((units.obs_size,), jnp.float32)
    return Normalized(like, shape, shape)


def _classes(tree: Any) -> Iterator[str]:
    """The names of all classes in a config's tree."""
    if isinstance(tree, dict):
        if "class" in tree:
            yield str(tree["class"])
        tree = list(tree.values())
    if isinstance(tree, list):
        for branch in tree:
            yield from _classes(branch)


def undelayed(env: Any) -> Any:
    """The task itself, without what pays its rewards later."""
    while isinstance(env, DelayedReward | DelayedHostReward):
        env = env.env
    return env


def task_of(run: Any) -> Mapping[str, Any]:
    """What a run's record tells of its task. One of an older Credo tells nothing: of a task of
    others the environment is opened then, unless it is somebody's own code."""
    if "task" in run.config:
        return run.config["task"]
    env = run.algorithm.env
    foreign = undelayed(env)
    if isinstance(foreign, AbstractForeignEnvironment):
        if foreign.foreign_code is None:
            return foreign.task_record()
        warnings.warn(
            f"{run.path} was made by an older Credo, which did not record the units of "
            f"{foreign.foreign_code}: actions lie in [-1, 1], -1 is the low of a Box and 1 its "
            "high",
            stacklevel=3,
        )
    sizes = {name: getattr(env, name) for name in ("obs_size", "action_size", "agents")}
    return sizes | {"actions": None}
