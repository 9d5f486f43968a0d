"""What a class says of its fields: the docstring below a field, or the comment behind it."""

import ast
import functools
import inspect
import textwrap


@functools.cache
def texts(cls: type) -> dict[str, str]:
    """Help for the fields of a dataclass, by their names; of one that says nothing, none. A class
    without source (of a prompt) has none."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        try:
            source = textwrap.dedent(inspect.getsource(base))
            (tree,) = ast.parse(source).body
        except (OSError, TypeError, ValueError, SyntaxError):
            continue
        body, lines = getattr(tree, "body", []), source.splitlines()
        for node, after in zip(body, [*body[1:], None], strict=True):
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                text = _docstring(after) or _comment(lines[(node.end_lineno or 1) - 1], node)
                found |= {node.target.id: text} if text else {}
    return found


def _docstring(node: ast.AST | None) -> str:
    text = node.value.value if _is_text(node) else ""  # pyright: ignore
    return " ".join(text.split())


def _is_text(node: ast.AST | None) -> bool:
    constant = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return constant and isinstance(node.value.value, str)  # pyright: ignore


def _comment(line: str, node: ast.AnnAssign) -> str:
    behind = line.encode()[node.end_col_offset :].decode()  # offsets are of bytes
    return behind.partition("#")[2].strip()
