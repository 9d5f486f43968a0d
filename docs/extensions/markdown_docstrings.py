"""Docstrings are Markdown: this makes autodoc read them so, and lists the fields of a class with
their defaults, as `--help` does."""

import ast
import dataclasses
import inspect
import io
import textwrap
import tokenize
from collections.abc import Iterator

from docutils.parsers.rst import Directive
from docutils.utils import new_document
from myst_parser.parsers.sphinx_ import MystParser


class Markdown(Directive):
    """Its content as Markdown."""

    has_content = True

    def run(self):
        source, _ = self.state_machine.get_source_and_line(self.lineno)
        document = new_document(source, self.state.document.settings)
        MystParser().parse("\n".join(self.content), document)
        return document.children


def setup(app):
    app.add_directive("markdown", Markdown)
    app.connect("autodoc-process-docstring", as_markdown)
    app.connect("autodoc-process-signature", without_fields)
    app.connect("autodoc-skip-member", only_methods)
    return {"parallel_read_safe": True}


def as_markdown(app, what, name, obj, options, lines: list[str]) -> None:
    """Wrap a docstring into the directive, its fields behind it."""
    told = [*lines]
    if what == "class" and dataclasses.is_dataclass(obj):
        if told and told[0].startswith(f"{obj.__name__}("):  # what dataclasses make up themselves
            told = []
        told += ["", *fields(obj)]
    lines[:] = [".. markdown::", "", *("   " + line for line in told), ""]


def without_fields(app, what, name, obj, options, signature, returns):
    """A class's signature would repeat its fields."""
    return ("", None) if what == "class" and dataclasses.is_dataclass(obj) else None


def only_methods(app, what, name, obj, skip, options):
    """Fields stand in the list of `fields`."""
    if what == "class" and not (inspect.isroutine(obj) or isinstance(obj, property)):
        return True
    return None


def fields(cls: type) -> list[str]:
    """A Markdown list of the fields that a class and its bases declare."""
    told = {}
    for base in reversed(cls.__mro__):
        if base.__module__.startswith("credo"):
            told |= dict(declared(base))
    known = {field.name for field in dataclasses.fields(cls) if field.init}
    lines = [text for name, text in told.items() if name in known and not name.startswith("_")]
    return ["**Fields:**", "", *lines] if lines else []


def declared(cls: type) -> Iterator[tuple[str, str]]:
    """Name and line of each field in a class's own source: its default, and the docstring or the
    comment behind it."""
    source = textwrap.dedent(inspect.getsource(cls))
    comments = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    body = ast.parse(source).body[0].body
    for node, after in zip(body, [*body[1:], ast.Pass()], strict=True):
        if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)):
            continue
        text = comments.get(node.end_lineno, "")
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            text = " ".join(str(after.value.value).split())
        default = default_of(node.value)
        shown = f" = `{default}`" if default else ""
        yield node.target.id, f"- `{node.target.id}`{shown}" + (f": {text}" if text else "")


def default_of(value: ast.expr | None) -> str:
    """A default as it is written, also inside `eqx.field(…)`."""
    if isinstance(value, ast.Call) and ast.unparse(value.func).endswith("field"):
        inside = {keyword.arg: keyword.value for keyword in value.keywords}
        value = inside.get("default") or inside.get("default_factory")
    return " ".join(ast.unparse(value).split()) if value is not None else ""
