"""Memory of a replay buffer of a million Humanoid transitions, against the estimate that refuses a
buffer too large for the machine. Filled in a process of its own; needs 6 GB."""

import json
import os
import pathlib
import resource
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

from credo.replay import Replay, extend, row_bytes
from credo.types import Transition

OBS, ACT, ROWS, BLOCK = 348, 17, 1_000_000, 100_000
NEEDED, TOLERANCE = 6e9, 0.1


def transitions(n: int) -> Transition:
    """Rows of ones: pages that are not written would take no memory."""
    obs, action = np.ones((n, OBS), np.float32), np.ones((n, ACT), np.float32)
    rewards, ended = {"reward": np.ones(n, np.float32)}, np.ones(n, bool)
    return Transition(obs, action, rewards, obs, terminated=ended, truncated=ended)


def fill(rows: int) -> int:
    """Bytes by which the peak of this process grows while a buffer of `rows` is filled."""
    new = transitions(BLOCK)
    row = jax.tree.map(lambda x: jnp.asarray(x[0]), new)
    extend(Replay.empty(row, 10), transitions(10))  # JAX itself takes memory
    before = resident()
    replay = Replay.empty(row, rows)
    for _ in range(rows // BLOCK):
        replay = extend(replay, new)
    size = int(jax.block_until_ready(replay.size))
    if size != rows:
        raise RuntimeError(f"the buffer holds {size:,} of {rows:,} rows")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before


def resident() -> int:
    """Bytes of memory of this process now."""
    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def main() -> None:
    print(f"replay buffer of {ROWS:,} transitions, {OBS} observations and {ACT} actions")
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if free < NEEDED:
        print(f"  (not measured: {free / 1e9:.1f} GB are free, it takes {NEEDED / 1e9:.0f} GB)")
        return
    command = [sys.executable, "-m", "benchmarks.replay_memory", str(ROWS)]
    answer = subprocess.run(command, capture_output=True, text=True)
    if answer.returncode:
        raise RuntimeError(f"{command} failed:\n{answer.stderr[-2000:]}")
    peak = json.loads(answer.stdout)
    row = jax.tree.map(lambda x: x[0], transitions(1))
    estimate = ROWS * row_bytes(row)
    print(f"  {'row_bytes says':<34}{estimate / 1e9:8.3f} GB")
    print(f"  {'the peak of the process grew by':<34}{peak / 1e9:8.3f} GB")
    off = 100 * (peak / estimate - 1)
    print(f"  {'difference':<34}{off:+8.1f} %   goal within ±{100 * TOLERANCE:.0f} %")


if __name__ == "__main__":
    if len(sys.argv) == 1:
        main()
    else:
        print(json.dumps(fill(int(sys.argv[1]))))
