"""Who hears of a run while it goes on: callbacks of your own, and the loggers that Credo has."""

import importlib
import importlib.util
import pathlib
import secrets
import socket
import struct
import time
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from . import files
from .record import RunError

if TYPE_CHECKING:
    from .options import RunOptions
    from .store import Run

Metrics = dict[str, Any]


class Callback:
    """Hears of a run: derive from it and override what you need.

    Hooks are called in the process that trains, after the dispatch that a generation ran in: of a
    task in JAX up to 64 generations are one dispatch, which is kept whatever a hook says about one
    of them. `run` is the run on disk, as far as it is saved. A hook that raises ends the run: it is
    saved first, and `on_end` is told.
    """

    def on_generation(self, run: "Run", generation: int, metrics: Metrics) -> bool | None:
        """Called for every generation in order, with its row of `metrics.csv`. Return True to save
        and end the run."""

    def on_test(self, run: "Run", generation: int, score: float) -> None:
        """Called when the best policy of a generation was tested: `score` is its mean return over
        the test's episodes. Where tests are made now and then (`test_every`), one with exactly the
        score of the test before is not told."""

    def on_end(self, run: "Run", reason: str) -> None:
        """Called once, after the last save. `reason` is "budget", "score", "wall clock",
        "callback", "signal" or "error"."""


class Logger(Callback):
    """A callback that training can do without: if it raises, it is dropped with a warning."""


class TensorBoard(Logger):
    """TensorBoard events, written by the caller's thread: nothing waits for a queue."""

    def __init__(self) -> None:
        self.path: pathlib.Path | None = None

    def on_generation(self, run: "Run", generation: int, metrics: Metrics) -> None:
        """One event with all finite numbers. Raises `OSError`."""
        # A tenth of a second that a finished run need not pay.
        from tensorboardX.proto import event_pb2, summary_pb2

        event, summary = cast(Any, event_pb2).Event, cast(Any, summary_pb2).Summary
        if self.path is None:
            self.path = self._begin(run.path / "tensorboard", event, generation)
        values = [
            summary.Value(tag=name, simple_value=value) for name, value in _finite(metrics).items()
        ]
        files.append(self.path, _record(event(step=generation, summary=summary(value=values))))

    def _begin(self, folder: pathlib.Path, event: Any, first: int) -> pathlib.Path:
        """A new file, for which what earlier files say from step `first` on is void."""
        from tensorboardX.proto import event_pb2

        session = cast(Any, event_pb2).SessionLog
        began = session(status=session.START)
        head = [event(file_version="brain.Event:2"), event(step=first, session_log=began)]
        folder.mkdir(parents=True, exist_ok=True)
        now = f"{time.time():010.0f}.{socket.gethostname()}.{time.monotonic_ns()}"
        path = folder / f"events.out.tfevents.{now}"
        files.write_new(path, map(_record, head))
        return path


class Tracker(Logger):
    """Metrics to the experiment tracker of this name. Weights & Biases writes, with
    `WANDB_MODE=offline`, into `wandb/` of the run's folder; trackio into the user's cache."""

    def __init__(self, name: str) -> None:
        self.name, self.tracked = name, None

    def on_generation(self, run: "Run", generation: int, metrics: Metrics) -> None:
        """One step, in a tracked run that a resumed one goes on with."""
        if self.tracked is None:
            own: dict[str, Any] = {"embed": False}
            if self.name == "wandb":  # the streams are ours
                own = {"dir": run.path, "id": _identity(run), "settings": {"console": "off"}}
            config = {"algorithm": run.config["algorithm"], "seed": run.config["seed"]}
            own |= {"name": f"{run.path.name}-{_identity(run)}", "config": config}
            tracker = importlib.import_module(self.name)
            self.tracked = tracker.init(project="credo", resume="allow", **own)
        self.tracked.log(_finite(metrics), step=generation)

    def on_end(self, run: "Run", reason: str) -> None:
        """The tracked run ends too."""
        if self.tracked is not None:
            failed = {"exit_code": int(reason == "error")} if self.name == "wandb" else {}
            self.tracked.finish(**failed)


def of(options: "RunOptions") -> list[Callback]:
    """The callbacks that options ask for, loggers first. Raises `RunError` if the package of one is
    missing, and `TypeError` for what is no callback."""
    heard: list[Callback] = [TensorBoard()] * options.tensorboard
    for name in options.loggers:
        if importlib.util.find_spec(name) is None:
            raise RunError(f"{name} is not installed: pip install '.[{name}]' in a checkout")
        heard.append(Tracker(name))
    for callback in options.callbacks:
        if not isinstance(callback, Callback) and not callable(callback):
            raise TypeError(f"{callback!r} is no callback: derive it from credo.Callback")
        heard.append(callback if isinstance(callback, Callback) else OnGeneration(callback))
    return heard


class Listeners:
    """All callbacks of a run that goes on."""

    def __init__(self, run: "Run", callbacks: Sequence[Callback], score: float, every: bool):
        """`score`: that of the test before; `every`: whether each generation makes a test."""
        self.run, self.callbacks = run, list(callbacks)
        self.score, self.every = score, every
        self.error: Exception | SystemExit | None = None  # of a callback that is no logger

    def hear(self, rows: Sequence[Metrics]) -> bool:
        """Tell of these generations; whether the run is to end."""
        answers = []
        for row in rows:
            generation, score = row["generation"], row["champion_score"]
            answers += self.tell("on_generation", generation, row)
            if np.isfinite(score) and (self.every or score != self.score):
                self.tell("on_test", generation, score)
            self.score = score
        return any(answers) or self.error is not None

    def end(self, reason: str) -> None:
        """Tell of the end, then raise what a callback raised."""
        self.tell("on_end", reason)
        if self.error is not None:
            self.error.add_note(f"{self.run.path} was saved before this was raised")
            raise self.error

    def tell(self, hook: str, *what: Any) -> list[Any]:
        """Call a hook of all callbacks; their answers."""
        answers = []
        for callback in tuple(self.callbacks):
            try:
                answers.append(bool(getattr(callback, hook)(self.run, *what)))
            except (Exception, SystemExit) as error:
                self.callbacks.remove(callback)
                if not isinstance(callback, Logger):
                    self.error = self.error or error
                    continue
                name = getattr(callback, "name", type(callback).__name__)
                warnings.warn(f"{name} is no longer told: {error}; training goes on", stacklevel=4)
        return answers


class OnGeneration(Callback):
    """A plain function in the place of a callback."""

    def __init__(self, function: Callable[..., Any]):
        self.on_generation = function


def _finite(metrics: Metrics) -> dict[str, float]:
    told = {name: float(value) for name, value in metrics.items() if name != "generation"}
    return {name: value for name, value in told.items() if np.isfinite(value)}


def _identity(run: "Run") -> str:
    """By what a tracker finds this run again, kept in its folder."""
    path = run.path / "tracker.id"
    if not path.exists():
        files.write_text(path, secrets.token_hex(4))
    return files.read_text(path, most=64)


def _record(event: Any) -> bytes:
    """An event as the format has it: length, its checksum, data, their checksum."""
    from tensorboardX.record_writer import masked_crc32c

    event.wall_time = time.time()
    data = event.SerializeToString()
    length = struct.pack("<Q", len(data))
    sums = [struct.pack("<I", masked_crc32c(part)) for part in (length, data)]
    return b"".join((length, sums[0], data, sums[1]))
