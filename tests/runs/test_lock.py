import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from credo.runs.lock import RunLocked, lock

HOLD = """
import sys
from pathlib import Path
from credo.runs.lock import lock
with lock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def start(run: Path) -> subprocess.Popen:
    """A process that holds the run until its input ends, or says why it cannot."""
    return subprocess.Popen(
        [sys.executable, "-c", HOLD, str(run)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_second_process_is_refused(tmp_path):
    with lock(tmp_path / "run"), start(tmp_path / "run") as second:
        _, errors = second.communicate()
        assert second.returncode == 1
        last = errors.strip().splitlines()[-1]
        assert last.startswith("credo.runs.lock.RunLocked")
        assert f"process {os.getpid()} on {socket.gethostname()} since 2" in last
        assert f"`kill {os.getpid()}`" in last


def test_free_after_the_holder_is_killed(tmp_path):
    with start(tmp_path) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(RunLocked, match=f"process {holder.pid} on"), lock(tmp_path):
            pass
        holder.kill()
        holder.wait()
    content = (tmp_path / "lock").read_text()
    assert f'"pid": {holder.pid}' in content
    with lock(tmp_path):
        assert f'"pid": {os.getpid()}' in (tmp_path / "lock").read_text()


def test_free_after_the_block_however_it_ends(tmp_path):
    with pytest.raises(ZeroDivisionError), lock(tmp_path):
        raise ZeroDivisionError
    assert (tmp_path / "lock").read_text() == ""
    with lock(tmp_path), pytest.raises(RunLocked, match="in use by process"), lock(tmp_path):
        pass


def test_a_refusal_leaves_the_holders_name(tmp_path):
    with lock(tmp_path):
        before = (tmp_path / "lock").read_text()
        with pytest.raises(RunLocked), lock(tmp_path):
            pass
        assert (tmp_path / "lock").read_text() == before != ""


@pytest.mark.parametrize("content", [b"", b"not JSON", b"[]", b"{}", b"\xb1"])
def test_a_holder_without_a_name(tmp_path, content):
    with lock(tmp_path):
        (tmp_path / "lock").write_bytes(content)
        with pytest.raises(RunLocked, match="in use by another process: wait"), lock(tmp_path):
            pass


def test_two_runs_do_not_share_a_lock(tmp_path):
    with lock(tmp_path / "a"), lock(tmp_path / "b"):
        assert (tmp_path / "a" / "lock").read_text() != ""
        assert (tmp_path / "b" / "lock").read_text() != ""


@pytest.mark.parametrize("target", ["precious", "none"])
def test_a_link_is_no_lock_and_is_not_followed(tmp_path, target):
    (tmp_path / "precious").write_text("precious")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "lock").symlink_to(tmp_path / target)
    with pytest.raises(OSError, match=r"is a link and not followed: remove it: .*run/lock'"):
        lock(tmp_path / "run").__enter__()
    assert (tmp_path / "precious").read_text() == "precious"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["precious", "run"]


def test_a_file_with_a_second_name_is_not_emptied(tmp_path):
    (tmp_path / "precious").write_text("precious")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "lock").hardlink_to(tmp_path / "precious")
    with lock(tmp_path / "run"), pytest.raises(RunLocked), lock(tmp_path / "run"):
        pass
    assert (tmp_path / "precious").read_text() == "precious"


def test_a_pipe_is_no_lock_and_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "lock")
    with pytest.raises(OSError, match="is no regular file"):
        lock(tmp_path).__enter__()
