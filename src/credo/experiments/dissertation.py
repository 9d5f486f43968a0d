"""What the dissertation has of each experiment, and what to know before comparing: the texts and
numbers of `dissertation.toml`."""

import tomllib
from functools import cache
from importlib import resources
from typing import Any

from ..report.sections import Text
from .base import Value


@cache
def _every() -> dict[str, Any]:
    path = resources.files("credo.experiments").joinpath("dissertation.toml")
    return tomllib.loads(path.read_text(encoding="utf-8"))


def told(name: str) -> dict[str, Any]:
    """The lead of an experiment's page and its published values, as `Experiment` takes them."""
    found = _every()[name]
    common = {key: found[key] for key in ("metric", "source") if key in found}
    values = [Value(**{**common, **value}) for value in found.get("values", [])]
    return {"published": found["published"], "values": values}


def notes(*names: str) -> Text:
    """How to read a page: the notes of these names, one after the other."""
    return Text("How to read it", [text for name in names for text in _every()[name]["notes"]])
