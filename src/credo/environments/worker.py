"""Copies of an environment of others in a process of their own, and the pipe to it.

`python -m credo.environments.worker` imports the standard library, NumPy, Gymnasium and the
environment: no JAX. `Process` starts one and speaks to it; `Environments` is what it holds.
A message is a header (kind, length) and raw arrays in the machine's byte order, JSON for opening
and for faults; nothing is unpickled. Needs pipes and signals as Unix has them.
"""

import array
import contextlib
import json
import math
import mmap
import os
import select
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from typing import Any

import numpy as np

from .adapters import APIS, Fault

HEADER = struct.Struct("=II")  # kind, bytes that follow
OPEN, RESET, STEP, FRAME, FAULT = range(5)
SIZES = (
    "obs_size",
    "obs_dtype",
    "action_size",
    "max_steps",
    "discrete",
    "agents",
    "signals",
    "actions",
    "observations",
    "obs_range",
    "warnings",
)
GRACE = 2.0  # seconds that environments get to close themselves


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
        rewards = [(name, team if private else (n,)) for name, private in sizes["signals"]]
        parts = [(shape, np.dtype(np.float64)) for _, shape in rewards]
        parts.append(((*team, sizes["obs_size"]), dtype))
        flags = [(n,)] * 3 + ([] if agents is None else [team] * 2)
        parts += [(shape, np.dtype(np.bool_)) for shape in flags]
        lengths = [math.prod(shape) * dtype.itemsize for shape, dtype in parts]
        self.buffer = bytearray(HEADER.size + sum(lengths))
        HEADER.pack_into(self.buffer, 0, FRAME, len(self.buffer) - HEADER.size)
        arrays, at = [], HEADER.size
        for (shape, dtype), length in zip(parts, lengths, strict=True):
            arrays.append(np.ndarray(shape, dtype, self.buffer, at))
            at += length
        self.rewards = {name: arrays[k] for k, (name, _) in enumerate(rewards)}
        self.obs, self.terminated, self.truncated, self.failed, *others = arrays[len(rewards) :]
        self.active, self.gone = others or (None, None)


class Environments:
    """`n` copies in this process, behind flat arrays. Raises `Fault`, and nothing else.

    `spec` has `id`, `kwargs` (a dict), `max_episode_steps` (a number or None) and, if it is not
    Gymnasium's, `api`. `current[0]` is the copy that is being called: it may lie in memory shared
    with whoever must know.
    """

    def __init__(self, spec: dict[str, Any], n: int, current: Any = None):
        self.current = array.array("i", [0]) if current is None else current
        self.n, self._envs = n, []
        api = APIS[spec.get("api", "gymnasium")]
        with _blaming("look at its id and kwargs, and whether its package is installed"):
            for i in range(n):
                self.current[0] = i
                self._envs.append(api.make(spec))
        with _blaming():
            self.current[0] = 0
            self._api = api(self._envs[0], spec)
        self._sizes = {name: getattr(self._api, name) for name in SIZES}
        self.agents, self.max_steps = self._api.agents, self._api.max_steps
        self.action_size = self._api.action_size
        self._steps = [-1] * n  # in this episode; -1: there is none

    def reset(self, seeds: np.ndarray, active: np.ndarray) -> Frame:
        """Seeds `[n]`, uint32; active `[n]`."""
        frame = Frame(self.n, self._sizes)
        with _blaming():
            for i in active.nonzero()[0].tolist():
                self.current[0] = i
                self._api.reset(self._envs[i], int(seeds[i]), frame, i)
                self._steps[i] = 0
        self._finite(frame)
        return frame

    def step(self, actions: np.ndarray, active: np.ndarray) -> Frame:
        """Actions `[n, act]`, of a team `[n, agents, act]`, in [-1, 1], clipped to it; active
        `[n]`."""
        frame = Frame(self.n, self._sizes)
        with _blaming():
            self._given(actions, active)
            own, step, steps = self._api.read(actions), self._api.step, self._steps
            for i in active.nonzero()[0].tolist():
                self.current[0] = i
                if steps[i] < 0:
                    raise Fault("was asked for a step outside an episode", "reset this copy first")
                over = step(self._envs[i], own[i], frame, i)
                steps[i] += 1
                if steps[i] >= self.max_steps:
                    frame.truncated[i] = over = True
                if over:
                    steps[i] = -1
        self._finite(frame)
        return frame

    def _given(self, actions: np.ndarray, active: np.ndarray) -> None:
        if np.isfinite(actions).all():
            return
        for i in active.nonzero()[0].tolist():
            self.current[0] = i
            if not np.isfinite(actions[i]).all():
                told = "look at the policy: NaN and inf are no actions"
                raise Fault(f"was given the action {actions[i].tolist()}", told)

    def _finite(self, frame: Frame) -> None:
        """One look at all copies; rows of those that are not active are 0."""
        parts = (frame.obs, *frame.rewards.values())
        if all(np.isfinite(x).all() for x in parts):
            return
        good = [np.isfinite(x.reshape(self.n, -1)).all(axis=1) for x in parts]
        self.current[0] = i = int(np.flatnonzero(~np.all(good, axis=0))[0])
        told = "the reward" if good[0][i] else "an observation"
        raise Fault(
            f"returned NaN or inf in {told}",
            "guard the division, root or logarithm it is from, or end the episode before",
        )

    def sizes(self) -> dict[str, Any]:
        return self._sizes

    usable = True

    def close(self, grace: float = 0.0) -> None:
        for env in self._envs:
            with contextlib.suppress(Exception):  # nobody needs it any more
                env.close()


class _blaming:
    """What an environment raises becomes a `Fault`. (A generator would cost twice the time.)"""

    def __init__(self, fix: str = "mend the environment"):
        self.fix = fix

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind, error, trace) -> None:
        if error is None or isinstance(error, Fault | KeyboardInterrupt):
            return
        place = traceback.extract_tb(trace)[-1]
        what = f"raised {kind.__name__}: {error} ({place.filename}:{place.lineno})"
        raise Fault(what, self.fix) from error


def _message(kind: int, value: dict[str, Any]) -> bytes:
    text = json.dumps(value).encode()
    return HEADER.pack(kind, len(text)) + text


class Process:
    """The same as `Environments`, in a worker process. No call takes longer than `timeout` seconds.

    After a `Fault` it is of no use: close it.
    """

    def __init__(self, spec: dict[str, Any], n: int, timeout: float):
        self.n, self._timeout, self._idle = n, timeout, True
        requests, self._out = os.pipe()
        self._in, replies = os.pipe()
        os.set_blocking(self._out, False)
        with tempfile.TemporaryFile() as shared:
            shared.truncate(mmap.PAGESIZE)
            self.current = memoryview(mmap.mmap(shared.fileno(), mmap.PAGESIZE)).cast("i")
            self._process = _start(requests, replies, shared.fileno())
        os.close(requests)
        os.close(replies)
        self._readable, self._writable = select.poll(), select.poll()
        self._readable.register(self._in, select.POLLIN)
        self._writable.register(self._out, select.POLLOUT)
        try:
            reply = self._ask(_message(OPEN, {"spec": spec, "n": n}), bytearray(HEADER.size))
        except BaseException:
            self.close(grace=0.0)
            raise
        self._sizes = json.loads(reply[HEADER.size :])

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
        frame = Frame(self.n, self._sizes)
        payload = numbers.tobytes() + active.tobytes()
        self._ask(HEADER.pack(kind, len(payload)) + payload, frame.buffer)
        return frame

    def _ask(self, request: bytes, reply: bytearray) -> bytearray:
        """Send a message; the one that comes back, in `reply` if it fits exactly."""
        if not self._idle:
            raise Fault("was interrupted in an earlier call", "ask for copies(n) again")
        self._idle = False
        deadline = time.monotonic() + self._timeout
        self._send(request, deadline)
        got = self._receive(reply, 0, HEADER.size, deadline)
        kind, length = HEADER.unpack_from(reply)
        if HEADER.size + length != len(reply):
            reply = reply[:got] + bytearray(HEADER.size + length - got)
        self._receive(reply, got, len(reply), deadline)
        if kind == FAULT:
            raise Fault(**json.loads(reply[HEADER.size :]))
        self._idle = True
        return reply

    def _send(self, request: bytes, deadline: float) -> None:
        try:
            sent = os.write(self._out, request)
            while sent < len(request):  # more than a pipe holds
                self._wait(self._writable, deadline)
                sent += os.write(self._out, request[sent:])
        except BrokenPipeError:
            raise self._ended() from None

    def _receive(self, into: bytearray, got: int, least: int, deadline: float) -> int:
        """Read until there are at least so many bytes; how many there are."""
        view = memoryview(into)
        while got < least:
            self._wait(self._readable, deadline)
            count = os.readv(self._in, [view[got:]])
            if count == 0:
                raise self._ended()
            got += count
        return got

    def _wait(self, pipe: select.poll, deadline: float) -> None:
        if not pipe.poll(max(0.0, 1000 * (deadline - time.monotonic()))):
            raise Fault(
                f"gave no answer within {self._timeout:g} s",
                "mend what hangs, or set a longer timeout if it is only slow",
            )

    def _ended(self) -> Fault:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE)
        status = self._process.returncode
        how = f"with exit status {status}"
        if status is not None and status < 0:
            how = f"by {signal.Signals(-status).name}"
        return Fault(f"ended its process {how}", "see what it wrote to the error stream")

    def close(self, grace: float = GRACE) -> None:
        """End the process: let it close its environments for `grace` seconds, then by force."""
        if self._out < 0:
            return
        os.close(self._out)
        self._out = -1
        self._idle = False
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(grace)
        if self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)  # with all that it started
        self._process.wait()
        os.close(self._in)


def _start(*descriptors: int) -> subprocess.Popen:
    """The worker: it finds modules where this process does, and never writes to its output."""
    path = os.pathsep.join(os.path.abspath(entry) for entry in sys.path)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    arguments = [str(number) for number in (*descriptors, os.getpid())]
    return subprocess.Popen(
        [sys.executable, "-P", "-m", __name__, *arguments],
        env={**threads, **os.environ, "PYTHONPATH": path},
        stdin=subprocess.DEVNULL,
        stdout=2,
        pass_fds=descriptors,
        start_new_session=True,  # Ctrl-C is for the parent
    )


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
                    reply = _answer(environments, kind, payload).buffer
            except Fault as fault:
                reply = _message(FAULT, {"what": fault.what, "fix": fault.fix})
            rest = memoryview(reply)
            while rest:
                rest = rest[sink.write(rest) :]
        if environments is not None:
            environments.close()


def _answer(environments: Environments, kind: int, payload: bytes) -> Frame:
    n = environments.n
    active = np.frombuffer(payload, np.bool_, n, len(payload) - n)
    if kind == RESET:
        return environments.reset(np.frombuffer(payload, np.uint32, n), active)
    shape = (n, environments.agents or 1, environments.action_size)
    actions = np.frombuffer(payload, np.float32, math.prod(shape)).reshape(shape)
    return environments.step(actions if environments.agents else actions[:, 0], active)


def _watch(parent: int) -> None:
    """End with the parent, even in the middle of a step."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def main() -> None:
    requests, replies, shared, parent = (int(number) for number in sys.argv[1:])
    for descriptor in (requests, replies, shared):
        os.set_inheritable(descriptor, False)
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    current = memoryview(mmap.mmap(shared, mmap.PAGESIZE)).cast("i")
    _serve(requests, replies, current)


if __name__ == "__main__":
    main()
