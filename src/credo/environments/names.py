"""What a name stands for: `package.module:name`, an id of Gymnasium's registry, or a team's module.

The one place where the stored name of an environment, or of a function that pays rewards, becomes
code. Nothing is called that is not a class of the wanted kind or a plain Python function: a name
such as os:system or subprocess:Popen is refused unused. Importing a module executes it all the
same: `foreign_code` says whose code a name would import. No JAX here: a worker imports this.
"""

import contextlib
import dataclasses
import importlib
import importlib.util
import inspect
import json
import os
import pathlib
import sys
from collections.abc import Mapping
from typing import Any

import gymnasium
from gymnasium.envs.registration import WrapperSpec

OWN_TEAMS = ("pettingzoo.", "mpe2.")  # modules of teams that are no user's own code
ALONE = "name the module, as in mine:{}, or set in_process=True"

_HERE: dict[str, Any] = {}  # what no other process can import, by the name that it got here


class Fault(Exception):
    """What an environment did wrong (`what`), and what to do about it (`fix`)."""

    def __init__(self, what: str, fix: str):
        super().__init__(what, fix)
        self.what, self.fix = what, fix


# ------------------------------------------------------------------------------ things to names


def name_of(thing: Any) -> str:
    """The name of a class or plain Python function; a string is one already.

    What is defined in the script that runs is named by the script's module, so that a worker finds
    it. What no other process can import (of a notebook or prompt, in a function, a lambda) is
    `__main__:name` and found in this process alone.

    **Raises:** `ValueError` if it is none of these.
    """
    if isinstance(thing, str):
        module, _, path = thing.partition(":")
        main = _walk(sys.modules["__main__"], path) if module == "__main__" else None
        return name_of(main) if _nameable(main) else thing
    if not _nameable(thing):
        raise ValueError(
            f"{thing!r} is given as an environment or reward: give a class, a plain Python "
            "function, or its name as package.module:name"
        )
    module, path = thing.__module__, thing.__qualname__
    if _walk(sys.modules.get(module), path) is thing:
        module = _script() if module == "__main__" else module
        if module is not None:
            return f"{module}:{path}"
    return _kept(f"__main__:{path}", thing)


def here_alone(name: str) -> bool:
    """Whether no other process can import this."""
    return name.startswith("__main__:")


def _nameable(thing: Any) -> bool:
    """Whether it is a class or a plain Python function."""
    return isinstance(thing, type) or inspect.isfunction(thing)


def _kept(name: str, thing: Any) -> str:
    """A class that a notebook defines anew gets a name of its own: its copies are others."""
    for known, other in _HERE.items():
        if other is thing:
            return known
    count = sum(known.partition("@")[0] == name for known in _HERE)
    name = f"{name}@{count + 1}" if count else name
    _HERE[name] = thing
    return name


def _script() -> str | None:
    """By what name others import the script that runs; None in a notebook or at a prompt."""
    main = sys.modules["__main__"]
    spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
    if spec is not None:  # python -m
        return spec.name
    stem = pathlib.Path(file).stem if file else ""
    if not stem.isidentifier():
        return None
    found = importlib.util.find_spec(stem)
    origin = None if found is None else found.origin
    if not (origin and os.path.exists(origin) and file and os.path.exists(file)):
        return None
    return stem if os.path.samefile(origin, file) else None


# ------------------------------------------------------------------------------ names to things


def resolve(name: str, kind: type | None = None) -> Any:
    """The class of this `kind`, or plain Python function, that `package.module:name` names. It is
    not called.

    **Raises:** `Fault` if there is none, or if it is anything else; whatever the import raises.
    """
    found = find(name)
    if inspect.isfunction(found):
        return found
    wanted = "a plain Python function"
    if kind is not None:
        base = f"{kind.__module__.partition('.')[0]}.{kind.__name__}"
        wanted = f"a class derived from {base}, or {wanted} that makes one"
    if isinstance(found, type):
        if kind is not None and issubclass(found, kind):
            return found
        raise Fault(f"is a {found.__name__}", f"name {wanted}")
    if found is not None:
        raise Fault(f"is a {type(found).__name__}", f"name {wanted}")
    if here_alone(name):
        raise Fault(
            "was defined in a notebook, at a prompt or inside a function, and is not known here",
            "go on where it is defined, or put it into a module and name that: mine:Name",
        )
    module, _, path = name.partition(":")
    raise Fault(f"is not there: {module} has no {path}", f"name {wanted}")


def find(name: str) -> Any:
    """What `package.module:name` names, or None; the module is imported."""
    if name in _HERE:
        return _HERE[name]
    module, _, path = name.partition(":")
    return _walk(importlib.import_module(module), path.partition("@")[0])


def _walk(module: Any, path: str) -> Any:
    """Follow `Outer.Inner`: from a module into its names, from there through classes alone."""
    found = module
    for step, part in enumerate(path.split(".")):
        if not part.isidentifier() or (step and not isinstance(found, type)):
            return None
        found = getattr(found, part, None)
    return found


def kind_of(name: str, kwargs: Mapping[str, Any] | None = None) -> str | None:
    """Whether `package.module:name` makes tasks of "gymnasium" or of "pettingzoo"; None: neither.

    A class tells by what it is derived from, a function by what it says to return, and if it does
    not say, by what it returns: it is called. For names that were typed in, not for stored ones.

    **Raises:** what the import or the function raises.
    """
    maker = find(name)
    made = maker
    if inspect.isfunction(maker):
        made = inspect.signature(maker).return_annotation
        if not isinstance(made, type) or made is inspect.Signature.empty:
            env = maker(**(kwargs or {}))
            made = type(env)
            with contextlib.suppress(Exception):  # it is not needed any more
                env.close()
    bases = getattr(made, "__mro__", ())
    if gymnasium.Env in bases:
        return "gymnasium"
    names = {f"{base.__module__}.{base.__name__}" for base in bases}
    return "pettingzoo" if "pettingzoo.utils.env.ParallelEnv" in names else None


# ------------------------------------------------------------------------------ whose code


def foreign_code(api: str, id: str, kwargs: Mapping[str, Any]) -> str | None:
    """Whose code opening this would import, by name; None for what Gymnasium, PettingZoo, MPE2 and
    Credo themselves have. Imports nothing."""
    module, _, name = id.rpartition(":")
    credos = api == "gymnasium" and name.startswith("credo/")
    if ":" in id and not (credos and module == "credo.environments.gymnasium"):
        return id
    if credos:  # `task` is what credo.environments.gymnasium.make would import
        return str(kwargs["task"] or repr(kwargs["task"])) if "task" in kwargs else None
    if api == "pettingzoo":
        registry = getattr(sys.modules.get("pettingzoo"), "parallel_registry", {})
        entry = registry[id].entry_point if id in registry else id
        own = isinstance(entry, str) and entry.startswith(OWN_TEAMS)
        return None if own else (entry if isinstance(entry, str) else id)
    spec = gymnasium.registry.get(id)
    if spec is None or _own(spec):
        return None
    return spec.entry_point if isinstance(spec.entry_point, str) else id


def _own(spec: Any) -> bool:
    """Whether entry point and wrappers of a registered environment are Gymnasium's or Credo's."""
    entries = [spec.entry_point, *(w.entry_point for w in spec.additional_wrappers)]
    modules = [x if isinstance(x, str) else getattr(x, "__module__", "") for x in entries]
    return all(module.startswith(("gymnasium.", "credo.")) for module in modules)


def registered(id: str) -> dict[str, Any] | None:
    """What this process's registry says of an id, for a worker that never saw the script which
    registered it: plain values. None if there is no such id here; `entry_point` is None if what is
    registered cannot be told. Also of one whose code is Gymnasium's: a script may have named it."""
    spec = gymnasium.registry.get(id)
    if spec is None:
        return None
    entry = name_of(spec.entry_point) if _nameable(spec.entry_point) else spec.entry_point
    entry = name_of(entry) if isinstance(entry, str) else None
    told = {
        "id": spec.id,
        "entry_point": entry,
        "kwargs": spec.kwargs,
        "max_episode_steps": spec.max_episode_steps,
        "order_enforce": spec.order_enforce,
        "additional_wrappers": [dataclasses.astuple(x) for x in spec.additional_wrappers],
    }
    if entry is None or (not _own(spec) and here_alone(entry)) or not _json(told):
        return {"id": spec.id, "entry_point": None}
    return told


def register(told: dict[str, Any] | None) -> None:
    """Know an id here as it is known where `registered` was called.

    **Raises:** `Fault` if it is known there alone.
    """
    if told is None or told["id"] in gymnasium.registry:
        return
    if told["entry_point"] is None:
        raise Fault("is registered in the process of the script alone", ALONE.format(told["id"]))
    wrappers = [WrapperSpec(*spec) for spec in told["additional_wrappers"]]
    gymnasium.register(**{**told, "additional_wrappers": tuple(wrappers)})


def _json(value: Any) -> bool:
    """Whether JSON can hold it."""
    try:
        json.dumps(value)
    except (TypeError, ValueError):
        return False
    return True
