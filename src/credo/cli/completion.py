"""Completion for shells: `eval "$(credo --print-completion bash)"`, or zsh.

The script asks `credo --complete WORDS…` what can come next; that imports no JAX.
"""

from ..experiments.catalogue import EXPERIMENTS
from ..sweep.plan import Plan
from . import commands
from .line import Line
from .names import ALGORITHMS, CATALOGUE, COMMANDS, fail

SCRIPT = """_credo() {
    local known="$(credo --complete "${COMP_WORDS[@]:1:COMP_CWORD-1}")"
    COMPREPLY=($(compgen -W "$known" -- "${COMP_WORDS[COMP_CWORD]}"))
}
complete -o default -F _credo credo"""
SHELLS = {"bash": SCRIPT, "zsh": f"autoload -U +X bashcompinit && bashcompinit\n{SCRIPT}"}


def script(shell: str = "") -> str:
    """What a shell must be told, to be evaluated by it."""
    if shell not in SHELLS:
        fail(f"no completion for {shell!r}", shell, SHELLS)
    return SHELLS[shell]


def next(words: list[str]) -> str:
    """What can stand behind these words, separated by spaces; "" where it is a file. Of an
    algorithm's flags it knows the short names alone: the others would need JAX."""
    match words:
        case []:
            return " ".join(COMMANDS)
        case ["train"]:
            return " ".join(ALGORITHMS)
        case ["train", _]:
            return " ".join(CATALOGUE["tasks"])
        case ["reproduce"]:
            return " ".join(EXPERIMENTS)
        case [*_, "--network" | "--preset" as flag]:
            return " ".join(CATALOGUE[f"{flag.strip('-')}s"])
        case [command, *_] if command in COMMANDS:
            line = Line(command, ["", ""])
            line.command(getattr(commands, command.title()))
            if command == "sweep":
                line.take(Plan())
            names = [*(CATALOGUE["short"] if command == "train" else ()), *line.known()]
            return " ".join(f"--{name}" for name in names)
    return ""
