"""Training: the loop around `generation`, a run on disk, and how to come back to it.

A run is a folder:

    config.json          the object tree, seed, budget, versions and machine
    metrics.csv          one row per generation; the same bits however often the run was stopped
    timing.csv           the clock, which is not
    tensorboard/         the same as events
    checkpoints/         everything needed to go on
    champion.safetensors the fittest of the last generation, with its config inside
"""

import contextlib
import dataclasses
import json
import os
import pathlib
import re
import shutil
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray, PyTree

from .. import compilation, require
from ..compilation import jit
from ..environments.host import AbstractHostEnvironment, EnvironmentFailure
from ..replay import shapes_alone
from ..types import NOTHING
from . import checkpoint, config, log
from .budget import Budget
from .lock import lock
from .progress import Progress

CHUNK = 64  # generations in one dispatch, at most
DISPATCH = 0.3  # seconds that one dispatch should last
MOST = 2**31 - 1  # what 32 bits hold

Callback = Callable[[int, dict[str, Any]], bool | None]


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
    @compilation.float32()
    def champion(self) -> PyTree:
        """The policy with the highest fitness of the last generation; of a learner alone, its
        actor."""
        with shapes_alone():
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


@compilation.float32()
def train(
    algorithm: Any,
    *,
    generations: int | None = None,
    frames: int | None = None,
    seed: int = 0,
    path: str | pathlib.Path | None = None,
    warm_start: str | pathlib.Path | None = None,
    stop_at: float | None = None,
    wall_clock: float | None = None,
    checkpoint_every: float = 60.0,
    keep: int = 3,
    tensorboard: bool = True,
    progress: bool = True,
    callback: Callback | None = None,
) -> Run:
    """Start a run in an empty or new folder and train.

    **Arguments:**

    - `generations`, `frames` (environment steps): the budget. The run ends after the first
      generation that reaches one of them; without both, the algorithm's `default_budget`, or
      else 1000 generations.
    - `seed`: everything random follows from it.
    - `path`: the run's folder; by default `runs/<algorithm>-<task>-<seed>`.
    - `warm_start`: another run, whose champion this one starts from.
    - `stop_at`: end early once a generation's `champion_score` reaches this.
    - `wall_clock`: seconds after which to save and end.
    - `checkpoint_every`: seconds between checkpoints; `keep`: how many stay on disk.
    - `callback(generation, metrics)`: called for every generation, after the dispatch it ran in;
      return True to end. What the dispatch has run by then is kept.

    **Raises:** `RunError` if the folder holds a run already, if the algorithm cannot start from
    a policy, or if an environment outside JAX fails; `Interrupted` after a signal.
    """
    compilation.enable_cache()
    budget = Budget.of(algorithm, generations, frames, stop_at)
    require.at_least("keep", keep, 1)
    record_of = config.to_tree(algorithm)
    config.from_tree(record_of)  # what cannot be read back should fail now, not at a resume
    path = pathlib.Path(path) if path else free_name(algorithm, seed)
    if (path / "config.json").exists():
        raise RunError(
            f"{path} holds a run already: `credo resume {path}` goes on with it; choose another "
            "path for a new one"
        )
    record = {
        "algorithm": record_of,
        "seed": seed,
        "budget": budget.record(),
        "machine": config.machine(),
    }
    if warm_start is not None:
        record["warm_start"] = str(warm_start)
    with _new_folder(path):
        # Left by a process that was killed before it wrote its config: nobody can resume it.
        shutil.rmtree(path / "checkpoints", ignore_errors=True)
        state = _initial(algorithm, jax.random.key(seed))
        if warm_start is not None:
            state = _warm(algorithm, state, Run(warm_start))
        # The first checkpoint comes before the config: what has a config can be resumed.
        checkpoint.save(path / "checkpoints", 0, eqx.filter(state, eqx.is_array), {"frames": 0})
        del state  # it may fill half of the memory, and is read back
        config.write_json(path / "config.json", record)
        run = Run(path)
        return _train(
            run,
            algorithm,
            _load(run, algorithm),
            wall_clock,
            checkpoint_every=checkpoint_every,
            keep=keep,
            tensorboard=tensorboard,
            progress=progress,
            callback=callback,
        )


@compilation.float32()
def resume(
    path: str | pathlib.Path,
    *,
    generations: int | None = None,
    frames: int | None = None,
    stop_at: float | None = None,
    wall_clock: float | None = None,
    checkpoint_every: float = 60.0,
    keep: int = 3,
    tensorboard: bool = True,
    progress: bool = True,
    callback: Callback | None = None,
) -> Run:
    """Go on with a run from its newest intact checkpoint, to its own budget or a larger one.

    The result has the same bits as that of a run never stopped (same machine and core count).
    A new budget takes the place of the whole old one: with `generations` alone a limit of frames
    is dropped, and the other way round; without `stop_at` that is dropped too.
    """
    compilation.enable_cache()
    run = Run(path)
    with lock(run.path):
        algorithm = run.algorithm
        saved = _load(run, algorithm)
        old = Budget.read(run.config["budget"])
        if generations is not None or frames is not None:
            budget = Budget.of(algorithm, generations, frames, stop_at)
            try:
                budget.refuse_smaller(old, saved.generation, int(saved.counters["frames"]))
            except ValueError as error:
                raise RunError(str(error)) from None
        else:
            budget = old if stop_at is None else dataclasses.replace(old, stop_at=stop_at)
        if budget != old:
            run.config["budget"] = budget.record()
            config.write_json(run.path / "config.json", run.config)
        _warn_of_other_machine(run.config["machine"])
        return _train(
            run,
            algorithm,
            saved,
            wall_clock,
            checkpoint_every=checkpoint_every,
            keep=keep,
            tensorboard=tensorboard,
            progress=progress,
            callback=callback,
        )


def _load(run: Run, algorithm: Any) -> checkpoint.Checkpoint:
    """The newest intact checkpoint, its state whole."""
    like = eqx.filter_eval_shape(algorithm.init, key=jax.random.key(0))
    like, static = eqx.partition(like, lambda x: isinstance(x, jax.ShapeDtypeStruct))
    saved = checkpoint.load(run.path / "checkpoints", like)
    return eqx.tree_at(lambda saved: saved.state, saved, eqx.combine(saved.state, static))


def _train(
    run: Run,
    algorithm: Any,
    saved: checkpoint.Checkpoint,
    wall_clock: float | None,
    *,
    checkpoint_every: float,
    keep: int,
    tensorboard: bool,
    progress: bool,
    callback: Callback | None,
) -> Run:
    """From `saved` to the end of the budget. The caller holds the lock."""
    root = jax.random.key(run.config["seed"])
    state, generation, frames = saved.state, saved.generation, int(saved.counters["frames"])
    del saved  # the state is donated: nobody may hold the old one
    budget = Budget.read(run.config["budget"])
    rows = log.read(run.path / "metrics.csv")
    reached = budget.reached(generation, frames, _score_at(rows, generation))
    journal = log.Log(run.path, generation, tensorboard=tensorboard and not reached)
    before = log.read(run.path / "timing.csv").get("seconds", np.zeros(1))[-1]
    began = last_save = time.monotonic()
    safe, chunk, ended = generation, 1, False

    board = Progress(run.path, generation, frames, budget, progress)
    with Signals(quiet=not progress) as signals, board as bar:
        if reached:
            bar.say(f"is finished: {reached}; to go on give a larger --generations or --frames")
        else:
            bar.start()
        while not (reached or ended or signals.received):
            tick = time.monotonic()
            try:
                state, batch = play(algorithm, state, root, generation, frames, chunk, budget)
            except EnvironmentFailure as failure:
                # The state was donated: what is on disk is all there is.
                journal.close()
                raise RunError(
                    f"{str(failure).rstrip('.')}. The checkpoint of generation {safe} stands; "
                    f"resume with `credo resume {run.path}`"
                ) from failure
            generation, frames = batch[-1]["generation"], batch[-1]["frames"]
            now = time.monotonic()
            seconds = now - tick
            journal.append(batch, seconds, before + now - began)
            bar.update(generation, batch[-1], seconds)
            if callback is not None:
                answers = [callback(row["generation"], row) for row in batch]
                ended = any(answers)
            ended = ended or (wall_clock is not None and now - began >= wall_clock)
            reached = budget.reached(generation, frames, batch[-1]["champion_score"])
            if now - last_save >= checkpoint_every:
                journal.sync()
                _save(run, algorithm, generation, state, frames, keep)
                safe, last_save = generation, now
            # The first dispatch compiles; from the second on, its length follows the clock.
            # How many generations one dispatch holds is data and changes no result.
            chunk = 2 if chunk == 1 else int(np.clip(len(batch) * DISPATCH / seconds, 1, CHUNK))
        journal.close()
        journal.sync()
        _save(run, algorithm, generation, state, frames, keep)
    if signals.received and not reached:
        raise Interrupted(
            f"stopped at {budget.where(generation, frames)} and saved; go on with "
            f"`credo resume {run.path}`",
            128 + signals.received,
        )
    return run


def play(
    algorithm: Any,
    state: PyTree,
    root: PRNGKeyArray,
    generation: int,
    frames: int,
    n: int,
    budget: Budget,
) -> tuple[PyTree, list[dict[str, Any]]]:
    """The next generations, at most `n` and `CHUNK`, none beyond the budget; one if the task lies
    outside JAX. `state` is used up.

    **Returns:** the state and a row of metrics, in Python numbers, for each generation.
    """
    if isinstance(algorithm.env, AbstractHostEnvironment):
        state, metrics = algorithm.generation(state, key=jax.random.fold_in(root, generation + 1))
        columns, count = jax.tree.map(lambda x: np.asarray(x)[None], metrics), 1
    else:
        n = min(n, CHUNK, (budget.generations or MOST) - generation)
        left = MOST if budget.frames is None else min(budget.frames - frames, MOST)
        numbers = (np.int32(generation), np.int32(n), np.int32(left), budget.stop_score)
        state, count, metrics = advance((algorithm, root, *numbers), state)
        columns = jax.tree.map(np.asarray, metrics)
    batch = []
    for i in range(int(count)):
        row = {name: column[i].item() for name, column in columns.items()}
        row = {name: np.nan if value == NOTHING else value for name, value in row.items()}
        frames += int(row.pop("frames"))
        batch.append({"generation": generation + i + 1, "frames": frames, **row})
    return state, batch


@jit(donate="all-except-first")
def advance(fixed: tuple[Any, ...], state: PyTree):
    """`n` generations, at most `CHUNK`, in one program; fewer if a score reaches `stop_at`, or
    their frames `left`. The memory of `state` is used for the result.

    **Arguments:** `fixed`: the algorithm, the root key, how many generations are done, `n`,
    `left` and `stop_at`.

    **Returns:** the state, how many generations ran, and metrics `[CHUNK]` each.
    """
    algorithm, root, generation, n, left, stop_at = fixed
    dynamic, static = eqx.partition(state, eqx.is_array)

    def one(dynamic, i):
        # Generation g draws from fold_in(root, g): a checkpoint needs no generator's state.
        key = jax.random.fold_in(root, generation + i + 1)
        state, metrics = algorithm.generation(eqx.combine(dynamic, static), key=key)
        return eqx.filter(state, eqx.is_array), metrics

    shapes = jax.eval_shape(one, dynamic, jnp.int32(0))[1]
    empty = jax.tree.map(lambda x: jnp.zeros((CHUNK, *x.shape), x.dtype), shapes)

    def body(loop):
        i, left, dynamic, _, kept = loop
        dynamic, metrics = one(dynamic, i)
        kept = jax.tree.map(lambda xs, x: xs.at[i].set(x), kept, metrics)
        left = left - metrics["frames"].astype(jnp.int32)
        return i + 1, left, dynamic, metrics["champion_score"], kept

    def ongoing(loop):
        i, left, _, score, _ = loop
        return (i < n) & (left > 0) & ~(score >= stop_at)

    start = (jnp.int32(0), left, dynamic, jnp.float32(-jnp.inf), empty)
    count, _, dynamic, _, kept = jax.lax.while_loop(ongoing, body, start)
    return eqx.combine(dynamic, static), count, kept


@jit
def _initial(algorithm: Any, root: PRNGKeyArray) -> PyTree:
    return algorithm.init(key=jax.random.fold_in(root, 0))


def _save(run: Run, algorithm: Any, generation: int, state: PyTree, frames: int, keep: int):
    arrays = eqx.filter(state, eqx.is_array)
    checkpoint.save(run.path / "checkpoints", generation, arrays, {"frames": frames}, keep=keep)
    metadata = {"algorithm": json.dumps(config.to_tree(algorithm)), "generation": str(generation)}
    checkpoint.export_policy(run.path / "champion.safetensors", state.champion, metadata)


def _warm(algorithm: Any, state: PyTree, source: Run) -> PyTree:
    """The first state, started from the champion of another run."""
    if not hasattr(algorithm, "warm"):
        raise RunError(
            f"{type(algorithm).__name__} cannot start from another run's champion: only an "
            "algorithm with a method `warm(state, policy)` can"
        )
    try:
        policy = checkpoint.import_policy(source.path / "champion.safetensors", state.champion)
    except checkpoint.CheckpointError as error:
        if "does not fit" not in str(error):
            raise  # it is missing or damaged
        theirs, ours = source.algorithm.network, algorithm.network
        raise RunError(
            f"the champion of {source.path} is {theirs} on {source.algorithm.env}, and this run is "
            f"{ours} on {algorithm.env}: give the same --preset or --network, and a task of the "
            f"same sizes ({str(error).splitlines()[0]})"
        ) from error
    return algorithm.warm(state, policy)


@contextlib.contextmanager
def _new_folder(path: pathlib.Path) -> Iterator[None]:
    """Own a folder for a run. If none comes to be in it, the folder goes again."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    with lock(path):
        if (path / "config.json").exists():
            raise RunError(f"another process started a run in {path} just now: choose another path")
        try:
            yield
        except BaseException:
            if made and not (path / "config.json").exists():
                shutil.rmtree(path, ignore_errors=True)
                with contextlib.suppress(OSError):  # something else may lie there by now
                    for folder in made[1:]:
                        folder.rmdir()
            raise


def _score_at(rows: dict[str, np.ndarray], generation: int) -> float:
    if generation == 0 or "champion_score" not in rows:
        return -np.inf
    match = np.flatnonzero(rows["generation"] == generation)
    return float(rows["champion_score"][match[-1]]) if match.size else -np.inf


def free_name(algorithm: Any, seed: int | str, label: str = "") -> pathlib.Path:
    """A folder that does not exist. `label`: what stands before the seed; by default the names of
    the algorithm and the task."""
    label = label or f"{type(algorithm).__name__}-{type(algorithm.env).__name__}"
    name = re.sub(r"[^\w.]+", "-", f"{label}-{seed}".lower())
    path, copies = pathlib.Path("runs") / name, 1
    while path.exists():
        copies += 1
        path = pathlib.Path("runs") / f"{name}-{copies}"
    return path


def _warn_of_other_machine(recorded: dict[str, Any]):
    here = config.machine()
    # What an older version did not record, a run of that time did not use.
    known = recorded.get("versions", {})
    here["versions"] = {name: here["versions"].get(name) for name in known}
    for what in ("cores", "processor", "device", "versions"):
        lines = config.differences(recorded.get(what, {}), here[what], what)
        if lines:
            warnings.warn(
                f"this run began elsewhere ({'; '.join(lines)}): it goes on, but not bit for bit",
                stacklevel=3,
            )


class Signals:
    """Ctrl-C and SIGTERM ask for an end after the generation; a second one stops at once."""

    def __init__(self, quiet: bool = True):
        self.received = 0
        self.quiet = quiet
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
        if not self.quiet:
            # Not `print`: the signal may have come while the progress bar was being written.
            os.write(2, b"\ncredo: stopping behind this generation; once more to stop at once\n")

    def __exit__(self, *_):
        for number, handler in self._before.items():
            signal.signal(number, handler)
