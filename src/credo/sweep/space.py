"""What the trials of a sweep draw: a range for each of some flags.

Values are words as they are typed, so that a range can name whatever its flag accepts. Nothing here
imports JAX or Optuna.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from typing import Any

from .. import require

Drawn = dict[str, Any]  # by name: a number of a range of numbers, a word of a list
FIELDS = ("low", "high", "step", "log")
EXAMPLE = '"learner.gamma" = { low = 0.9, high = 0.999 }'
FORMS = "{ low = …, high = … }, also with log = true or step = …, or a list of values"


@dataclasses.dataclass(frozen=True)
class Range:
    """What can be drawn for one flag: a word of `choices`, or a number from `low` to `high`.

    - `step`: distance of the numbers, above 0, a divisor of the range; None: any number, or of
      whole numbers 1.
    - `log`: numbers are drawn evenly on a logarithmic scale; `low` is above 0.
    - `whole`: numbers are whole.
    - `when`: names of other ranges, each with the words under which this one counts.

    Raises `ValueError`, which begins with the name.
    """

    name: str
    choices: tuple[str, ...] = ()
    low: float = 0.0
    high: float = 0.0
    step: float | None = None
    log: bool = False
    whole: bool = False
    when: tuple[tuple[str, tuple[str, ...]], ...] = ()

    def __post_init__(self):
        if self.choices:
            if len(set(self.choices)) < len(self.choices):
                raise ValueError(f"{self.name} has a value twice: {'; '.join(self.choices)}")
            return
        for name in ("low", "high", *(() if self.step is None else ("step",))):
            self._require_number(name)
        if not self.low < self.high:
            raise ValueError(
                f"{self.name}: low is {self.low} and high {self.high}: give low < high"
            )
        if self.log and self.low <= 0:
            raise ValueError(f"{self.name}: low is {self.low}: with log it must be above 0")
        if self.log and self.step is not None:
            raise ValueError(f"{self.name} has log and a step: give one of them")
        if self.step is not None:
            self._require_divisor(self.step)

    def _require_number(self, name: str) -> None:
        value = getattr(self, name)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and math.isfinite(value)):
            raise ValueError(f"{self.name}: {name} is {value!r}: it must be a finite number")
        if self.whole and value != int(value):
            raise ValueError(f"{self.name}: {name} is {value}: it must be a whole number")

    def _require_divisor(self, step: float) -> None:
        """Of 0.1 … 0.9 by 0.2, which binary fractions hide."""
        low, high, by = (Decimal(str(x)) for x in (self.low, self.high, step))
        if step <= 0 or (high - low) % by:
            raise ValueError(
                f"{self.name}: step is {step}: it must be above 0 and divide the range from "
                f"{self.low} to {self.high}"
            )

    @classmethod
    def of(cls, name: str, value: Any) -> "Range":
        """The range that a file says: a list of values, or a table."""
        numbers = dict(value) if isinstance(value, dict) else {"choices": value}
        listed, when = numbers.pop("choices", []), numbers.pop("when", {})
        for field in numbers.keys() - set(FIELDS):
            raise ValueError(f"{name} has no {field!r}{require.suggestion(field, FIELDS)}: {FORMS}")
        two = {"low", "high"} <= numbers.keys() and isinstance(numbers.get("log", False), bool)
        if not isinstance(listed, list) or (numbers if listed else not two):
            raise ValueError(f"{name} is {value!r}: give {FORMS}")
        if not isinstance(when, dict):
            raise ValueError(f'{name}: when is {when!r}: write when = {{ "other-flag" = "word" }}')
        conditions = tuple((flag.replace("_", "-"), words(x)) for flag, x in when.items())
        return cls(name, words(listed), **numbers, when=conditions)

    @property
    def ends(self) -> tuple[Any, ...]:
        """Every choice, or the two ends."""
        return self.choices or (self.low, self.high)

    def of_whole_numbers(self, whole: bool) -> "Range":
        """The same of numbers that are whole, or of any."""
        kind = int if whole else float
        dataclasses.replace(self, whole=whole)  # or `int` would cut 0.5
        numbers = {name: kind(getattr(self, name)) for name in ("low", "high")}
        step = None if self.step is None else kind(self.step)
        return dataclasses.replace(self, **numbers, step=step, whole=whole)

    def counts(self, drawn: Mapping[str, Any]) -> bool:
        """Whether it is drawn at all, beside what was drawn for the ranges above it."""
        return all(drawn.get(name) in known for name, known in self.when)

    def draw(self, trial: Any) -> Any:
        """A value, as a trial of Optuna suggests it."""
        if self.choices:
            return trial.suggest_categorical(self.name, self.choices)
        if self.whole:
            step = 1 if self.step is None else int(self.step)
            return trial.suggest_int(
                self.name, int(self.low), int(self.high), step=step, log=self.log
            )
        return self._on_grid(
            trial.suggest_float(self.name, self.low, self.high, step=self.step, log=self.log)
        )

    def _on_grid(self, value: float) -> float:
        """0.3 in place of 0.30000000000000004."""
        if self.step is None:
            return value
        low, step = Decimal(str(self.low)), Decimal(str(self.step))
        return float(low + step * round((value - self.low) / self.step))


def words(values: Any) -> tuple[str, ...]:
    """Values of a file as they are typed: a list among them is one value, `64,64`."""
    listed = values if isinstance(values, list) else [values]
    return tuple(
        ",".join(map(str, value)) if isinstance(value, list) else str(value) for value in listed
    )


def require_known(ranges: Sequence[Range]) -> None:
    """Raise `ValueError` unless conditions name lists above them, and words that these have."""
    above: dict[str, Range] = {}
    for one in ranges:
        for name, known in one.when:
            choices = above[name].choices if name in above else ()
            if not choices:
                raise ValueError(
                    f"{one.name}: when names {name}, which is no list of values above it"
                    f"{require.suggestion(name, [x for x in above if above[x].choices])}"
                )
            for word in known:
                if word not in choices:
                    raise ValueError(
                        f"{one.name}: when {name} is {word!r}: it is one of {', '.join(choices)}"
                    )
        above[one.name] = one


def draw(ranges: Sequence[Range], trial: Any) -> Drawn:
    """What a trial of Optuna suggests for each range that counts, in their order."""
    drawn: Drawn = {}
    for one in ranges:
        if one.counts(drawn):
            drawn[one.name] = one.draw(trial)
    return drawn


def corners(ranges: Sequence[Range]) -> Iterator[Drawn]:
    """Drawings by which mistakes are found: in one of them at least each range has each of its
    choices, or its ends, and all others their first or lowest."""
    by_name = {one.name: one for one in ranges}
    for one in ranges:
        for needed, end in itertools.product(_ways(one, by_name), one.ends):
            fixed, drawn = needed | {one.name: end}, {}
            for other in ranges:
                if other.counts(drawn):
                    drawn[other.name] = fixed.get(other.name, other.ends[0])
            yield drawn


def _ways(one: Range, by_name: Mapping[str, Range]) -> Iterator[Drawn]:
    """What others can be for this range to count."""
    names = [name for name, _ in one.when]
    for chosen in itertools.product(*(known for _, known in one.when)):
        above: Drawn = {}
        for name in names:
            above |= next(_ways(by_name[name], by_name))
        yield above | dict(zip(names, chosen, strict=True))
