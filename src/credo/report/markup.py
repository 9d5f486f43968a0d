"""Templates of all pages, and text in HTML and in Markdown: whatever a record holds is escaped, so
that no title, label or cell can become markup.

Templates lie in `templates/`, style sheets and scripts in `static/`.
"""

import functools
import html
import re
from typing import Any

import jinja2
import markupsafe

from ..runs import files
from .styles import STATIC


def render(template: str, **known: Any) -> str:
    """A template of `templates/`, filled. A name that it needs and is not `known` is an error."""
    return _environment().get_template(template).render(known)


def static(*names: str) -> markupsafe.Markup:
    """Files of `static/`, one after the other, to stand in a page as they are."""
    return markupsafe.Markup("".join(files.read_text(STATIC / name) for name in names))


def prose(text: str) -> markupsafe.Markup:
    """Text in HTML, with `code` between backticks."""
    return markupsafe.Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text)))


def markdown_prose(text: str) -> str:
    """Text in a line of Markdown, with `code` between backticks."""
    parts = re.split(r"(`[^`]+`)", " ".join(text.split()))
    return "".join(part if i % 2 else markdown_text(part) for i, part in enumerate(parts))


def markdown_text(text: object) -> str:
    """Text in Markdown, or in a cell of its table: nothing in it is markup. White space is one
    blank, HTML and what Markdown and GitHub's formulas take for markup is escaped."""
    line = html.escape(re.sub(r"\s+", " ", str(text)), quote=False)
    line = re.sub(r"([\\`*|$~]|\](?=[(\[:])|(?<!\w)_|_(?!\w))", r"\\\1", line)
    return re.sub(r"^(\d*)([#+.)-])(?=[# ])", r"\1\\\2", line)  # a heading or an item


def fenced(text: str) -> str:
    """A block of code that its text cannot end: its fence is longer than any in the text."""
    fence = "`" * max(3, 1 + max(map(len, re.findall("`+", text)), default=0))
    return f"{fence}sh\n{text}\n{fence}"


@functools.cache
def _environment() -> jinja2.Environment:
    """What templates have besides their arguments: the filters above. In `*.html` everything is
    escaped that is not marked as safe; JSON (`tojson`) is compact and cannot end a script."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("credo.report"),
        autoescape=jinja2.select_autoescape(["html"]),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    words = {"md": markdown_text, "md_prose": markdown_prose, "prose": prose, "fenced": fenced}
    environment.filters |= words
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return environment
