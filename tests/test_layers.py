"""Imports only go down, so that every layer can be read without the ones above it."""

import ast
import pathlib

import credo

ROOT = pathlib.Path(credo.__file__).parent
LEVELS = [
    {"types", "tree", "compilation", "require", "memory", "runner", "fields"},
    {"environments", "networks"},
    {"playing"},
    {"rollout", "replay"},
    {"normalization"},
    {"evolution", "learners"},
    {"algorithms"},
    {"analysis"},
    {"runs"},
    {"executors"},
    {"report"},
    {"sweep"},
    {"experiments"},
    {"cli"},
    {"__main__"},
]
LEVEL = {part: level for level, parts in enumerate(LEVELS) for part in parts}


def part_of(module: tuple[str, ...]) -> str | None:
    """The part of credo that a module's dotted name lies in."""
    return module[1] if module[0] == "credo" and len(module) > 1 else None


def imports(source: str, package: tuple[str, ...]) -> set[str]:
    """Parts of credo that a file in `package` imports, also inside functions."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {part_of(tuple(alias.name.split("."))) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            base += tuple(node.module.split(".")) if node.module else ()
            if base == ("credo",):
                found |= {alias.name for alias in node.names}
            elif base[:1] == ("credo",):
                found.add(part_of(base))
    return found - {None}


def edges() -> dict[tuple[str, str], str]:
    """(importing part, imported part) and one file where it happens."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        names = path.relative_to(ROOT.parent).with_suffix("").parts
        if names == ("credo", "__init__"):
            continue  # the front door shows what the rooms hold
        here = part_of(names)
        for part in imports(path.read_text(encoding="utf-8"), names[:-1]):
            if part != here:
                found[here, part] = str(path.relative_to(ROOT))
    return found


def test_every_part_has_a_level():
    parts = {
        path.stem
        for path in ROOT.iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert parts - {"__init__"} <= set(LEVEL)
    assert {"types", "rollout", "algorithms"} <= parts


def test_imports_only_go_down():
    found = edges()
    assert ("rollout", "environments") in found  # the search sees what is there
    assert ("algorithms", "evolution") in found
    upward = {
        f"{here} imports {there} in {path}"
        for (here, there), path in found.items()
        if there not in LEVEL or LEVEL[there] >= LEVEL[here]
    }
    assert upward == set()


def test_evolution_and_learners_do_not_know_each_other():
    assert not {("evolution", "learners"), ("learners", "evolution")} & set(edges())


def test_algorithms_do_not_know_runs():
    assert ("algorithms", "runs") not in edges()


def test_the_search_sees_every_way_to_import():
    source = "\n".join(
        [
            "import credo.cli",
            "import jax.numpy as jnp",
            "from credo import rollout",
            "from credo.runs.loop import train",
            "from . import mlp",
            "from .. import tree",
            "from ..environments.base import correct",
            "def late():",
            "    from ..analysis import memory",
        ]
    )
    assert imports(source, ("credo", "networks")) == {
        "cli",
        "rollout",
        "runs",
        "networks",
        "tree",
        "environments",
        "analysis",
    }
