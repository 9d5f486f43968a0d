"""Nothing is left of the processes that we start, however they end, and none starts another while
it imports the user's script."""

import os
import pathlib
import signal
import subprocess
import sys
import threading
import time

import jax
import numpy as np
import pytest

from credo.environments import processes
from credo.environments.gymnasium import Gymnasium
from credo.environments.wrappers import delayed

HERE = os.path.dirname(__file__)
linux = pytest.mark.skipif(sys.platform != "linux", reason="needs a subreaper and pidfd")


def marked(mark: str) -> list[int]:
    """Processes with `mark` among their arguments."""
    found = []
    for path in pathlib.Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if mark.encode() in path.read_bytes().split(b"\0"):
                found.append(int(path.parent.name))
        except OSError:
            pass
    return found


def alive(pid: int) -> bool:
    try:
        status = pathlib.Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return status.rpartition(")")[2].split()[0] not in "ZX"


def until(found, seconds=10.0):
    end = time.monotonic() + seconds
    while not found() and time.monotonic() < end:
        time.sleep(0.02)
    return found()


def parent_task(mark, **kwargs):
    return Gymnasium("failing:Parent", kwargs={"mark": mark, **kwargs}, max_episode_steps=9)


def one(copies, steps=2):
    copies.reset(np.zeros(1, np.uint32), np.ones(1, bool))
    for _ in range(steps):
        step = copies.step(np.zeros((1, 1)), np.ones(1, bool))
    return step


@linux
@pytest.mark.parametrize("detached", [False, True])
@pytest.mark.parametrize("fault", ["", "dies"])
def test_what_an_environment_starts_ends_with_it(detached, fault, tmp_path):
    mark = f"credo-test-{tmp_path}"
    copies = parent_task(mark, detached=detached, fault=fault).copies(1)
    assert until(lambda: len(marked(mark)) == 1)  # its arguments show a moment after its start
    before = marked(mark)
    if fault:
        assert one(copies).failed[0]
        assert until(lambda: len(marked(mark)) == 1)  # that of the new copy
        assert marked(mark) != before
    copies.close()
    assert marked(mark) == []


@linux
def test_an_end_is_seen_though_a_child_holds_the_pipe():
    task = Gymnasium("failing:Faulty", kwargs={"fault": "leaves_a_child"}, max_episode_steps=9)
    copies, began = task.copies(1), time.monotonic()
    assert one(copies).failed[0]
    assert "ended its process with exit status 9" in copies.failure_text(0)
    assert time.monotonic() - began < 20  # of the 60 seconds of a timeout
    copies.close()


PARENT = f"""
import sys, time
sys.path.insert(0, {HERE!r})
import numpy as np
from credo.environments.worker import Process
mark, fault, detached = sys.argv[1:]
kwargs = {{"mark": mark, "fault": fault, "at": 1, "detached": bool(detached)}}
process = Process({{"id": "failing:Parent", "kwargs": kwargs, "max_episode_steps": 9,
                   "registered": None}}, 1, 60)
process.reset(np.zeros(1, np.uint32), np.ones(1, bool))
print(process._process.pid, flush=True)
if fault:
    process.step(np.zeros((1, 1), np.float32), np.ones(1, bool))
time.sleep(600)
"""


@linux
@pytest.mark.parametrize("detached", ["", "yes"])
@pytest.mark.parametrize("fault", ["", "hangs", "holds"])
def test_a_worker_and_what_it_started_end_with_a_parent_that_is_killed(fault, detached, tmp_path):
    """Without a chance to clean up; idle, in the middle of a step, or in one that lets no other
    thread run."""
    mark = f"credo-test-{tmp_path}"
    with subprocess.Popen(
        [sys.executable, "-c", PARENT, mark, fault, detached],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as parent:
        assert parent.stdout is not None
        guardian = int(parent.stdout.readline())
        worker = children(guardian)
        time.sleep(0.3)
        assert len(worker) == 1
        assert until(lambda: len(marked(mark)) == 2)  # the parent is one of them
        parent.kill()
        assert parent.wait() == -signal.SIGKILL
        assert until(lambda: marked(mark) == [])
        assert until(lambda: not any(map(alive, (guardian, *worker))))
        assert parent.communicate(timeout=10)[1] == ""


def children(pid: int) -> list[int]:
    return [int(x) for x in pathlib.Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@linux
def test_a_worker_ends_with_its_guardian(tmp_path):
    mark = f"credo-test-{tmp_path}"
    copies = parent_task(mark).copies(1)
    guardian = copies._backend._process.pid
    (worker,) = children(guardian)
    os.kill(guardian, signal.SIGKILL)
    assert until(lambda: not alive(worker))
    for left in marked(mark):  # it was not detached by us, and nobody is there to inherit it
        os.kill(left, signal.SIGKILL)
    copies.close()


def test_modules_are_found_in_a_folder_with_a_colon(tmp_path, monkeypatch):
    folder = tmp_path / "co:lon"
    folder.mkdir()
    (folder / "odd_place.py").write_text(
        "import sys; sys.path.insert(0, sys.path[0]); from broken import Tiny\n"
    )
    monkeypatch.syspath_prepend(str(folder))
    copies = Gymnasium("odd_place:Tiny", max_episode_steps=4).copies(1)
    assert one(copies).obs.shape == (1, 2)
    copies.close()


UNGUARDED = f"""
import sys
sys.path.insert(0, {HERE!r})
from broken import Tiny
print("imported", file=sys.stderr)
from credo.environments.worker import Process
spec = {{"id": "unguarded:Tiny", "kwargs": {{}}, "max_episode_steps": 9, "registered": None}}
Process(spec, 1, 60)
"""


def test_a_script_without_a_guard_starts_no_more(tmp_path):
    (tmp_path / "unguarded.py").write_text(UNGUARDED)
    told = subprocess.run(
        [sys.executable, "unguarded.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert told.returncode == 1
    assert told.stderr.count("imported\n") == 2  # here, and in one worker
    assert "unguarded opens a task when it is imported" in told.stderr
    assert "put it under if __name__ == '__main__'" in told.stderr


def test_each_thread_has_its_own_copies():
    env = Gymnasium("broken:Tiny", max_episode_steps=9)
    mine, late = env.copies(1), delayed(env).copies(1)
    theirs = []

    def play():
        copies = env.copies(1)
        theirs.append((copies, delayed(env).copies(1), copies._backend._process))
        assert env.copies(1) is copies

    thread = threading.Thread(target=play)
    thread.start()
    thread.join()
    ((copies, other, process),) = theirs
    assert copies is not mine
    assert other is not late
    assert other.inner is copies
    assert process.poll() is None
    assert env.copies(1) is mine
    assert delayed(env).copies(1) is late
    theirs.clear()
    del copies, other  # the thread has ended: nobody has them
    assert process.poll() == 0
    assert mine.usable
    mine.close()


@pytest.mark.filterwarnings("ignore:.*fork.*")
def test_a_child_forked_after_jax_was_used_is_told(tmp_path):
    env = Gymnasium("broken:Tiny", max_episode_steps=9)
    mine = env.copies(1)
    jax.block_until_ready(jax.numpy.zeros(1))
    said = tmp_path / "said"
    child = os.fork()
    if child == 0:
        try:
            env.copies(1)
        except processes.Refused as refused:
            said.write_text(str(refused))
        finally:
            os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert said.read_text().startswith("this process was forked after JAX was used")
    assert "'spawn' or 'forkserver'" in said.read_text()
    assert one(mine).obs.shape == (1, 2)  # the parent's are as they were
    mine.close()


SETTLING = """
import os, sys
from credo.environments import processes
processes.CLAIM = sys.argv[1]  # other tests settle too
print(processes.settle(), *os.sched_getaffinity(0), flush=True)
sys.stdin.read()
"""


@pytest.mark.skipif(not processes.LINUX, reason="no process is bound to a core")
def test_processes_settle_on_different_cores_whoever_started_them():
    def settled() -> tuple[subprocess.Popen, int]:
        line = [sys.executable, "-c", SETTLING, f"test-{os.getpid()}"]
        pipe = subprocess.PIPE
        process = subprocess.Popen(line, stdin=pipe, stdout=pipe, text=True)
        assert process.stdout is not None
        core, *allowed = map(int, process.stdout.readline().split())
        assert allowed == [core]
        return process, core

    usable = processes.cores()
    running = [settled() for _ in range(2 * len(usable))]
    try:
        assert [core for _, core in running] == usable * 2  # evenly
        running[1][0].communicate()
        again = settled()
        assert again[1] == running[1][1]  # what has ended claims nothing
        again[0].communicate()
    finally:
        for process, _ in running:
            process.kill()
            process.communicate()


SETTLED = """
import os, subprocess, sys, threading
from credo.environments import processes
processes.CLAIM = sys.argv[1]
before = processes.cores()
child = [sys.executable, "-c", "import os; print(sorted(os.sched_getaffinity(0)))"]
with processes.settled():
    assert len(processes.cores()) == 1
    stay = threading.Event()
    thread = threading.Thread(target=stay.wait)
    thread.start()
    assert processes.others() == len(before) - 1
    with processes.roaming():
        assert eval(subprocess.check_output(child)) == before
    assert len(processes.cores()) == 1
assert processes.cores() == sorted(os.sched_getaffinity(thread.native_id)) == before
assert processes.others() == 0 and not processes._claims
stay.set()
assert processes.counted() == len(before)
import jax
with processes.settled():  # and JAX begins
    assert jax.numpy.ones(2).sum() == 2
assert processes.counted() == 1
with processes.settled():  # its threads are counted
    assert processes.cores() == before
"""


@pytest.mark.skipif(not processes.LINUX, reason="no process is bound to a core")
@pytest.mark.skipif(len(processes.cores()) < 2, reason="there is one core")
def test_a_settled_process_has_one_core_and_its_children_all():
    told = [sys.executable, "-c", SETTLED, f"settled-{os.getpid()}"]
    done = subprocess.run(told, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
