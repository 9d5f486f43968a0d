"""Values as they are typed, by the types of what they are for; tyro reads them."""

import ast
import contextlib
import inspect
import io
import pathlib
import re
import types
import typing
from collections.abc import Iterator
from typing import Any, Literal

from .names import fail

TYPED = (int, float, bool, str, types.NoneType, pathlib.Path, tuple, Literal, ...)
SECONDS = {"": 1, "s": 1, "m": 60, "h": 3600}
TIMES = ("wall-clock", "checkpoint-every")


def leaves(kind: Any) -> Iterator[Any]:
    """The types in a type, and `tuple`, `dict` and `Literal` for containers and choices."""
    origin = typing.get_origin(kind)
    if origin in (None, tuple, dict, Literal):
        yield origin or kind
    for inside in () if origin is Literal else typing.get_args(kind):
        yield from leaves(inside)


def typed(kind: Any) -> bool:
    """Whether values of a type can be typed: numbers, words, yes or no, paths, choices, tuples of
    these, and settings by name."""
    return dict in leaves(kind) or all(k in TYPED for k in leaves(kind))


def read(name: str, kind: Any, words: list[str], old: Any, rest: list[str]) -> Any:
    """What was typed for the flag `name`. Settings by name are added to `old` ones; what stands
    behind a flag that alone says yes goes to `rest`. Ends the command if it cannot be read."""
    inside = set(leaves(kind))
    if dict in inside:
        return (old or {}) | pairs(name, words)
    if kind is bool and words[:1] not in (["True"], ["False"]):
        rest += words
        return True
    if int in inside and float not in inside:
        words = [word.removesuffix(".0") for word in words]  # 1e6 in a file
    if tuple in inside:
        words = ",".join(words).split(",") if str in inside and words else split(words)
    elif str in inside and len(words) == 1:
        return None if words == ["None"] and types.NoneType in inside else words[0]
    return _by_type(name, kind, [seconds(name, w) for w in words] if name in TIMES else words)


def _by_type(name: str, kind: Any, words: list[str]) -> Any:
    """The value of a plain type, of a tuple of them, or one of a Literal."""
    import tyro

    try:
        with contextlib.redirect_stderr(io.StringIO()):
            config = (tyro.conf.FlagConversionOff,)
            return tyro.cli(kind, args=words, console_outputs=False, config=config)
    except SystemExit:
        if len(words) == 1 and typing.get_origin(kind) is Literal:
            fail(f"no {name} {words[0]!r}", words[0], typing.get_args(kind))
        told = f"is {' '.join(words)!r}" if words else "needs a value"
        fail(f"--{name} {told}: it must be {in_words(kind)}")


NOUNS = {int: "a whole number", float: "a number", bool: "True or False", types.NoneType: "None"}


def in_words(kind: Any) -> str:
    """A type, for people: `whole numbers with commas between, or None`."""
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        return ", or ".join(in_words(part) for part in inside)
    if origin is tuple:
        each = {in_words(part) for part in inside if part is not ...}
        what = " or ".join(sorted(each)).replace("a whole number", "whole numbers")
        what = re.sub(r"\ba number\b", "numbers", what)
        length = "" if ... in inside else f" ({len(inside)} of them)"
        return f"{what}{length} with commas between"
    return NOUNS.get(kind) or inspect.formatannotation(kind)


def plain(token: str) -> str:
    """`1e6` is a valid integer, `1000000`; anything else stays as it is."""
    whole = re.fullmatch(r"\d+(\.\d+)?e\+?\d+", token) and float(token).is_integer()
    return str(int(float(token))) if whole else token


def split(values: list[str]) -> list[str]:
    """`64,64`, `64 64` and `(64, 64)` are two values."""
    return [word for word in re.split(r"[\s,()]+", " ".join(values)) if word]


def pairs(flag: str, values: list[str]) -> dict[str, Any]:
    """`size=8 slippery=False`, or `size 8 slippery False`, by name, with values as `literal` reads
    them. Ends the command if a name is none or has no value."""
    rest, found = list(values), {}
    if not rest:
        fail(f"--{flag} needs settings: --{flag} NAME=VALUE …")
    while rest:
        key, equals, value = rest.pop(0).partition("=")
        if not re.fullmatch(r"[^\W\d][\w.-]*", key):
            fail(f"--{flag}: {key + equals + value!r} is no setting: write NAME=VALUE")
        if not equals and not rest:
            fail(f"--{flag}: {key} has no value: write {key}=VALUE")
        found[key.replace("-", "_")] = literal(value if equals else rest.pop(0))
    return found


def literal(text: str) -> Any:
    """`8`, `0.5`, `False`, `None`, `(1, 2)` and `'8'` as in Python; anything else is a string."""
    try:
        return ast.literal_eval(plain(text))
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return text


def seconds(flag: str, text: str) -> str:
    """`90s`, `30m` or `2h` in seconds; a number without a letter is in seconds already."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh]?)", text)
    if match is None and text not in ("None", "nan"):
        fail(f"--{flag} is {text!r}: write seconds, minutes or hours as 90s, 30m or 2h")
    return str(float(match[1]) * SECONDS[match[2]]) if match else text
