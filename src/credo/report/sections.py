"""What a page is made of: plain records of figures, tables and text, and no way to draw them.

`figures` draws them with matplotlib, `pages` sets them in HTML and Markdown. Importing these
records is cheap: it loads neither.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True, eq=False)
class Summary:
    """Independent runs in one cell of a table: shown as their mean with a 95 % bootstrap interval,
    and every run.

    `values`: one per seed, in the order of `seeds`; None where a run has none. `scale`: what they
    are multiplied with, 100 for percent. `digits`: behind the point; None: three or four in all.
    """

    values: Sequence[float | None]
    seeds: Sequence[int] = ()
    scale: float = 1.0
    digits: int | None = None

    def __post_init__(self):
        if len(self.seeds) not in (0, len(self.values)):
            raise ValueError(
                f"a summary has {len(self.values)} values and {len(self.seeds)} seeds: give one "
                "seed for each value, or none at all"
            )


Cell = str | float | Summary | None


@dataclass(frozen=True, eq=False)
class Curve:
    """One line of a figure, with every seed it was made from.

    `x[points]` must increase; `runs[seeds, points]`. Values that are not finite are left out;
    the mean and its interval are drawn where every seed has a value.
    """

    label: str
    x: ArrayLike
    runs: ArrayLike

    def __post_init__(self):
        points, shape = np.shape(self.x), np.shape(self.runs)
        if len(points) != 1 or len(shape) != 2 or shape[1:] != points or 0 in shape:
            raise ValueError(
                f"curve {self.label!r} has x of shape {points} and runs of shape {shape}: "
                "x must be [points] and runs [seeds, points], with at least one of each"
            )
        if not np.all(np.diff(np.asarray(self.x, dtype=np.float64)) > 0):
            raise ValueError(f"curve {self.label!r} has an x that does not increase: sort it")


@dataclass(frozen=True)
class Reference:
    """A level to compare with: a baseline, a published number, an upper bound."""

    label: str
    value: float

    def __post_init__(self):
        if not math.isfinite(self.value):
            raise ValueError(f"reference {self.label!r} is {self.value}: a level must be finite")


@dataclass(frozen=True, eq=False)
class Figure:
    """Curves over a common axis, with the mean over seeds, its interval and every seed.

    `joined`: whether a run goes on from one x to the next. Over depth, coupling or another setting
    each x has runs of its own, which are drawn as dots.
    """

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve]
    references: Sequence[Reference] = ()
    caption: str = ""
    y_range: tuple[float, float] | None = None  # (low, high); widened to show the references
    joined: bool = True

    def __post_init__(self):
        if not self.curves:
            raise ValueError(f"figure {self.title!r} has no curves: give at least one")
        if self.y_range is not None and not self.y_range[0] < self.y_range[1]:
            raise ValueError(f"figure {self.title!r} has y_range {self.y_range}: give (low, high)")


@dataclass(frozen=True, eq=False)
class HeatMap:
    """`values[rows, columns]` as colours; values of both signs are centred on zero."""

    title: str
    values: ArrayLike
    row_labels: Sequence[str]
    column_labels: Sequence[str]
    x_label: str
    y_label: str
    caption: str = ""

    def __post_init__(self):
        shape = np.shape(self.values)
        labels = (len(self.row_labels), len(self.column_labels))
        if shape != labels or 0 in shape:
            raise ValueError(
                f"heat map {self.title!r} has values of shape {shape} and {labels[0]} row and "
                f"{labels[1]} column labels: values must be [rows, columns], none of them empty"
            )


@dataclass(frozen=True)
class Track:
    """A row at each column of `Tracks`. `notes`: what the table adds at each column, "" where there
    is nothing to add; none at all if there is nothing anywhere."""

    label: str
    rows: Sequence[int]
    notes: Sequence[str] = ()
    scripted: bool = False  # drawn apart from those that learn


@dataclass(frozen=True, eq=False)
class Tracks:
    """Who is in which row, column by column, and where the goal is. A table says the same.

    Row 0 is at the top. `goals[columns]`: a row; `reached[columns]`: whether it counts as reached.
    """

    title: str
    tracks: Sequence[Track]
    goals: Sequence[int]
    reached: Sequence[bool]
    row_labels: Sequence[str]
    column_labels: Sequence[str]
    x_label: str
    y_label: str
    goal_label: str = "goal"
    outcomes: tuple[str, str] = ("reached", "missed")  # of a goal, in words
    breaks: Sequence[int] = ()  # columns that have a line before them
    caption: str = ""

    def __post_init__(self):
        columns, rows = len(self.column_labels), len(self.row_labels)
        every = [self.reached, self.goals, *(x.rows for x in self.tracks)]
        lengths = [len(x) for x in (*every, *(x.notes for x in self.tracks if x.notes))]
        if not self.tracks or columns == 0 or set(lengths) != {columns}:
            raise ValueError(
                f"tracks {self.title!r} have {columns} column labels, {len(self.tracks)} tracks "
                f"and {lengths} outcomes, goals, rows and notes: give at least one track, and of "
                "everything one for each column"
            )
        for place in every[1:]:
            if not all(0 <= row < rows for row in place):
                raise ValueError(
                    f"tracks {self.title!r} have {rows} row labels and a mark or a goal in rows "
                    f"{list(place)}: each must be in 0..{rows - 1}"
                )

    @property
    def table(self) -> "Table":
        """The same in words, a row for each column of the picture."""

        def note(track: Track, column: int) -> list[str]:
            """What is added to a place, if anything."""
            return [x for x in track.notes[column : column + 1] if x]

        notes = [self.outcomes[0 if reached else 1] for reached in self.reached]
        told = [Track(self.goal_label, self.goals, notes), *self.tracks]
        rows = [
            [label, *(", ".join([self.row_labels[x.rows[i]], *note(x, i)]) for x in told)]
            for i, label in enumerate(self.column_labels)
        ]
        return Table(self.title, [self.x_label, *(x.label for x in told)], rows)


@dataclass(frozen=True)
class Drawing:
    """A picture of its own: one `<svg>` element for each colouring. Ids must differ, also from
    those of other drawings on the page (see the `prefix` of `trajectories`)."""

    title: str
    light: str
    dark: str
    caption: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of cells: numbers are rounded to four digits and right-aligned, strings are shown as
    given, None and NaN are a dash.

    `marked`: indices of rows that stand out, such as settings that differ; the caption says why.
    `folded`: behind its title, until a reader opens it.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    marked: Collection[int] = ()
    folded: bool = False

    def __post_init__(self):
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(
                    f"table {self.title!r} has {len(self.columns)} columns "
                    f"and a row of {len(row)} cells: {row!r}"
                )


@dataclass(frozen=True)
class Text:
    """Paragraphs; what stands between backticks is code."""

    title: str
    paragraphs: Sequence[str]


Drawn = Figure | HeatMap | Tracks | Drawing
Section = Drawn | Table | Text


@dataclass(frozen=True)
class Page:
    """A page of results.

    `lead`: a sentence or two below the title. `command`: what makes the page, exactly as typed.
    `sections`: in order; neighbouring figures stand together. `facts`: where its numbers come from
    (versions, processor, seeds); each is one value or several. `banner`: what a reader must know
    before anything else, such as `SMOKE`. Lead and captions are prose: `code` between backticks.
    """

    title: str
    lead: str
    command: str
    sections: Sequence[Section]
    facts: Mapping[str, str | Sequence[str]] = field(default_factory=dict)
    banner: str = ""


SMOKE = "This page shows that everything runs. It is no result: tiny networks, seconds of training."
