"""Training: the loop around `generation`, a run on disk, and how to come back to it.

A run is a folder:

    config.json          the object tree, seed, budget, versions and machine
    metrics.csv          one row per generation; the same bits however often the run was stopped
    timing.csv           the clock, which is not
    tensorboard/         the same as events
    checkpoints/         everything needed to go on
    champion.safetensors the best policy, with its config inside
"""

import json
import pathlib
import shutil
import signal
import threading
import time
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray, PyTree

from .. import compilation, require
from ..compilation import jit
from . import checkpoint, config, log
from .lock import lock
from .progress import Progress

CHUNK = 64  # generations in one dispatch, at most
DISPATCH = 0.3  # seconds that one dispatch should last


class RunError(RuntimeError):
    """A run that cannot start or go on; the message says what to do."""


class Interrupted(RunError):
    """Stopped by a signal, saved. `code` is the exit code a shell expects."""

    def __init__(self, message: str, code: int):
        super().__init__(message)
        self.code = code


class Run:
    """A run on disk, finished or not."""

    def __init__(self, path: str | pathlib.Path):
        self.path = pathlib.Path(path)
        if not (self.path / "config.json").exists():
            raise RunError(
                f"{self.path} is not a run: it has no config.json; name a folder that "
                "`credo train` made"
            )
        try:
            self.config = json.loads((self.path / "config.json").read_text())
        except json.JSONDecodeError as error:
            raise RunError(f"{self.path / 'config.json'} is damaged: {error}") from error

    @property
    def algorithm(self) -> Any:
        return config.from_tree(self.config["algorithm"])

    @property
    def metrics(self) -> dict[str, np.ndarray]:
        """Columns of `metrics.csv`, one entry per generation."""
        return log.read(self.path / "metrics.csv")

    @property
    def champion(self) -> PyTree:
        """The policy with the highest fitness of the last generation."""
        like = eqx.filter_eval_shape(self.algorithm.init, key=jax.random.key(0)).champion
        return checkpoint.import_policy(self.path / "champion.safetensors", like)

    def policy(self) -> "Policy":
        """The champion as a plain callable on NumPy observations."""
        return Policy(self.champion)


class Policy:
    """A trained policy: `action = policy(observation)`, its memory kept between calls."""

    def __init__(self, policy: PyTree):
        arrays, self._static = eqx.partition(policy, eqx.is_array)
        self._arrays = arrays
        self._step = jax.jit(
            lambda arrays, obs, carry: eqx.combine(arrays, self._static)(obs, carry)
        )
        self.reset()

    def reset(self, seed: int = 0) -> None:
        """Forget: call at the start of every episode."""
        self._carry = eqx.combine(self._arrays, self._static).start(key=jax.random.key(seed))

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """An action in [-1, 1], float32."""
        obs = jnp.asarray(observation, jnp.float32)
        action, self._carry = self._step(self._arrays, obs, self._carry)
        return np.asarray(action)


def train(
    algorithm: Any,
    *,
    generations: int,
    seed: int = 0,
    path: str | pathlib.Path | None = None,
    stop_at: float | None = None,
    wall_clock: float | None = None,
    checkpoint_every: float = 60.0,
    keep: int = 3,
    tensorboard: bool = True,
    progress: bool = True,
    callback: Callable[[int, dict[str, Any]], bool | None] | None = None,
) -> Run:
    """Start a run in an empty or new folder and train.

    **Arguments:**

    - `generations`: the budget. - `seed`: everything random follows from it.
    - `path`: the run's folder; by default `runs/<algorithm>-<task>-<seed>`.
    - `stop_at`: end early once a generation's `champion_score` reaches this.
    - `wall_clock`: seconds after which to save and end.
    - `checkpoint_every`: seconds between checkpoints; `keep`: how many stay on disk.
    - `callback(generation, metrics)`: called for every generation, after the dispatch it ran in;
      return True to end. What the dispatch has run by then is kept.

    **Raises:** `RunError` if the folder holds a run already, `Interrupted` after a signal.
    """
    compilation.enable_cache()
    require.at_least("generations", generations, 1)
    require.at_least("keep", keep, 1)
    record_of = config.to_tree(algorithm)
    config.from_tree(record_of)  # what cannot be read back should fail now, not at a resume
    path = pathlib.Path(path) if path else free_name(algorithm, seed)
    if (path / "config.json").exists():
        raise RunError(
            f"{path} holds a run already: `credo resume {path}` goes on with it; choose another "
            "path for a new one"
        )
    path.mkdir(parents=True, exist_ok=True)
    record = {
        "algorithm": record_of,
        "seed": seed,
        "budget": {"generations": generations, "stop_at": stop_at},
        "machine": config.machine(),
    }
    options = {"checkpoint_every": checkpoint_every, "keep": keep, "tensorboard": tensorboard}
    with lock(path):
        if (path / "config.json").exists():
            raise RunError(f"another process started a run in {path} just now: choose another path")
        # Left by a process that was killed before it wrote its config: nobody can resume it.
        shutil.rmtree(path / "checkpoints", ignore_errors=True)
        state = _initial(algorithm, jax.random.key(seed))
        # The first checkpoint comes before the config: what has a config can be resumed.
        checkpoint.save(path / "checkpoints", 0, eqx.filter(state, eqx.is_array), {"frames": 0})
        config.write_json(path / "config.json", record)
        return _train(
            Run(path), algorithm, wall_clock, progress=progress, callback=callback, **options
        )


def resume(
    path: str | pathlib.Path,
    *,
    generations: int | None = None,
    stop_at: float | None = None,
    wall_clock: float | None = None,
    checkpoint_every: float = 60.0,
    keep: int = 3,
    tensorboard: bool = True,
    progress: bool = True,
    callback: Callable[[int, dict[str, Any]], bool | None] | None = None,
) -> Run:
    """Go on with a run from its newest intact checkpoint, to its own budget or a larger one.

    The result has the same bits as that of a run never stopped (same machine and core count).
    A new `generations` budget without a `stop_at` drops the one the run had.
    """
    run = Run(path)
    with lock(run.path):
        budget = run.config["budget"]
        if generations is not None and generations < budget["generations"]:
            raise RunError(
                f"this run's budget is {budget['generations']} generations: a new budget must be "
                f"larger, not {generations}"
            )
        if generations is not None or stop_at is not None:
            budget["generations"] = generations or budget["generations"]
            budget["stop_at"] = stop_at
            config.write_json(run.path / "config.json", run.config)
        _warn_of_other_machine(run.config["machine"])
        return _train(
            run,
            run.algorithm,
            wall_clock,
            checkpoint_every=checkpoint_every,
            keep=keep,
            tensorboard=tensorboard,
            progress=progress,
            callback=callback,
        )


def _train(run, algorithm, wall_clock, *, checkpoint_every, keep, tensorboard, progress, callback):
    """From the newest checkpoint to the end of the budget. The caller holds the lock."""
    compilation.enable_cache()
    root = jax.random.key(run.config["seed"])
    like = eqx.filter_eval_shape(algorithm.init, key=root)
    like, static = eqx.partition(like, lambda x: isinstance(x, jax.ShapeDtypeStruct))
    saved = checkpoint.load(run.path / "checkpoints", like)
    state = eqx.combine(saved.state, static)
    generation, frames = saved.generation, int(saved.counters["frames"])
    budget = run.config["budget"]["generations"]
    stop_at = run.config["budget"]["stop_at"]
    # The mean of 49 of 50 in float32 is a little less than 0.98. NaN: no comparison ever stops.
    stop_score = np.float32(np.nan if stop_at is None else stop_at - 1e-6)
    rows = log.read(run.path / "metrics.csv")
    score = _score_at(rows, generation)
    journal = log.Log(run.path, generation, tensorboard=tensorboard)
    before = log.read(run.path / "timing.csv").get("seconds", np.zeros(1))[-1]
    began = last_save = time.monotonic()
    chunk, ended = 1, False

    with Signals() as signals, Progress(run.path, generation, budget, progress) as bar:
        while generation < budget and not (score >= stop_score or ended or signals.received):
            tick = time.monotonic()
            n = min(chunk, budget - generation)
            state, score, count, metrics = advance(
                algorithm, state, root, np.int32(generation), np.int32(n), stop_score
            )
            columns = jax.tree.map(np.asarray, metrics)
            batch = []
            for i in range(int(count)):
                row = {name: column[i].item() for name, column in columns.items()}
                generation += 1
                frames += int(row.pop("frames"))
                batch.append({"generation": generation, "frames": frames, **row})
            now = time.monotonic()
            seconds = now - tick
            journal.append(batch, seconds, before + now - began)
            bar.update(generation, batch[-1], seconds, len(batch))
            if callback is not None:
                answers = [callback(row["generation"], row) for row in batch]
                ended = any(answers)
            ended = ended or (wall_clock is not None and now - began >= wall_clock)
            if now - last_save >= checkpoint_every:
                journal.sync()
                _save(run, algorithm, generation, state, frames, keep)
                last_save = now
            # The first dispatch compiles; from the second on, its length follows the clock.
            # How many generations one dispatch holds is data and changes no result.
            chunk = 2 if chunk == 1 else int(np.clip(n * DISPATCH / seconds, 1, CHUNK))
        journal.close()
        journal.sync()
        _save(run, algorithm, generation, state, frames, keep)
    if signals.received and generation < budget:
        raise Interrupted(
            f"stopped at generation {generation} of {budget} and saved; go on with "
            f"`credo resume {run.path}`",
            128 + signals.received,
        )
    return run


@jit
def advance(
    algorithm: Any, state: PyTree, root: PRNGKeyArray, generation: Any, n: Any, stop_at: Any
):
    """`n` generations, at most `CHUNK`, in one program; fewer if a score reaches `stop_at`.

    **Returns:** the state, the last score, how many ran, and metrics `[CHUNK]` each.
    """
    dynamic, static = eqx.partition(state, eqx.is_array)

    def one(dynamic, i):
        # Generation g draws from fold_in(root, g): a checkpoint needs no generator's state.
        key = jax.random.fold_in(root, generation + i + 1)
        state, metrics = algorithm.generation(eqx.combine(dynamic, static), key=key)
        return eqx.filter(state, eqx.is_array), metrics

    shapes = jax.eval_shape(one, dynamic, jnp.int32(0))[1]
    empty = jax.tree.map(lambda x: jnp.zeros((CHUNK, *x.shape), x.dtype), shapes)

    def body(loop):
        i, dynamic, _, kept = loop
        dynamic, metrics = one(dynamic, i)
        kept = jax.tree.map(lambda xs, x: xs.at[i].set(x), kept, metrics)
        return i + 1, dynamic, metrics["champion_score"], kept

    def ongoing(loop):
        i, _, score, _ = loop
        return (i < n) & ~(score >= stop_at)

    start = (jnp.int32(0), dynamic, jnp.float32(-jnp.inf), empty)
    count, dynamic, score, kept = jax.lax.while_loop(ongoing, body, start)
    return eqx.combine(dynamic, static), score, count, kept


@jit
def _initial(algorithm: Any, root: PRNGKeyArray) -> PyTree:
    return algorithm.init(key=jax.random.fold_in(root, 0))


def _save(run: Run, algorithm: Any, generation: int, state: PyTree, frames: int, keep: int):
    arrays = eqx.filter(state, eqx.is_array)
    checkpoint.save(run.path / "checkpoints", generation, arrays, {"frames": frames}, keep=keep)
    metadata = {"algorithm": json.dumps(config.to_tree(algorithm)), "generation": str(generation)}
    checkpoint.export_policy(run.path / "champion.safetensors", state.champion, metadata)


def _score_at(rows: dict[str, np.ndarray], generation: int) -> float:
    if generation == 0 or "champion_score" not in rows:
        return -np.inf
    match = np.flatnonzero(rows["generation"] == generation)
    return float(rows["champion_score"][match[-1]]) if match.size else -np.inf


def free_name(algorithm: Any, seed: int | str) -> pathlib.Path:
    name = f"{type(algorithm).__name__}-{type(algorithm.env).__name__}-{seed}".lower()
    path, copies = pathlib.Path("runs") / name, 1
    while path.exists():
        copies += 1
        path = pathlib.Path("runs") / f"{name}-{copies}"
    return path


def _warn_of_other_machine(recorded: dict[str, Any]):
    here = config.machine()
    for what in ("cores", "processor", "device", "versions"):
        lines = config.differences(recorded.get(what), here[what], what)
        if lines:
            warnings.warn(
                f"this run began elsewhere ({'; '.join(lines)}): it goes on, but not bit for bit",
                stacklevel=3,
            )


class Signals:
    """Ctrl-C and SIGTERM ask for an end after the generation; a second one stops at once."""

    def __init__(self):
        self.received = 0
        self._before: dict[int, Any] = {}

    def __enter__(self):
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._receive)
        return self

    def _receive(self, number, frame):
        if self.received:
            raise SystemExit(128 + number)
        self.received = number

    def __exit__(self, *_):
        for number, handler in self._before.items():
            signal.signal(number, handler)
