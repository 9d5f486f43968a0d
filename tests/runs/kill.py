"""Kill a run at random moments, resume it each time, and compare it with one left alone.

    python tests/runs/kill.py --what erl --kills 20

Half of the kills fall before a process trains (imports, the first checkpoint, compiling), half
while it trains and writes; none after the run's end. What must agree, byte for byte: metrics,
champion, config and the last checkpoint.
"""

import argparse
import pathlib
import random
import signal
import subprocess
import sys
import tempfile
import time

SMALL = (
    "--network.hidden 8 --warmup-frames 200 --replay-capacity 5000 --test-every 3 "
    "--updates-per-frame 0.02 --max-episode-steps 40"
)
TEAM = (
    "credo.environments.probes:Meet --network.trunk 8 --updates-per-frame 0.05 "
    "--replay-capacity 2000 --test-episodes 2"
)
TRAIN = {
    "neuroevolution": "neuroevolution sequence-classification --depth 3 --min-gap 1 --max-gap 3 "
    "--population-size 20 --episodes 5 --network.hidden 3",
    "bptt": "bptt sequence-recall --depth 2 --min-corridor 1 --max-corridor 3 --batch-size 20 "
    "--updates 2 --network.hidden 3 --train-size 100",
    "ccea": "ccea credo.environments.probes:Meet --population-size 6 --elite-fraction 0.2 "
    "--teams 2 --episodes 2 --test-episodes 4 --network.hidden 4",
    "islands": "ccea credo.environments.probes:Meet --population-size 6 --elite-fraction 0.34 "
    "--teams 2 --episodes 2 --test-episodes 4 --network.hidden 4 "
    "islands:islands --islands.number 2 --islands.renewal 0.05",
    "dmmu": "neuroevolution credo.environments.probes:Meet --network dmmu --network.hidden 3 "
    "--population-size 6 --elite-fraction 0.2 --episodes 2 --test-episodes 4",
    "erl": f"erl InvertedPendulum-v5 {SMALL} --sync-period 2",
    "cerl": f"cerl InvertedPendulum-v5 {SMALL}",
    "merl": f"merl {TEAM} --population-size 6 --elite-fraction 0.34 --episodes 2 --workers 4 "
    "--warmup-frames 200 --test-every 3 --migration-period 2",
    "matd3": f"matd3 {TEAM} --learner.critic.critic.hidden 8 --learner.batch-size 16 "
    "--episodes 4 --start-frames 100 --test-every 100",
}
GENERATIONS = {  # enough for 20 kills
    "neuroevolution": 100_000,
    "bptt": 20_000,
    "ccea": 60_000,
    "islands": 60_000,
    "dmmu": 20_000,
    "erl": 300,
    "cerl": 150,
    "merl": 100_000,
    "matd3": 150_000,
}


def start(run: pathlib.Path, what: str, generations: int) -> subprocess.Popen:
    """Resume the run if there is one to resume, else train."""
    often = ["--checkpoint-every", "0.05"]
    if (run / "config.json").exists():
        arguments = ["resume", str(run), *often]
    else:
        algorithm, task, *flags = TRAIN[what].split()
        budget = ["--generations", str(generations), "--path", str(run)]
        arguments = ["train", algorithm, task, *budget, *often, *flags]
    return subprocess.Popen(
        [sys.executable, "-m", "credo.cli", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(run: pathlib.Path, what: str, generations: int) -> None:
    process = start(run, what, generations)
    output, _ = process.communicate()
    if process.returncode != 0:
        raise SystemExit(f"credo failed with exit code {process.returncode}:\n{output}")


def rows(run: pathlib.Path) -> int:
    path = run / "timing.csv"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def trains(process: subprocess.Popen, run: pathlib.Path, before: int) -> float:
    """Wait for the first row of metrics beyond `before`: the seconds that took."""
    began = time.monotonic()
    while process.poll() is None and rows(run) <= before and time.monotonic() - began < 120:
        time.sleep(0.002)
    return time.monotonic() - began


def kill_once(
    run: pathlib.Path, what: str, generations: int, starting: float, rng: random.Random
) -> str:
    """Start, wait for a random moment, SIGKILL. Says where the run then was."""
    began, before = time.monotonic(), rows(run)
    process = start(run, what, generations)
    if rng.random() < 0.5:
        time.sleep(rng.uniform(0.0, starting))
    else:
        trains(process, run, before)
        time.sleep(rng.uniform(0.0, 0.5))
    ended = process.poll()
    process.send_signal(signal.SIGKILL)
    output, _ = process.communicate()
    if ended == 0:
        raise SystemExit("the run reached its end before a kill: give more --generations")
    if ended is not None:
        raise SystemExit(f"credo failed with exit code {ended}:\n{output}")
    saved = sorted(p.name for p in (run / "checkpoints").glob("[0-9]*"))
    return f"after {time.monotonic() - began:.2f} s, newest checkpoint {saved[-1:] or 'none'}"


def different(a: pathlib.Path, b: pathlib.Path) -> list[str]:
    """Files that are not the same bytes in both runs."""
    newest = sorted(p.name for p in (a / "checkpoints").glob("[0-9]*"))[-1]
    names = ["metrics.csv", "champion.safetensors", "config.json"]
    names += [f"checkpoints/{newest}/{p.name}" for p in (a / "checkpoints" / newest).iterdir()]
    return [
        name
        for name in names
        if not (b / name).exists() or (a / name).read_bytes() != (b / name).read_bytes()
    ]


def compare(
    folder: pathlib.Path,
    kills: int,
    generations: int,
    seed: int = 0,
    what: str = "neuroevolution",
) -> list[str]:
    """The files in which a run killed `kills` times differs from one left alone."""
    rng = random.Random(seed)
    finish(
        folder / "first", what, 1
    )  # compiles, so that the next start takes as long as those killed
    process = start(folder / "alone", what, generations)
    starting = trains(process, folder / "alone", 0)
    output, _ = process.communicate()
    if process.returncode != 0:
        raise SystemExit(f"credo failed with exit code {process.returncode}:\n{output}")
    for i in range(kills):
        where = kill_once(folder / "killed", what, generations, starting, rng)
        print(f"kill {i + 1:2d} {where}", flush=True)
    finish(folder / "killed", what, generations)
    return different(folder / "alone", folder / "killed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--what", choices=TRAIN, default="neuroevolution")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--generations", type=int, help="enough for all kills by default")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = compare(
            pathlib.Path(folder),
            arguments.kills,
            arguments.generations or GENERATIONS[arguments.what],
            arguments.seed,
            arguments.what,
        )
    print(f"differing files: {', '.join(found) or 'none'}")
    raise SystemExit(bool(found))


if __name__ == "__main__":
    main()
