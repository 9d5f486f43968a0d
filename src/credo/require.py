"""Checks of arguments: each says what was given and what is allowed."""

from collections.abc import Iterable
from typing import Any


def choice(name: str, value: str, allowed: Iterable[str]) -> None:
    """Raise unless `value` is one of `allowed`."""
    if value not in allowed:
        raise ValueError(f"{name} is {value!r}: it must be one of {', '.join(sorted(allowed))}")


def at_least(name: str, value: Any, minimum: float) -> None:
    """Raise if `value` is a number below `minimum`. Arrays pass: they may be traced."""
    if isinstance(value, int | float) and not value >= minimum:
        raise ValueError(f"{name} is {value}: it must be at least {minimum}")


def within(name: str, value: Any, low: float, high: float) -> None:
    """Raise if `value` is a number outside [low, high]. Arrays pass: they may be traced."""
    if isinstance(value, int | float) and not low <= value <= high:
        raise ValueError(f"{name} is {value}: it must lie in [{low:g}, {high:g}]")


def signal(given: str | None, known: tuple[str, ...]) -> None:
    """A reward signal of the task, or None."""
    if given is not None and given not in known:
        raise ValueError(f"no reward signal {given!r}: this task has {', '.join(known)}")
