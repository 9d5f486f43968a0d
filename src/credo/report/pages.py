"""Pages of results: one HTML file that opens without a network, or a README beside SVG files."""

import itertools
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..runs import files
from . import figures, markup, tables
from .sections import Drawing, Drawn, Figure, Page, Section, Table, Tracks
from .styles import DARK, DASHES, LIGHT, Look, assign

TALL = 30  # rows; of more, a table is in a box that scrolls
WIDE = 7  # columns; of more, a table has smaller print and gaps


def write(page: Page, path: str | os.PathLike[str]) -> Path:
    """Write `page` to the HTML file `path` and return it. A reader never sees half a file."""
    files.write_text(path, render(page))
    return Path(path)


def render(page: Page) -> str:
    """The page as HTML, with style sheet and script inside: nothing is loaded from anywhere.
    Neighbouring figures stand together, two beside each other on a wide screen."""
    parts = itertools.groupby(drawn(page), lambda part: part.kind == "figure")
    return markup.render(
        "page.html",
        page=page,
        groups=[(together, list(group)) for together, group in parts],
        themes={"light": LIGHT, "dark": DARK},
        css=markup.static("base.css", "page.css"),
        script=markup.static("page.js"),
        dashes=[" ".join(f"{figures.LINE * x:g}" for x in dash) for dash in DASHES],
        tables=tables,
        tall=TALL,
        wide=WIDE,
    )


def markdown(page: Page, folder: str | os.PathLike[str]) -> Path:
    """Write `page` as `README.md` with its figures as SVG files beside it, for a repository page,
    and return its path. The same page gives the same bytes; figures of an earlier one go."""
    folder = Path(folder)
    parts = drawn(page, legend=True)
    width = round(100 * figures.WIDTH)
    text = markup.render("page.md", page=page, parts=parts, width=width, tables=tables)
    text = re.sub(r"\n{3,}", "\n\n", re.sub(r" +\n", "\n", text))
    pictures = {
        f"figure-{part.number}-{theme}.svg": f"{getattr(part, theme)}\n"
        for part in parts
        if part.number
        for theme in ("light", "dark")
    }
    for name, svg in pictures.items():
        files.write_text(folder / name, svg)
    for old in folder.glob("figure-*.svg"):
        if old.name not in pictures and re.fullmatch(r"figure-\d+-(light|dark)\.svg", old.name):
            files.remove(old)
    files.write_text(folder / "README.md", text)
    return folder / "README.md"


class Part(NamedTuple):
    """A section as templates see it."""

    kind: str  # text, table, figure
    section: Section
    number: int = 0  # of a figure, from 1
    light: str = ""  # the figure as `<svg>`, in both colourings
    dark: str = ""
    tips: dict[str, Any] | None = None  # what tooltips say, and where
    legend: Sequence[tuple[int, str, Look]] = ()  # index, label and look of the named curves
    note: str = ""  # how to read it
    table: Table | None = None  # the same in words


def drawn(page: Page, legend: bool = False) -> list[Part]:
    """The sections of a page with their figures drawn, curves of one label alike in all of them.
    `legend`: whether pictures have theirs inside."""
    plots = [section for section in page.sections if isinstance(section, Figure)]
    looks = assign(curve.label for figure in plots for curve in figure.curves)
    numbers = itertools.count(1)
    found: list[Part] = []
    for section in page.sections:
        if isinstance(section, Table):
            found.append(Part("table", section, note=tables.note(section)))
        elif isinstance(section, Drawn):
            found.append(_figure(section, next(numbers), looks, legend))
        else:
            found.append(Part("text", section))
    return found


def _figure(section: Drawn, number: int, looks: figures.Looks, legend: bool) -> Part:
    """A figure in both colourings. Ids of its SVG begin with the colouring and its number."""
    if isinstance(section, Drawing):
        return Part("figure", section, number, section.light, section.dark)
    light, dark = (
        figures.picture(section, theme, prefix=f"{name}-{number}-", looks=looks, legend=legend)
        for name, theme in (("light", LIGHT), ("dark", DARK))
    )
    curves = section.curves if isinstance(section, Figure) else ()
    named = [(i, c.label, looks[c.label]) for i, c in enumerate(curves) if c.label.strip()]
    table = section.table if isinstance(section, Tracks) else None
    note = figures.note(section)
    return Part("figure", section, number, light.svg, dark.svg, light.tips, named, note, table)
