"""A process that plays one share after another (see `players`): pickles in, pickles out, each
behind its length, and what comes in behind a byte as well, 1 if this process is to be spared. It
computes on one core, in one thread, and ends when its input does.

What it reads is from the process that started it, and what it writes is read by that one alone.
"""

import os
import pickle
import struct
import sys
from typing import Any

from ..environments import processes

LENGTH = struct.Struct("=Q")
ASKED = struct.Struct("=?Q")  # whether the task may not end this process, and the length


def main() -> None:
    """Play shares until there are none."""
    processes.settle()
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever prints must not look like an answer
    import jax

    from ..compilation import enable_cache, float32
    from ..environments import foreign

    # On its one core a second thread would only have to be waited for, at every step.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    enable_cache()
    foreign.judged_elsewhere()
    with float32():
        while head := sys.stdin.buffer.read(ASKED.size):
            spared, length = ASKED.unpack(head)
            foreign.spare(not spared)
            body = sys.stdin.buffer.read(length)
            message = pickle.dumps(_answer(body), protocol=5)
            answers.write(LENGTH.pack(len(message)))
            answers.write(message)
            answers.flush()


def _answer(body: bytes) -> tuple[str, Any]:
    """The outcomes of some parts and how their episodes ended, or in words what was raised."""
    from ..environments import foreign
    from ..environments.host import EnvironmentFailure
    from . import play

    try:
        parts, what = pickle.loads(body)
        foreign.know(parts[0].env, what)
    except Exception as error:  # a class of the user's script, which this process did not run
        return "unknown", f"{type(error).__name__}: {error}"
    try:
        told = foreign.tally(parts[0].env)
        told.news.clear()
        return "outcome", (play(parts), told.news)
    except EnvironmentFailure as error:
        return "failure", str(error)
    except Exception as error:  # the parent reports it
        return "error", f"{type(error).__name__}: {error}"
