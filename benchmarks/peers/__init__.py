"""Scripts that peers' own environments run, and how they are called."""

import json
import os
import pathlib
import subprocess
from typing import Any

PEERS = ("torch", "sb3", "sbx", "evorl", "vmas", "benchmarl", "neat", "rejax")
FOLDER = pathlib.Path(__file__).parent
VARIABLES = {name: f"CREDO_PEER_{name.upper()}" for name in PEERS}


def ask(peer: str, script: str, *arguments: str) -> dict[str, Any] | None:
    """What a peer's script measured; None if its Python is not given."""
    python = os.environ.get(VARIABLES[peer])
    if not python:
        print(f"  ({peer}: not measured; set {VARIABLES[peer]} to a Python that has it)")
        return None
    answer = subprocess.run(
        [python, str(FOLDER / script), *arguments], capture_output=True, text=True
    )
    if answer.returncode:
        raise RuntimeError(f"{script} failed:\n{answer.stderr[-2000:]}")
    return json.loads(answer.stdout.splitlines()[-1])
