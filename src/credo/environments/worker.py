"""Copies of an environment of others in a process of their own, and the pipe to it.

Its `main` imports the standard library, NumPy, Gymnasium and the environment: no JAX. `Process`
starts one and speaks to it; `Environments` is what it holds, and `Fatal` the same without a worker,
where that may cost the process. A message is a header (kind, length)
and raw arrays in the machine's byte order, JSON for opening and for faults; nothing is unpickled.
Needs pipes and signals as Unix has them.
"""

import contextlib
import json
import math
import mmap
import os
import select
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from . import processes
from .adapters import APIS, Fault

HEADER = struct.Struct("=II")  # kind, bytes that follow
OPEN, RESET, STEP, FRAME, FAULT, FAULTS = range(6)
SIZES = (
    "obs_size",
    "obs_dtype",
    "action_size",
    "max_steps",
    "choices",
    "image",
    "groups",
    "lengths",
    "masked",
    "agents",
    "signals",
    "actions",
    "observations",
    "shown",
    "asks",
    "names",
    "obs_range",
    "warnings",
)
GRACE = 2.0  # seconds that environments get to close themselves
FOREVER = 1e9  # seconds: what a timer of the system can hold
SHORTEST = 1.0  # seconds: what the machine may keep a call waiting is no fault of the environment
OPENING = 600.0  # seconds that opening one environment may take, if `timeout` is not longer
LARGEST = float(np.finfo(np.float32).max)
LOOK = "look at its id and kwargs, and whether its package is installed"
MEND = "mend the environment"


class Frame:
    """What `n` copies say, as arrays that look into the bytes of one message.

    `sizes` is what `Environments.sizes` says. Observations are float32 or uint8; `rewards` has an
    array per signal, float64, `[n]` or, of one that is private to each agent, `[n, agents]`.
    `failed`: the copy's episode broke in this call, and its row is 0. For a team observations have
    an axis of agents, `active` says who acts next, and `gone` who terminated with this step.
    """

    def __init__(self, n: int, sizes: dict[str, Any]):
        agents, dtype = sizes["agents"], np.dtype(sizes["obs_dtype"])
        team = (n,) if agents is None else (n, agents)
        shapes = [team if private else (n,) for _, private in sizes["signals"]]
        parts: list[tuple[tuple[int, ...], np.dtype]] = [
            (shape, np.dtype(np.float64)) for shape in shapes
        ]
        parts.append(((*team, sizes["obs_size"]), dtype))
        flags = [(n,)] * 3 + ([] if agents is None else [team] * 2)
        self._parts = parts + [(shape, np.dtype(np.bool_)) for shape in flags]
        self._names = [name for name, _ in sizes["signals"]]
        self._length = sum(math.prod(shape) * dtype.itemsize for shape, dtype in self._parts)
        self._lay()

    def _lay(self) -> None:
        self.buffer = bytearray(HEADER.size + self._length)
        HEADER.pack_into(self.buffer, 0, FRAME, self._length)
        arrays, at = [], HEADER.size
        for shape, dtype in self._parts:
            arrays.append(np.ndarray(shape, dtype, self.buffer, at))
            at += arrays[-1].nbytes
        self.rewards = dict(zip(self._names, arrays, strict=False))
        self.obs, self.terminated, self.truncated, self.failed, *others = arrays[len(self._names) :]
        self.active, self.gone = others or (None, None)
        self.faults: dict[int, Fault] = {}  # why a copy failed

    def fresh(self) -> "Frame":
        """Another one of the same layout, all zeros."""
        frame = object.__new__(Frame)
        frame._parts, frame._names, frame._length = self._parts, self._names, self._length
        frame._lay()
        return frame

    def fail(self, i: int, fault: Fault) -> None:
        """The episode of copy `i` broke, and nothing that it says now counts."""
        self.faults[i] = fault
        for said in (self.obs, self.terminated, self.truncated, self.active, self.gone):
            if said is not None:
                said[i] = 0
        for reward in self.rewards.values():
            reward[i] = 0.0
        self.failed[i] = True


class Environments:
    """`n` copies in this process, behind flat arrays.

    What goes wrong in one copy ends its episode (`Frame.failed`, `Frame.faults`), and the copy is
    opened anew before its next one. A wrong request, or one that cannot be opened at first, raises
    `Fault`.

    `spec` has `id`, `kwargs` (a dict), `max_episode_steps` (a number or None) and, if it is not
    Gymnasium's, `api`. `current[0]` is the copy that is being called and `current[1]` is 1 while
    it is being opened: they may lie in memory shared with whoever must know.
    """

    def __init__(self, spec: dict[str, Any], n: int, current: Any = None):
        self._alone = current is not None  # Ctrl-C is not meant for this process
        self.current = [0, 0] if current is None else current
        self.n, self._spec, self._envs = n, spec, []
        self._kind = APIS[spec.get("api", "gymnasium")]
        try:
            for i in range(n):
                self._envs.append(self._open(i))
            self._api = self._kind(self._envs[0], spec)
        except BaseException as error:
            self.close()
            raise self._fault(error, LOOK if len(self._envs) < n else MEND) from error
        self._sizes = {name: getattr(self._api, name) for name in SIZES}
        self._blank = Frame(n, self._sizes)
        self.agents, self.max_steps = self._api.agents, self._api.max_steps
        self.action_size = self._api.action_size
        self._steps = [-1] * n  # in this episode; -1: there is none

    def _open(self, i: int) -> Any:
        """Make copy `i`, while `current` says so."""
        self.current[0], self.current[1] = i, 1
        try:
            return self._kind.make(self._spec)
        finally:
            self.current[1] = 0

    def reset(self, seeds: np.ndarray, active: np.ndarray) -> Frame:
        """Seeds `[n]`, uint32; active `[n]`."""
        frame = self._blank.fresh()
        for i in active.nonzero()[0].tolist():
            self.current[0] = i
            try:
                if self._envs[i] is None:
                    self._envs[i] = self._open(i)
                self._api.reset(self._envs[i], int(seeds[i]), frame, i)
                self._steps[i] = 0
            except BaseException as error:
                self._broke(frame, i, self._fault(error))
        self._finite(frame)
        return frame

    def step(self, actions: np.ndarray, active: np.ndarray) -> Frame:
        """Actions `[n, act]`, of a team `[n, agents, act]`, in [-1, 1], clipped to it; active
        `[n]`."""
        frame = self._blank.fresh()
        self._given(actions, active)
        own, step, steps = self._api.read(actions), self._api.step, self._steps
        for i in active.nonzero()[0].tolist():
            self.current[0] = i
            if steps[i] < 0:
                raise Fault("was asked for a step outside an episode", "reset this copy first")
            try:
                over = step(self._envs[i], own[i], frame, i)
            except BaseException as error:
                self._broke(frame, i, self._fault(error))
                continue
            steps[i] += 1
            if steps[i] >= self.max_steps:
                frame.truncated[i] = over = True
            if over:
                steps[i] = -1
        self._finite(frame)
        return frame

    def _given(self, actions: np.ndarray, active: np.ndarray) -> None:
        """Raise `Fault` of the first active copy whose action is not finite."""
        if np.isfinite(actions).all():
            return
        for i in active.nonzero()[0].tolist():
            self.current[0] = i
            if not np.isfinite(actions[i]).all():
                told = "look at the policy: NaN and inf are no actions"
                raise Fault(f"was given the action {actions[i].tolist()}", told)

    def _finite(self, frame: Frame) -> None:
        """One look at all copies: learners have float32. Rows that are not active are 0."""
        rewards = frame.rewards.values()
        if np.isfinite(frame.obs).all() and all((abs(x) <= LARGEST).all() for x in rewards):
            return
        seen = np.isfinite(frame.obs.reshape(self.n, -1)).all(axis=1)
        paid = [(abs(x.reshape(self.n, -1)) <= LARGEST).all(axis=1) for x in rewards]
        for i in np.flatnonzero(~(seen & np.all(paid, axis=0))).tolist():
            large = _large(self._api.said[i])
            if seen[i]:
                large = all(np.isfinite(x[i]).all() for x in rewards)
            what = "too large a number for float32" if large else "NaN or inf"
            where = "the reward" if seen[i] else "an observation"
            how = "guard the division, root or logarithm it is from, or end the episode before"
            how = "scale it down" if large else how
            self._broke(frame, i, Fault(f"returned {what} in {where}", how))

    def _broke(self, frame: Frame, i: int, fault: Fault) -> None:
        """The episode of copy `i` has failed: close it, so that the next one opens it anew."""
        frame.fail(i, fault)
        self._steps[i] = -1
        if i < len(self._envs) and self._envs[i] is not None:
            with contextlib.suppress(Exception):
                self._envs[i].close()
            self._envs[i] = None

    def _fault(self, error: BaseException, fix: str = MEND) -> Fault:
        """What an environment raised, told. Ctrl-C in the user's own process is the user's."""
        if isinstance(error, Fault):
            return error
        if isinstance(error, KeyboardInterrupt) and not self._alone:
            raise error
        if isinstance(error, processes.Refused):
            return Fault(f"cannot be opened: {error.what}", error.fix)
        place = traceback.extract_tb(error.__traceback__)[-1]
        what = f"raised {type(error).__name__}: {error} ({place.filename}:{place.lineno})"
        return Fault(what, fix)

    def sizes(self) -> dict[str, Any]:
        return self._sizes

    usable = True

    def close(self, grace: float = 0.0) -> None:
        while self._envs:
            with contextlib.suppress(Exception):  # it is not needed any more
                self._envs.pop().close()


class Fatal(Environments):
    """The same, in a process that others can spare: where no worker stands between, an environment
    that ends its process ends this one, and if a call takes longer than `timeout` seconds for all
    copies together, and than `SHORTEST`, SIGALRM does. Nor does one stay that uses this signal
    itself."""

    def __init__(self, spec: dict[str, Any], n: int, timeout: float):
        self._timeout, self._watched = timeout, False
        self._within(n * max(OPENING, timeout), super().__init__, spec, n, [0, 0])

    def reset(self, seeds: np.ndarray, active: np.ndarray) -> Frame:
        opens = any(env is None for env in self._envs)
        limit = max(OPENING, self._timeout) if opens else self._timeout
        return self._within(limit, super().reset, seeds, active)

    def step(self, actions: np.ndarray, active: np.ndarray) -> Frame:
        return self._within(self._timeout, super().step, actions, active)

    def close(self, grace: float = 0.0) -> None:
        self._within(max(grace, GRACE), super().close, grace)

    def _within(self, seconds: float, call: Callable[..., Any], *arguments: Any) -> Any:
        """What a call returns, by the system's own timer, for which no thread is needed."""
        if self._watched:  # within another call
            return call(*arguments)
        self._watched = True
        signal.setitimer(signal.ITIMER_REAL, min(max(seconds, SHORTEST), FOREVER))
        try:
            return call(*arguments)
        finally:
            self._watched = False
            left, _ = signal.setitimer(signal.ITIMER_REAL, 0.0)
            if left == 0.0 or signal.getsignal(signal.SIGALRM) is not signal.SIG_DFL:
                os.kill(os.getpid(), signal.SIGKILL)  # the next hang would be noticed by nobody


def _large(said: Any) -> bool:
    """Whether an observation holds a finite number that float32 does not."""
    if isinstance(said, Mapping | tuple | list):
        return any(map(_large, said.values() if isinstance(said, Mapping) else said))
    numbers = np.asarray(said, np.float64)
    return bool((np.isfinite(numbers) & (abs(numbers) > LARGEST)).any())


class Lost(Fault):
    """The worker is gone, or gives no answer: the episodes of all its copies are over."""


def _message(kind: int, value: Any) -> bytes:
    """Header and JSON."""
    text = json.dumps(value).encode()
    return HEADER.pack(kind, len(text)) + text


class Process:
    """The same as `Environments`, in a worker process. No copy takes longer than `timeout` seconds
    for a reset or a step. (What is listed in `Frame.faults` is the copy's own.)

    After a `Fault` it is of no use: close it. `Lost` means that the worker failed, and
    `current[0]` is the copy that it was calling.
    """

    def __init__(self, spec: dict[str, Any], n: int, timeout: float):
        self.n, self._timeout, self._idle = n, timeout, True
        requests, self._out = os.pipe()
        self._in, replies = os.pipe()
        os.set_blocking(self._out, False)
        try:
            with tempfile.TemporaryFile() as shared:
                shared.truncate(mmap.PAGESIZE)
                self.current = memoryview(mmap.mmap(shared.fileno(), mmap.PAGESIZE)).cast("i")
                self.current[1] = 1  # it begins by opening them
                self._process = _start(requests, replies, shared.fileno())
        except BaseException:
            os.close(self._in)
            os.close(self._out)
            raise
        finally:
            os.close(requests)
            os.close(replies)
        self._readable, self._writable = select.poll(), select.poll()
        self._readable.register(self._in, select.POLLIN)
        self._writable.register(self._out, select.POLLOUT)
        if self._process.ending is not None:
            self._readable.register(self._process.ending, select.POLLIN)
        message = _message(OPEN, {"spec": spec, "n": n})
        try:
            self._sizes = json.loads(self._ask(message, bytearray(HEADER.size))[HEADER.size :])
        except BaseException:
            self.close(grace=0.0)
            raise
        self._blank = Frame(n, self._sizes)

    def sizes(self) -> dict[str, Any]:
        return self._sizes

    @property
    def usable(self) -> bool:
        return self._idle and self._process.poll() is None

    def reset(self, seeds: np.ndarray, active: np.ndarray) -> Frame:
        return self._call(RESET, seeds, active)

    def step(self, actions: np.ndarray, active: np.ndarray) -> Frame:
        return self._call(STEP, actions, active)

    def _call(self, kind: int, numbers: np.ndarray, active: np.ndarray) -> Frame:
        """One request, and the frame that answers it."""
        frame = self._blank.fresh()
        payload = numbers.tobytes() + active.tobytes()
        self._ask(HEADER.pack(kind, len(payload)) + payload, frame.buffer)
        if frame.failed.any():  # why, is in a message of its own
            self._idle = False
            told = self._reply(bytearray(HEADER.size))
            frame.faults = {i: Fault(*why) for i, *why in json.loads(told[HEADER.size :])}
        return frame

    def _ask(self, request: bytes, reply: bytearray) -> bytearray:
        """Send a message; the one that comes back, in `reply` if it fits exactly."""
        if not self._idle:
            raise Fault("was interrupted in an earlier call", "ask for copies(n) again")
        self._idle = False
        self._send(request)
        return self._reply(reply)

    def _reply(self, reply: bytearray) -> bytearray:
        """The next message of the worker, of which a `Fault` is raised."""
        got = self._receive(reply, 0, HEADER.size)
        kind, length = HEADER.unpack_from(reply)
        if HEADER.size + length != len(reply):
            reply = reply[:got] + bytearray(HEADER.size + length - got)
        self._receive(reply, got, len(reply))
        if kind == FAULT:
            raise Fault(**json.loads(reply[HEADER.size :]))
        self._idle = True
        return reply

    def _send(self, request: bytes) -> None:
        try:
            sent = os.write(self._out, request)
            while sent < len(request):  # more than a pipe holds
                self._wait(self._writable)
                sent += os.write(self._out, request[sent:])
        except BrokenPipeError:
            raise self._ended() from None

    def _receive(self, into: bytearray, got: int, least: int) -> int:
        """Read until there are at least so many bytes; how many there are."""
        view = memoryview(into)
        while got < least:
            if self._in not in self._wait(self._readable):
                raise self._ended()  # though a process it started may hold the pipe open
            count = os.readv(self._in, [view[got:]])
            if count == 0:
                raise self._ended()
            got += count
        return got

    def _wait(self, pipe: select.poll) -> list[int]:
        """Until something can be done: with what. Each copy that is called has its own time."""
        seen, began = None, time.monotonic()
        while not (ready := pipe.poll(min(1000.0, 100 * self._timeout))):
            copy, opening = self.current[0], self.current[1]
            now, limit = time.monotonic(), self._timeout
            if opening:
                limit = max(limit, OPENING)
            if (copy, opening) != seen:
                seen, began = (copy, opening), began if seen is None else now
            elif now - began > limit:
                raise Lost(
                    f"gave no answer within {limit:g} s",
                    "mend what hangs, or set a longer timeout if it is only slow",
                )
        return [descriptor for descriptor, _ in ready]

    def _ended(self) -> Lost:
        """How the worker ended, as the error to be raised."""
        how = "and left it running"
        if self._process.over(GRACE):
            status = self._process.returncode
            how = f"with exit status {status}"
            if status < 0:
                how = f"by {signal.Signals(-status).name}"
        return Lost(f"ended its process {how}", "see what it wrote to the error stream")

    def close(self, grace: float = GRACE) -> None:
        """End the process: let it close its environments for `grace` seconds, then by force."""
        if self._out < 0:
            return
        os.close(self._out)
        self._out = -1
        self._idle = False
        self._process.end(grace)
        os.close(self._in)


def one_thread() -> dict[str, str]:
    """The variables of a process in which the libraries of an environment use one thread."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    return {**dict.fromkeys(names, "1"), **os.environ}


def _start(*descriptors: int) -> processes.Child:
    """The worker, which never writes to its parent's output."""
    arguments = [str(number) for number in descriptors]
    return processes.Child(__name__, *arguments, env=one_thread(), stdout=2, pass_fds=descriptors)


def _serve(requests: int, replies: int, current: memoryview) -> None:
    """Answer until the parent closes its end."""
    environments = None
    with open(requests, "rb") as source, open(replies, "wb", buffering=0) as sink:
        while header := source.read(HEADER.size):
            kind, length = HEADER.unpack(header)
            payload = source.read(length)
            try:
                if kind == OPEN:
                    environments = Environments(**json.loads(payload), current=current)
                    reply = _message(OPEN, environments.sizes())
                else:
                    assert environments is not None
                    frame = _answer(environments, kind, payload)
                    reply = bytes(frame.buffer) if frame.faults else frame.buffer
                    if frame.faults:
                        whys = [[i, why.what, why.fix] for i, why in frame.faults.items()]
                        reply += _message(FAULTS, whys)
            except Fault as fault:
                reply = _message(FAULT, {"what": fault.what, "fix": fault.fix})
            rest = memoryview(reply)
            while rest:
                rest = rest[sink.write(rest) :]
        if environments is not None:
            environments.close()


def _answer(environments: Environments, kind: int, payload: bytes) -> Frame:
    """What the copies say to one request; its payload is an array `[n, ...]` and `active`."""
    n = environments.n
    active = np.frombuffer(payload, np.bool_, n, len(payload) - n)
    if kind == RESET:
        return environments.reset(np.frombuffer(payload, np.uint32, n), active)
    shape = (n, environments.agents or 1, environments.action_size)
    actions = np.frombuffer(payload, np.float32, math.prod(shape)).reshape(shape)
    return environments.step(actions if environments.agents else actions[:, 0], active)


def main() -> None:
    requests, replies, shared = (int(number) for number in sys.argv[1:])
    for descriptor in (requests, replies, shared):
        os.set_inheritable(descriptor, False)
    current = memoryview(mmap.mmap(shared, mmap.PAGESIZE)).cast("i")
    _serve(requests, replies, current)
