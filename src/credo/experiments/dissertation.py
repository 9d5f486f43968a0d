"""What the dissertation has of each experiment, and what to know before comparing: the texts and
numbers of `dissertation.toml`."""

import tomllib
from functools import cache
from importlib import resources
from typing import Any

from .base import Value
from .views import Notes, where


@cache
def _every() -> dict[str, Any]:
    path = resources.files("credo.experiments").joinpath("dissertation.toml")
    return tomllib.loads(path.read_text(encoding="utf-8"))


def told(name: str, *shared: str) -> dict[str, Any]:
    """The lead of an experiment's page and its published values, as `Experiment` takes them, with
    the values that it shares."""
    values = []
    for found in [_every()[x] for x in (name, *shared)]:
        common = {key: found[key] for key in ("metric", "source") if key in found}
        values += [Value(**{**common, **value}) for value in found.get("values", [])]
    return {"published": _every()[name]["published"], "values": values}


def notes(*names: str) -> Notes:
    """How to read a page: the notes of these names, one after the other."""
    every = [note for name in names for note in _every()[name].get("notes", ())]
    return Notes([x if isinstance(x, str) else where(x["text"], **x["labels"]) for x in every])
