"""How a command ends: one line on stderr and an exit code, whatever was raised.

0: done. 1: it failed. 2: it was asked for wrongly. 128 + n: signal n, so 130 after Ctrl-C and 141
where what is printed is not read. What was not foreseen leaves its traceback in a file, which the
line names. Nothing here imports JAX.
"""

import contextlib
import linecache
import os
import pathlib
import select
import sys
import tempfile
import traceback
from collections.abc import Callable
from typing import Any

from . import screen, signals

ROOT = str(pathlib.Path(__file__).parents[1]) + os.sep  # Credo's own code
PIPE, INTERRUPT = 141, 130


def say(text: str) -> None:
    """A line on stderr, if anybody reads it; what a name out of a file may hold moves no cursor."""
    screen.say("".join(c if c.isprintable() or c in "\n\t" else f"\\x{ord(c):02x}" for c in text))


def run(command: Callable[[], Any], *, alone: bool = False) -> None:
    """Call `command`. What it raises ends as `SystemExit` with a code, and is said. `alone`: it is
    all that this process does."""
    if alone:
        signals.hear()
    try:
        try:
            command()
        finally:
            sys.stdout.flush()
    except BaseException as error:
        code = _code(error)
        if alone and isinstance(error, KeyboardInterrupt):
            _leave(code)
    else:
        return
    raise SystemExit(code)  # outside of `except`: nothing is chained that might be printed


def _leave(code: int) -> None:
    """End at once. A library that Ctrl-C met while it was imported is half there, and may crash as
    Python takes itself apart; what was to be saved was saved before, and workers end with us."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    os._exit(code)


def open_streams() -> None:
    """A standard stream that the caller has closed goes nowhere, and what is printed there too."""
    screen.occupy()
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r+"))  # noqa: SIM115


def _code(error: BaseException) -> Any:
    """What an exception is to the shell; said on stderr, unless it was said where it was raised."""
    if isinstance(error, SystemExit):
        return _exit(error)
    if isinstance(error, KeyboardInterrupt):
        say("credo: stopped")
        return INTERRUPT
    if isinstance(error, BrokenPipeError) and _unread():
        return PIPE
    if _memory(error):
        say(
            f"credo: not enough memory: {first(error) or type(error).__name__}. Give a smaller "
            "population, network, number of episodes or --replay-capacity"
        )
        return 1
    if type(error).__module__.startswith("credo.") or isinstance(error, OSError):
        say(f"credo: {error}")
        return getattr(error, "code", 1)
    if file := _raised_here(error):
        say(f"credo: {error}")
        wrong = isinstance(error, ValueError | TypeError)
        return 2 if wrong and not file.startswith(f"{ROOT}runs{os.sep}") else 1
    say(f"credo: {_unforeseen(error)}; {_traceback(error)}")
    return 1


def _exit(error: SystemExit) -> Any:
    """Only Credo and what reads its flags may end a command: code that it calls may not, least of
    all with 0, which would say that all is well."""
    last = traceback.extract_tb(error.__traceback__)[-1].filename
    if last.startswith(ROOT) or f"{os.sep}tyro{os.sep}" in last:
        return error.code
    say(f"credo: {place(error) or last} ends Python (exit code {error.code!r})")
    return 1


def _unread() -> bool:
    """Whether stdout is not read any more; what is still to be written there goes nowhere."""
    try:
        number, poll = sys.stdout.fileno(), select.poll()
        poll.register(number, 0)
        if not poll.poll(0):
            return False
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, number)  # Python flushes once more when it ends
        os.close(null)
    except (OSError, ValueError, AttributeError):  # no descriptor, or no poll on this system
        return False
    return True


def _memory(error: BaseException) -> bool:
    """Python's and NumPy's want of memory, and that of JAX, whose classes have moved about."""
    runtime = type(error).__name__ in ("JaxRuntimeError", "XlaRuntimeError")
    return isinstance(error, MemoryError) or (runtime and "RESOURCE_EXHAUSTED" in str(error))


def _raised_here(error: BaseException) -> str:
    """The file of Credo whose `raise` this is, or "". A `raise` of ours has a sentence; what only
    went wrong in our code has none."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    line = linecache.getline(last.filename, last.lineno or 0)
    ours = last.filename.startswith(ROOT) and line.lstrip().startswith("raise ")
    return last.filename if ours else ""


def place(error: BaseException) -> str:
    """Where code of others raised this, as `file:line`; "" if it was raised in
    ours or in a package."""
    installed = (ROOT, sys.prefix, sys.base_prefix)
    for at in reversed(traceback.extract_tb(error.__traceback__)):
        if os.path.isabs(at.filename) and not at.filename.startswith(installed):
            return f"{at.filename}:{at.lineno}"
    return ""


def first(error: BaseException) -> str:
    """The first line of what an exception says."""
    return str(error).strip().partition("\n")[0].rstrip(".")


def _unforeseen(error: BaseException) -> str:
    what, where = f"{type(error).__name__}: {first(error)}", place(error)
    return f"{where} raised {what}" if where else f"internal error: {what}"


def _traceback(error: BaseException) -> str:
    """Write the traceback to a file that was not there before, and say which."""
    text = "".join(traceback.format_exception(error))
    try:
        number, path = tempfile.mkstemp(prefix="credo-", suffix=".log")  # follows no link
        with open(number, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(f"{sys.argv}\n\n{text}")
    except OSError as failure:
        return f"its traceback cannot be written ({failure}):\n{text}"
    return f"the traceback is in {path}"
