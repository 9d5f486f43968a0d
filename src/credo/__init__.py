"""Credo: credit assignment by evolution and gradient.

import credo

task = credo.SequenceClassification(depth=5)
algorithm = credo.Neuroevolution.ours(task, credo.MMU(hidden=5))
run = credo.train(algorithm, generations=300)
policy = run.policy()
action = policy(observation)
"""

import ast
import importlib
import pathlib

_STUB = pathlib.Path(__file__).with_name("__init__.pyi")
_EXPORTS = {
    name.name: node.module
    for node in ast.parse(_STUB.read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom)
    for name in node.names
}
"""The module of each public name: `__init__.pyi` has them, with their types for editors."""
__all__ = sorted(_EXPORTS)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str):
    # Imported on first use, so that `credo --help` need not wait for JAX.
    if name not in _EXPORTS:
        raise AttributeError(f"module 'credo' has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_EXPORTS[name]}", __name__), name)


def __dir__():
    return __all__
