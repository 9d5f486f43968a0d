"""A page of results: plain records that describe it, and `write`, which makes one HTML file.

The file is self-contained: style and figures are inside it, and it opens without a network.
matplotlib is loaded by `write` alone, so that importing the records is cheap.
"""

import math
import os
import re
from collections.abc import Sequence
from html import escape
from numbers import Integral, Real
from pathlib import Path

import numpy as np

from ..runs import files
from .sections import Cell as Cell
from .sections import Curve as Curve
from .sections import Drawing as Drawing
from .sections import Drawn as Drawn
from .sections import Figure as Figure
from .sections import HeatMap as HeatMap
from .sections import Page as Page
from .sections import Reference as Reference
from .sections import Section as Section
from .sections import Summary as Summary
from .sections import Table as Table
from .sections import Text as Text
from .sections import Track as Track
from .sections import Tracks as Tracks


def write(page: Page, path: str | os.PathLike[str]) -> Path:
    """Write `page` to the HTML file `path` and return it. A reader never sees half a file."""
    path = Path(path)
    files.write_text(path, render(page))
    return path


def render(page: Page) -> str:
    """The page as HTML."""
    body = [f"<h1>{escape(page.title)}</h1>"]
    if page.lead:
        body.append(f'<p class="lead">{escape(page.lead)}</p>')
    if page.command:
        # Words in spans of their own: a browser would break --a-flag at its hyphens.
        words = re.sub(r"\S+", lambda word: f"<span>{escape(word[0])}</span>", page.command)
        body.append(
            '<div class="command"><p class="label">Made by</p>'
            f"<pre><code>{words}</code></pre></div>"
        )
    body += [render_group(first, group) for first, group in groups(page.sections)]
    if page.facts:
        rows = "".join(
            f"<dt>{escape(name)}</dt><dd>{escape(str(fact))}</dd>"
            for name, fact in page.facts.items()
        )
        body.append(f'<section><h2>Provenance</h2><dl class="facts">{rows}</dl></section>')
    content = "\n".join(body)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        # Without an icon of its own, a browser asks the server for one.
        '<link rel="icon" href="data:,">\n'
        f"<title>{escape(page.title)}</title>\n<style>{STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{content}\n</main>\n</body>\n</html>\n"
    )


def groups(sections: Sequence[Section]) -> list[tuple[int, list[Section]]]:
    """Neighbouring figures together, everything else alone, each with the index of its first."""
    found: list[tuple[int, list[Section]]] = []
    for index, section in enumerate(sections):
        if isinstance(section, Drawn) and found and isinstance(found[-1][1][0], Drawn):
            found[-1][1].append(section)
        else:
            found.append((index, [section]))
    return found


def render_group(first: int, group: Sequence[Section]) -> str:
    section = group[0]
    if isinstance(section, Text):
        return render_text(section)
    if isinstance(section, Table):
        return render_table(section)
    figures = "\n".join(
        render_figure(figure, f"s{first + offset}")
        for offset, figure in enumerate(group)
        if isinstance(figure, Drawn)
    )
    kind = "figures alone" if len(group) == 1 else "figures"
    return f'<div class="{kind}">\n{figures}\n</div>'


def render_text(text: Text) -> str:
    paragraphs = "".join(f"<p>{escape(paragraph)}</p>" for paragraph in text.paragraphs)
    return f'<section class="text">{heading(text.title)}{paragraphs}</section>'


def render_figure(figure: Drawn, name: str) -> str:
    """Both colourings of a figure; the style sheet shows one. `name` keeps their ids apart."""
    from . import plots

    if isinstance(figure, Drawing):
        light, dark, note = figure.light, figure.dark, ""
    else:
        light = plots.figure_svg(figure, dark=False, prefix=f"{name}-light-")
        dark = plots.figure_svg(figure, dark=True, prefix=f"{name}-dark-")
        note = plots.note(figure)
    table = render_rows(figure.table) if isinstance(figure, Tracks) else ""
    caption = render_caption(figure.caption, note, table)
    return (
        f'<figure>{heading(figure.title)}<div class="plot">'
        f'<div class="light">{light}</div><div class="dark">{dark}</div></div>'
        f"{caption}</figure>"
    )


def render_table(table: Table) -> str:
    # The box may end between two rows, and then shows no sign of the rest.
    count = f"{len(table.rows)} rows, in a box that scrolls." if len(table.rows) > 12 else ""
    caption = render_caption(table.caption, count)
    return f'<figure class="table">{heading(table.title)}{render_rows(table)}{caption}</figure>'


def render_rows(table: Table) -> str:
    """The table in a box that scrolls, without its title."""
    numeric = [
        any(is_number(cell) for cell in column)
        and all(cell is None or is_number(cell) for cell in column)
        for column in zip(*table.rows, strict=True)
    ] or [False] * len(table.columns)
    header = "".join(
        f'<th scope="col"{classes(number=right, long=len(column) > 20)}>{escape(column)}</th>'
        for column, right in zip(table.columns, numeric, strict=True)
    )
    rows = "".join(
        "<tr>"
        + "".join(render_cell(cell, right) for cell, right in zip(row, numeric, strict=True))
        + "</tr>\n"
        for row in table.rows
    )
    return (
        # Focusable, so that a keyboard can scroll it.
        f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(table.title)}">'
        f"<table><thead><tr>{header}</tr></thead><tbody>\n{rows}</tbody></table></div>"
    )


def render_cell(cell: Cell, right: bool) -> str:
    text = cell_text(cell)
    number = right or is_number(cell)
    return f"<td{classes(number=number, long=len(text) > 28)}>{escape(text)}</td>"


def classes(**present: bool) -> str:
    """The class attribute that names those that are true."""
    names = " ".join(name for name, there in present.items() if there)
    return f' class="{names}"' if names else ""


def is_number(cell: object) -> bool:
    return isinstance(cell, Real) and not isinstance(cell, bool | np.bool_)


def cell_text(cell: Cell) -> str:
    """A cell as the table shows it."""
    if cell is None or (is_number(cell) and math.isnan(cell)):  # type: ignore[arg-type]
        return "–"
    if isinstance(cell, Summary):
        return " ".join(cell_text(value) for value in cell.values)
    if isinstance(cell, str) or not is_number(cell):
        return str(cell)
    if isinstance(cell, Integral):
        text = f"{int(cell):,}"
    elif math.isinf(cell):
        text = "∞" if cell > 0 else "-∞"
    else:
        text = f"{cell:,.0f}" if 1e4 <= abs(cell) < 1e15 else f"{cell:.4g}"
    return text.replace("-", "−")


def render_caption(caption: str, note: str, table: str = "") -> str:
    """The text below a figure, and in it a table that opens."""
    table = table and f"<details><summary>As a table</summary>{table}</details>"
    note = f'<span class="note">{escape(note)}</span>' if note else ""
    text = " ".join(filter(None, [escape(caption), note, table]))
    return f"<figcaption>{text}</figcaption>" if text else ""


def heading(title: str) -> str:
    return f"<h2>{escape(title)}</h2>" if title else ""


STYLE = """
:root {
  --page: #ffffff; --ink: #1c1f23; --muted: #59616b; --line: #d9dde2; --box: #f5f6f8;
  --shade: #1c1f2326;
}
@media screen and (prefers-color-scheme: dark) {
  :root {
    --page: #14171b; --ink: #e4e7eb; --muted: #a0a8b2; --line: #343a42; --box: #1d2127;
    --shade: #00000080;
  }
}
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; text-size-adjust: 100%; }
body {
  margin: 0; background: var(--page); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial,
    "DejaVu Sans", sans-serif;
  overflow-wrap: break-word;
}
main { max-width: 72rem; margin: 0 auto; padding: 3rem 1.5rem 4rem; }
h1 { margin: 0 0 .75rem; font-size: 1.9rem; line-height: 1.2; font-weight: 650; }
h2 { margin: 0 0 .5rem; font-size: 1.1rem; line-height: 1.35; font-weight: 650; }
p { margin: 0 0 .9rem; }
.lead, .text p { max-width: 44rem; }
.lead { font-size: 1.1rem; }
.text > p:last-child { margin-bottom: 0; }
section, figure, .figures { margin: 0; }
section, .table, .figures { margin-top: 2.75rem; }
.command { margin-top: 1.5rem; max-width: 44rem; }
.label { margin: 0 0 .3rem; color: var(--muted); font-size: .85rem; }
pre {
  margin: 0; padding: .75rem 1rem; white-space: pre-wrap; overflow-x: auto;
  overflow-wrap: normal; background: var(--box);
  border: 1px solid var(--line); border-radius: 6px;
  font: .9rem/1.5 ui-monospace, SFMono-Regular, Menlo, Consolas, "DejaVu Sans Mono", monospace;
}
code { font: inherit; }
code span { white-space: nowrap; }
.figures { display: grid; gap: 2.75rem 2.5rem; grid-template-columns: minmax(0, 1fr); }
figcaption { margin-top: .6rem; font-size: .9rem; line-height: 1.5; max-width: 44rem; }
.note { color: var(--muted); }
details { margin-top: .4rem; }
summary { width: fit-content; color: var(--muted); cursor: pointer; }
details .scroll { margin-top: .5rem; }
.plot { max-width: 36rem; }
.plot svg { display: block; width: 100%; height: auto; overflow: visible; }
.dark { display: none; }
@media screen and (prefers-color-scheme: dark) {
  .light { display: none; }
  .dark { display: block; }
}
@media (min-width: 56rem) {
  .figures { grid-template-columns: repeat(2, minmax(0, 1fr)); }
  .alone { grid-template-columns: minmax(0, 1fr); }
  .alone figure {
    display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); column-gap: 2.5rem;
  }
  .alone h2 { grid-column: 1 / -1; }
  .alone figcaption { align-self: center; margin: 0; }
}
.scroll {
  overflow: auto; max-height: 34rem; max-width: 100%; width: fit-content;
  border: 1px solid var(--line); border-radius: 6px;
  /* A shade at the right edge while there is more to scroll to. */
  background:
    linear-gradient(var(--page), var(--page)) right / 1.5rem 100% no-repeat local,
    linear-gradient(to left, var(--shade), transparent) right / .9rem 100% no-repeat scroll;
}
table { border-collapse: separate; border-spacing: 0; font-size: .9rem; line-height: 1.4; }
th, td {
  padding: .4rem .9rem; text-align: left; vertical-align: top; max-width: 28rem;
  white-space: nowrap;
}
th.long { white-space: normal; min-width: 9rem; }
td.long { white-space: normal; min-width: 15rem; }
th {
  position: sticky; top: 0; background: var(--box); font-weight: 600; vertical-align: bottom;
  border-bottom: 1px solid var(--line);
}
tr + tr td { border-top: 1px solid var(--line); }
.number { text-align: right; font-variant-numeric: tabular-nums; }
.facts {
  display: grid; grid-template-columns: max-content minmax(0, 1fr); gap: .35rem 1.5rem;
  margin: 0; font-size: .9rem;
}
.facts dt { color: var(--muted); }
.facts dd { margin: 0; }
@media (max-width: 40rem) {
  main { padding: 1.5rem 1rem 2.5rem; }
  h1 { font-size: 1.5rem; }
  section, .table, .figures { margin-top: 2.25rem; }
  .facts { grid-template-columns: minmax(0, 1fr); gap: 0; }
  .facts dd { margin-bottom: .5rem; }
}
@media print {
  .scroll { max-height: none; overflow: visible; }
  figure { break-inside: avoid; }
}
"""
