"""Nothing on the screen ends a training, and no wait outlives a second signal."""

import contextlib
import io
import os
import pathlib
import signal
import subprocess
import sys
import threading
import time

import pytest

from credo.runs import screen, signals
from credo.runs.budget import Budget
from credo.runs.progress import Progress
from credo.runs.signals import Signals

WAITS = """
import ctypes, sys, time
from credo.runs.signals import Signals
with Signals(quiet=False) as signals:
    print("ready", flush=True)
    {wait}
"""
PATIENT = "[time.sleep(0.1) for _ in range(600)]"
# Python hears of no signal in here: its handlers run between two steps of the main thread.
STUCK = (
    "m = ctypes.create_string_buffer(64); [ctypes.CDLL(None).pthread_mutex_lock(m) for _ in '12']"
)


@pytest.mark.parametrize("wait", [PATIENT, STUCK], ids=["patient", "stuck"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_second_signal_ends_any_wait(wait, number):
    script = WAITS.format(wait=wait)
    process = subprocess.Popen([sys.executable, "-c", script], stdout=-1, stderr=-1, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(number)
        time.sleep(0.3)
        assert process.poll() is None
        process.send_signal(number)
        began = time.monotonic()
        assert process.wait(20) == 128 + number
        assert time.monotonic() - began < 10
    finally:
        process.kill()
        process.communicate()


def test_a_hang_up_that_is_ignored_stays_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as `nohup` starts a process
    try:
        with Signals() as signals:
            os.kill(os.getpid(), signal.SIGHUP)
            time.sleep(0.05)
        assert signals.received == 0
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_afterwards_everything_is_as_before():
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    files = len(os.listdir("/proc/self/fd")) if pathlib.Path("/proc/self/fd").exists() else 0
    for _ in range(3):
        with Signals() as signals:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.05)
        assert signals.received == signal.SIGTERM
    assert [signal.getsignal(number) for number in numbers] == before
    deadline = time.monotonic() + 5
    while files and len(os.listdir("/proc/self/fd")) > files and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not files or len(os.listdir("/proc/self/fd")) <= files


def test_in_another_thread_signals_are_left_alone():
    def enter():
        with Signals():
            pass

    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert signal.getsignal(signal.SIGTERM) == before


class Broken(io.StringIO):
    def __init__(self, error):
        super().__init__()
        self.error = error

    def write(self, text):
        raise self.error

    def flush(self):
        raise self.error


ERRORS = [BrokenPipeError(32, "no"), OSError(5, "no"), OSError(28, "no"), ValueError("closed")]


@pytest.mark.parametrize("stream", [*map(Broken, ERRORS), None], ids=[*map(repr, ERRORS), "none"])
def test_no_word_raises_into_training(stream, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(sys, "stdout", stream)
    with screen.calm():
        print("on stdout", flush=True)
        print("on stderr", file=sys.stderr, flush=True)
        with Progress(tmp_path / "run", 0, 0, Budget(generations=2)) as bar:
            bar.start([])
            row = {"champion_score": 0.5, "fitness_max": 1.0, "frames": 3}
            bar.update(1, row, 1.0)
            bar.update(2, row | {"frames": 6}, 1.0)
    screen.say("and at the end")
    assert sys.stderr is stream


def test_what_is_said_arrives(capsys):
    with screen.calm():
        print("±", file=sys.stderr)
    screen.say("a")
    assert capsys.readouterr() == ("", "±\na\n")


def test_a_screen_that_knows_ascii_alone_gets_that():
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii", write_through=True)
    screen.Stream(stream).write("1 ± 2\n")
    assert stream.buffer.getvalue() == b"1 \\xb1 2\n"  # pyright: ignore


TRAIN = (
    "{python} -m credo train neuroevolution sequence-classification --depth 2 --min-gap 1 "
    "--max-gap 2 --population-size 10 --episodes 4 --test-episodes 6 --network.hidden 3 "
    "--generations 1000000 --tensorboard False --checkpoint-every 1000 --path {path}"
)


def to_all(process):
    os.killpg(process.pid, signal.SIGINT)


def to_the_run(process):
    """To Python alone: the shell has replaced itself, or is its parent."""
    os.killpg(process.pid, signal.SIGTERM)


@pytest.mark.parametrize(
    ("shell", "stop"),
    [
        ("{train} 2>&1 | tee {log}", to_all),
        ("{train} 2>&1 | head -1", to_the_run),
        ("exec {train} 2>&- >&-", to_the_run),
    ],
    ids=["tee", "head", "closed"],
)
def test_whoever_stops_reading_loses_nothing(tmp_path, shell, stop):
    path = tmp_path / "run"
    train = TRAIN.format(python=sys.executable, path=path)
    command = shell.format(train=train, log=tmp_path / "log")

    # Not `preexec_fn`: it would fork this process, in which JAX has threads.
    fresh = "import os, signal, sys; [signal.signal(n, signal.SIG_DFL) for n in (1, 2)]; "
    nothing = subprocess.DEVNULL
    process = subprocess.Popen(
        [sys.executable, "-c", fresh + "os.execvp('bash', sys.argv[1:])", "bash", "-c", command],
        stdout=nothing,
        stderr=nothing,
        start_new_session=True,
    )
    try:
        deadline = time.monotonic() + 120
        while not (path / "metrics.csv").exists():
            assert time.monotonic() < deadline
            time.sleep(0.02)
        time.sleep(0.5)  # some dispatches, and words about them
        stop(process)
        deadline = time.monotonic() + 60
        while _alive(process.pid):
            assert time.monotonic() < deadline
            process.poll()
            time.sleep(0.05)
    finally:
        if _alive(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    rows = (path / "metrics.csv").read_text().count("\n") - 1
    newest = max(int(folder.name) for folder in (path / "checkpoints").glob("[0-9]*"))
    assert newest == rows >= 1


def _alive(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_ctrl_c_that_was_swallowed_is_remembered():
    """As in a callback of C code, where nobody hears of an exception."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        signals.hear()
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with signals.Signals() as heard:
            assert heard.received == signal.SIGINT
        with signals.Signals() as heard:
            assert heard.received == 0
    finally:
        signal.signal(signal.SIGINT, before)
