"""House rules that can be counted: functions are short, and every package explains itself."""

import ast
import pathlib
import tokenize

import numpy as np
import pytest

import credo

ROOT = pathlib.Path(credo.__file__).parent
PACKAGES = sorted(path.parent.name for path in ROOT.glob("*/__init__.py"))
COUNTED = {tokenize.NAME, tokenize.NUMBER, tokenize.OP, tokenize.STRING}


def parsed(package):
    """The files of a package, and what is in them."""
    paths = sorted((ROOT / package).rglob("*.py"))
    return [(path, ast.parse(path.read_text(encoding="utf-8"))) for path in paths]


def docstrings(tree):
    """Lines of the docstrings of modules, classes, functions and fields."""
    bodies = [getattr(node, "body", []) for node in ast.walk(tree)]
    texts = [
        inner
        for body in bodies
        for inner in (body if isinstance(body, list) else [])
        if isinstance(inner, ast.Expr)
        and isinstance(inner.value, ast.Constant)
        and isinstance(inner.value.value, str)
    ]
    return {line for text in texts for line in range(text.lineno, text.end_lineno + 1)}


def code(path):
    """Lines that hold anything but comments and blanks, docstrings among them."""
    with path.open("rb") as file:
        tokens = [token for token in tokenize.tokenize(file.readline) if token.type in COUNTED]
    return {line for t in tokens for line in range(t.start[0], t.end[0] + 1)}


@pytest.mark.parametrize("package", PACKAGES)
def test_nine_functions_of_ten_have_twenty_lines_at_most(package):
    """Docstrings apart."""
    lengths = [
        len(set(range(node.lineno, node.end_lineno + 1)) - docstrings(node))
        for _, tree in parsed(package)
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
    ]
    assert not lengths or np.percentile(lengths, 90) <= 20


@pytest.mark.parametrize("package", PACKAGES)
def test_docstrings_are_a_fifth_of_the_other_code(package):
    lines = [(docstrings(tree), code(path)) for path, tree in parsed(package)]
    texts = sum(len(text) for text, _ in lines)
    assert texts >= 0.2 * sum(len(every - text) for text, every in lines)
