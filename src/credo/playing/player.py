"""A process that plays one share after another for the one that started it (see `local`): pickles
in, each behind a byte, 1 if this process is to be spared, and its length; pickles out, each behind
its length. It ends when its input does.
"""

import functools
import os
import pickle
import struct

from .crew import answer, enlist

LENGTH = struct.Struct("=Q")
ASKED = struct.Struct("=?Q")


def main() -> None:
    """Play shares until there are none."""
    asked, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    # What an environment or its children read or print is no question and no answer.
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(2, 1)
    enlist()
    while head := asked.read(ASKED.size):
        spared, length = ASKED.unpack(head)
        load = functools.partial(pickle.loads, asked.read(length))
        message = pickle.dumps(answer(load, spared), protocol=5)
        answers.write(LENGTH.pack(len(message)))
        answers.write(message)
        answers.flush()
