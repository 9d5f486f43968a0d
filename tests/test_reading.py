"""How much code ERL is: the functions of its file that run, and everything that they call."""

import ast
import pathlib
import sys

import jax
import pytest

import credo
from credo.algorithms.erl import ERL
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Copy

SOURCE = pathlib.Path(credo.__file__).parent
DEFINITIONS = (ast.FunctionDef, ast.ClassDef, ast.Module)


def called(function) -> dict[pathlib.Path, set[int]]:
    """First lines of the functions of Credo that run, by file."""
    found: dict[pathlib.Path, set[int]] = {}
    prefix = str(SOURCE)

    def look(frame, event, _):
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(prefix):
            found.setdefault(pathlib.Path(code.co_filename), set()).add(code.co_firstlineno)

    jax.clear_caches()  # what was compiled before is not traced again
    sys.setprofile(look)
    try:
        function()
    finally:
        sys.setprofile(None)
    return found


def code(path: pathlib.Path, firsts: set[int]) -> int:
    """Lines of these functions, without blank ones, comments and docstrings."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    kept, docs = set(), set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            first = min(x.lineno for x in (node, *node.decorator_list))
            if first in firsts:
                kept |= set(range(first, node.end_lineno + 1))
        if isinstance(node, DEFINITIONS) and ast.get_docstring(node) is not None:
            docs |= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return sum(lines[i - 1].strip()[:1] not in ("", "#") for i in kept - docs)


@pytest.mark.parametrize("env", [Copy(), Gymnasium("InvertedPendulum-v5", in_process=True)])
def test_erl_and_what_it_calls_is_short(env):
    """At most 800 lines, whether the task is JAX or not. Neither the task itself is counted nor, of
    one outside JAX, who plays it."""
    erl = ERL.erl(env, warmup_frames=1, replay_capacity=1000, updates_per_frame=0.1)

    def three_generations():
        state = erl.init(key=jax.random.key(0))
        for g in range(3):
            state, _ = erl.generation(state, key=jax.random.key(g))

    found = called(three_generations)
    files = {path.relative_to(SOURCE).as_posix() for path in found}
    assert {"algorithms/erl.py", "rollout.py", "replay.py", "learners/td3.py"} <= files
    others = ("environments", "playing")
    mine = {path: at for path, at in found.items() if path.parent.name not in others}
    assert sum(code(path, at) for path, at in mine.items()) <= 800
