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
import pathlib
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray, PyTree

from .. import compilation, require
from ..compilation import jit
from ..environments import processes
from ..environments.host import AbstractHostEnvironment, EnvironmentFailure
from ..replay import Replay, shapes_alone
from ..types import NOTHING
from . import checkpoint, config, files, log, policy, record, screen, weights
from .budget import Budget, fitted, fitted_as
from .folder import free_name, new_folder
from .folder import runs_in as runs_in
from .lock import lock
from .policy import Policy
from .progress import Progress
from .record import RunError
from .signals import Signals
from .trust import seal, short, signed_here

CHUNK = 64  # generations in one dispatch, at most
DISPATCH = 0.3  # seconds that one dispatch should last
MOST = 2**31 - 1  # what 32 bits hold

Callback = Callable[[int, dict[str, Any]], bool | None]


class Interrupted(RunError):
    """Stopped by a signal, saved. `code` is the exit code a shell expects."""

    def __init__(self, message: str, code: int):
        super().__init__(message)
        self.code = code


class Run:
    """A run on disk, finished or not."""

    def __init__(self, path: str | pathlib.Path, *, trust: bool = False):
        """`trust`: whether classes and environments of somebody's own may be imported that a run
        names which this user did not make. Raises `RunError`."""
        self.path = pathlib.Path(path)
        self.config = record.read(self.path)
        self.trusted = trust or signed_here(self.config)

    @property
    def algorithm(self) -> Any:
        """What was recorded, as an object. A team outside JAX is opened for it, no other task."""
        tree = self.config["algorithm"]
        with _found(self):
            return config.from_tree(tree, trust=self.trusted, source=str(self.path))

    def part(self, name: str) -> Any:
        """A field of the recorded algorithm as an object (its `env`, `network`, `learners`), made
        of Credo's own classes; None if somebody's own code would have to be imported for it. It
        opens no environment."""
        try:
            return config.from_tree(self.config["algorithm"].get(name), trust=False)
        except ValueError:
            return None

    @property
    def metrics(self) -> dict[str, np.ndarray]:
        """Columns of `metrics.csv`, one entry per generation. Raises `RunError` if it is not what
        the newest checkpoint says it was."""
        _verify_metrics(self)
        return log.read(self.path / "metrics.csv")

    @property
    @compilation.float32()
    def champion(self) -> PyTree:
        """The policy with the highest fitness of the last generation; of a learner alone, its
        actor. Raises `RunError` if it is another run's, or if the task has other sizes today."""
        algorithm = self.algorithm
        with _found(self), shapes_alone():
            record.check_task(self.config, algorithm.env)
            like = eqx.filter_eval_shape(algorithm.init, key=jax.random.key(0)).champion
        return _champion(self, like)

    def restored(self, like: PyTree) -> PyTree:
        """The champion, of which `like` has the structure. Raises as `champion` does."""
        return _champion(self, like)

    def policy(self, raw: bool = False) -> Policy:
        """The champion as a plain callable, in the task's own units; `raw`: in [-1, 1]."""
        return policy.of(self, raw)


@screen.calm()
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
    - `seed`: everything random follows from it; 0 to 2^32 - 1.
    - `path`: the run's folder; by default `runs/<algorithm>-<task>-<seed>`.
    - `warm_start`: another run, whose champion this one starts from.
    - `stop_at`: end early once a generation's `champion_score` reaches this.
    - `wall_clock`: seconds after which to save and end.
    - `checkpoint_every`: seconds between checkpoints; `keep`: how many stay on disk.
    - `callback(generation, metrics)`: called for every generation, after the dispatch it ran in;
      return True to end. What the dispatch has run by then is kept.

    **Raises:** `RunError` if there is anything in the folder already, if the algorithm cannot start
    from a policy, if weights are no numbers any more, or if an environment outside JAX fails;
    `ValueError` for a seed or a budget that cannot be; `Interrupted` after a signal.
    """
    processes.allow()
    compilation.enable_cache()
    budget = Budget.of(algorithm, generations, frames, stop_at)
    require.at_least("keep", keep, 1)
    if isinstance(seed, bool) or not (isinstance(seed, int) and 0 <= seed < 2**32):
        raise ValueError(f"seed is {seed}: it must be a whole number from 0 to 2^32 - 1")
    tree = config.to_tree(algorithm)
    config.from_tree(tree)  # what cannot be read back should fail now, not at a resume
    source = None if warm_start is None else Run(warm_start)
    path = pathlib.Path(path) if path else free_name(algorithm, seed)
    said: dict[str, Any] = {"algorithm": json.loads(json.dumps(tree)), "seed": seed}
    said |= {"budget": budget.record(), "machine": config.machine()}
    if prompt := config.of_a_prompt(tree):
        said["resumable"] = False
        warnings.warn(
            f"{', '.join(prompt)} was defined at a prompt or in a notebook: this run can go on in "
            "this process alone; put it into a file for one that can be resumed",
            stacklevel=3,
        )
    if warm_start is not None:
        said["warm_start"] = str(warm_start)
    with new_folder(path):
        fit = fitted(algorithm, budget)
        state = _initial(fit, jax.random.key(seed))
        if source is not None:
            state = _warm(algorithm, state, source)
        said["task"] = config.to_tree(record.task_of(algorithm.env))
        files.remove(path / "checkpoints")  # left by a process that died here
        # The first checkpoint comes before the config: what has a config can be resumed.
        arrays, seals = eqx.filter(state, eqx.is_array), {"record": seal(said)}
        checkpoint.save(path / "checkpoints", 0, arrays, {"frames": 0}, seals=seals)
        del state, arrays  # it may fill half of the memory, and is read back
        record.write(path, said)
        run = Run(path, trust=True)
        return _train(
            run,
            fit,
            _load(run, fit),
            wall_clock,
            checkpoint_every=checkpoint_every,
            keep=keep,
            tensorboard=tensorboard,
            progress=progress,
            callback=callback,
        )


@screen.calm()
@compilation.float32()
def resume(
    path: str | pathlib.Path,
    *,
    trust: bool = False,
    set: Mapping[str, Any] | None = None,
    without_replay: bool = False,
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

    **Arguments**, beside those of `train`:

    - `trust`: as in `Run`; the run is then taken for one of this user's.
    - `set`: other numbers and strings for the algorithm from here on, by the names of its fields:
      `{"learner.actor_lr": 1e-4}`. Population, weights and replay buffer stay; config.json says
      when what was changed.
    - `without_replay`: go on with an empty replay buffer if its files are damaged.

    **Raises:** as `train`; `RunError` if the task or the files are not those of this run.
    """
    processes.allow()
    compilation.enable_cache()
    with lock(Run(path, trust=trust).path):  # what is no run gets no lock
        run = Run(path, trust=trust)
        algorithm = run.algorithm
        old = Budget.read(run.config["budget"])
        budget = old if stop_at is None else dataclasses.replace(old, stop_at=stop_at)
        if generations is not None or frames is not None:
            budget = Budget.of(algorithm, generations, frames, stop_at)
        # A smaller budget is refused, but only once it is known how far the run is. A setting may
        # make generations longer: the buffer must hold what either plays.
        settings = (algorithm, config.replaced(algorithm, dict(set or {})))
        fit = max(
            (fitted(one, limit) for one in settings for limit in (old, budget)),
            key=lambda one: getattr(one, "replay_capacity", 0),
        )
        if set:
            fit = fitted_as(algorithm, fit)
        with _found(run):
            record.check_task(run.config, algorithm.env)
            saved = _load(run, fit, without_replay)
        try:
            budget.refuse_smaller(old, saved.generation, int(saved.counters["frames"]))
        except ValueError as error:
            raise RunError(str(error)) from None
        for change in run.config.get("changes", []):  # of an older checkpoint it begins earlier
            change["generation"] = min(change["generation"], saved.generation)
        fit = _changed(run, fit, set or {}, saved.generation)
        _record_budget(run, old, budget, saved.generation)
        if run.config != record.read(run.path) or (trust and not signed_here(run.config)):
            record.write(run.path, run.config, sign=run.trusted)
        _warn_of_other_machine(run.config["machine"])
        return _train(
            run,
            fit,
            saved,
            wall_clock,
            checkpoint_every=checkpoint_every,
            keep=keep,
            tensorboard=tensorboard,
            progress=progress,
            callback=callback,
        )


def _record_budget(run: Run, old: Budget, budget: Budget, generation: int) -> None:
    """Put another budget into the record, and the old one into its history."""
    if budget != old:
        change = {"generation": generation, "budget": old.record()}
        run.config["changes"] = [*run.config.get("changes", []), change]
        run.config["budget"] = budget.record()


def _changed(run: Run, fit: Any, changes: Mapping[str, Any], generation: int) -> Any:
    """The algorithm with other settings, of the same state, and put into the record."""
    recorded, before = run.config["algorithm"], short(run.config["algorithm"])
    if not changes:
        return fit
    new = config.replaced(fit, dict(changes))
    if "replay_capacity" in changes or _shapes(new) != _shapes(fit):
        told = ", ".join(f"{name}={value!r}" for name, value in changes.items())
        raise RunError(
            f"{told} changes the sizes of what {run.path} has learned: only numbers that change "
            "none can be set on the way; start a new run, with --from for its champion"
        )
    tree = config.to_tree(config.replaced(run.algorithm, dict(changes)))
    tree = json.loads(json.dumps(tree))
    if tree != recorded:
        change = {"generation": generation, "set": dict(changes), "before": before}
        run.config["changes"] = [*run.config.get("changes", []), change]
        run.config["algorithm"] = tree
    return new


def _shapes(algorithm: Any) -> Any:
    """The structure, shapes and types of an algorithm's state."""
    with shapes_alone():
        like = eqx.filter_eval_shape(algorithm.init, key=jax.random.key(0))
    leaves, structure = jax.tree.flatten(like)
    return structure, [(x.shape, x.dtype) if hasattr(x, "shape") else x for x in leaves]


@contextlib.contextmanager
def _found(run: Run) -> Iterator[None]:
    """Say where a run began if what it names cannot be found from here."""
    try:
        yield
    except (config.NotFound, EnvironmentFailure) as error:
        home = record.home(run.config)
        if not home:
            raise
        raise RunError(f"{str(error).rstrip('.')}{home}") from error


def _champion(run: Run, like: PyTree) -> PyTree:
    """The champion of a run, if that is what its file says."""
    path = run.path / "champion.safetensors"
    metadata = checkpoint.read_metadata(path)
    if why := record.stranger(run.config, _json(metadata.get("record"))):
        lines = config.differences(_json(metadata.get("algorithm")), run.config["algorithm"])
        told = f" ({'; '.join(lines[:3])})" if lines else ""
        raise RunError(
            f"{path} is not this run's champion: {why}{told}; `credo resume {run.path}` writes it "
            "again, or restore it from a copy"
        )
    return checkpoint.import_policy(path, like)


def _json(text: str | None) -> Any:
    try:
        return json.loads(text or "null")
    except ValueError:
        return None


def _verify_metrics(run: Run) -> None:
    """Raise `RunError` if metrics.csv is not what the newest intact checkpoint says it was."""
    for folder in sorted((run.path / "checkpoints").glob("[0-9]*"), reverse=True):
        try:
            seals = json.loads(files.read_bytes(folder / checkpoint.COMMIT))["seals"]
            sealed = seals["metrics"]
        except (OSError, ValueError, KeyError, TypeError):
            continue  # damaged, or written by an older version
        why = _unlike(run.path, sealed)
        if why is None:
            return
        if checkpoint.damage(folder) is None and not record.stranger(run.config, seals["record"]):
            raise RunError(
                f"{why}; `credo resume` goes on from the newest checkpoint it agrees with"
            )


def _unlike(path: pathlib.Path, sealed: Any) -> str | None:
    """How metrics.csv differs from what a checkpoint sealed, in words."""
    try:
        log.verify(path, sealed)
    except (ValueError, KeyError, TypeError) as error:
        return str(error)
    return None


def _load(run: Run, algorithm: Any, without_replay: bool = False) -> checkpoint.Checkpoint:
    """The newest intact checkpoint of this very run, its state whole."""

    def check(generation: int, seals: Mapping[str, Any]) -> str | None:
        why = record.stranger(run.config, seals.get("record"))
        if why is None and "metrics" in seals:
            why = _unlike(run.path, seals["metrics"])
            lost.extend([why] if why else [])
        # Some generations are soon trained again; a run whose checkpoints are whole never begins
        # anew because another file was lost.
        return lost[0] if why is None and generation == 0 and lost else why

    lost: list[str] = []  # what is wrong with metrics.csv, by checkpoints that are whole
    like = eqx.filter_eval_shape(algorithm.init, key=jax.random.key(0))
    like, static = eqx.partition(like, lambda x: isinstance(x, jax.ShapeDtypeStruct))
    saved = checkpoint.load(
        run.path / "checkpoints", like, without_replay=without_replay, check=check
    )
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
    log.Log(run.path, generation, tensorboard=False)  # what came after need not be readable
    rows = log.read(run.path / "metrics.csv")
    reached = budget.reached(generation, frames, _score_at(rows, generation))
    journal = log.Log(run.path, generation, tensorboard=tensorboard and not reached)
    before = journal.elapsed
    began = last_save = time.monotonic()
    safe, chunk, ended = generation, 1, False

    board = Progress(run.path, generation, frames, budget, progress)
    with Signals(quiet=not progress) as signals, board as bar:
        if reached:
            bar.say(f"is finished: {reached}; to go on give a larger --generations or --frames")
        else:
            _require_sound(run, state, generation, safe)
            bar.say_memory(_buffers(state))
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
            _require_sound(run, state, generation, safe)
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
                _save(run, generation, state, frames, keep)
                safe, last_save = generation, now
            # The first dispatch compiles; from the second on, its length follows the clock.
            # How many generations one dispatch holds is data and changes no result.
            chunk = 2 if chunk == 1 else int(np.clip(len(batch) * DISPATCH / seconds, 1, CHUNK))
        journal.close()
        journal.sync()
        _save(run, generation, state, frames, keep)
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


def _save(run: Run, generation: int, state: PyTree, frames: int, keep: int):
    arrays, sealed = eqx.filter(state, eqx.is_array), seal(run.config)
    seals: dict[str, Any] = {"record": sealed}
    if generation > 0:
        seals["metrics"] = log.seal(run.path, generation)
    counters = {"frames": frames}
    checkpoint.save(run.path / "checkpoints", generation, arrays, counters, keep=keep, seals=seals)
    metadata = {"algorithm": json.dumps(run.config["algorithm"]), "generation": str(generation)}
    metadata["record"] = json.dumps(sealed, sort_keys=True)
    checkpoint.export_policy(run.path / "champion.safetensors", state.champion, metadata)


def _warm(algorithm: Any, state: PyTree, source: Run) -> PyTree:
    """The first state, started from the champion of another run."""
    if not hasattr(algorithm, "warm"):
        raise RunError(
            f"{type(algorithm).__name__} cannot start from another run's champion: only an "
            "algorithm with a method `warm(state, policy)` can"
        )
    try:
        policy = _champion(source, state.champion)
    except checkpoint.CheckpointError as error:
        if "does not fit" not in str(error):
            raise  # it is missing or damaged
        theirs = [
            source.part(name) or config.brief(source.config["algorithm"][name])
            for name in ("network", "env")
        ]
        flag = "normalize_observations"
        flags = [bool(source.config["algorithm"].get(flag)), getattr(algorithm, flag, False)]
        if flags[0] != flags[1]:
            raise RunError(
                f"the champion of {source.path} was trained with {flag}={flags[0]}, and this run "
                f"has {flag}={flags[1]}: give both the same"
            ) from error
        raise RunError(
            f"the champion of {source.path} is {theirs[0]} on {theirs[1]}, and this run is "
            f"{algorithm.network} on {algorithm.env}: give the same --preset or --network, and a "
            f"task of the same sizes ({str(error).splitlines()[0]})"
        ) from error
    return algorithm.warm(state, policy)


def _require_sound(run: Run, state: PyTree, generation: int, safe: int) -> None:
    """End a training whose weights are no numbers any more: nothing can be learned from there."""
    if (what := weights.broken(state)) is None:
        return
    stands = f"The checkpoint of generation {safe} stands"
    if generation == safe:
        stands = "It began so"
    raise RunError(
        f"the weights of {what} are not finite after generation {generation} of {run.path}: "
        f"nothing more can be learned. {stands}; look at the size of rewards and observations, and "
        "at the learning rates (credo resume RUN --set NAME=VALUE)"
    )


def _buffers(state: PyTree) -> list[Replay]:
    leaves = jax.tree.leaves(state, is_leaf=lambda x: isinstance(x, Replay))
    return [leaf for leaf in leaves if isinstance(leaf, Replay)]


def _score_at(rows: dict[str, np.ndarray], generation: int) -> float:
    if generation == 0 or "champion_score" not in rows:
        return -np.inf
    match = np.flatnonzero(rows["generation"] == generation)
    return float(rows["champion_score"][match[-1]]) if match.size else -np.inf


def _warn_of_other_machine(recorded: dict[str, Any]):
    here = config.machine()
    # What an older version did not record, a run of that time did not use.
    known = recorded.get("versions", {})
    here["versions"] = {name: here["versions"].get(name) for name in known}
    for what in ("cores", "processor", "device", "versions"):
        lines = config.differences(recorded.get(what, {}), here[what], what)
        if lines:
            warnings.warn(
                f"this run began under other conditions ({'; '.join(lines)}): it goes on, but not "
                "bit for bit",
                stacklevel=3,
            )
