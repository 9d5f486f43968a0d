"""The file of a sweep: settings that are fixed, `[ranges]` of flags, and `[sweep]`, how to search.

What it says goes through the very flags of `credo train`, before anything is trained. Nothing here
imports JAX or Optuna before a file is checked.
"""

import dataclasses
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ..runs.ending import say
from ..runs.record import RunError
from ..sweep import space
from ..sweep.plan import Plan
from ..sweep.space import Drawn, Range
from . import settings, train
from .line import Flag, Line
from .names import ALGORITHMS, fail
from .values import leaves

NAME = "sweep.toml"
WHERE = "where runs are trained is for the command line alone: credo sweep FILE --on PLACE"
EACH = "the same for every trial: set it above [ranges]"
REFUSED = {  # settings of a training that a sweep sees to
    "seeds": "how many a trial has is said in [sweep]",
    "path": "where runs lie is for the sweep to say: credo sweep FILE --path FOLDER",
    "wall-clock": "what a run reaches in a time is not the same twice: give frames or generations",
} | dict.fromkeys(("on", "submit", "slurm", "ray"), WHERE)
SETTLED = {  # what cannot be drawn
    "algorithm": f"an algorithm is {EACH}",
    "task": f"a task is {EACH}",
    "seed": f"the first seed is {EACH}",
}
Filed = list[tuple[str, list[str]]]  # names and values of flags, as they are typed


class File(NamedTuple):
    """A file of a sweep, read and not yet checked.

    `fixed`: settings of a training, `ranges` of flags, `search`: what `[sweep]` says, by name; as
    they are in the file.
    """

    path: str
    fixed: dict[str, Any]
    ranges: dict[str, Any]
    search: dict[str, Any]

    @classmethod
    def read(cls, path: str) -> "File":
        """The parts of a file. Ends the command if it cannot be read."""
        found = settings.table(path)
        ranges, search = found.pop("ranges", {}), found.pop("sweep", {})
        if not (isinstance(ranges, dict) and isinstance(search, dict)):
            fail(f"{path}: ranges and sweep are tables: write [ranges] and [sweep]")
        flat = settings.flat
        return cls(path, dict(flat(found)), dict(flat(ranges, _is_range)), dict(flat(search)))

    def said(self, trust: bool) -> Filed:
        """What it says of the search, as flags. Ends the command if no search has such a field."""
        known = [field.name for field in dataclasses.fields(Plan)]
        for name in [name for name in self.search if name not in known]:
            fail(f"{self.path}: [sweep] has no {name!r}", name, known)
        return settings.read(self.path, self.search, trust=trust)

    def text(self, plan: Plan) -> str:
        """The same file, with all of a plan in it."""
        lines = []
        search = dataclasses.asdict(plan)
        for title, table in (("", self.fixed), ("\n[ranges]", self.ranges), ("\n[sweep]", search)):
            lines += [title] if title else []
            lines += [f"{json.dumps(name)} = {_toml(value)}" for name, value in table.items()]
        return "\n".join(lines) + "\n"


class Trials(NamedTuple):
    """What the trials of a checked file train: `fixed` settings, and those of `ranges`."""

    fixed: Filed
    ranges: Sequence[Range]

    def made(self, drawn: Drawn) -> tuple[train.Train, Any]:
        """The command and the algorithm of what a trial drew. Raises `ValueError` for values that
        do not go together."""
        return self._made(drawn)[1:]

    def flags(self, drawn: Drawn) -> Mapping[str, Flag]:
        """The flags that there are beside what was drawn, by their short and full names. Ends the
        command with what a flag says of a value that it cannot have."""
        line, *_ = train.or_fail(lambda: self._made(drawn))
        full = {path.rstrip("_").replace("_", "-"): flag for path, flag in line.flags.items()}
        return full | line.known()

    def _made(self, drawn: Drawn) -> tuple[Line, train.Train, Any]:
        line = Line("train", [])
        settings.place(line, self.fixed)
        line.given = [(name, [str(value)]) for name, value in drawn.items()]
        command = line.command(train.Train)
        algorithm = train.algorithm_of(line, command)
        line.done()
        return line, command, algorithm


def checked(file: File, *, trust: bool) -> Trials:
    """What trials train. Ends the command with what a flag says of a name or a value that it
    cannot have."""
    fixed = settings.read(file.path, file.fixed, trust=trust)
    for name in [name for name, _ in fixed if name in REFUSED]:
        fail(f"{file.path} sets {name}: {REFUSED[name]}")
    for name, example in (("algorithm", "td3"), ("task", "Hopper-v5")):
        if name not in dict(fixed):
            fail(f'{file.path} names no {name}: write {name} = "{example}" above [ranges]')
    word = dict(fixed)["algorithm"][0]
    if word not in ALGORITHMS:
        fail(f"no algorithm {word!r}", word, ALGORITHMS)
    if not file.ranges:
        fail(f"{file.path} has no [ranges]: a sweep needs one at least, such as {space.EXAMPLE}")
    ranges = [_range(file.path, name, value, trust) for name, value in file.ranges.items()]
    for name in [name for name in file.ranges if name in file.fixed]:
        fail(f"{file.path} sets {name}, and has a range of it: leave one of them")
    try:
        space.require_known(ranges)
    except ValueError as error:
        fail(f"{file.path}: {error}")
    return Trials(fixed, _fitted(file.path, Trials(fixed, ranges)))


def settle(folder: pathlib.Path, file: File, plan: Plan, *, trust: bool) -> None:
    """Write the file of a sweep into its folder. If one is there it must say the same, but for the
    number of trials, of which the larger one is kept. Raises `RunError`."""
    from ..runs import files

    path, known = folder / NAME, plan
    if path.exists():
        before = File.read(str(path))
        line = Line("sweep", [])
        line.filed = before.said(trust)
        known = line.take(Plan())
        if told := _differing((before, known), (file, plan)):
            raise RunError(
                f"{folder} holds a sweep with other settings ({'; '.join(told)}): all but the "
                "number of trials stays as it began; give another --path"
            )
    if not path.exists() or known.trials < plan.trials:
        files.write_text(path, file.text(plan))


def _range(path: str, name: str, value: Any, trust: bool) -> Range:
    """A range of a file, whose words are as safe as its settings."""
    refused = REFUSED | SETTLED
    if name in refused:
        fail(f"{path} has a range of {name}: {refused[name]}")
    try:
        one = Range.of(name, value)
    except ValueError as error:
        fail(f"{path}: {error}")
    settings.read(path, {name: list(one.choices)}, trust=trust)
    return one


def _fitted(path: str, trials: Trials) -> list[Range]:
    """The ranges as their flags have them: of whole numbers or of any. Ends the command if a flag
    cannot have a value at the edge of a range."""
    known: dict[str, Flag] = {}
    for drawn in space.corners(trials.ranges):
        try:
            known = {**trials.flags(drawn), **known}
        except SystemExit:
            said = ", ".join(f"{name} = {value}" for name, value in drawn.items())
            say(f"       in {path}, where {said}")
            raise
    return [_of_kind(path, one, known.get(one.name)) for one in trials.ranges]


def _of_kind(path: str, one: Range, flag: Flag | None) -> Range:
    """A range of values that a flag can have. One of settings by name, such as `kwargs.g`, is of
    whole numbers if they are written so."""
    inside = set(leaves(flag.kind)) if flag else set()
    if one.choices:
        if flag and flag.kind is bool and not {"True", "False"} >= set(one.choices):
            fail(f"{path}: --{one.name} is true or false, not {' or '.join(one.choices)}")
        return one
    if flag and not {int, float} & inside:
        fail(
            f"{path}: --{one.name} takes no numbers: give a list of values in place of low and high"
        )
    numbers = (one.low, one.high, *(() if one.step is None else (one.step,)))
    written = all(isinstance(x, int) for x in numbers)
    try:
        return one.of_whole_numbers(float not in inside if flag else written)
    except ValueError as error:
        fail(f"{path}: {error}")


def _is_range(value: Any) -> bool:
    """Whether a table is a range, and not one of ranges, as `[ranges.learner]` is."""
    return "choices" in value or any(not isinstance(x, dict | list) for x in value.values())


def _differing(before: tuple[File, Plan], now: tuple[File, Plan]) -> list[str]:
    """What a sweep and a command for it do not have in common, but for the number of trials."""
    told = []
    for old, new in zip(*(_settled(*one) for one in (before, now)), strict=True):
        names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
        told += [f"{name}: {old.get(name)} != {new.get(name)}" for name in names]
    return told


def _settled(file: File, plan: Plan) -> tuple[dict[str, Any], ...]:
    search = dataclasses.asdict(plan)
    del search["trials"]
    return file.fixed, file.ranges, {"order of ranges": ", ".join(file.ranges)}, search


def _toml(value: Any) -> str:
    """A value of a file as TOML again; a table in one line."""
    if not isinstance(value, dict):
        return settings.toml(value)
    pairs = (f"{json.dumps(name)} = {_toml(x)}" for name, x in value.items())
    return f"{{ {', '.join(pairs)} }}"
