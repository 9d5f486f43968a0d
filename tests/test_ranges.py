"""A range that a setting's documentation states is a range that it keeps."""

import dataclasses
import importlib
import inspect
import itertools
import pkgutil
import re

import pytest

import credo
from credo import fields
from credo.environments.double_pole import DoublePole
from credo.environments.rover import Rover
from credo.environments.sequence_recall import SequenceRecall
from credo.networks.graph import Graph
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU

BOUNDS = re.compile(r"(?<!cell )(at least|≥|above) (-?\d+(?:\.\d+)?)(?![\d/])")
INTERVAL = re.compile(r"in ([\[(])(-?[\d.]+), (-?[\d.]+)([\])])")
NO_SETTINGS = {  # what a program or a rollout holds, whose numbers are arrays
    "Descent",
    "EpsilonGreedy",
    "FleetState",
    "Normalized",
    "RoverState",
    "Shortened",
    "Trace",
}
OTHER_NUMBERS = {  # the range is of something that the field is about
    ("Choosing", "masked"),
    ("PPO", "first_std"),
    ("SequenceRecall", "unit"),
}
GIVEN = {
    "env": (SequenceRecall(depth=1), DoublePole(), Rover()),
    "network": (MLP(), MMU(), Graph()),
}


def classes() -> list[type]:
    """Of all modules but those whose libraries are not installed."""
    found = set()
    for module in pkgutil.walk_packages(credo.__path__, "credo."):
        try:
            named = vars(importlib.import_module(module.name)).values()
        except ModuleNotFoundError:
            continue
        found |= {x for x in named if inspect.isclass(x) and dataclasses.is_dataclass(x)}
    ours = (x for x in found if x.__module__.startswith("credo"))
    return sorted(ours, key=lambda x: (x.__module__, x.__name__))


def outside(text: str) -> list[float]:
    """Values that a text says a field cannot have."""
    found = []
    for word, limit in BOUNDS.findall(text):
        found.append(float(limit) - (word != "above"))
    for opens, low, high, ends in INTERVAL.findall(text):
        found.append(float(low) - (opens == "[") / 2)
        found.append(float(high) + (ends == "]") / 2)
    return [*found, float("nan")] if found else []


def made(cls: type):
    """With the least that it has to be given, or by one of its presets; None: not by these."""
    needed = [
        f.name
        for f in dataclasses.fields(cls)
        if f.init and f.default is f.default_factory is dataclasses.MISSING
    ]
    options = (GIVEN.get(name, (1, 0.5, "a", (1,), MLP())) for name in needed)
    tries = [
        lambda given=given: cls(**dict(zip(needed, given, strict=True)))
        for given in itertools.product(*options)
    ]
    for preset in getattr(cls, "presets", dict)().values():
        tries += [lambda env=env, preset=preset: preset(env) for env in GIVEN["env"]]
    for attempt in tries:
        try:
            return attempt()
        except (AttributeError, TypeError, ValueError):
            continue
    return None


def cases():
    for cls in classes():
        if cls.__name__ in NO_SETTINGS or cls.__name__.startswith("Abstract"):
            continue
        own = {f.name for f in dataclasses.fields(cls) if f.init}
        texts = {name: text for name, text in fields.texts(cls).items() if outside(text)}
        names = [x for x in texts if x in own and (cls.__name__, x) not in OTHER_NUMBERS]
        if names:
            yield pytest.param(cls, {name: texts[name] for name in names}, id=cls.__name__)


@pytest.mark.parametrize(("cls", "ranges"), list(cases()))
def test_what_lies_outside_is_refused_by_name(cls, ranges):
    one = made(cls)
    assert one is not None
    for name, text in ranges.items():
        now = getattr(one, name)
        for value in outside(text):
            whole = isinstance(now, int) and not isinstance(now, bool) and value == value
            given = int(value) if whole else value
            several = "tuple" in str(inspect.get_annotations(cls).get(name))
            given = (given,) * (len(now or ()) or 4) if several else given
            # A whole number that is NaN is of another type.
            with pytest.raises((ValueError, TypeError), match=name.rstrip("s")):
                dataclasses.replace(one, **{name: given})
