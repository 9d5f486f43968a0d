"""Tasks by name: Credo's own, a class or function of one's own, and those of other packages."""

import contextlib
import dataclasses
import importlib
import importlib.util
import re
import sys
from typing import Any

from ..environments import checks, names
from ..environments.base import AbstractEnvironment
from ..environments.gymnasium import Gymnasium
from ..environments.host import AbstractHostEnvironment, EnvironmentFailure
from ..require import suggestion
from ..runs import config
from ..runs.ending import first, place, say
from .names import CATALOGUE, TASKS, fail, load, of_user
from .values import pairs

KINDS = {  # those of PettingZoo need an extra
    kind: f"environments.{kind}:{name}"
    for kind, name in (("gymnasium", "Gymnasium"), ("pettingzoo", "PettingZoo"))
}
IN_JAX = {  # packages of tasks in JAX, which name theirs package:id
    package: f"environments.{package}:{name}"
    for package, name in (
        ("brax", "Brax"),
        ("gymnax", "Gymnax"),
        ("jaxmarl", "JaxMARL"),
        ("jumanji", "Jumanji"),
        ("playground", "Playground"),
    )
}


def task(name: str, kwargs: dict[str, Any], rewards: tuple[str, ...]) -> Any:
    """A task with its defaults, made with `kwargs`; `rewards` as in `with_settings`. Ends the
    command with what was meant if the name is none."""
    return with_settings(_named(name, kwargs), kwargs, rewards)


def with_settings(env: Any, kwargs: dict[str, Any], rewards: tuple[str, ...] = ()) -> Any:
    """A task with other settings, also inside a wrapper.

    **Arguments:** `kwargs`: what Gymnasium or PettingZoo makes it with, by name; those that are not
    named stay. `rewards`: names of a task's own ones, the first is what training maximises; for a
    team of PettingZoo NAME=MODULE:FUNCTION, which are added.
    """
    if not (kwargs or rewards):
        return env
    known, new = {f.name for f in dataclasses.fields(env)}, {}
    if "env" in known and "kwargs" not in known:  # a wrapper
        return dataclasses.replace(env, env=with_settings(env.env, kwargs, rewards))
    for name in {name for name, x in (("kwargs", kwargs), ("rewards", rewards)) if x} - known:
        fail(f"{type(env).__name__} has no --{name}: its settings are flags, see --help-all")
    if kwargs:
        new["kwargs"] = dict(env.kwargs) | kwargs
    if rewards:
        own = config.class_name(type(env)) == f"credo.{KINDS['pettingzoo']}"
        new["rewards"] = dict(env.rewards) | pairs("rewards", [*rewards]) if own else rewards
    return dataclasses.replace(env, **new)


def _named(name: str, kwargs: dict[str, Any]) -> Any:
    """A task by the form of its name: a word of the catalogue, `package:id` of a package in JAX,
    `module:Name`, the module of a team, or an id of Gymnasium."""
    if name in TASKS:
        return load(TASKS[name]["path"])()
    if name.partition(":")[0] in IN_JAX:
        return _of_package(name)
    if re.fullmatch(r"\w+(\.\w+)*:\w+", name):
        return _own(name, kwargs)
    if re.fullmatch(r"\w+(\.\w+)+", name):
        with contextlib.suppress(ModuleNotFoundError):  # of what stands before the last dot
            if importlib.util.find_spec(name):
                return load(KINDS["pettingzoo"])(id=name)
        own = ":".join(name.rsplit(".", 1))
        fail(f"no module {name!r}: a class or function of your own is written {own}")
    if match := re.fullmatch(r"(?:\./)?(\w+)\.py:(\w+)", name):  # a file in place of its module
        fail(f"{name!r} names a file: name its module, {match[1]}:{match[2]}")
    return _registered(name)


def _of_package(name: str) -> Any:
    """gymnax:CartPole-v1, and the like of other packages of tasks in JAX."""
    package, _, id = name.partition(":")
    try:
        return load(IN_JAX[package])(id=id)
    except (ModuleNotFoundError, ValueError) as error:
        fail(str(error))


def _registered(name: str) -> Any:
    """A task of Gymnasium's registry; one of a package that registers its own is written
    package:Id-v0, and the package is imported."""
    import gymnasium

    module, _, id = name.rpartition(":")
    if module:
        of_user(name, lambda: importlib.import_module(module))
    if id not in gymnasium.registry:
        if package := CATALOGUE["packages"].get(id.partition("/")[0]):
            own = f"{package.replace('-', '_')}:{id}"
            fail(f"{id} is a task of {package}: pip install {package}, then name it {own}")
        told = "one of your own is written package.module:name"
        fail(f"no task {name!r}; {told}", name, TASKS, gymnasium.registry)
    return Gymnasium(id=name)


def _own(name: str, kwargs: dict[str, Any]) -> Any:
    """A class of one's own, or a plain function that makes an environment: it may be called, since
    it is named on this command line."""
    found = of_user(name)
    module, _, missing = name.partition(":")
    if found is None:
        there = [x for x in vars(sys.modules[module]) if not x.startswith("_")]
        fail(f"cannot import {name!r}: {module} has no {missing}{suggestion(missing, there)}")
    if isinstance(found, type) and issubclass(found, AbstractEnvironment | AbstractHostEnvironment):
        return of_user(name, found)
    kind = of_user(name, lambda: names.kind_of(name, kwargs))
    if kind is None:
        fail(
            f"{name} is no task: derive it from credo.AbstractEnvironment or gymnasium.Env, or "
            "name a function that makes a gymnasium.Env or a pettingzoo.ParallelEnv"
        )
    return load(KINDS[kind])(id=name)


def require_sound(name: str, env: Any) -> None:
    """End with what is wrong with a task that is not ours, before anything is trained on it: one of
    the user's own is checked, one of a package is opened."""
    if name.partition(":")[0] in IN_JAX:
        return  # it was opened when it was named
    if ":" in name:
        if found := problems(env):
            say("\n".join(f"- {problem}" for problem in found))
            fail(f"fix {name} before training: `credo check {name}` checks it again")
    elif name not in TASKS:
        try:
            env.copies(1)
        except EnvironmentFailure as failure:
            fail(f"cannot make the task {name!r}: {failure}")


def problems(env: Any) -> list[str]:
    """What `check_environment` finds, a sentence each. An exception of the task's own code is a
    problem too."""
    try:
        return checks.check_environment(env)
    except Exception as error:  # the task is the user's code: say where, and what often helps
        where = f" at {place(error)}" if place(error) else ""
        return [
            f"it raised {type(error).__name__}{where}: {first(error)} (everything runs inside JAX: "
            "choose with jnp.where, not `if`; methods are sample(self, *, key) and reward(self, "
            "answer, target, scored, perfect))"
        ]
