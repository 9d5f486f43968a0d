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


def trainable(env: Any) -> None:
    """A task that gradient learners can be trained on: one agent, Box actions."""
    if env.agents is not None or getattr(env, "discrete", False):
        has = "Discrete actions" if env.agents is None else f"{env.agents} agents"
        raise ValueError(
            f"{getattr(env, 'id', type(env).__name__)} has {has}: learners follow the gradient of "
            "one agent's continuous actions. Evolve without a learner (credo train ea), or give a "
            "task of one agent with Box actions"
        )
