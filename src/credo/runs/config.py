"""The object is its config: object trees as JSON and back, and the record of versions and machine.

Reading builds `equinox.Module` objects from their fields. A class is looked up by name: in Credo
itself, or, for an environment, network or operator of your own, in a module of yours, which is
imported. Nothing that is stored in a run is executed, but a config can name a module on your path:
look into a stranger's config.json before you resume it.
"""

import dataclasses
import difflib
import importlib
import importlib.metadata
import inspect
import os
import pathlib
import platform
import sys
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..environments.base import AbstractEnvironment
from ..environments.host import AbstractHostEnvironment
from ..evolution.crossover import AbstractCrossover
from ..evolution.mutation import AbstractMutation
from ..evolution.selection import AbstractSelection
from ..learners.base import AbstractLearner
from ..learners.manager import AbstractManager
from ..networks.base import AbstractNetwork
from ..networks.exploration import AbstractNoise
from ..networks.mlp import AbstractCritic
from . import files

EXTENSIONS = (
    AbstractEnvironment,
    AbstractHostEnvironment,
    AbstractNetwork,
    AbstractMutation,
    AbstractCrossover,
    AbstractSelection,
    AbstractLearner,
    AbstractManager,
    AbstractNoise,
    AbstractCritic,
)
PACKAGES = ("credo", "jax", "jaxlib", "equinox", "optax", "numpy", "gymnasium", "mujoco")


class ConfigError(ValueError):
    """A config that cannot be read or built; the message says what to do."""


def to_tree(value: Any) -> Any:
    """An object tree as plain JSON values. Floats keep every bit."""
    if isinstance(value, eqx.Module):
        fields = {f.name: to_tree(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"class": class_name(type(value)), **fields}
    if isinstance(value, dict):
        return {str(k): to_tree(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [to_tree(v) for v in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array) and np.ndim(value) == 0:
        return np.asarray(value).item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ConfigError(
        f"a field holds {value!r}: only numbers, strings, tuples and Modules can be recorded in a "
        "config; make it one of these, or compute it in a property"
    )


def from_tree(tree: Any) -> Any:
    """The object that `to_tree` recorded."""
    if isinstance(tree, list):
        return tuple(from_tree(v) for v in tree)
    if not isinstance(tree, dict):
        return tree
    if "class" not in tree:
        return {k: from_tree(v) for k, v in tree.items()}
    cls = find_class(tree["class"])
    fields = {k: from_tree(v) for k, v in tree.items() if k != "class"}
    known = [f.name for f in dataclasses.fields(cls)]
    for name in fields:
        if name not in known:
            raise ConfigError(
                f"{tree['class']} has no field {name!r}{suggestion(name, known)}: was this run "
                "made by another version of Credo?"
            )
    return cls(**fields)


def class_name(cls: type) -> str:
    """`package.module:Class`, by which `find_class` finds it again."""
    module = cls.__module__
    if module == "__main__":  # a script: its file has a name under which it can be imported
        file = getattr(sys.modules["__main__"], "__file__", None)
        if file is None:
            raise ConfigError(
                f"{cls.__name__} was defined at a prompt: put it into a file, or its runs could "
                "not be resumed"
            )
        module = pathlib.Path(file).stem
    if "." in cls.__qualname__:
        raise ConfigError(f"{cls.__qualname__} is defined inside something: move it to the module")
    return f"{module}:{cls.__name__}"


def find_class(name: str) -> type:
    """The Module class `package.module:Class`."""
    module, _, attribute = name.partition(":")
    try:
        cls = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"cannot find {name!r} ({error}): install its package, or start Python where its "
            "file lies"
        ) from error
    if not (inspect.isclass(cls) and issubclass(cls, eqx.Module)):
        raise ConfigError(f"{name!r} is not an equinox.Module class")
    own = module.split(".")[0] == "credo"
    if not own and not issubclass(cls, EXTENSIONS):
        # A stored name must not be able to call an arbitrary class of the machine.
        raise ConfigError(f"{name!r} is neither Credo's nor one of the kinds that extend it")
    return cls


def suggestion(name: str, known: list[str]) -> str:
    """' (did you mean …?)', or nothing."""
    close = difflib.get_close_matches(name, known, n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def differences(a: Any, b: Any, path: str = "") -> list[str]:
    """Where two JSON trees differ, as `path: a != b`."""
    if isinstance(a, dict) and isinstance(b, dict):
        return [
            line
            for key in sorted(a.keys() | b.keys())
            for line in differences(a.get(key), b.get(key), f"{path}.{key}".lstrip("."))
        ]
    return [] if a == b else [f"{path}: {a!r} != {b!r}"]


def changed(recorded: Any, today: Any) -> list[str]:
    """Where the tree of an object that was recorded differs from today's tree of one. A field that
    came after the record has its default. Raises `ConfigError` if there is no such object today."""
    return differences(to_tree(from_tree(recorded)), today)


def machine() -> dict[str, Any]:
    """What a result depends on beside the config."""
    versions = {name: version for name in PACKAGES if (version := _version(name)) is not None}
    return {
        "versions": {"python": platform.python_version(), **versions},
        "processor": _processor(),
        "cores": len(available_cores()),
        "device": jax.devices()[0].device_kind,
        "system": platform.platform(),
    }


def available_cores() -> list[int]:
    """The cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def write_json(path: pathlib.Path, value: Any) -> None:
    """Write a file that is either the old one or the whole new one."""
    files.write_json(path, value)


def flatten(tree: Any, path: str = "") -> dict[str, Any]:
    """A config tree as one level: `mutation.strength` -> value."""
    if not isinstance(tree, dict):
        return {path: tree}
    flat = {}
    for key, value in tree.items():
        name = path if key == "class" else f"{path}.{key}".lstrip(".")
        value = value.partition(":")[2] if key == "class" else value
        flat |= flatten(value, name or "algorithm")
    return flat


def brief(tree: dict[str, Any]) -> str:
    """One line: `SequenceClassification(depth=21, …)`."""
    fields = ", ".join(f"{k}={v!r}" for k, v in tree.items() if k != "class")
    return f"{tree['class'].partition(':')[2]}({fields})"
