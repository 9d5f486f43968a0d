"""The arguments of a command, and the objects that are made with them.

Every field of an object, and of the objects inside it, is a flag: `--learners.0.gamma 0.9`. A field
that holds one of a family takes its word (`--manager ucb`), and has the flags of what was chosen.
Short names (`--gamma`) stand for all fields that mean the same. Nothing here imports JAX.
"""

import dataclasses
import fnmatch
import re
import textwrap
import typing
from collections.abc import Iterable, Iterator
from typing import Any, Literal, NamedTuple

from .. import fields
from .families import family_of
from .names import CATALOGUE, fail
from .values import leaves, plain, read, split, typed

TOKEN = re.compile(r"--([^\W\d][^=]*)(?:=(.*))?", re.DOTALL)
LETTERS = {"-h": "--help", "-o": "--output"}
OPEN = re.compile(r"((env|options|place|breeder)\.)+")  # fields of these need no prefix
CHOSEN = ("env", "network", "options")  # by words and flags of the command


class Flag(NamedTuple):
    """A field that can be typed, or a short name of several.

    `path` leads to the field from the object that was taken, as `learners.0.critic.hidden`; `name`
    is what to type, without dashes: the path, or what is left of it where that is enough.
    """

    name: str
    path: str  # "" of a short name
    kind: Any
    value: Any  # what holds if nothing is typed
    text: str

    def help(self, text: str) -> str:
        """Some lines about it: what it is, what can be typed, and what holds if nothing is."""
        choices = typing.get_args(self.kind) if typing.get_origin(self.kind) is Literal else ()
        told = f"{text} ({', '.join(map(str, choices))})" if choices else text
        lines = textwrap.wrap(told if self.value in ("", {}) else f"{told} [{self.shown}]", 72)
        return f"  --{self.name:<22} " + f"\n{' ' * 27}".join(lines)

    @property
    def shown(self) -> str:
        """Its value as it is typed."""
        return ",".join(map(str, self.value)) if isinstance(self.value, tuple) else str(self.value)


class Line:
    """Words, then flags with their values.

    A command takes its own fields (`command`) and those of other objects (`take`), one object after
    the other, and says when all of them are known (`done`).
    """

    def __init__(self, command: str, argv: Iterable[str]):
        self.prog, self.text, self.words, self.help = f"credo {command}", "", [], ""
        self.given: list[tuple[str, list[str]]] = []
        self.filed: list[tuple[str, list[str]]] = []  # of a file, as if they were typed before
        self.flags: dict[str, Flag] = {}  # by path: all that can be typed
        self.used: set[str] = set()  # names of `given` and `filed` that some field took
        self.skipped: set[str] = set()  # fields that are no flags
        self.reserved: set[str] = set()  # names that a field of the task cannot have: it is `env.…`
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
        """The command: fields that are not keyword-only are words, the others flags. Ends with help
        if a word is missing, and with what is wrong if there are too many or a value cannot be."""
        words = [f for f in dataclasses.fields(cls) if not f.kw_only]
        needed = sum(f.default is dataclasses.MISSING for f in words)
        names = [f"[{f.name.upper()}]" if f.default is None else f.name.upper() for f in words]
        self.prog = " ".join((self.prog, *self.words, *names[len(self.words) :]))
        self.text = " ".join((cls.__doc__ or "").split())
        self.skipped = {f.name for f in words}
        try:
            command = self.take(cls(*[None] * needed))
        except ValueError as error:  # it begins with the name of an option
            fail(re.sub(r"^\w+", lambda m: "--" + m[0].replace("_", "-"), str(error)))
        self.skipped = set()
        if len(self.words) < needed:
            self.end()
        return dataclasses.replace(command, **self._placed([f.name for f in words], _kinds(cls)))

    def _placed(self, names: list[str], kinds: dict[str, Any]) -> dict[str, Any]:
        """The words, by the names of their fields; a last one that is a tuple takes the rest."""
        placed: dict[str, Any] = dict(zip(names, self.words, strict=False))
        if tuple in leaves(kinds[names[-1]]):
            placed[names[-1]] = tuple(self.words[len(names) - 1 :])
        elif len(self.words) > len(names):
            most = "one word" if len(names) == 1 else f"{len(names)} words"
            fail(f"{self.prog} takes {most}, and {self.words[len(names)]!r} is another")
        return placed

    def take(self, value: Any, path: str = "") -> Any:
        """`value` with what the flags say of its fields, and of the objects inside it.

        `path`: what stands before the names of its fields, such as `env.`. Raises what the object
        raises about its values. An object that no flag changes is returned as it is.
        """
        kinds, texts, new = _kinds(type(value)), fields.texts(type(value)), {}
        if not path:
            self.reserved |= {f.name.replace("_", "-") for f in dataclasses.fields(value)}
        for f in dataclasses.fields(value):
            if not f.init or f.name in self.skipped:
                continue
            at, here, kind = path + f.name, getattr(value, f.name), kinds.get(f.name, Any)
            text = texts.get(f.name, "")
            if f.name not in CHOSEN and (family := family_of(kind)):
                kind = Literal[(*family.makers,)]  # pyright: ignore[reportInvalidTypeForm]
                for words in self._given(at, kind, family.word(here), text):
                    here = family.chosen(f.name, split(words), here)
            elif typed(kind):
                for words in self._given(at, kind, here, text):
                    here = read(self.flags[at].name, kind, words, here, self.words)
            here = self.inside(here, at)
            new |= {f.name: here} if here is not getattr(value, f.name) else {}
        return dataclasses.replace(value, **new) if new else value

    def inside(self, value: Any, at: str) -> Any:
        """What a field holds, with what the flags say of the objects in it."""
        if isinstance(value, tuple) and any(map(dataclasses.is_dataclass, value)):
            made = tuple(self.take(one, f"{at}.{i}.") for i, one in enumerate(value))
            return made if any(a is not b for a, b in zip(made, value, strict=True)) else value
        inner: str = getattr(type(value), "flags_of", "")
        if inner:  # it stands for what is within; files of before name it as well
            self._rename(f"{at}.{inner}.", f"{at}.", value, inner)
            new = self.inside(getattr(value, inner), at)
            same = new is getattr(value, inner)
            return value if same else dataclasses.replace(typing.cast(Any, value), **{inner: new})
        return self.take(value, f"{at}.") if dataclasses.is_dataclass(value) else value

    def _rename(self, old: str, new: str, value: Any, inner: str) -> None:
        """Of a file the names that begin with `old`; what only the object around has is derived."""
        of = {f.name for f in dataclasses.fields(value)} - {inner}
        self.used |= {f"{new}{name}" for name in of}
        if not hasattr(getattr(value, inner), inner):
            self.filed = [
                (new + name.removeprefix(old) if name.startswith(old) else name, values)
                for name, values in self.filed
            ]

    def _given(self, at: str, kind: Any, value: Any, text: str) -> Iterator[list[str]]:
        """The values that were typed for a field: of a file first, short names before full ones."""
        full = at.rstrip("_").replace("_", "-")
        name, task = OPEN.sub("", full), at.startswith("env.")
        name = full if task and name in self.reserved else name
        self.reserved |= set() if task else {name}
        self.flags.pop(at, None)  # an object may be taken twice: its last place counts
        self.flags[at] = Flag(name, at, kind, value, text)
        for given in (self.filed, self.given):
            for names in (shorts(at), {name, full}):
                for other, values in given:
                    key = other.removeprefix(f"{name}.")
                    if other in names or (key != other and dict in leaves(kind)):
                        self.used.add(other)
                        yield values if other in names else [key, *values]

    def known(self) -> dict[str, Flag]:
        """All flags by name; a short name stands for several, and shows the defaults of all."""
        found = {}
        for name, (text, *_) in CATALOGUE["short"].items():
            if flags := [flag for flag in self.flags.values() if name in shorts(flag.path)]:
                found[name] = Flag(name, "", flags[0].kind, _defaults(flags), text)
        return found | {flag.name: flag for flag in self.flags.values()}

    def done(self) -> None:
        """All flags are known: end with help if that was asked for, and with what was meant if
        there is no flag of some name."""
        if self.help:
            self.end()
        known = self.known()
        for name in [name for name, _ in self.filed + self.given if name not in self.used]:
            meant = CATALOGUE["meant"].get(name, "")
            if meant in known or " " in meant:
                fail(f"no flag '--{name}': {meant if ' ' in meant else f'it is called --{meant}'}")
            more = {f"--{other}" for other in known}
            fail(f"no flag '--{name}': see {self.prog} --help-all", f"--{name}", more=more)

    def end(self) -> typing.NoReturn:
        """End with help: the flags that people use, or with --help-all every field, by the object
        that it is of. Exit code 2 if help was not asked for."""
        print(f"usage: {self.prog} [flags]\n\n{textwrap.fill(self.text, 98)}\n")
        known, groups = self.known(), {}
        if self.help == "help-all" or len(known) < 20:
            for flag in known.values():
                groups.setdefault(flag.path.rpartition(".")[0], []).append(flag.help(flag.text))
            for title, texts in groups.items():
                head = [] if title in ("", "options", "place") else [f"\n{title}"]
                print(*head, *texts, sep="\n")
        else:
            for flag in [known[name] for name in CATALOGUE["screen"]["first"] if name in known]:
                print(flag.help(re.split(r"(?<=[\w`)\]])(?<!^\w)[.:;] ", flag.text)[0]))
            print("\n--help-all lists every field.")
        raise SystemExit(0 if self.help else 2)


def shorts(path: str) -> set[str]:
    """The short names that stand for a field: those with a pattern of its path in the catalogue."""
    table = CATALOGUE["short"].items()
    return {name for name, (_, *paths) in table if any(fnmatch.fnmatch(path, p) for p in paths)}


def _defaults(flags: list[Flag]) -> str:
    """What holds for the fields of a short name: one value, or several with the names of the fields
    where these differ, as in `actor-lr 5e-05, critic-lr 0.0005`."""
    lasts = [flag.name.rpartition(".")[2] for flag in flags]
    values = list(dict.fromkeys(flag.shown for flag in flags))
    if len(values) == 1 or len(set(lasts)) == 1:
        return " or ".join(values)
    named = (f"{last} {flag.shown}" for last, flag in zip(lasts, flags, strict=True))
    return ", ".join(dict.fromkeys(named))


def _kinds(cls: type) -> dict[str, Any]:
    """The annotations of a class; of one whose annotations cannot be read, none."""
    try:
        return typing.get_type_hints(cls)
    except Exception:  # a name that its module knows for type checkers alone
        return {}
