"""One process per run."""

import contextlib
import datetime
import fcntl
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path


class RunLocked(Exception):
    """Another process works on the same run."""


@contextlib.contextmanager
def lock(run_directory: Path) -> Iterator[None]:
    """Own `run_directory` inside the `with` block; makes the folder if there is none.

    The lock is the operating system's, on the file `lock` in that folder: it ends with the
    process, however that ends, and a file that stays behind means nothing. Processes forked
    inside the block hold it too; those started anew do not.

    Raises `RunLocked`, which names the holder, if another process (or this one) has the lock.
    """
    path = Path(run_directory) / "lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a+") as file:  # "a+" does not empty the file: its holder's name is in it
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise RunLocked(_message(Path(run_directory), file.read())) from None
        now = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
        file.truncate(0)
        json.dump({"pid": os.getpid(), "host": socket.gethostname(), "started": now}, file)
        file.flush()
        try:
            yield
        finally:
            file.truncate(0)
            fcntl.flock(file, fcntl.LOCK_UN)  # a forked child may keep the file open


def _message(run_directory: Path, content: str) -> str:
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
