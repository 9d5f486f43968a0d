"""One process per run."""

import contextlib
import datetime
import fcntl
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from . import files

MOST = 1000  # bytes of a holder's name


class RunLocked(Exception):
    """Another process works on the same run."""


@contextlib.contextmanager
def lock(run_directory: Path) -> Iterator[None]:
    """Own `run_directory` inside the `with` block; makes the folder if there is none.

    The lock is the operating system's, on the file `lock` in that folder: it ends with the
    process, however that ends, and a file that stays behind means nothing. Processes forked
    inside the block hold it too; those started anew do not.

    Raises `RunLocked`, which names the holder, if another process (or this one) has the lock, and
    `OSError` if the file cannot be made, or is a link: it is never followed.
    """
    path = Path(run_directory) / "lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    # The file is not emptied before it is owned: its holder's name is in it.
    descriptor = files.opened(path, os.O_RDWR | os.O_CREAT | os.O_APPEND)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            content = os.pread(descriptor, MOST, 0).decode(errors="replace")
            raise RunLocked(_message(Path(run_directory), content)) from None
        except OSError as error:  # of a file system without locks
            raise files.named(error, path) from error
        if not _is_at(descriptor, path):  # who had it has just removed it with its folder
            raise RunLocked(_message(Path(run_directory), ""))
        now = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
        holder = {"pid": os.getpid(), "host": socket.gethostname(), "started": now}
        _write(descriptor, json.dumps(holder))
        try:
            yield
        finally:
            _write(descriptor, "")
            fcntl.flock(descriptor, fcntl.LOCK_UN)  # a forked child may keep the file open
    finally:
        os.close(descriptor)


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether the file that is open is the one that has this name now."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def is_lock(path: Path) -> bool:
    """Whether a file is a lock of ours: empty, or with its holder's name."""
    try:
        content = files.read_bytes(path, most=MOST)
        return not content or set(json.loads(content)) == {"pid", "host", "started"}
    except (OSError, ValueError, TypeError):
        return False


def _write(descriptor: int, content: str) -> None:
    # The name is only for others to read: on a full disk the lock holds without it, and a file
    # with a second name may be another user's.
    with contextlib.suppress(OSError):
        if os.fstat(descriptor).st_nlink == 1:
            os.truncate(descriptor, 0)
            os.write(descriptor, content.encode())


def _message(run_directory: Path, content: str) -> str:
    """Who holds the lock, from what the file says, and what to do."""
    who, stop = "another process", "stop it"
    # Between its lock and its name a holder's file is empty.
    with contextlib.suppress(ValueError, KeyError, TypeError):
        holder = json.loads(content)
        who = f"process {holder['pid']} on {holder['host']} since {holder['started']}"
        stop = f"stop it (`kill {holder['pid']}` on {holder['host']})"
    return (
        f"{run_directory} is in use by {who}: wait until it ends, or {stop}, "
        "or choose another run. No file needs to be deleted."
    )
