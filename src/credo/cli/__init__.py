"""The command line: the only place where names are looked up.

Nothing here imports JAX before a command needs it: `credo --help` answers at once.
"""

import os
import sys
import warnings

from ..runs import ending
from .names import ALGORITHMS, COMMANDS, fail


def main(argv: list[str] | None = None) -> None:
    """Entry point of `credo`. Whatever happens ends in a line and an exit code (see `ending`).

    **Arguments:** `argv`: what was typed behind `credo`; None: the process's own, which then ends
    with the command.
    """
    ending.open_streams()
    words = list(sys.argv[1:] if argv is None else argv)
    ending.run(lambda: _command(words), alone=argv is None)


def _command(argv: list[str]) -> None:
    """Do what the first word says."""
    match argv:
        case [] | ["-h" | "--help" | "--help-all" | "help", *_]:
            print(overview())
        case ["-V" | "--version", *_]:
            from importlib.metadata import version

            print("credo", version("credo"))
        case ["--print-completion", *shell]:
            from . import completion

            print(completion.script(*shell))
        case ["--complete", *words]:
            from . import completion

            print(completion.next(words))
        case [command, *rest]:
            _run(command, rest)


def _run(command: str, argv: list[str]) -> None:
    """Read the words and flags of a command, and call it. Its warnings are lines on stderr."""
    if command not in COMMANDS:
        if command in ALGORITHMS:
            fail(f"{command} is an algorithm: credo train {command} TASK")
        fail(f"no command {command!r}", command, COMMANDS)
    from . import commands, settings
    from .line import Line

    warnings.showwarning = lambda message, *_args, **_kw: ending.say(f"warning: {message}")
    try:
        sys.path.insert(0, os.getcwd())  # environments of users lie where they work
    except OSError as error:
        ending.say(f"credo: this folder is not there any more ({error.strerror}): go to another")
        raise SystemExit(1) from None
    line = Line(command, argv)
    if command == "train":
        settings.add_file(line)
    line.command(getattr(commands, command.title()))(line)


def overview() -> str:
    """Every command in a line."""
    width = max(map(len, COMMANDS)) + 2
    lines = ["usage: credo COMMAND …", "", "credit assignment by evolution and gradient", ""]
    lines += [f"  {name:<{width}}{text}" for name, text in COMMANDS.items()]
    lines += ["", "credo COMMAND --help shows a command's flags with units and defaults."]
    return "\n".join(lines)
