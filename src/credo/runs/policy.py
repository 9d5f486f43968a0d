"""A run's policy as a plain callable, in the units of its own task."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from ..compilation import float32
from ..networks.normalized import Normalized
from ..networks.team import Team
from ..runner import Units
from .record import RunError
from .record import task_of as task_record


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

    @float32()
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

    @float32()
    def _step(self, obs: np.ndarray) -> np.ndarray:
        action, self._carry = self._play(self._arrays, jnp.asarray(obs), self._carry)
        return np.asarray(action)


@float32()
def champion(run: Any) -> PyTree:
    """The policy that a `Run` shows. Where its record tells the task's sizes
    and its networks are Credo's own, no environment is opened, and no code of others is
    imported."""
    tree, network = run.config["algorithm"], run.part("network")
    if network is None or "task" not in run.config or not tree["class"].startswith("credo."):
        return run.champion
    like = _like(network, tree.get("normalize_observations"), _units(run))
    return run.restored(like)


def _like(network: Any, normalized: bool | None, units: Units) -> PyTree:
    """What an algorithm's policy looks like, from its record and that of the task."""
    if units.agents is not None and not network.team:  # CCEA has a population for each agent
        network = Team(trunk=(), head=network, sharing="nothing")
    team = (units.agents,) if network.team else ()
    sizes = (units.obs_size, units.action_size, *team)
    like = eqx.filter_eval_shape(network.init, *sizes, key=jax.random.key(0))
    if not normalized:
        return like
    numbers: Any = jax.ShapeDtypeStruct((*sizes[2:], units.obs_size), jnp.float32)
    return Normalized(like, numbers, numbers)


def _units(run: Any) -> Units:
    """How a run's record says that one speaks to its task. Raises `RunError`."""
    try:
        return Units(run.config["task"])
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise RunError(
            f"{run.path / 'config.json'} is damaged: its task cannot be read "
            f"({type(error).__name__}: {error}); restore it from a copy"
        ) from error


def task_of(run: Any) -> Mapping[str, Any]:
    """What a run's record tells of its task. One of an older Credo tells nothing: a task of others
    is opened then, and refused if it is code of others and the run is not trusted."""
    if "task" not in run.config:
        return task_record(run.algorithm.env)
    _units(run)
    return run.config["task"]
