"""Families: what can stand in a field that holds an object, such as a manager or a critic.

A member is chosen by its word in the catalogue, `--manager ucb`, or as a class of the user's,
`--manager mine:Manager`; in a field that holds several, `--learners td3,sac`.
"""

import dataclasses
import itertools
import types
from typing import Any, NamedTuple

from .names import CATALOGUE, fail, load, of_user
from .values import leaves


class Family(NamedTuple):
    """What a field can hold, and the words for it."""

    makers: dict[str, str]
    """Where the class or function is that makes one; "" of `none`, if the field may be empty."""
    bases: tuple[type, ...]
    """What a class of the user's must be derived from."""
    many: bool
    """The field is a tuple of them."""

    def word(self, value: Any) -> str:
        """The word for what stands there; of what has no word, the name of its class. Of no member
        it is none, or nothing where `none` is the word of a member."""
        if isinstance(value, tuple):
            return ",".join(map(self.word, value)) or ("" if self.makers.get("none") else "none")
        words = {path: word for word, path in self.makers.items()}
        return "none" if value is None else words.get(_path(type(value)), type(value).__name__)

    def chosen(self, flag: str, words: list[str], old: Any) -> Any:
        """What the words name; a member of the same class that is there already stays as it is,
        with its settings. A word may name a class of the user's, as package.module:Class."""
        words = [] if words in (["none"], ["None"]) and not self.makers.get("none") else words
        there = old if self.many else (old,)
        pairs = itertools.zip_longest(words, there[: len(words)])
        made = tuple(self._one(flag, word, before) for word, before in pairs)
        return made if self.many else (*made, None)[0]

    def _one(self, flag: str, word: str, old: Any) -> Any:
        if ":" in word:  # named on this command line, so it may be imported
            maker = of_user(word)
            if not (isinstance(maker, type) and issubclass(maker, self.bases)):
                fail(f"{word} is no {' or '.join(base.__name__ for base in self.bases)}")
        elif not self.makers.get(word):
            fail(f"no {flag} {word!r}", word, self.makers)
        else:
            maker = load(self.makers[word])
        return old if maker is type(old) else of_user(word, maker)


def family_of(kind: Any) -> Family | None:
    """The family of a field's type: what the catalogue lists for its classes, and of one that it
    does not list the class itself. None where there is nothing to choose."""
    kinds = list(leaves(kind))
    bases = tuple(k for k in kinds if isinstance(k, type) and dataclasses.is_dataclass(k))
    makers: dict[str, str] = {}  # a copy: the catalogue stays as it is
    for base in bases:
        abstract = base.__name__.startswith("Abstract")
        own = {} if abstract else {base.__name__.lower(): _path(base)}
        makers |= CATALOGUE["families"].get(base.__name__, own)
    if makers and (tuple in kinds or types.NoneType in kinds):
        makers.setdefault("none", "")
    return Family(makers, bases, tuple in kinds) if len(makers) > 1 else None


def _path(cls: type) -> str:
    return f"{cls.__module__.removeprefix('credo.')}:{cls.__name__}"
