"""Values as they are typed."""

import ast
import re
from typing import Any

from .names import fail

SECONDS = {"": 1, "s": 1, "m": 60, "h": 3600}


def plain(token: str) -> str:
    """`1e6` is a valid integer."""
    whole = re.fullmatch(r"\d+(\.\d+)?e\+?\d+", token) and float(token).is_integer()
    return str(int(float(token))) if whole else token


def split(values: list[str]) -> list[str]:
    """`64,64`, `64 64` and `(64, 64)` are two values."""
    return [word for word in re.split(r"[\s,()]+", " ".join(values)) if word]


def literal(text: str) -> Any:
    """`8`, `0.5`, `False`, `None`, `(1, 2)` and `'8'` as in Python; anything else is a string."""
    try:
        return ast.literal_eval(plain(text))
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return text


def pairs(flag: str, values: list[str]) -> dict[str, Any]:
    """`size=8 slippery=False`, or `size 8 slippery False`, by name."""
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


def seconds(flag: str, text: str) -> str:
    """`90s`, `30m` or `2h` in seconds."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh]?)", text)
    if match is None and text not in ("None", "nan"):
        fail(f"--{flag} is {text!r}: write seconds, minutes or hours as 90s, 30m or 2h")
    return str(float(match[1]) * SECONDS[match[2]]) if match else text
