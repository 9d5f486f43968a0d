"""Pages of results: one HTML file that opens without a network, or a README beside SVG files.

Templates lie in `templates/`, the style sheet and the script in `static/`. Whatever a record holds
is escaped: no title, label or cell can become markup.
"""

import functools
import html
import math
import os
import re
from collections.abc import Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import markupsafe
import numpy as np

from ..runs import files
from . import figures, statistics
from .sections import Cell, Drawing, Drawn, Figure, Page, Section, Summary, Table, Tracks
from .styles import DARK, DASHES, LIGHT, STATIC, assign

TALL = 30  # rows; of more, a table is in a box that scrolls


def write(page: Page, path: str | os.PathLike[str]) -> Path:
    """Write `page` to the HTML file `path` and return it. A reader never sees half a file."""
    path = Path(path)
    files.write_text(path, render(page))
    return path


def render(page: Page) -> str:
    """The page as HTML."""
    text = {name: files.read_text(STATIC / name) for name in ("base.css", "page.css", "page.js")}
    return _template("page.html").render(
        page=page,
        groups=groups(drawn(page)),
        themes={"light": LIGHT, "dark": DARK},
        css=text["base.css"] + text["page.css"],
        script=text["page.js"],
    )


def markdown(page: Page, folder: str | os.PathLike[str]) -> Path:
    """Write `page` as `README.md` with its figures as SVG files beside it, for a repository page,
    and return its path. The same page gives the same bytes; figures of an earlier one go."""
    folder = Path(folder)
    parts = drawn(page, legend=True)
    text = _template("page.md").render(page=page, parts=parts, width=round(100 * figures.WIDTH))
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


# ------------------------------------------------------------------------------- what templates see


class Part(NamedTuple):
    """A section as templates see it. Of a figure: its number from 1, both colourings, what a
    tooltip says, and curves of the legend with their looks. `table`: of a table, or of tracks."""

    kind: str  # text, table, figure
    section: Section
    number: int = 0
    light: str = ""
    dark: str = ""
    tips: Any = None
    legend: Sequence[tuple[int, str, Any]] = ()
    note: str = ""
    table: Table | None = None


def drawn(page: Page, legend: bool = False) -> list[Part]:
    """The sections of a page with their figures drawn, curves of one label alike in all of them.
    `legend`: whether pictures have theirs inside."""
    plots = [section for section in page.sections if isinstance(section, Figure)]
    looks = assign(curve.label for figure in plots for curve in figure.curves)
    found: list[Part] = []
    number = 0
    for section in page.sections:
        if isinstance(section, Table):
            found.append(Part("table", section, note=table_note(section), table=section))
        elif isinstance(section, Drawn):
            number += 1
            found.append(_figure(section, number, looks, legend))
        else:
            found.append(Part("text", section))
    return found


def _figure(section: Drawn, number: int, looks: figures.Looks, legend: bool) -> Part:
    if isinstance(section, Drawing):
        return Part("figure", section, number, section.light, section.dark)
    light, dark = (
        figures.picture(section, theme, prefix=f"{prefix}-{number}-", looks=looks, legend=legend)
        for theme, prefix in ((False, "light"), (True, "dark"))
    )
    named = [
        (i, curve.label, looks[curve.label])
        for i, curve in enumerate(section.curves if isinstance(section, Figure) else ())
        if curve.label.strip()
    ]
    table = section.table if isinstance(section, Tracks) else None
    note = figures.note(section)
    return Part("figure", section, number, light.svg, dark.svg, light.tips, named, note, table)


def groups(parts: Sequence[Part]) -> list[list[Part]]:
    """Neighbouring figures together, everything else alone."""
    found: list[list[Part]] = []
    for part in parts:
        if part.kind == "figure" and found and found[-1][0].kind == "figure":
            found[-1].append(part)
        else:
            found.append([part])
    return found


def table_note(table: Table) -> str:
    """What brackets and small numbers of a table mean."""
    cells = [cell for row in table.rows for cell in row if isinstance(cell, Summary)]
    if not any(len(cell.values) > 1 for cell in cells):
        return ""
    names = dict.fromkeys(statistics.CENTRES[cell.centre][1] for cell in cells)
    return statistics.NOTE.format(centre=" or ".join(names))


# -------------------------------------------------------------------------------------------- cells


class Shown(NamedTuple):
    """A cell in words: `small` below `text`, `title` in a tooltip."""

    text: str
    small: str = ""
    title: str = ""


def shown(cell: Cell) -> Shown:
    """A cell as a table shows it."""
    if isinstance(cell, Summary):
        text, runs, every = statistics.shown(cell)
        return Shown(text, runs, every)
    if cell is None or (_is_number(cell) and math.isnan(cell)):  # type: ignore[arg-type]
        return Shown("–")
    if isinstance(cell, str) or not _is_number(cell):
        return Shown(str(cell))
    if isinstance(cell, Integral):
        text = f"{int(cell):,}"
    elif math.isinf(cell):
        text = "∞" if cell > 0 else "-∞"
    else:
        text = f"{cell:,.0f}" if 1e4 <= abs(cell) < 1e15 else f"{cell:.4g}"
    return Shown(text.replace("-", "−"))


def numeric(table: Table) -> list[bool]:
    """Which columns hold numbers, and nothing else."""
    return [
        any(_is_number(cell) for cell in column)
        and all(cell is None or _is_number(cell) for cell in column)
        for column in zip(*table.rows, strict=True)
    ] or [False] * len(table.columns)


def _is_number(cell: object) -> bool:
    number = isinstance(cell, Real) and not isinstance(cell, bool | np.bool_)
    return number or isinstance(cell, Summary)


def hidden_runs(table: Table) -> list[tuple[str, str, str]]:
    """Row, column and every run of the summaries that show their extremes alone."""
    return [
        (shown(row[0]).text, column, shown(cell).title)
        for row in table.rows
        for column, cell in zip(table.columns, row, strict=True)
        if isinstance(cell, Summary) and len(cell.values) > statistics.FEW
    ]


def prose(text: str) -> markupsafe.Markup:
    """Text in HTML, with `code` between backticks."""
    return markupsafe.Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(html.escape(text))))


def markdown_prose(text: str) -> str:
    """Text in a line of Markdown, with `code` between backticks."""
    parts = re.split(r"(`[^`]+`)", " ".join(text.split()))
    return "".join(part if i % 2 else markdown_text(part) for i, part in enumerate(parts))


def markdown_text(text: object) -> str:
    """Text in Markdown, or in a cell of its table: nothing in it is markup."""
    line = html.escape(re.sub(r"\s+", " ", str(text)), quote=False)
    line = re.sub(r"([\\`*|$~]|\](?=[(\[:])|(?<!\w)_|_(?!\w))", r"\\\1", line)
    return re.sub(r"^(\d*)([#+.)-])(?=[# ])", r"\1\\\2", line)  # a heading or an item


def fenced(text: str) -> str:
    """A block of code that its text cannot end."""
    fence = "`" * max(3, 1 + max(map(len, re.findall("`+", text)), default=0))
    return f"{fence}sh\n{text}\n{fence}"


@functools.cache
def _template(name: str) -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("credo.report"),
        autoescape=lambda name: name is not None and name.endswith(".html"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"md": markdown_text, "md_prose": markdown_prose, "prose": prose}
    environment.filters |= {"fenced": fenced, "shown": shown}
    environment.globals |= {
        "numeric": numeric,
        "hidden_runs": hidden_runs,
        "TALL": TALL,
        "dashes": [" ".join(f"{figures.LINE * x:g}" for x in dash) for dash in DASHES],
    }
    return environment.get_template(name)
