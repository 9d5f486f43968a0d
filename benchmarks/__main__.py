"""Run every benchmark: `python -m benchmarks [NAME …]`, one core each unless it says otherwise.

Compare ratios of one run; seconds depend on the machine and on who else uses it.
"""

import importlib
import os
import sys

NAMES = (
    "sequence_generation",
    "team_generation",
    "td3_update",
    "recurrent_update",
    "recurrent_ppo",
    "ppo_jax",
    "dqn",
    "erl_hopper",
    "erl_brax",
    "rover_step",
    "maddpg_update",
    "first_output",
    "replay_memory",
    "rollouts",
    "overlap",
    "workers",
    "neat_generation",
)

if __name__ == "__main__":
    # One core for everybody: libraries that use two would be compared with those that use one.
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[variable] = "1"
    names = sys.argv[1:] or NAMES
    for name in names:
        if name not in NAMES:
            raise SystemExit(f"no benchmark {name!r}: choose from {', '.join(NAMES)}")
        importlib.import_module(f"benchmarks.{name}").main()
