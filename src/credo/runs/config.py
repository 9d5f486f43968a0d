"""The object is its config: object trees as JSON and back, and the record of versions and machine.

Reading builds `equinox.Module` objects from their fields. A class is looked up by name: in Credo
itself, or, for an environment, network or operator of your own, in a module of yours, which is
imported. To import is to execute, so what is read from a record of unknown origin is Credo's own
alone (`trust=False`).
"""

import dataclasses
import functools
import importlib
import importlib.metadata
import inspect
import pathlib
import platform
import re
import sys
import types
import typing
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jaxtyping
import numpy as np

from ..environments import processes
from ..environments.base import AbstractEnvironment
from ..environments.foreign import AbstractForeignEnvironment
from ..environments.host import AbstractHostEnvironment
from ..evolution.breeder import AbstractBreeder
from ..evolution.crossover import AbstractCrossover
from ..evolution.mutation import AbstractMutation
from ..evolution.selection import AbstractSelection
from ..learners.base import AbstractLearner
from ..learners.coach import AbstractCoach
from ..learners.credit import AbstractRedistribution
from ..learners.fitness_critic import AbstractFitnessCritic
from ..learners.horizon import AbstractHorizon
from ..learners.manager import AbstractManager
from ..learners.share import AbstractShare
from ..learners.surrogate import AbstractSurrogate
from ..networks.base import AbstractNetwork
from ..networks.exploration import AbstractNoise
from ..networks.mlp import AbstractCritic
from ..networks.values import AbstractValues
from ..require import suggestion

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
    AbstractValues,
    AbstractShare,
    AbstractBreeder,
    AbstractCoach,
    AbstractSurrogate,
    AbstractHorizon,
    AbstractRedistribution,
    AbstractFitnessCritic,
)
PACKAGES = ("credo", "jax", "jaxlib", "equinox", "optax", "numpy", "gymnasium", "mujoco")


class ConfigError(ValueError):
    """A config that cannot be read or built; the message says what to do."""


class NotFound(ConfigError):
    """A class that a record names cannot be imported from here."""


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
        value = np.asarray(value).item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ConfigError(
        f"a field holds {value!r}: only numbers, strings, tuples and Modules can be recorded in a "
        "config; make it one of these, or compute it in a property"
    )


def from_tree(tree: Any, *, trust: bool = True, source: str = "this record") -> Any:
    """The object that `to_tree` recorded.

    **Arguments:** `trust`: whether classes and environments of others may be imported, as
    in a record of this user. Without it a record that names any is refused before that.
    `source`: whose record it is, for messages.

    **Raises:** `ConfigError`, or what a class says about the values it is given.
    """
    tree = _renewed(tree)
    foreign = [] if trust else [name for name in class_names(tree) if not _OWN.fullmatch(name)]
    if foreign:
        raise ConfigError(_untrusted(source, foreign[0]))

    def build(tree: Any, at: str) -> Any:
        if isinstance(tree, list):
            return tuple(build(v, f"{at}.{i}") for i, v in enumerate(tree))
        if not isinstance(tree, dict):
            return tree
        fields = {k: build(v, f"{at}.{k}") for k, v in tree.items() if k != "class"}
        if "class" not in tree:
            return fields
        made = _made(find_class(tree["class"]), fields, at.lstrip("."))
        foreign = isinstance(made, AbstractForeignEnvironment) and not trust
        if (
            foreign and (named := made.foreign_code) is not None
        ):  # before anything is made of it, which may open it
            raise ConfigError(_untrusted(source, named))
        return made

    return build(tree, "")


def _untrusted(source: str, named: str) -> str:
    """Why a record is not read, and what to do."""
    return (
        f"{source} was not made here and names {named}, which is code of others: look into "
        "config.json, then give --trust (from Python Run(path, trust=True))"
    )


_OWN = re.compile(r"credo\.((environments|networks|evolution|learners|algorithms)\.\w+|replay):\w+")


def class_names(tree: Any) -> Iterator[str]:
    """The names of all classes in a record."""
    if isinstance(tree, dict):
        if "class" in tree:
            yield str(tree["class"])
        tree = list(tree.values())
    if isinstance(tree, list):
        for value in tree:
            yield from class_names(value)


def _made(cls: type, fields: dict[str, Any], at: str) -> Any:
    """An object of `cls`, whose fields are what its annotations say."""
    known = {f.name: f for f in dataclasses.fields(cls)}
    name, kinds = f"{cls.__module__}:{cls.__name__}", _kinds(cls)
    for key, value in fields.items():
        if key not in known:
            raise ConfigError(
                f"{name} has no field {key!r}{suggestion(key, list(known))}: this was written by "
                "an older version of Credo"
            )
        if key in kinds and value is not known[key].default and not _fits(value, kinds[key]):
            kind = inspect.formatannotation(kinds[key]).replace("credo.", "")
            where = f"{at}.{key}".lstrip(".")
            raise ConfigError(f"{where} of {name} is {value!r}: it must be {kind}")
    try:
        return cls(**fields)
    except (TypeError, AttributeError, LookupError, ArithmeticError) as error:
        raise ConfigError(
            f"{name} cannot be made of what is recorded ({type(error).__name__}: {error})"
        ) from error


@functools.cache
def _kinds(cls: type) -> dict[str, Any]:
    """The annotations of a class; of one whose annotations cannot be read, none."""
    try:
        return typing.get_type_hints(cls)
    except Exception:  # a name that its module knows for type checkers alone
        return {}


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value may stand where `kind` is annotated. What JSON cannot tell apart passes."""
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, one) for one in inside)
    if origin is tuple:
        if not isinstance(value, tuple) or inside[-1:] == (...,):
            return isinstance(value, tuple) and all(_fits(v, inside[0]) for v in value)
        return len(value) == len(inside) and all(map(_fits, value, inside))
    if origin is typing.Literal:
        return value in inside
    if kind in (None, type(None)):
        return value is None
    if kind is bool or kind is str or kind is dict or origin is dict:
        return isinstance(value, origin or kind)
    if inspect.isclass(kind) and issubclass(kind, int | float | jaxtyping.AbstractArray):
        return isinstance(value, int | float) and not isinstance(value, bool)
    if inspect.isclass(kind) and issubclass(kind, eqx.Module):
        return isinstance(value, eqx.Module)  # what can stand for it is for the class to say
    return True


def class_name(cls: type) -> str:
    """`package.module:Class`, by which `find_class` finds it again; `__main__:Class` of one that
    was defined at a prompt or in a notebook, for this process alone."""
    module = cls.__module__
    if module == "__main__":  # a script: its file has a name under which it can be imported
        file = getattr(sys.modules["__main__"], "__file__", None)
        module = module if file is None else pathlib.Path(file).stem
    if "." in cls.__qualname__:
        raise ConfigError(f"{cls.__qualname__} is defined inside something: move it to the module")
    return f"{module}:{cls.__name__}"


def of_a_prompt(tree: Any) -> list[str]:
    """The classes in a record that no other process can find."""
    if isinstance(tree, dict | list):
        values = tree.values() if isinstance(tree, dict) else tree
        return [name for value in values for name in of_a_prompt(value)]
    prompt = isinstance(tree, str) and tree.startswith("__main__:")
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    return [tree.partition(":")[2]] if prompt and file is None else []


def find_class(name: str) -> type:
    """The Module class `package.module:Class`."""
    if not isinstance(name, str):
        raise ConfigError(f"a class is named {name!r}: it must be package.module:Class")
    module, _, attribute = name.partition(":")
    try:
        cls = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        if module == "__main__":
            raise ConfigError(
                f"{attribute} was defined at a prompt or in a notebook and is known in that "
                "process alone: put it into a file of its own, and import it from there"
            ) from error
        if module.split(".")[0] == "credo":
            raise NotFound(
                f"cannot find {name!r}: this was written by an older version of Credo"
            ) from error
        raise NotFound(
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
    came after the record has its default. Nothing that only the record names is imported or made.
    Raises `ConfigError` if a class has no such field today."""
    recorded = _renewed(recorded)
    return [] if recorded == today else differences(_completed(recorded, today), today)


EVEN = {"class": "credo.learners.credit:Even", "late_only": False}


def _renewed(tree: Any) -> Any:
    """A record as it would be written today: `redistribute` was True or False once."""
    if isinstance(tree, list):
        return [_renewed(part) for part in tree]
    if not isinstance(tree, dict):
        return tree
    new = {name: _renewed(part) for name, part in tree.items()}
    if isinstance(new.get("redistribute"), bool):
        new["redistribute"] = dict(EVEN) if new["redistribute"] else None
    return new


def _completed(recorded: Any, today: Any) -> Any:
    """The record with the defaults of fields that are newer than it."""
    if isinstance(recorded, list) and isinstance(today, list) and len(recorded) == len(today):
        return [_completed(*pair) for pair in zip(recorded, today, strict=True)]
    if not (isinstance(recorded, dict) and isinstance(today, dict)):
        return recorded
    same = {k: _completed(v, today[k]) if k in today else v for k, v in recorded.items()}
    if "class" not in recorded or recorded["class"] != today.get("class"):
        return same
    known = {f.name: f for f in dataclasses.fields(find_class(recorded["class"]))}
    for name in recorded.keys() - {"class", *known}:
        raise ConfigError(f"{recorded['class']} has no field {name!r}{suggestion(name, [*known])}")
    newer = {k: f.default for k, f in known.items() if k not in recorded}
    made = {k: to_tree(v) for k, v in newer.items() if v is not dataclasses.MISSING}
    return same | made


def replaced(algorithm: Any, changes: dict[str, Any]) -> Any:
    """`algorithm` with other numbers and strings, named as in `learners.0.gamma`. Raises
    `ConfigError`."""
    tree = to_tree(algorithm)
    for name, value in changes.items():
        *inner, last = name.split(".")
        node = tree
        for part in inner:
            node = _inside(node, part, name)
        old = _inside(node, last, name)
        plain = (bool, int, float, str, type(None))
        if isinstance(old, dict | list) or not isinstance(value, plain):
            raise ConfigError(f"{name} is {value!r}: only numbers and strings can be changed")
        if last == "class" or (inner[:1] == ["env"] and isinstance(old, str)):
            raise ConfigError(f"{name} makes another task or method: that is a new run")
        node[int(last) if isinstance(node, list) else last] = value
    return from_tree(tree)


def _inside(node: Any, part: str, name: str) -> Any:
    """The entry `part` of an object's tree."""
    if not isinstance(node, dict | list):
        raise ConfigError(f"no setting {name!r}: what stands before {part!r} has no parts")
    known = list(map(str, range(len(node)))) if isinstance(node, list) else list(node)
    if part not in known:
        fields = ", ".join(k for k in known if k != "class")
        raise ConfigError(
            f"no setting {name!r}: there is no {part!r}{suggestion(part, known)} in {fields}"
        )
    return node[int(part)] if isinstance(node, list) else node[part]


def machine() -> dict[str, Any]:
    """What a result depends on beside the config."""
    versions = {name: version for name in PACKAGES if (version := _version(name)) is not None}
    return {
        "versions": {"python": platform.python_version(), **versions},
        "processor": _processor(),
        "cores": processes.counted(),
        "device": jax.devices()[0].device_kind,
        "system": platform.platform(),
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    """The name of the processor as the system has it."""
    try:
        for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


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
