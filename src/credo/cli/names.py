"""The catalogue of `names.toml`: every name that can be typed, what it names, and what was meant
where there is no such name. Nothing here imports JAX."""

import difflib
import importlib
import pathlib
import tomllib
from collections.abc import Callable, Iterable
from functools import reduce
from typing import Any, NoReturn

from ..runs import ending

CATALOGUE = tomllib.loads(pathlib.Path(__file__).with_suffix(".toml").read_text("utf-8"))
COMMANDS: dict[str, str] = CATALOGUE["commands"]
ALGORITHMS: dict[str, dict[str, Any]] = CATALOGUE["algorithms"]
TASKS: dict[str, dict[str, Any]] = CATALOGUE["tasks"]
NETWORKS: dict[str, dict[str, Any]] = CATALOGUE["networks"]


def load(path: str) -> Any:
    """What `module:Name` or `module:Class.attribute` below `credo` names."""
    module, _, name = path.partition(":")
    return reduce(getattr, name.split("."), importlib.import_module(f"credo.{module}"))


def fail(
    message: str, given: str = "", known: Iterable[str] = (), more: Iterable[str] = ()
) -> NoReturn:
    """End with exit code 2: one line on what is wrong, and one on what was meant.

    **Arguments:** `given`: the word that was typed. `known`: the words that can be typed; the one
    nearest to `given` is named, or all are listed. `more`: names that may have been meant, but are
    too many to be listed.
    """
    ending.say(f"credo: {message}")
    known = list(known)
    if close := difflib.get_close_matches(given, [*known, *more], cutoff=0.5):
        meant = next((name for name in close if given.startswith(name)), close[0])
        ending.say(f"       did you mean {meant!r}?")
    elif known:
        ending.say(f"       choose one of: {', '.join(known)}")
    raise SystemExit(2)


def of_user(name: str, call: Callable[[], Any] | None = None) -> Any:
    """What `call` makes of `package.module:name`, which was named on this command line; by default
    what is found there. What it raises ends the command with where that was: it is the user's own
    code, which may raise anything."""
    from ..environments.names import find

    module = repr(name.rpartition(":")[0])
    try:
        return call() if call else find(name)
    except SyntaxError as error:
        fail(f"cannot import {module} of {name}: {error.filename}:{error.lineno}: {error.msg}")
    except ImportError as error:
        fail(f"cannot import {name!r}: {error}. Start credo in the folder of its file")
    except SystemExit as error:
        ends = f"{ending.place(error)} ends Python (exit code {error.code!r})"
        fail(f"cannot import {module} of {name}: {ends}: put that under if __name__ == '__main__'")
    except Exception as error:
        place, what = ending.place(error), f"{type(error).__name__}: {ending.first(error)}"
        if place or not (isinstance(error, TypeError) and isinstance(call, type)):
            fail(f"cannot use {name}: {place or 'it'} raised {what}")
        if "abstract" in str(error):
            missing = sorted(getattr(call, "__abstractvars__", call.__abstractmethods__))
            fail(f"{name} is not complete: define {', '.join(missing)}")
        fail(f"{name} cannot be made without arguments ({error}): give every field a default")
