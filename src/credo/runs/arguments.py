"""What the command line makes of its words: flags for the fields of objects, and complaints.

Nothing here imports JAX.
"""

import ast
import dataclasses
import difflib
import math
import re
import warnings
from collections.abc import Iterable
from typing import Annotated, Any, NoReturn

from .ending import say

SEEDS = 2**32  # what a key of JAX is made of, and a simulator takes


def fail(
    message: str, given: str = "", known: Iterable[str] = (), more: Iterable[str] = ()
) -> NoReturn:
    """One line on what is wrong, one on what to do, exit code 2. `more`: names that may have been
    meant, but are too many to be listed."""
    say(f"credo: {message}")
    known = list(known)
    close = difflib.get_close_matches(given, [*known, *more], n=1, cutoff=0.5)
    if close:
        say(f"       did you mean {close[0]!r}?")
    elif known:
        say(f"       choose one of: {', '.join(known)}")
    raise SystemExit(2)


def plain_integer(token: str) -> str:
    """`1e6` is a valid integer."""
    if re.fullmatch(r"\d+(\.\d+)?e\+?\d+", token) and float(token).is_integer():
        return str(int(float(token)))
    return token


def pop_option(argv: list[str], name: str, default: str, short: str = "") -> tuple[str, list[str]]:
    """Take `--name value` or `--name=value` out of the arguments."""
    rest, value, tokens = [], default, iter(argv)
    for token in tokens:
        if token == name or (short and token == short):
            value = next(tokens, "")
            if not value:
                fail(f"{name} needs a value")
        elif token.startswith(f"{name}="):
            value = token.partition("=")[2]
        else:
            rest.append(token)
    return value, rest


def pop_switch(argv: list[str], name: str) -> tuple[bool, list[str]]:
    """Take `--name` out of the arguments."""
    return name in argv, [token for token in argv if token != name]


def pop_pairs(argv: list[str], name: str) -> tuple[dict[str, Any], list[str]]:
    """Take settings by name out of the arguments: `--kwargs size=8 slippery=False`, the same as
    `--kwargs size 8 slippery False` or `--kwargs.size 8`. Values are as in `literal`."""
    rest, pairs, tokens = [], {}, list(argv)
    while tokens:
        flag, equals, value = tokens.pop(0).partition("=")
        if flag == name and not equals:
            before = len(pairs)
            while tokens and not tokens[0].startswith("--"):
                pairs.update([_pair(name, tokens)])
            if len(pairs) == before:
                fail(f"{name} needs settings: {name} NAME=VALUE …")
        elif flag == name:
            pairs.update([_pair(name, [value])])
        elif flag.startswith(f"{name}."):
            tokens[:0] = [value] if equals else []
            pairs.update([_pair(name, [flag.removeprefix(f"{name}."), *tokens[:1]])])
            del tokens[:1]
        else:
            rest.append(flag + equals + value)
    return pairs, rest


def _pair(flag: str, tokens: list[str]) -> tuple[str, Any]:
    """The next setting, taken off `tokens`: `NAME=VALUE`, or `NAME` and `VALUE`."""
    name, equals, value = tokens.pop(0).partition("=")
    if not name.isidentifier():
        fail(f"{flag}: {name + equals + value!r} is no setting: write NAME=VALUE")
    if not equals:
        if not tokens or tokens[0].startswith("--"):
            fail(f"{flag}: {name} has no value: write {name}=VALUE")
        value = tokens.pop(0)
    return name, literal(value)


def pop_changes(argv: list[str], name: str) -> tuple[dict[str, Any], list[str]]:
    """Take every `--set part.field=value` out of the arguments."""
    rest, changes, tokens = [], {}, iter(argv)
    for token in tokens:
        if token != name and not token.startswith(f"{name}="):
            rest.append(token)
            continue
        change = next(tokens, "") if token == name else token.partition("=")[2]
        field, equals, value = change.partition("=")
        if not (field and equals and value):
            fail(f"{name} is {change!r}: write a field and its value, as learner.actor_lr=1e-4")
        changes[field.replace("-", "_")] = literal(value)
    return changes, rest


def literal(text: str) -> Any:
    """`8`, `0.5`, `False`, `None`, `(1, 2)` and `'8'` as in Python; anything else is a string."""
    try:
        return ast.literal_eval(plain_integer(text))
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return text


def in_range(options: Any, seeds: int = 1) -> None:
    """End if an option of a command is out of its range. `seeds`: how many count up from `seed`."""
    given = {name: x for name, x in vars(options).items() if isinstance(x, int | float)}
    for name, value in given.items():
        flag = f"--{name.replace('_', '-')}"
        if name in COUNTS and value < 1:
            fail(f"{flag} is {value}: it must be at least 1")
        if name in COUNTS and value >= 2**63:
            fail(f"{flag} is {value:g}: it must be less than 2^63")
        if name == "seed":
            last = value + max(seeds, 1) - 1
            if not 0 <= value <= last < SEEDS:
                through = f" … {last}" if last > value else ""
                fail(f"{flag} is {value}{through}: a seed must lie in 0 … {SEEDS - 1}")
        if name == "checkpoint_every" and not value >= 0:
            fail(f"{flag} is {value}: it must be at least 0 seconds")
        if name == "fps" and not 0 < value < math.inf:
            fail(f"{flag} is {value}: it must be more than 0")
        if name == "stop_at" and math.isnan(value):
            fail(f"{flag} is {value}: give the score at which to end")


COUNTS = ("generations", "frames", "seeds", "keep", "episodes", "runs", "jobs")


def seconds(text: str | None) -> float | None:
    """`90s`, `30m` or `2h`."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smh]?)", text)
    if match is None:
        fail(f"wall-clock is {text!r}: write seconds, minutes or hours as 90s, 30m or 2h")
    return float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]]


def parse(
    prog: str,
    default: Any,
    options: type,
    argv: list[str],
    *,
    flat: bool = False,
    popped: tuple[str, ...] = (),
) -> list[Any]:
    """Flags for the fields of `default` (if any) and of `options`.

    A task's own fields need no prefix (`--depth`), those of other parts do (`--network.hidden`,
    `--learners.0.gamma`). `flat`: `default` is itself a task. `popped`: flags that the caller took
    out of `argv` before; a misspelled one is still there.
    """
    import tyro

    arguments = []
    if default is not None:
        default = _with_plain_task(default)
        plain = Annotated[type(default), tyro.conf.arg(name="")]
        arguments.append(("object", plain, dataclasses.field(default=default)))
    plain = Annotated[options, tyro.conf.arg(name="")]
    arguments.append(("options", plain, dataclasses.field(default_factory=options)))
    command = dataclasses.make_dataclass("Command", arguments)
    command.__doc__ = options.__doc__
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Mutable type")
        try:
            parsed = tyro.cli(command, prog=prog, args=argv, config=(tyro.conf.FlagConversionOff,))
        except ValueError as error:
            fail(str(error))
        except SystemExit as end:
            if end.code:
                _suggest(argv, popped)
            raise
    result = [parsed.options]
    if default is not None:
        result.insert(0, _original(parsed.object))
    return result


def _suggest(argv: list[str], popped: tuple[str, ...]) -> None:
    for token in argv:
        close = difflib.get_close_matches(token.partition("=")[0], popped, n=1, cutoff=0.8)
        if token.startswith("--") and "." not in token and close:
            say(f"credo: {token}: did you mean {close[0]!r}?")


def _with_plain_task(value: Any) -> Any:
    """`value` as a class whose `env` flags have no prefix; a wrapped task's own have none too."""
    import tyro

    cls: Any = type(value)
    fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if not dataclasses.is_dataclass(fields.get("env")):
        return value
    fields["env"] = _with_plain_task(fields["env"])
    plain = Annotated[type(fields["env"]), tyro.conf.arg(name="")]
    body = {
        "__annotations__": {"env": plain},
        "__module__": cls.__module__,
        "__doc__": cls.__doc__,
        "original": staticmethod(lambda: cls),
    }
    return type(cls)(cls.__name__, (cls,), body)(**fields)


def _original(value: Any) -> Any:
    if not hasattr(value, "original"):
        return value
    fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    return value.original()(**fields | {"env": _original(fields["env"])})
