"""All settings of a training as TOML, a line a flag: `credo train --config run.toml`."""

import dataclasses
import json
import pathlib
import tomllib
from collections.abc import Callable, Iterator
from typing import Any

from ..environments.names import OWN_TEAMS
from .line import Line
from .names import fail

OWN = ("config", "save_config", "print_config", "trust")  # about the file itself


def add_file(line: Line) -> None:
    """The settings of the file that `--config` names, as if they were typed before the others;
    words that were typed take the place of its algorithm and task."""
    files = [values[0] for name, values in line.given if name == "config" and values]
    if not files:
        return
    said = [values for name, values in line.given if name == "trust"]
    trust = bool(said) and said[-1][:1] in ([], ["True"], ["true"])
    place(line, read(files[-1], table(files[-1], "--config "), trust=trust))


def place(line: Line, filed: list[tuple[str, list[str]]]) -> None:
    """Settings as if they were typed before all others."""
    line.filed, saved = filed, dict(filed)
    words = [*saved.get("algorithm", []), *saved.get("task", [])]
    line.words, line.used = line.words + words[len(line.words) :], {"algorithm", "task"}


def table(path: str, flag: str = "") -> dict[str, Any]:
    """What is in a TOML file. Ends the command, with the `flag` that named it, if it cannot be
    read."""
    try:
        return tomllib.loads(pathlib.Path(path).read_text("utf-8"))
    except (OSError, ValueError) as error:
        fail(f"{flag}{path}: {error}")


def read(path: str, found: dict[str, Any], *, trust: bool) -> list[tuple[str, list[str]]]:
    """The settings `found` in a file as names and values of flags, as they are typed.

    Tables may be nested: `[learner]`, `gamma = 0.9`. Whoever wrote the file is not who typed its
    name: without `trust`, what names code of others is refused, and the command ends.
    """
    flags = [
        (name, [str(x) for x in (value if isinstance(value, list) else [value])])
        for name, value in flat(found)
    ]
    for name, values in flags:
        if name.replace("-", "_") in OWN:
            fail(f"{path} sets --{name}, which is for the command line alone")
        if name in ("algorithm", "task") and len(values) != 1:
            fail(f"{path} sets {name} to {values}: give one word")
        for value in values if not trust else ():
            team = name == "task" and "." in value and not value.startswith(OWN_TEAMS)
            if team or ":" in value or "\\" in value:  # an escape may hide a colon
                told = "maybe code of others: look into it, and give --trust"
                fail(f"{path} names {value!r}, {told}")
    return flags


def flat(
    table: dict[str, Any], is_one: Callable[[Any], bool] = lambda value: False, prefix: str = ""
) -> Iterator[tuple[str, Any]]:
    """The flags of a table and of those inside it, with their values as they are in the file. A
    table may be a value itself: `is_one` says so."""
    for key, value in table.items():
        name = f"{prefix}{key}".replace("_", "-")
        if isinstance(value, dict) and not is_one(value):
            yield from flat(value, is_one, f"{name}.")
        else:
            yield name, value


def written(command: Any, algorithm: Any) -> str:
    """The settings of a command and of its algorithm, for `read`. Names that are the command's or
    the algorithm's are not the task's: its field of the same name is `env.…`."""
    told = {"algorithm": command.algorithm, "task": command.task}
    others = (command, command.options, command.place, algorithm)
    fields = [f.name for x in others for f in dataclasses.fields(x)]
    for value, empty in ((command, (None, {}, ())), (algorithm, ())):
        line = Line("train", [])
        line.reserved = {name.replace("_", "-") for name in fields} - {"rewards", "kwargs"}
        line.skipped = {"algorithm", "task", "id", *OWN}
        line.take(value)
        told |= {flag.name: flag.value for flag in line.flags.values() if flag.value not in empty}
    return "".join(f"{json.dumps(name)} = {toml(value)}\n" for name, value in told.items())


def toml(value: Any) -> str:
    """A value as TOML; `NAME=VALUE` settings are a list of such strings."""
    if isinstance(value, dict):
        value = [f"{name}={x!r}" for name, x in value.items()]
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, int | float) else json.dumps(str(value))
