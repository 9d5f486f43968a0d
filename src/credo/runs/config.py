"""The object is its config: object trees as JSON and back, and the record of versions and machine.

Reading builds `equinox.Module` objects from their fields. A class is looked up by name: in Credo
itself, or, for an environment or network of your own, in a module that you have installed. Nothing
stored in a run is executed.
"""

import dataclasses
import difflib
import importlib
import importlib.metadata
import inspect
import json
import os
import pathlib
import platform
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..environments.base import AbstractEnvironment
from ..networks.base import AbstractNetwork


class ConfigError(ValueError):
    """A config that cannot be read or built; the message says what to do."""


def to_tree(value: Any) -> Any:
    """An object tree as plain JSON values. Floats keep every bit."""
    if isinstance(value, eqx.Module):
        fields = {f.name: to_tree(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"class": f"{type(value).__module__}:{type(value).__qualname__}", **fields}
    if isinstance(value, dict):
        return {str(k): to_tree(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [to_tree(v) for v in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return np.asarray(value).tolist()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ConfigError(
        f"a field holds {value!r}: only numbers, strings, tuples and Modules can be recorded; "
        "make it a field of one of these, or a Module of your own"
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
    if not own and not issubclass(cls, AbstractEnvironment | AbstractNetwork):
        # A stored name must not be able to call an arbitrary class of the machine.
        raise ConfigError(f"{name!r} is neither Credo's nor an environment or network of yours")
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


def machine() -> dict[str, Any]:
    """What a result depends on beside the config."""
    versions = {
        name: importlib.metadata.version(name)
        for name in ("credo", "jax", "jaxlib", "equinox", "numpy", "gymnasium")
    }
    return {
        "versions": {"python": platform.python_version(), **versions},
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "device": jax.devices()[0].device_kind,
        "system": platform.platform(),
    }


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
    draft = path.with_name(f".{path.name}.draft")
    with draft.open("w") as file:
        json.dump(value, file, indent=1, ensure_ascii=False)
        file.write("\n")
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)


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
