"""Copies of a Gymnasium environment in a process of their own, and the pipe to it.

`python -m credo.environments.worker` imports the standard library, NumPy, Gymnasium and the
environment: no JAX. `Process` starts one and speaks to it; `Environments` is what it holds.
A message is a header (kind, length) and raw arrays in the machine's byte order, JSON for opening
and for faults; nothing is unpickled. Needs pipes and signals as Unix has them.
"""

import array
import contextlib
import functools
import importlib
import json
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
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

HEADER = struct.Struct("=II")  # kind, bytes that follow
OPEN, RESET, STEP, FRAME, FAULT = range(5)
GRACE = 2.0  # seconds that environments get to close themselves


class Fault(Exception):
    """What an environment did wrong (`what`), and what to do about it (`fix`)."""

    def __init__(self, what: str, fix: str):
        super().__init__(what, fix)
        self.what, self.fix = what, fix


class Frame:
    """What `n` copies say, as arrays that look into the bytes of one message."""

    def __init__(self, n: int, obs_size: int):
        obs = HEADER.size + 8 * n
        flags = obs + 4 * n * obs_size
        self.buffer = bytearray(flags + 2 * n)
        HEADER.pack_into(self.buffer, 0, FRAME, len(self.buffer) - HEADER.size)
        self.rewards = np.ndarray(n, np.float64, self.buffer, HEADER.size)
        self.obs = np.ndarray((n, obs_size), np.float32, self.buffer, obs)
        self.terminated = np.ndarray(n, np.bool_, self.buffer, flags)
        self.truncated = np.ndarray(n, np.bool_, self.buffer, flags + n)


class Environments:
    """`n` copies in this process, behind flat arrays. Raises `Fault`, and nothing else.

    `spec` has `id`, `kwargs` (a dict) and `max_episode_steps` (a number or None). `current[0]` is
    the copy that is being called: it may lie in memory shared with whoever must know.
    """

    def __init__(self, spec: dict[str, Any], n: int, current: Any = None):
        self.current = array.array("i", [0]) if current is None else current
        self.n, self._envs = n, []
        with _blaming("look at its id and kwargs, and whether its package is installed"):
            for i in range(n):
                self.current[0] = i
                self._envs.append(_make(spec))
        self.max_steps = _time_limit(self._envs[0], spec["max_episode_steps"])
        self.obs_size, self._write = _observations(self._envs[0].observation_space)
        self.action_size, self._read = _actions(self._envs[0].action_space)
        self.discrete = isinstance(self._envs[0].action_space, gymnasium.spaces.Discrete)
        self._steps = [-1] * n  # in this episode; -1: there is none

    def reset(self, seeds: np.ndarray, active: np.ndarray) -> Frame:
        """Seeds `[n]`, uint32; active `[n]`."""
        frame = Frame(self.n, self.obs_size)
        with _blaming():
            for i in active.nonzero()[0].tolist():
                self.current[0] = i
                result = self._envs[i].reset(seed=int(seeds[i]))
                _count(result, 2, "reset", "(observation, info)")
                self._write(result[0], frame.obs[i])
                self._steps[i] = 0
        self._finite(frame)
        return frame

    def step(self, actions: np.ndarray, active: np.ndarray) -> Frame:
        """Actions `[n, act]` in [-1, 1], clipped to it; active `[n]`."""
        frame = Frame(self.n, self.obs_size)
        with _blaming():
            self._given(actions, active)
            own = self._read(actions)
            for i in active.nonzero()[0].tolist():
                self.current[0] = i
                self._step(i, own[i], frame)
        self._finite(frame)
        return frame

    def _given(self, actions: np.ndarray, active: np.ndarray) -> None:
        if np.isfinite(actions).all():
            return
        for i in active.nonzero()[0].tolist():
            self.current[0] = i
            if not np.isfinite(actions[i]).all():
                told = "look at the policy: NaN and inf are no actions"
                raise Fault(f"was given the action {actions[i]}", told)

    def _step(self, i: int, action: Any, frame: Frame) -> None:
        if self._steps[i] < 0:
            raise Fault("was asked for a step outside an episode", "reset this copy first")
        result = self._envs[i].step(action)
        _count(result, 5, "step", "(observation, reward, terminated, truncated, info)")
        obs, reward, terminated, truncated, _ = result
        self._write(obs, frame.obs[i])
        if not isinstance(reward, (float, int)) and np.shape(reward) != ():
            raise Fault(f"returned the reward {reward!r}", "return one number")
        frame.rewards[i] = reward
        frame.terminated[i] = terminated
        frame.truncated[i] = truncated
        self._steps[i] += 1
        if self._steps[i] >= self.max_steps:
            frame.truncated[i] = truncated = True
        if terminated or truncated:
            self._steps[i] = -1

    def _finite(self, frame: Frame) -> None:
        """One look at all copies; rows of those that are not active are 0."""
        if np.isfinite(frame.obs).all() and np.isfinite(frame.rewards).all():
            return
        good = np.isfinite(frame.obs).all(axis=1) & np.isfinite(frame.rewards)
        self.current[0] = i = int(np.flatnonzero(~good)[0])
        told = "the reward" if np.isfinite(frame.obs[i]).all() else "an observation"
        raise Fault(
            f"returned NaN or inf in {told}",
            "guard the division, root or logarithm it is from, or end the episode before",
        )

    def sizes(self) -> dict[str, int]:
        names = ("obs_size", "action_size", "max_steps", "discrete")
        return {name: getattr(self, name) for name in names}

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


def _make(spec: dict[str, Any]) -> gymnasium.Env:
    """One environment, by its Gymnasium id, as `package.module:Class`, or by an id that a module
    registers when it is imported: `package.module:Name-v0`."""
    module, _, name = spec["id"].partition(":")
    cls = getattr(importlib.import_module(module), name, None) if name.isidentifier() else None
    if cls is None:
        if name:
            importlib.import_module(module)
        return _registered(**spec | {"id": name or module})
    _hear_mujoco()
    env = cls(**spec["kwargs"])
    if not isinstance(env, gymnasium.Env):
        raise Fault(f"is a {type(env).__name__}", "name a class derived from gymnasium.Env")
    return env


def _registered(id: str, kwargs: dict[str, Any], max_episode_steps: int | None) -> gymnasium.Env:
    with warnings.catch_warnings():  # -v4 tasks are asked for on purpose
        warnings.filterwarnings("ignore", r".*is out of date", DeprecationWarning)
        entry = gymnasium.spec(id).entry_point
        if isinstance(entry, str):
            importlib.import_module(entry.partition(":")[0])
        _hear_mujoco()
        return gymnasium.make(id, max_episode_steps, disable_env_checker=True, **kwargs)


def _hear_mujoco() -> None:
    """MuJoCo would write its warnings to a file in the working directory, once for every copy."""
    mujoco = sys.modules.get("mujoco")
    if mujoco is not None and mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_tell)


@functools.cache  # each once
def _tell(warning: str) -> None:
    if "'settotalmass' is deprecated" not in warning:  # in Gymnasium's half_cheetah.xml
        print(f"MuJoCo: {warning}", file=sys.stderr)


def _time_limit(env: gymnasium.Env, limit: int | None) -> int:
    limits = [] if limit is None else [limit]
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, gymnasium.wrappers.TimeLimit):
            limits.append(env._max_episode_steps)
        env = env.env
    if not limits:
        raise Fault(
            "has no time limit: an episode might never end",
            "set max_episode_steps, the steps after which an episode is truncated: on the command "
            "line --max-episode-steps 1000, say",
        )
    return min(limits)


def _observations(space: gymnasium.Space) -> tuple[int, Callable[[Any, np.ndarray], None]]:
    """Size of a flat observation, and how to write one into a row of float32.

    Box: flattened. Discrete: one-hot. What is made of them: one after the other.
    """
    shape = space.shape

    def write_box(obs: Any, row: np.ndarray) -> None:
        obs = np.asarray(obs)
        if obs.shape != shape:
            raise Fault(
                f"returned an observation of shape {obs.shape}",
                f"its observation_space says {shape}: make the two agree",
            )
        row[:] = obs.ravel()

    def write_other(obs: Any, row: np.ndarray) -> None:
        if not space.contains(obs):
            raise Fault(
                f"returned the observation {obs!r}",
                f"its observation_space is {space}: make the two agree",
            )
        row[:] = gymnasium.spaces.flatten(space, obs)

    if not space.is_np_flattenable:
        raise Fault(
            f"has the observation space {space}",
            "use a Box, a Discrete, or a Dict or Tuple of them",
        )
    box = isinstance(space, gymnasium.spaces.Box)
    return gymnasium.spaces.flatdim(space), write_box if box else write_other


def _actions(space: gymnasium.Space) -> tuple[int, Callable[[np.ndarray], np.ndarray]]:
    """Size of an action, and how to turn actions `[n, act]` in [-1, 1] into the space's own.

    Box: -1 is its low, 1 its high. Discrete: the entry that is largest.
    """
    if isinstance(space, gymnasium.spaces.Discrete):
        start = space.start
        return int(space.n), lambda actions: np.argmax(actions, axis=1) + start
    if not isinstance(space, gymnasium.spaces.Box):
        raise Fault(f"has the action space {space}", "use a Box or a Discrete")
    low, high = (np.float64(bound).ravel() for bound in (space.low, space.high))
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise Fault(
            f"has an action space without bounds: {space}",
            "give its Box a finite low and high: actions in [-1, 1] are scaled to them",
        )
    center, half = (low + high) / 2, (high - low) / 2
    shape, dtype = space.shape, space.dtype
    whole = not np.issubdtype(dtype, np.floating)

    def read(actions: np.ndarray) -> np.ndarray:
        own = np.minimum(np.maximum(center + half * actions, low), high)
        own = np.rint(own) if whole else own
        return own.astype(dtype).reshape(-1, *shape)

    return low.size, read


def _count(result: Any, n: int, where: str, parts: str) -> None:
    if not (isinstance(result, tuple) and len(result) == n):
        count = f"{len(result)} values" if isinstance(result, tuple) else type(result).__name__
        raise Fault(f"returned {count} from {where}", f"return {parts}")


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
        self.obs_size, self.action_size = self._sizes["obs_size"], self._sizes["action_size"]

    def sizes(self) -> dict[str, int]:
        return self._sizes

    @property
    def usable(self) -> bool:
        return self._idle and self._process.poll() is None

    def reset(self, seeds: np.ndarray, active: np.ndarray) -> Frame:
        return self._call(RESET, seeds, active)

    def step(self, actions: np.ndarray, active: np.ndarray) -> Frame:
        return self._call(STEP, actions, active)

    def _call(self, kind: int, numbers: np.ndarray, active: np.ndarray) -> Frame:
        frame = Frame(self.n, self.obs_size)
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
    actions = np.frombuffer(payload, np.float32, n * environments.action_size)
    return environments.step(actions.reshape(n, -1), active)


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
