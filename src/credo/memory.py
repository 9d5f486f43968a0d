"""Memory: how many bytes this process may still take."""

import math
import os
import pathlib
import re
import resource
from collections.abc import Iterator

GROUPS = {  # files of a control group, version 2 and version 1
    "": ("memory.max", "memory.current"),
    "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes"),
}


def available(root: pathlib.Path = pathlib.Path("/")) -> int:
    """The least of what the machine has to give, of what this process's control groups (a
    container, a job of a cluster) leave it, and of its address space (`ulimit -v`).

    **Arguments:** `root`: where /proc and /sys are.
    """
    space = resource.getrlimit(resource.RLIMIT_AS)[0]
    space = math.inf if space == resource.RLIM_INFINITY else space
    left = [
        os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"),
        1024 * _number(root / "proc/meminfo", "MemAvailable:"),
        space - 1024 * _number(root / "proc/self/status", "VmSize:", 0),
        *_groups(root),
    ]
    return int(max(min(left), 0))


def _groups(root: pathlib.Path) -> Iterator[float]:
    """What each control group of this process, and each around it, leaves. What was read from files
    and can be forgotten is not taken."""
    file = root / "proc/self/cgroup"
    for line in file.read_text().splitlines() if file.exists() else ():
        _, kind, name = line.split(":", 2)
        if kind in GROUPS:
            base = root / "sys/fs/cgroup" / kind
            limit, used = GROUPS[kind]
            inner = base / name.lstrip("/")
            for group in (inner, *inner.parents[: len(inner.relative_to(base).parts)]):
                files = _number(group / "memory.stat", "inactive_file", 0)
                yield _number(group / limit) - _number(group / used, "", 0) + files


def _number(file: pathlib.Path, name: str = "", missing: float = math.inf) -> float:
    """The number behind `name` at the start of a line."""
    text = file.read_text() if file.exists() else ""
    found = re.search(rf"^{name}\s*(\d+)", text, re.MULTILINE)
    return int(found[1]) if found else missing
