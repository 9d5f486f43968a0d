"""A run's config.json: read, checked and written in one place.

    algorithm   the object tree, as `config.to_tree` records it
    seed        everything random follows from it
    budget      limits of generations, frames and score
    options     how it was run at the start (`RunOptions`); nothing that is learned follows from it
    machine     versions, processor, cores, device and system at the start
    task        sizes and actions of the task at the start, and the folder it was found from
    warm_start  the run whose champion this one started from
    changes     what was changed on the way: budgets, settings
    resumable   false if a class was defined in a notebook
    signature   of the user who made it (see `trust`)
    sha256      of all the others: it finds what was changed by hand or by a disk

Older versions wrote algorithm, seed, budget, machine and warm_start alone.
"""

import json
import os
import pathlib
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from . import files, trust

NAME = "config.json"
SIZES = {
    "obs_size": "numbers in an observation",
    "action_size": "numbers in an action",
    "agents": "agents of a team",
}
CLASS = re.compile(r"[^\W\d]\w*(\.\w+)*:[^\W\d]\w*")


class RunError(RuntimeError):
    """A run that cannot start, go on or be read; the message says what to do."""


class Record(dict[str, Any]):
    """What config.json says. A name that is asked for and not there is a damaged file."""

    path: pathlib.Path

    def __missing__(self, name: str):
        raise RunError(f"{self.path} is damaged: it has no {name!r}; restore it from a copy")


def read(folder: pathlib.Path) -> Record:
    """The record of the run in `folder`. Raises `RunError`, which names the file."""
    path = folder / NAME
    if not os.path.lexists(path):
        raise RunError(
            f"{folder} is not a run: it has no {NAME}; name a folder that `credo train` made"
        )
    record = Record(_parsed(path))
    record.path = path
    _check(record)
    if record.get(trust.CHECKSUM, _checksum(record)) != _checksum(record):
        raise RunError(
            f"{path} was changed after Credo wrote it (its checksum says so): restore it from a "
            "copy. The settings of a run are changed by `credo resume RUN --set NAME=VALUE`, its "
            "budget by --generations and --frames"
        )
    return record


def _parsed(path: pathlib.Path) -> dict[str, Any]:
    """What is in the file, as JSON."""
    try:
        content = json.loads(files.read_text(path))
    except OSError as error:
        raise RunError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        told = str(error) if str(path) in str(error) else f"{path} is damaged: {error}"
        raise RunError(f"{told}; restore it from a copy") from error
    if not isinstance(content, dict):
        raise RunError(f"{path} is damaged: it is no JSON object; restore it from a copy")
    return content


def _check(record: Record) -> None:
    """Raise `RunError` if a field is unknown or of a wrong kind."""
    if unknown := sorted(set(record) - set(FIELDS)):
        # A checksum under another name would protect nothing.
        raise RunError(
            f"{record.path} has an entry {unknown[0]!r}, which this version of Credo does not "
            "write: restore it from a copy if it is damaged, or install the newer version that "
            "made it"
        )
    for name, (right, what) in FIELDS.items():
        if name in record and not right(record[name]):
            raise RunError(
                f"{record.path} is damaged: {name!r} is {_brief(record[name])}: it must be {what}; "
                "restore it from a copy"
            )


def write(folder: pathlib.Path, record: dict[str, Any], *, sign: bool = True) -> None:
    """Write config.json, with a checksum and, unless a record of others was changed, with this
    user's signature."""
    said = {k: v for k, v in record.items() if k not in (trust.CHECKSUM, trust.SIGNATURE)}
    if sign and (signature := trust.sign(said)):
        said |= {trust.SIGNATURE: signature}
    files.write_json(folder / NAME, said | {trust.CHECKSUM: _checksum(said)})


def stranger(record: Mapping[str, Any], sealed: Any) -> str | None:
    """How a champion or checkpoint with this seal (`trust.seal`) is not of this run, in words; None
    if it is, or was written by a version that sealed nothing."""
    if not isinstance(sealed, Mapping):
        return None
    ours = trust.seal(record)
    if sealed.get("seed") != ours["seed"]:
        return (
            f"it was written for a run with seed {sealed.get('seed')}, this one has {ours['seed']}"
        )
    before = [change.get("before") for change in record.get("changes", [])]
    if sealed.get("algorithm") not in [ours["algorithm"], *before]:
        return "it was written for a run with another algorithm, task or settings"
    return None


def task_of(env: Any) -> dict[str, Any]:
    """What a record says of a task: its sizes, what its actions are outside JAX, and from which
    folder it was found."""
    told: Any = None
    inner = env
    while told is None and inner is not None:  # a delayed task is still that task
        told = getattr(inner, "task_record", None)
        inner = getattr(inner, "env", None)
    told = told() if callable(told) else told
    try:
        folder = os.fsencode(os.getcwd()).decode(errors="replace")
    except OSError:  # it was removed
        folder = None
    sizes: dict[str, Any] = {name: getattr(env, name, None) for name in SIZES}
    sizes |= {"discrete": bool(getattr(env, "discrete", False))}
    return sizes | {"actions": None, "observations": None} | (told or {}) | {"folder": folder}


def check_task(record: Mapping[str, Any], env: Any) -> None:
    """Raise `RunError` if a task is not the one that a run began with: `env` has other sizes than
    were recorded. It opens a task outside JAX."""
    recorded, name = record.get("task", {}), task_name(env)
    for size, what in SIZES.items():
        if size not in recorded:
            continue
        then, now = recorded[size], getattr(env, size, None)
        if then != now:
            raise RunError(
                f"{name} has {_count(now)} {what} today and {_count(then)} when this run began: "
                "give it back what it had, or start a new run"
            )
    if "discrete" in recorded and recorded["discrete"] != bool(getattr(env, "discrete", False)):
        kinds = {False: "Box", True: "Discrete"}
        then, now = kinds[bool(recorded["discrete"])], kinds[not recorded["discrete"]]
        raise RunError(f"{name} has {now} actions today and {then} ones when this run began")


def task_name(env: Any) -> str:
    """What people call a task: its id, or its class."""
    while getattr(env, "id", None) is None and getattr(env, "env", None) is not None:
        env = env.env
    return getattr(env, "id", None) or type(env).__name__


def home(record: Mapping[str, Any]) -> str:
    """Where to go for a task that cannot be found from here, as the end of a sentence."""
    folder = record.get("task", {}).get("folder")
    here = task_of(None)["folder"]
    return f". It began in {folder}: start credo there" if folder not in (None, here) else ""


def _count(size: int | None) -> str:
    return "no" if size is None else str(size)


def _checksum(content: dict[str, Any]) -> str:
    return trust.short({k: v for k, v in content.items() if k != trust.CHECKSUM})


def _brief(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:60] + "…"


# What each field must be.

Test = Callable[[Any], bool]


def _is(*kinds: type) -> Test:
    return lambda value: isinstance(value, kinds) and (bool in kinds or not isinstance(value, bool))


def _whole(least: int, most: int = 2**63 - 1) -> Test:
    return lambda value: _is(int)(value) and least <= value <= most


def _maybe(test: Test) -> Test:
    return lambda value: value is None or test(value)


def _has(needed: Iterable[str] = (), /, **tests: Test) -> Test:
    """An object with the needed entries; each that is tested passes, where it is there."""
    return lambda value: (
        isinstance(value, dict)
        and set(needed) <= set(value)
        and all(test(value[name]) for name, test in tests.items() if name in value)
    )


def _object(**tests: Test) -> Test:
    named: dict[str, Test] = {"class": lambda value: CLASS.fullmatch(str(value)) is not None}
    return _has(("class", *tests), **named, **tests)


def _is_budget(value: Any) -> bool:
    limits: dict[str, Test] = {"generations": _maybe(_whole(1)), "frames": _maybe(_whole(1))}
    right = _has(**limits, stop_at=_maybe(_is(int, float)))(value)
    known = right and not set(value) - {*limits, "stop_at"}
    return known and any(value.get(name) is not None for name in limits)


SIZE, TEXT = _maybe(_whole(0, 2**31)), _is(str)
MACHINE: dict[str, Test] = {
    "versions": lambda value: isinstance(value, dict) and all(map(TEXT, value.values())),
    "cores": _whole(0, 2**31),
    **dict.fromkeys(("processor", "device", "system"), TEXT),
}
CHANGE = _has(("generation",), generation=_whole(0))


def _is_changes(value: Any) -> bool:
    return isinstance(value, list) and all(map(CHANGE, value))


def _is_hash(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch("[0-9a-f]+", value) is not None


FIELDS: dict[str, tuple[Test, str]] = {
    "algorithm": (_object(env=_object()), 'an object with "class" and "env"'),
    # Older versions took seeds that JAX cuts to 32 bits.
    "seed": (_whole(-(2**63)), "a whole number"),
    "budget": (_is_budget, "generations and frames, whole numbers of at least 1, and stop_at"),
    "options": (_has(), "an object"),
    "machine": (_has(**MACHINE), "versions, processor, cores, device and system"),
    "task": (
        _has(**dict.fromkeys(SIZES, SIZE), folder=_maybe(TEXT)),
        "the sizes of the task and the folder it was found from",
    ),
    "warm_start": (TEXT, "the path of a run"),
    "changes": (_is_changes, "a list of objects, each with a generation"),
    "resumable": (_is(bool), "true or false"),
    trust.CHECKSUM: (_is_hash, "a number in hexadecimal digits"),
    trust.SIGNATURE: (_is_hash, "a number in hexadecimal digits"),
}
