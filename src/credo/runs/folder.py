"""The folder of a run: who may have it, and what is left of it when a run fails to begin."""

import contextlib
import os
import pathlib
import re
from collections.abc import Iterator
from typing import Any

from . import files, screen
from .config import to_tree
from .lock import is_lock, lock
from .names import run_name
from .record import NAME, RunError

LEFT = re.compile(
    r"lock|\.config\.json\.draft(\.json)?|checkpoints(/\.?0{8}[\w.-]*"
    r"(/\.?(state\.safetensors|counters\.json|COMMIT|replay\d[\w.-]*)(\.draft\w*)?)?)?"
)
"""What a process leaves in a folder that dies before its run begins: nothing but the first
checkpoint, or less, and what holds the folder meanwhile."""


def runs_in(path: str | pathlib.Path) -> list[pathlib.Path]:
    """The run at `path`, or all runs directly inside it, as `--seeds` makes them. Raises `RunError`
    if there is none."""
    path = pathlib.Path(path)
    if os.path.lexists(path / NAME):
        return [path]
    inside = [file.parent for file in path.glob(f"*/{NAME}")]
    if not inside:
        raise RunError(
            f"{path} is no run and has none in it: name a folder that `credo train` made, with "
            "--seeds or without"
        )
    number = re.compile(r"\d+")  # seed-2 comes before seed-10
    return sorted(inside, key=lambda run: number.sub(lambda m: m[0].zfill(20), run.name))


def free_name(algorithm: Any, seed: int | str) -> pathlib.Path:
    """A folder that does not exist, named by the words for the algorithm and the task."""
    label = run_name(to_tree(algorithm))
    name = re.sub(r"[^\w.]+", "-", f"{label}-{seed}".lower())
    path, copies = pathlib.Path("runs") / name, 1
    while path.exists():
        copies += 1
        path = pathlib.Path("runs") / f"{name}-{copies}"
    if copies > 1:
        screen.say(f"credo: runs/{name} is there already: this run goes to {path}")
    return path


@contextlib.contextmanager
def new_folder(path: pathlib.Path) -> Iterator[None]:
    """Own a new or empty folder for a run. If none comes to be in it, all is as it was before."""
    _refuse_occupied(path)
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    locked = os.path.lexists(path / "lock")
    try:
        with lock(path):
            _refuse_occupied(path)  # another process may have been quicker
            begun = os.path.lexists(path / "checkpoints")
            try:
                yield
            except BaseException:
                if not (path / NAME).exists():
                    if not begun:
                        files.remove(path / "checkpoints")
                    if not locked:  # while it is ours: later it may be another's
                        files.remove(path / "lock")
                raise
    except BaseException:
        if not (path / NAME).exists():
            with contextlib.suppress(OSError):  # something else may lie there by now
                for folder in made:
                    folder.rmdir()
        raise


def _left(folder: pathlib.Path, path: pathlib.Path) -> bool:
    """Whether something in a folder was left by a process that died before its run began."""
    relative = path.relative_to(folder)
    name = relative.as_posix()
    if path.is_symlink() or not LEFT.fullmatch(name):
        return False
    if relative.parts[0] == "checkpoints" and len(relative.parts) < 3:
        return path.is_dir()
    return path.is_file() and (name != "lock" or is_lock(path))


def _refuse_occupied(path: pathlib.Path) -> None:
    """Raise unless a new run can have this folder: nothing in it is ever removed."""
    if not os.path.lexists(path):
        return
    if not path.is_dir():
        raise RunError(f"{path} is no folder: choose another path for the run")
    if os.path.lexists(path / NAME):
        raise RunError(
            f"{path} holds a run already: `credo resume {path}` goes on with it; choose another "
            "path for a new one"
        )
    if not all(_left(path, entry) for entry in path.rglob("*")):
        names = sorted(os.listdir(path))
        more = ", …" if len(names) > 3 else ""
        raise RunError(
            f"{path} is not empty and no run of Credo's (it holds {', '.join(names[:3])}{more}): "
            "give a new or an empty folder"
        )
