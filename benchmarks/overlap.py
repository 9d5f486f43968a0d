"""Seconds of a generation of ERL and CERL on Swimmer: on one core, and on two with `--overlap`.

On one core the parts are told apart: what is played, by one process, and what is learned, in one
thread of XLA. The goal is that overlap saves the smaller of the two, less a tenth.
"""

import functools
import json
import os
import subprocess
import sys
import tempfile
import time

KINDS = {
    "erl, 0.1 updates per frame": ("erl", "0.1", 14),
    "cerl, 0.02 updates per frame": ("cerl", "0.02", 11),
}
WARM = 4  # generations, in which programs compile and players begin
GOAL = 0.9  # of the smaller part


def clocked(words: list[str]) -> None:
    """`credo` with these words, in this process; then seconds of a generation and of its play, as
    JSON."""
    from credo.algorithms.erl import ERL
    from credo.cli import main
    from credo.playing import players

    marks, played = list[tuple[float, float]](), [0.0]
    settle, generation = players.Players.settle, ERL.generation

    def settled(self, *asked):
        began = time.perf_counter()
        settle(self, *asked)
        played[0] += time.perf_counter() - began

    @functools.wraps(generation)
    def begun(self, state, *, key):
        marks.append((time.perf_counter(), played[0]))
        return generation(self, state, key=key)

    players.Players.settle, ERL.generation = settled, begun
    main(words)
    (began, before), (ended, after), n = marks[WARM], marks[-1], len(marks) - 1 - WARM
    print(json.dumps({"all": (ended - began) / n, "play": (after - before) / n}))


def measured(cores: list[int], kind: str, *more: str) -> dict[str, float]:
    """What `clocked` says of a run on some cores."""
    preset, updates, generations = KINDS[kind]
    with tempfile.TemporaryDirectory() as folder:
        words = ["train", preset, "Swimmer-v5", "--updates-per-frame", updates, "--path"]
        words += [f"{folder}/run", "--generations", str(generations), "--progress", "False", *more]
        program = f"from benchmarks.overlap import clocked; clocked({words!r})"
        told = subprocess.run(
            [sys.executable, "-c", program],
            check=True,
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: os.sched_setaffinity(0, cores),
        ).stdout
    return json.loads(told.splitlines()[-1])


def main() -> None:
    every = list(range(os.cpu_count() or 1))[:2]
    print("seconds of a generation on Swimmer: one core; two with overlap")
    for kind in KINDS:
        one = measured(every[:1], kind, "--processes", "1")
        two = measured(every, kind, "--overlap", "True")
        play, learn = one["play"], one["all"] - one["play"]
        saved = (one["all"] - two["all"]) / min(play, learn)
        print(
            f"  {kind:29s} {one['all']:.2f} (play {play:.2f}, learn {learn:.2f}); "
            f"{two['all']:.2f}: saves {saved:.2f} of the smaller part (goal {GOAL})"
        )


if __name__ == "__main__":
    main()
