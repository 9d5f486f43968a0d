"""Disturb a run at random moments, resume it each time, and compare it with one left alone.

    python tests/runs/kill.py --what erl --times 20
    python tests/runs/kill.py --what all --times 104 --how all

A disturbance is SIGKILL, SIGTERM, SIGINT, SIGHUP, output that nobody reads any more, or a pause
(SIGSTOP, SIGCONT) before a SIGKILL. Half of them fall before a process trains (imports, the first
checkpoint, compiling), half while it trains and writes; none after the run's end. What must agree,
byte for byte: metrics, champion, config and the last checkpoint. No process may be left.
"""

import argparse
import os
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
ALONE = (
    "InvertedPendulum-v5 --network.hidden 8 --start-frames 100 --replay-capacity 5000 "
    "--test-every 100 --test-episodes 2 --updates-per-frame 0.05 --max-episode-steps 40 "
    "--learner.batch-size 16 --learner.critic.hidden 8"
)
TEAM = (
    "credo.environments.probes:Meet --network.trunk 8 --updates-per-frame 0.05 "
    "--replay-capacity 2000 --test-episodes 2"
)
TEAM_ALONE = (
    f"{TEAM} --learner.critic.critic.hidden 8 --learner.batch-size 16 "
    "--episodes 4 --start-frames 100 --test-every 100"
)
TRAIN = {
    "neuroevolution": "neuroevolution sequence-classification --depth 3 --min-gap 1 --max-gap 3 "
    "--population-size 20 --episodes 5 --network.hidden 3",
    "neat": "neat sequence-classification --depth 3 --min-gap 1 --max-gap 3 "
    "--population-size 20 --episodes 5 --network.hidden 3 --connections 20",
    "infomax": "neat sequence-classification --depth 3 --min-gap 1 --max-gap 3 --cells lstm "
    "--population-size 20 --episodes 5 --network.hidden 3 --connections 20 "
    "--infomax infomax --infomax.generations 5000 --infomax.episodes 10",
    "bptt": "bptt sequence-recall --depth 2 --min-corridor 1 --max-corridor 3 --batch-size 20 "
    "--updates 2 --network.hidden 3 --train-size 100",
    "ccea": "ccea credo.environments.probes:Meet --population-size 6 --breeder.elite-fraction 0.2 "
    "--teams 2 --episodes 2 --test-episodes 4 --network.hidden 4",
    "islands": "ccea credo.environments.probes:Meet --population-size 6 "
    "--breeder.elite-fraction 0.34 "
    "--teams 2 --episodes 2 --test-episodes 4 --network.hidden 4 "
    "breeder.islands:islands --breeder.islands.number 2 --breeder.islands.renewal 0.05",
    "dmmu": "neuroevolution credo.environments.probes:Meet --network dmmu --network.hidden 3 "
    "--population-size 6 --breeder.elite-fraction 0.2 --episodes 2 --test-episodes 4",
    "erl": f"erl InvertedPendulum-v5 {SMALL} --sync-period 2",
    "cerl": f"cerl InvertedPendulum-v5 {SMALL}",
    "ea": "ea InvertedPendulum-v5 --network.hidden 8 --test-every 3 --max-episode-steps 40",
    "merl": f"merl {TEAM} --population-size 6 --breeder.elite-fraction 0.34 --episodes 2 "
    "--workers 4 "
    "--warmup-frames 200 --test-every 3 --migration-period 2",
    "td3": f"td3 {ALONE}",
    "ddpg": f"ddpg {ALONE}",
    "sac": f"sac {ALONE}",
    "memory": f"sac {ALONE} --network gru --hide velocities --sampling.window 8 "
    "--sampling.burn-in 2 --learner.batch-size 16",
    "ppo": "ppo InvertedPendulum-v5 --network.hidden 8 --critic.hidden 8 --horizon 100 --copies 4 "
    "--batch-size 20 --epochs 2 --test-episodes 2 --test-every 300 --max-episode-steps 40",
    "matd3": f"matd3 {TEAM_ALONE}",
    "maddpg": f"maddpg {TEAM_ALONE}",
}
GENERATIONS = {  # half of them are enough for seven disturbances
    "neuroevolution": 100_000,
    "neat": 20_000,
    "infomax": 15_000,
    "bptt": 20_000,
    "ccea": 60_000,
    "islands": 60_000,
    "dmmu": 80_000,
    "erl": 300,
    "cerl": 150,
    "ea": 400,
    "merl": 4_000,
    "td3": 1_400,
    "ddpg": 1_400,
    "sac": 1_200,
    "memory": 900,
    "ppo": 500,
    "matd3": 120_000,
    "maddpg": 120_000,
}
SIGNALS = {
    "term": signal.SIGTERM,
    "int": signal.SIGINT,
    "hup": signal.SIGHUP,
    "pipe": signal.SIGINT,
}
HOW = ("kill", "stop", *SIGNALS)
MARK = "CREDO_KILL_MARK"  # in the environment of every process of a run
PATIENCE = 60.0  # seconds that a process gets to save and end


def start(run: pathlib.Path, what: str, generations: int, output=subprocess.PIPE):
    """Resume the run if there is one to resume, else train."""
    often = ["--checkpoint-every", "0.05"]
    if (run / "config.json").exists():
        arguments = ["resume", str(run), *often]
    else:
        algorithm, task, *flags = TRAIN[what].split()
        budget = ["--generations", str(generations), "--path", str(run)]
        arguments = ["train", algorithm, task, *budget, *often, *flags]
    return subprocess.Popen(
        [sys.executable, "-m", "credo", *arguments],
        stdout=output,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {MARK: str(run)},
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


def left_over(run: pathlib.Path) -> list[int]:
    """Processes of this run that are still there."""
    mark, found = f"{MARK}={run}".encode(), []
    for path in pathlib.Path("/proc").glob("[0-9]*/environ"):
        try:
            if mark in path.read_bytes().split(b"\0"):
                found.append(int(path.parent.name))
        except OSError:
            continue  # it has ended, or is somebody else's
    return found


def disturb(
    run: pathlib.Path, what: str, generations: int, starting: float, how: str, rng: random.Random
) -> str:
    """Start, wait for a random moment, disturb. Says where the run then was."""
    began, before = time.monotonic(), rows(run)
    reader, writer = os.pipe()
    process = start(run, what, generations, writer)
    os.close(writer)
    early = rng.random() < 0.5
    if how == "pipe":
        os.close(reader)  # whatever it says from now on raises in it
    if early:
        time.sleep(rng.uniform(0.0, starting))
    else:
        trains(process, run, before)
        time.sleep(rng.uniform(0.0, 0.5))
    if process.poll() == 0 or (process.poll() == 141 and how == "pipe"):
        raise SystemExit("the run reached its end before a disturbance: give more --generations")
    if process.poll() is not None:
        told = "" if how == "pipe" else os.read(reader, 100_000).decode()
        raise SystemExit(f"credo failed with exit code {process.returncode}:\n{told}")
    if how == "stop":
        process.send_signal(signal.SIGSTOP)
        time.sleep(rng.uniform(0.0, 0.5))
        process.send_signal(signal.SIGCONT)
        time.sleep(rng.uniform(0.0, 0.5))
    number = SIGNALS.get(how, signal.SIGKILL)
    process.send_signal(number)
    code = process.wait(PATIENCE)
    # Before Python has its handlers a signal simply ends it; a run that is over just then is fine.
    if code not in (0, -number, 128 + number):
        raise SystemExit(f"{number.name} ended credo with exit code {code}")
    end = time.monotonic() + 5.0
    while left_over(run) and time.monotonic() < end:
        time.sleep(0.02)
    if left_over(run):
        raise SystemExit(f"after {number.name} processes {left_over(run)} are left")
    if how != "pipe":
        os.close(reader)
    saved = sorted(p.name for p in (run / "checkpoints").glob("[0-9]*"))
    return f"{how} after {time.monotonic() - began:.2f} s, newest checkpoint {saved[-1:] or 'none'}"


def content(path: pathlib.Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


def different(a: pathlib.Path, b: pathlib.Path) -> list[str]:
    """Files that are not the same bytes in both runs."""
    newest = sorted(p.name for p in (a / "checkpoints").glob("[0-9]*"))[-1]
    names = ["metrics.csv", "champion.safetensors", "config.json"]
    names += ["best.safetensors"] * any((run / "best.safetensors").exists() for run in (a, b))
    names += [f"checkpoints/{newest}/{p.name}" for p in (a / "checkpoints" / newest).iterdir()]
    return [name for name in names if content(a / name) != content(b / name)]


def compare(
    folder: pathlib.Path,
    times: int,
    generations: int,
    seed: int = 0,
    what: str = "neuroevolution",
    how: tuple[str, ...] = ("kill",),
) -> list[str]:
    """The files in which a run disturbed so often differs from one left alone."""
    rng = random.Random(seed)
    # It compiles, so that the next start takes as long as those disturbed.
    finish(folder / "first", what, 1)
    process = start(folder / "alone", what, generations)
    starting = trains(process, folder / "alone", 0)
    output, _ = process.communicate()
    if process.returncode != 0:
        raise SystemExit(f"credo failed with exit code {process.returncode}:\n{output}")
    for i in range(times):
        kind = how[(seed + i) % len(how)]
        where = disturb(folder / "disturbed", what, generations, starting, kind, rng)
        print(f"{what} {i + 1:2d} {where}", flush=True)
    finish(folder / "disturbed", what, generations)
    return different(folder / "alone", folder / "disturbed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--what", choices=[*TRAIN, "all"], default="neuroevolution")
    parser.add_argument("--how", choices=[*HOW, "all"], default="kill")
    parser.add_argument("--times", type=int, default=20, help="of all runs together")
    parser.add_argument("--generations", type=int, help="by default as many as so many take")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    arguments = parser.parse_args()
    # Where this was started by `nohup` or in the background, its children would ignore them.
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    names = list(TRAIN) if arguments.what == "all" else [arguments.what]
    how = HOW if arguments.how == "all" else (arguments.how,)
    times, failed = -(-arguments.times // len(names)), []
    for i, what in enumerate(names):
        generations = arguments.generations or GENERATIONS[what] * max(times, 2) // 14
        with tempfile.TemporaryDirectory() as folder:
            found = compare(pathlib.Path(folder), times, generations, arguments.seed + i, what, how)
        print(f"{what}: differing files: {', '.join(found) or 'none'}", flush=True)
        failed += [what] if found else []
    print(f"{len(names) * times} disturbances of {len(names)} runs; differing: {failed or 'none'}")
    raise SystemExit(bool(failed))


if __name__ == "__main__":
    main()
