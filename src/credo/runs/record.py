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
from collections.abc import Callable, Mapping
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
    choices = {
        "choices": list(getattr(env, "choices", ())),
        "masked": getattr(env, "masked", False),
    }
    unknown = {"actions": None, "observations": None} | choices
    return _sizes(env) | unknown | (told or {}) | {"folder": folder}


def check_task(record: Mapping[str, Any], env: Any) -> None:
    """Raise `RunError` if a task is not the one that a run began with: `env` has other sizes than
    were recorded. It opens a task outside JAX."""
    recorded, today = record.get("task", {}), _sizes(env)
    for name, now in today.items():
        then = recorded.get(name, now)
        if then == now:
            continue
        if name == "discrete":
            kinds = [("Discrete" if discrete else "Box") for discrete in (now, then)]
            told = f"{kinds[0]} actions today and {kinds[1]} ones when this run began"
        else:
            counts = ["no" if size is None else size for size in (now, then)]
            told = f"{counts[0]} {SIZES[name]} today and {counts[1]} when this run began"
        raise RunError(f"{task_name(env)} has {told}: give it back what it had, or start a new run")


def _sizes(env: Any) -> dict[str, Any]:
    """Those of a task today; None for those that it has not. It opens a task outside JAX."""
    sizes: dict[str, Any] = {name: getattr(env, name, None) for name in SIZES}
    return sizes | {"discrete": bool(getattr(env, "discrete", False))}


def task_name(env: Any) -> str:
    """What people call a task: its id, or its class. Of a wrapper, that of the task inside."""
    while getattr(env, "id", None) is None and getattr(env, "env", None) is not None:
        env = env.env
    return getattr(env, "id", None) or type(env).__name__


def home(record: Mapping[str, Any]) -> str:
    """Where to go for a task that cannot be found from here, as the end of a sentence."""
    folder = record.get("task", {}).get("folder")
    here = task_of(None)["folder"]
    return f". It began in {folder}: start credo there" if folder not in (None, here) else ""


def _checksum(content: dict[str, Any]) -> str:
    """The short hash of all other fields."""
    return trust.short({k: v for k, v in content.items() if k != trust.CHECKSUM})


def _brief(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:60] + "…"


# What each field must be.


def _whole(value: Any, least: int = 0, most: int = 2**63 - 1) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _is_object(value: Any) -> bool:
    """Whether this may be an object's tree: nothing is looked up before its class has a proper
    name."""
    return isinstance(value, dict) and CLASS.fullmatch(str(value.get("class"))) is not None


def _is_algorithm(value: Any) -> bool:
    return _is_object(value) and _is_object(value.get("env"))


def _is_budget(value: Any) -> bool:
    """At least one whole limit, and nothing that is none of a budget's fields."""
    if not (isinstance(value, dict) and value.keys() <= {"generations", "frames", "stop_at"}):
        return False
    limits = [value[k] for k in ("generations", "frames") if value.get(k) is not None]
    score = isinstance(value.get("stop_at"), int | float | None)
    return score and limits != [] and all(_whole(limit, 1) for limit in limits)


def _is_machine(value: Any) -> bool:
    """Older records lack some of it."""
    if not (isinstance(value, dict) and isinstance(value.get("versions", {}), dict)):
        return False
    named = [value.get(name, "") for name in ("processor", "device", "system")]
    texts = [*named, *value.get("versions", {}).values()]
    return _whole(value.get("cores", 0)) and all(isinstance(text, str) for text in texts)


def _is_task(value: Any) -> bool:
    if not (isinstance(value, dict) and isinstance(value.get("folder"), str | None)):
        return False
    return all(value.get(name) is None or _whole(value[name], 0, 2**31) for name in SIZES)


def _is_changes(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(change, dict) and _whole(change.get("generation")) for change in value
    )


def _is_hash(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch("[0-9a-f]+", value) is not None


FIELDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "algorithm": (_is_algorithm, 'an object with "class" and "env"'),
    # Older versions took seeds that JAX cuts to 32 bits.
    "seed": (lambda value: _whole(value, -(2**63)), "a whole number"),
    "budget": (_is_budget, "generations and frames, whole numbers of at least 1, and stop_at"),
    "options": (lambda value: isinstance(value, dict), "an object"),
    "machine": (_is_machine, "versions, processor, cores, device and system"),
    "task": (_is_task, "the sizes of the task and the folder it was found from"),
    "warm_start": (lambda value: isinstance(value, str), "the path of a run"),
    "changes": (_is_changes, "a list of objects, each with a generation"),
    "resumable": (lambda value: isinstance(value, bool), "true or false"),
    trust.CHECKSUM: (_is_hash, "a number in hexadecimal digits"),
    trust.SIGNATURE: (_is_hash, "a number in hexadecimal digits"),
}
