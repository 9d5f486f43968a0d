"""Child processes of ours: how they start, and that nothing of them is left.

`Child` runs the `main` of a module in a process of its own. Between it and us stands a guardian
(this file, run as a script), which on Linux inherits every process that the child starts, however
it detaches itself, and kills them all when the child ends, when it is told to, or when we are
gone, even by kill -9. If the guardian itself is killed, the child is too. On other systems than
Linux it kills the child's process group alone. The standard library, and no more, is imported here.
"""

import contextlib
import ctypes
import importlib
import json
import os
import pathlib
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any

LINUX = sys.platform == "linux"
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
LONGEST = 5.0  # seconds that a guardian gets to kill what it guards
CLAIM = "credo-core"  # what the names of claims begin with
MOST_ON_A_CORE = 64  # processes that settle there; one more may run on any
MULTIPLYING = "put it under if __name__ == '__main__'"

_claims: list[socket.socket] = []  # on the cores that this process has settled on
_roam: set[int] | None = None  # where children may run while this process is `settled`
_counted = 0  # cores that JAX has counted, where it did while this process was `settled`
_worker = False  # whether this process is a child, started here
_opening = True  # whether code that is imported here may start children
_forked = False  # whether it was forked from one in which JAX has threads


class Refused(RuntimeError):
    """Here nothing may be trained and no process started: `what` is the reason, `fix` the way."""

    def __init__(self, what: str, fix: str):
        super().__init__(what, fix)  # so that it can be pickled
        self.what, self.fix = what, fix

    def __str__(self) -> str:
        return f"{self.what}: {self.fix}"


def cores() -> list[int]:
    """Those that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def settle() -> int | None:
    """Compute from here on on one core alone: the one that the fewest other processes of ours have
    settled on, whichever command started them. The core; None where a process cannot be bound.

    Call it before JAX counts its threads. A core is claimed by a name in Linux's abstract socket
    namespace, which is free again when the process ends, however it ends.
    """
    if not hasattr(os, "sched_setaffinity") or not LINUX:
        return None
    usable = cores()
    for turn in range(MOST_ON_A_CORE):
        for core in usable:
            claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                claim.bind(f"\0{CLAIM}-{os.getuid()}-{core}-{turn}")
            except OSError:  # it is another's
                claim.close()
                continue
            _claims.append(claim)
            os.sched_setaffinity(0, {core})
            return core
    return None


@contextlib.contextmanager
def settled() -> Iterator[None]:
    """In here this process computes on one core (see `settle`), and its children on any. Not if JAX
    has counted its threads already: more than one on a core would wait for each other."""
    global _roam, _counted
    before, own = set(cores()), len(_claims)
    if len(before) == 1 or _jax_began() or settle() is None:
        yield
        return
    _roam = before
    try:
        yield
    finally:
        _roam, _counted = None, int(_jax_began())
        for thread in map(int, os.listdir("/proc/self/task")):
            with contextlib.suppress(OSError):  # it has ended meanwhile
                os.sched_setaffinity(thread, before)
        for claim in _claims[own:]:
            claim.close()
        del _claims[own:]


def others() -> int:
    """How many cores children may have beside the one on which this process is `settled`."""
    return 0 if _roam is None else len(_roam) - 1


def counted() -> int:
    """How many cores JAX computes on, by which it divides sums: those of this process, or one if it
    was `settled` when JAX began."""
    return _counted or len(cores())


@contextlib.contextmanager
def roaming() -> Iterator[None]:
    """In here this thread may run where children may, who are born with what it may."""
    if _roam is None:
        yield
        return
    own = os.sched_getaffinity(0)
    os.sched_setaffinity(0, _roam)
    try:
        yield
    finally:
        os.sched_setaffinity(0, own)


def allow(doing: str = "starts training", *, opening: bool = False) -> None:
    """Raise `Refused` where training, or a child of ours (`opening`), would multiply or never end:
    while a child imports the user's script, and in a process forked after JAX was used."""
    if _forked:
        raise Refused(
            "this process was forked after JAX was used, and JAX would wait in it for ever",
            "start it afresh, as multiprocessing does with the method 'spawn' or 'forkserver', or "
            "use Credo in it alone",
        )
    multiplies = _worker and not (opening and _opening)
    frame, script = sys._getframe() if multiplies else None, None
    while frame is not None:
        if frame.f_code.co_name == "<module>" and frame.f_back is not None:
            script = script or pathlib.Path(frame.f_code.co_filename).stem
        frame = frame.f_back
    if script is not None:
        raise Refused(f"{script} {doing} when it is imported", MULTIPLYING)


def _after_fork() -> None:
    """Note in a fork whether JAX had been used, whose threads do not come along."""
    global _forked
    _forked = _jax_began()


def _jax_began() -> bool:
    """Whether JAX has begun to compute, and has its threads."""
    return bool(getattr(sys.modules.get("jax._src.xla_bridge"), "_backends", None))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


class Child(subprocess.Popen):
    """`module.main()` in a process of its own, with `sys.argv[1:]` as given. Its `pid` is the
    guardian's, and its return code what the child ended with.

    It finds modules where this process does. Whoever holds it calls `end`.

    **Arguments:** `grace`, seconds that the child gets after SIGTERM when this process is gone or
    ends it by force; 0 kills it at once. `opening`: whether modules of users may start children of
    their own while the child imports them. `options` are those of `subprocess.Popen`.
    """

    def __init__(
        self,
        module: str,
        *arguments: str,
        grace: float = 0.0,
        opening: bool = False,
        **options: Any,
    ):
        allow("opens a task", opening=True)
        self._owner = os.getpid()
        self.ending = None
        path = json.dumps([os.path.abspath(entry) for entry in sys.path])
        told = [module, path, str(grace), str(self._owner), str(int(opening)), *arguments]
        options = {"stdin": subprocess.DEVNULL, "start_new_session": True} | options
        with roaming():
            super().__init__([sys.executable, "-P", os.path.abspath(__file__), *told], **options)
        self._grace = grace
        self.ending = _pidfd(self.pid)
        """Readable once the child has ended; None where there is no such thing."""

    def end(self, grace: float) -> None:
        """Wait `grace` seconds for the child to end by itself, then use force."""
        if os.getpid() != self._owner:  # forked: it is not ours
            return
        for patience, force in ((grace, self.terminate), (self._grace + LONGEST, self.kill)):
            if not self.over(patience):
                force()
        self.wait()
        if self.ending is not None:
            os.close(self.ending)
            self.ending = None

    def over(self, patience: float) -> bool:
        """Whether it has ended, or does within so many seconds."""
        if self.ending is not None and self.returncode is None:
            ended = select.poll()
            ended.register(self.ending, select.POLLIN)
            ended.poll(max(0.0, 1000 * patience))  # at once; `wait` would look now and then
            patience = 0.0
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(patience)
        return self.returncode is not None


def _pidfd(pid: int) -> int | None:
    """A descriptor that becomes readable when the process ends; None if there is no such thing."""
    if not hasattr(os, "pidfd_open"):
        return None
    with contextlib.suppress(OSError):
        return os.pidfd_open(pid)
    return None


def _control(option: int, value: int) -> None:
    """Linux: tell the kernel something about this process."""
    if LINUX:
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def _guardian(
    module: str, path: str, grace: str, parent: str, opening: str, *arguments: str
) -> None:
    """Run the child, and in this process guard it. Only the child returns."""
    mine = os.getpid()
    _control(PR_SET_CHILD_SUBREAPER, 1)
    wake, tell = os.pipe()
    for end in (wake, tell):
        os.set_blocking(end, False)
    for number in (signal.SIGCHLD, signal.SIGTERM):
        signal.signal(number, lambda *_: None)  # what counts is the byte in the pipe
    signal.set_wakeup_fd(tell, warn_on_full_buffer=False)
    worker = os.fork()
    if worker == 0:
        signal.set_wakeup_fd(-1)
        os.close(wake)
        os.close(tell)
        _run(mine, module, path, opening == "1", arguments)
        return
    _let_go(wake, tell)
    status = None
    with contextlib.suppress(BaseException):
        status = _wait(worker, int(parent), wake, float(grace))
    _kill_all(worker)
    _end_like(status)


def _run(guardian: int, module: str, path: str, opening: bool, arguments: tuple[str, ...]) -> None:
    """In the child: its own group, which ends with the guardian, and then what it is for."""
    for number in (signal.SIGCHLD, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    os.setpgid(0, 0)
    _control(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != guardian:  # it was gone before it could be promised
        os._exit(1)
    serve(module, json.loads(path), opening, arguments)


def serve(module: str, path: list[str], opening: bool, arguments: Sequence[str] = ()) -> None:
    """Do what a child is for, `module.main()`, in this process; modules are found at `path`."""
    sys.path[:] = path
    sys.argv = [module, *arguments]
    here: Any = importlib.import_module("credo.environments.processes")
    here.serves(opening)
    importlib.import_module(module).main()


def serves(opening: bool) -> None:
    """From now on this process is one that others give work to (see `allow`)."""
    global _worker, _opening
    _worker, _opening = True, opening


def _let_go(*kept: int) -> None:
    """Pipes are the child's: here they would hide that it has closed them."""
    nothing = os.open(os.devnull, os.O_RDWR)
    os.dup2(nothing, 0)
    os.dup2(nothing, 1)
    for descriptor in map(int, os.listdir("/dev/fd")):
        if descriptor > 2 and descriptor not in kept:
            with contextlib.suppress(OSError):
                os.close(descriptor)


def _wait(worker: int, parent: int, wake: int, grace: float) -> int:
    """Until the child has ended, or must: what it ended with, as `os.waitpid` says it."""
    events, gone, deadline = select.poll(), _pidfd(parent), None
    events.register(wake, select.POLLIN)
    if gone is not None:
        events.register(gone, select.POLLIN)
    while True:
        events.poll(None if gone is not None and deadline is None else 200)
        told = b""
        with contextlib.suppress(BlockingIOError):
            told = os.read(wake, 4096)
        for pid, status in _ended():
            if pid == worker:
                return status
        if deadline is not None and signal.SIGTERM in told:
            deadline = time.monotonic()  # told twice: at once
        if deadline is None and (signal.SIGTERM in told or os.getppid() != parent):
            deadline = time.monotonic() + grace
            if gone is not None:
                events.unregister(gone)
            if grace > 0:
                os.kill(worker, signal.SIGTERM)
        if deadline is not None and time.monotonic() >= deadline:
            os.kill(worker, signal.SIGKILL)
            return signal.SIGKILL


def _ended() -> list[tuple[int, int]]:
    """Every process here that has ended since the last look, and how."""
    found = []
    with contextlib.suppress(ChildProcessError):
        while (one := os.waitpid(-1, os.WNOHANG))[0] != 0:
            found.append(one)
    return found


def _kill_all(worker: int) -> None:
    """Kill the child, its group, and on Linux all that they started, until they are gone."""
    with contextlib.suppress(OSError):
        os.killpg(worker, signal.SIGKILL)
    children = pathlib.Path(f"/proc/self/task/{os.getpid()}/children")
    while children.exists():
        # Whose parent is killed comes here, so that in the end none is left.
        left = children.read_text().split()
        for pid in left:
            with contextlib.suppress(OSError):
                os.kill(int(pid), signal.SIGKILL)
        if not _ended() and not left:
            return
        time.sleep(0.002)


def _end_like(status: int | None) -> None:
    """End with the child's exit status, or by the signal that ended it."""
    status = 1 << 8 if status is None else status
    if os.WIFSIGNALED(status):
        import resource

        number = os.WTERMSIG(status)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if number != signal.SIGKILL:
            signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        time.sleep(1.0)
    os._exit(os.waitstatus_to_exitcode(status) & 0xFF)


if __name__ == "__main__":
    _guardian(*sys.argv[1:])
