"""What `credo export` writes: a champion in one file, for `credo.runner`, which needs no JAX."""

import importlib.metadata
import json
import pathlib
from typing import Any

import equinox as eqx
import numpy as np
import safetensors.numpy

from ..runner import DESCRIPTION, FINGERPRINT, VERSION, Runner, fingerprint
from . import config, files
from .policy import champion, task_of
from .record import RunError
from .store import Run

Weights = dict[str, np.ndarray]
SUFFIX = ".safetensors"
OTHERS = (".onnx", ".pt", ".pth", ".npz", ".npy", ".pkl", ".h5")  # kinds of files that it is not
PACKAGES = ("brax", "gymnax", "jaxmarl", "jumanji", "playground")
"""Modules of tasks whose ids are those of a package: such a task is called package:id."""


def export(run: Run, path: str | pathlib.Path) -> pathlib.Path:
    """Write a run's champion to one safetensors file, for
    `credo.runner.Runner.load`.

    Its metadata describe the network, the sizes and, for a task of Gymnasium or PettingZoo, the
    action space, so that the runner acts in the environment's own units. The run's record tells
    them: no environment is opened. What was at `path` is replaced.

    **Raises:** `RunError` if the network is none of Credo's, or the folder is not there.
    """
    path = pathlib.Path(path)
    if path.suffix in OTHERS:
        raise RunError(
            f"{path} ends in {path.suffix}, and a policy is written as {SUFFIX}, or as .onnx by "
            "`credo export`: name it so"
        )
    if not path.parent.is_dir():
        raise RunError(f"{path.parent} is no folder: make it first, or name another file")
    told, weights = described(run)
    description = json.dumps(told)
    metadata = {DESCRIPTION: description, FINGERPRINT: fingerprint(description, weights)}
    with files.whole(path) as draft:
        draft.write_bytes(safetensors.numpy.save(weights, metadata))
        Runner.load(draft)  # what cannot be read should fail now, not where it is to act
    return path


def described(run: Run) -> tuple[dict[str, Any], Weights]:
    """What a file says of a run's champion, and its weights."""
    network, weights = parts_of(champion(run))
    return _describe(run, network), weights


def parts_of(policy: Any) -> tuple[dict[str, Any], Weights]:
    """The network of a policy as JSON: its type, its config and the networks it is made of; and
    all its weights by name."""
    name = type(policy).__name__
    if not type(policy).__module__.startswith("credo.networks.") or name not in KINDS:
        raise RunError(
            f"{name} cannot be exported: the runner knows MLP, MMU, Recurrent, NTM, DNC, Graph "
            "and Convolutional, teams of them, DMMU and Centralized; from Python, "
            "Run(path).policy() plays any network"
        )
    kind, own, inner = KINDS[name]
    settings = config.to_tree(getattr(policy, "config", {}))
    fields = {k: v for k, v in settings.items() if k not in ("class", "head", "network")}
    weights = {k: np.array(w, np.float32) for k, w in own(policy).items() if eqx.is_array(w)}
    parts = []
    for prefix, part in inner(policy).items():
        node, within = parts_of(part)
        parts.append(node)
        weights |= {f"{prefix}.{k}": w for k, w in within.items()}
    return {"type": kind, "config": fields, "parts": parts}, weights


def _trunks(policy: Any) -> Weights:
    """Those of a team."""
    return {
        f"trunks.{i}.{name}": w
        for i, trunk in enumerate(policy.trunks)
        for name, w in trunk.items()
    }


def _numbered(name: str):
    return lambda policy: {f"{name}.{i}": x for i, x in enumerate(getattr(policy, name))}


def _within(policy: Any) -> dict[str, Any]:
    return {"policy": policy.policy}


KINDS: dict[str, tuple[str, Any, Any]] = {
    "MLPPolicy": ("MLP", lambda policy: policy.weights, lambda _: {}),
    "ConvolutionalPolicy": ("Convolutional", lambda p: p.weights, lambda p: {"head": p.head}),
    "MMUPolicy": ("MMU", vars, lambda _: {}),
    "RecurrentPolicy": ("Recurrent", lambda policy: policy.weights, lambda _: {}),
    "NTMPolicy": ("NTM", lambda policy: policy.weights, lambda _: {}),
    "DNCPolicy": ("DNC", lambda policy: policy.weights, lambda _: {}),
    "GraphPolicy": ("Graph", lambda policy: {"W": policy.W}, lambda _: {}),
    "TeamPolicy": ("Team", _trunks, _numbered("heads")),
    "DMMUPolicy": ("DMMU", lambda _: {}, _numbered("agents")),
    "CentralizedPolicy": ("Centralized", lambda _: {}, _within),
    "ChoosingPolicy": ("Choosing", lambda _: {}, _within),
    "Normalized": ("Normalized", lambda p: {"mean": p.mean, "std": p.std}, _within),
}
"""Of each policy its network's name for the runner, its own weights, and the policies within."""


def _task(env: dict[str, Any]) -> str:
    """What a task is called: its id, that of a package in JAX with the package, or its class."""
    module, _, name = env["class"].partition(":")
    package = module.rpartition(".")[2]
    if "id" not in env:
        return name
    known = module.startswith("credo.") and package in PACKAGES
    return f"{package}:{env['id']}" if known else env["id"]


def _describe(run: Run, network: dict[str, Any]) -> dict[str, Any]:
    """What the runner must know, from the record of the run alone: sizes, actions, names of
    agents."""
    env, task = run.config["algorithm"]["env"], task_of(run)
    while "id" not in env and "env" in env:  # what pays rewards later, say
        env = env["env"]
    return {
        "version": VERSION,
        "credo": importlib.metadata.version("credo"),
        "task": _task(env),
        "network": network,
        "obs_size": task["obs_size"],
        "action_size": task["action_size"],
        "agents": task["agents"],
        "action": task["actions"],
        "observations": task.get("observations"),
        "shown": task.get("shown"),
        **({"asks": task["asks"]} if "asks" in task else {}),
        "names": task.get("names"),
        "choices": task.get("choices") or (),
        "masked": task.get("masked", False),
        "lengths": task.get("lengths"),
    }
