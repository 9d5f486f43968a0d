"""The arguments of a command, and the objects that are made with them.

Every field of an object, and of the objects inside it, is a flag: `--learners.0.gamma 0.9`. A field
that holds one of a family takes its word (`--manager ucb`), and has the flags of what was chosen.
Short names (`--gamma`) stand for all fields that mean the same. tyro reads values by their types,
and shows them. Nothing here imports JAX.
"""

import contextlib
import dataclasses
import fnmatch
import io
import pathlib
import re
import textwrap
import types
import typing
from collections.abc import Iterable, Iterator
from typing import Any, Literal, NamedTuple

from .. import fields
from .families import family_of, leaves
from .names import CATALOGUE, fail
from .values import pairs, plain, seconds, split

TOKEN = re.compile(r"--([^\W\d][^=]*)(?:=(.*))?", re.DOTALL)
LETTERS = {"-h": "--help", "-o": "--output"}
OPEN = re.compile(r"((env|options)\.)+")  # fields of these need no prefix
CHOSEN = ("env", "network", "options")  # by words and flags of the command
TYPED = (int, float, bool, str, types.NoneType, pathlib.Path, tuple, Literal, ...)

WORDS = {int: "a whole number", float: "a number", bool: "True or False", types.NoneType: "None"}


class Flag(NamedTuple):
    """A field that can be typed."""

    name: str  # without dashes
    path: str  # where it is
    kind: Any
    value: Any
    text: str

    @property
    def group(self) -> str:
        """The object that it is a field of."""
        return self.path.rpartition(".")[0]

    def help(self, text: str) -> str:
        """A line or more about it: what it is, what can be typed, and what holds if nothing is."""
        choices = typing.get_args(self.kind) if typing.get_origin(self.kind) is Literal else ()
        value = ",".join(map(str, self.value)) if isinstance(self.value, tuple) else self.value
        told = " ".join(filter(None, (text, f"({', '.join(map(str, choices))})" * bool(choices))))
        lines = textwrap.wrap(f"{told} [{value}]", 72)
        return f"  --{self.name:<22} " + f"\n{' ' * 27}".join(lines)


class Line:
    """Words, then flags with their values."""

    def __init__(self, command: str, argv: Iterable[str]):
        self.prog, self.words, self.help, self.text = f"credo {command}", [], "", ""
        self.given: list[tuple[str, list[str]]] = []
        self.filed: list[tuple[str, list[str]]] = []  # as if they were typed before
        self.flags: dict[str, Flag] = {}  # by path: all that can be typed
        self.used, self.skipped, self.reserved = set(), set(), set()
        values = self.words
        for token in argv:
            match = TOKEN.fullmatch(LETTERS.get(token, token))
            if match and match[1] in ("help", "help-all"):
                self.help = match[1]
            elif match:
                values = [] if match[2] is None else [plain(match[2])]
                self.given.append((match[1].replace("_", "-"), values))
            else:
                values.append(plain(token))

    def command(self, cls: type) -> Any:
        """The command: fields that are not keyword-only are words, the others flags."""
        words = [f for f in dataclasses.fields(cls) if not f.kw_only]
        needed = [f for f in words if f.default is dataclasses.MISSING]
        names = [f.name.upper() if f in needed else f"[{f.name.upper()}]" for f in words]
        self.prog, self.text = " ".join((self.prog, *names)), " ".join((cls.__doc__ or "").split())
        self.skipped = {f.name for f in words}
        try:
            command = self.take(cls(*[None] * len(needed)))
        except ValueError as error:  # it begins with the name of an option
            fail(re.sub(r"^\w+", lambda m: "--" + m[0].replace("_", "-"), str(error)))
        self.skipped = set()
        if len(self.words) < len(needed):
            self.show()
            raise SystemExit(0 if self.help else 2)
        many = words and tuple in leaves(typing.get_type_hints(cls)[words[-1].name])
        if len(self.words) > len(words) and not many:
            most = "one word" if len(words) == 1 else f"{len(words)} words"
            fail(f"{self.prog} takes {most}, and {self.words[len(words)]!r} is another")
        placed = {f.name: word for f, word in zip(words, self.words, strict=False)}
        placed |= {words[-1].name: tuple(self.words[len(words) - 1 :])} if many else {}
        return dataclasses.replace(command, **placed)

    def take(self, value: Any, path: str = "") -> Any:
        """`value` with what the flags say of its fields, and of the objects inside it. Raises what
        they raise about the values."""
        kinds, texts, new = _kinds(type(value)), fields.texts(type(value)), {}
        if not path:
            self.reserved |= {f.name.replace("_", "-") for f in dataclasses.fields(value)}
        for f in dataclasses.fields(value):
            at, here, kind = path + f.name, getattr(value, f.name), kinds.get(f.name, Any)
            if not f.init or f.name in self.skipped:
                continue
            family = None if f.name in CHOSEN else family_of(kind)
            if family:
                kind, shown = Literal[(*family.words,)], family.word(here)  # pyright: ignore
                flag = Flag(self._name(at), at, kind, shown, texts.get(f.name, ""))
                for words in self._given(flag):
                    here = family.chosen(flag.name, split(words), here)
            elif all(k in TYPED for k in leaves(kind)) or dict in leaves(kind):
                flag = Flag(self._name(at), at, kind, here, texts.get(f.name, ""))
                for words in self._given(flag):
                    here = self._read(flag, words, here)
            new[f.name] = self._inside(here, at)
        new = {name: x for name, x in new.items() if x is not getattr(value, name)}
        return dataclasses.replace(value, **new) if new else value

    def _inside(self, value: Any, at: str) -> Any:
        if isinstance(value, tuple) and any(map(dataclasses.is_dataclass, value)):
            made = tuple(self.take(one, f"{at}.{i}.") for i, one in enumerate(value))
            return made if any(a is not b for a, b in zip(made, value, strict=True)) else value
        return self.take(value, f"{at}.") if dataclasses.is_dataclass(value) else value

    def _name(self, path: str) -> str:
        full = path.rstrip("_").replace("_", "-")
        bare = OPEN.sub("", full)
        return full if path.startswith("env.") and bare in self.reserved else bare

    def _given(self, flag: Flag) -> Iterator[list[str]]:
        """The values that were typed for a field: of a file first, short names before full ones."""
        self.flags[flag.path] = flag
        self.reserved |= set() if flag.path.startswith("env.") else {flag.name}
        exact = {flag.name, flag.path.replace("_", "-")}
        for given in (self.filed, self.given):
            for names in (shorts(flag.path), exact):
                for name, values in given:
                    key = name.removeprefix(f"{flag.name}.")
                    if name in names or (key != name and dict in leaves(flag.kind)):
                        self.used.add(name)
                        yield values if name in names else [key, *values]

    def _read(self, flag: Flag, words: list[str], here: Any) -> Any:
        """The value of a field by its type."""
        if dict in leaves(flag.kind):
            return (here or {}) | pairs(flag.name, words)
        if flag.kind is bool and words[:1] not in (["True"], ["False"]):
            self.words += words  # a flag alone says yes
            return True
        if flag.name in ("wall-clock", "checkpoint-every"):
            words = [seconds(flag.name, word) for word in words]
        return read(flag, split(words) if tuple in leaves(flag.kind) else words)

    def done(self) -> None:
        """All flags are known: show them if that was asked, and complain of any other."""
        if self.help:
            self.show()
            raise SystemExit(0)
        known = {flag.name: flag for flag in self.flags.values()} | self._shorts()
        for name in [name for name, _ in self.filed + self.given if name not in self.used]:
            meant = CATALOGUE["meant"].get(name, "")
            if meant in known or " " in meant:
                fail(f"no flag '--{name}': {meant if ' ' in meant else f'it is called --{meant}'}")
            more = {f"--{other}" for other in known}
            fail(f"no flag '--{name}': see {self.prog} --help-all", f"--{name}", more=more)

    def _shorts(self) -> dict[str, Flag]:
        """Short names, as flags that stand for several."""
        found: dict[str, Flag] = {}
        for flag in self.flags.values():
            for name in shorts(flag.path):
                found.setdefault(name, flag._replace(name=name, path=""))
        return found

    def show(self) -> None:
        """Help: the flags that people use, or with --help-all every field by its object."""
        print(f"usage: {self.prog} [flags]\n\n{textwrap.fill(self.text, 98)}\n")
        flags = {flag.name: flag for flag in self.flags.values()}
        known, first = self._shorts() | flags, CATALOGUE["screen"]["first"]
        if self.help == "help-all" or len(known) < 20:
            for title in dict.fromkeys(flag.group for flag in known.values()):
                print(*[f"\n{title}"] * (title not in ("", "options")))
                print(*[f.help(f.text) for f in known.values() if f.group == title], sep="\n")
        else:
            for flag in [known[name] for name in first if name in known]:
                print(flag.help(re.split(r"(?<=\w)[.:;] ", flag.text)[0]))
            print(f"\n--help-all lists every field: {len(known)} flags.")


def shorts(path: str) -> set[str]:
    """The short names that stand for a field."""
    table = CATALOGUE["short"].items()
    return {name for name, paths in table if any(fnmatch.fnmatch(path, p) for p in paths)}


def read(flag: Flag, words: list[str]) -> Any:
    """A value by its type."""
    import tyro

    if str in leaves(flag.kind) and tuple not in leaves(flag.kind) and len(words) == 1:
        return None if words == ["None"] and types.NoneType in leaves(flag.kind) else words[0]
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            config = (tyro.conf.FlagConversionOff,)
            return tyro.cli(flag.kind, args=words, console_outputs=False, config=config)
    except SystemExit:
        if len(words) == 1 and typing.get_origin(flag.kind) is Literal:
            fail(f"no {flag.name} {words[0]!r}", words[0], typing.get_args(flag.kind))
        told = f"is {' '.join(words)!r}" if words else "needs a value"
        fail(f"--{flag.name} {told}: it must be {said(flag.kind)}")


def said(kind: Any) -> str:
    """A type in words."""
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return "one of " + ", ".join(map(str, inside))
    if origin is tuple:
        return "numbers such as 64,64" if {int, float} & set(leaves(kind)) else "words"
    return " or ".join(map(said, inside)) if inside else WORDS.get(kind, "a word")


def _kinds(cls: type) -> dict[str, Any]:
    """The annotations of a class; of one whose annotations cannot be read, none."""
    try:
        return typing.get_type_hints(cls)
    except Exception:  # a name that its module knows for type checkers alone
        return {}
