"""What `credo export` writes: a champion in one file, for `credo.runner`, which needs no JAX."""

import importlib.metadata
import json
import pathlib
from typing import Any

import equinox as eqx
import gymnasium
import numpy as np
import safetensors.numpy

from ..environments.gymnasium import Gymnasium
from ..networks.mlp import MLPPolicy
from ..networks.mmu import MMUPolicy
from ..networks.recurrent import RecurrentPolicy
from ..runner import DESCRIPTION, FINGERPRINT, VERSION, Runner, fingerprint
from . import config, files
from .loop import Run, RunError
from .watch import gymnasium_task, opened


def export(run: Run, path: str | pathlib.Path) -> pathlib.Path:
    """Write a run's champion to one safetensors file, for `credo.runner.Runner.load`.

    Its metadata describe the network, the sizes and, for a task of Gymnasium, the action space,
    so that the runner acts in the environment's own units. What was at `path` is replaced.

    **Raises:** `RunError` if the network is none of MLP, MMU and Recurrent.
    """
    path, policy = pathlib.Path(path), run.champion
    if not isinstance(policy, MLPPolicy | MMUPolicy | RecurrentPolicy):
        raise RunError(
            f"{type(policy).__name__} cannot be exported: the runner knows MLP, MMU and Recurrent; "
            "from Python, Run(path).policy() plays any network"
        )
    weights = _weights(policy)
    description = json.dumps(_describe(run, policy))
    metadata = {DESCRIPTION: description, FINGERPRINT: fingerprint(description, weights)}
    with files.whole(path) as draft:
        draft.write_bytes(safetensors.numpy.save(weights, metadata))
        Runner.load(draft)  # what cannot be read should fail now, not where it is to act
    return path


def _weights(policy: MLPPolicy | MMUPolicy | RecurrentPolicy) -> dict[str, np.ndarray]:
    named = vars(policy) if isinstance(policy, MMUPolicy) else policy.weights
    return {name: np.array(w, np.float32) for name, w in named.items() if eqx.is_array(w)}


def _describe(run: Run, policy: MLPPolicy | MMUPolicy | RecurrentPolicy) -> dict[str, Any]:
    env = run.algorithm.env
    task = gymnasium_task(env)
    fields = config.to_tree(policy.config)
    return {
        "version": VERSION,
        "credo": importlib.metadata.version("credo"),
        "task": type(env).__name__ if task is None else task.id,
        "network": type(policy.config).__name__,
        "config": {name: value for name, value in fields.items() if name != "class"},
        "obs_size": env.obs_size,
        "action_size": env.action_size,
        "action": None if task is None else _action(task),
    }


def _action(task: Gymnasium) -> dict[str, Any]:
    """The action space as JSON."""
    with opened(task) as copy:
        space = copy._envs[0].action_space
    if isinstance(space, gymnasium.spaces.Discrete):
        return {"n": int(space.n), "start": int(space.start)}
    assert isinstance(space, gymnasium.spaces.Box)  # or it could not have been opened
    low, high = (np.float64(bound).ravel().tolist() for bound in (space.low, space.high))
    return {"low": low, "high": high, "shape": list(space.shape), "dtype": str(space.dtype)}
