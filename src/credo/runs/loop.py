"""Training: the loop around `generation`, and how to come back to it.

A run is a folder:

    config.json          the object tree, seed, budget, options, versions and machine
    metrics.csv          one row per generation; the same bits however often the run was stopped
    timing.csv           the clock, which is not
    tensorboard/         the same as events
    checkpoints/         everything needed to go on
    champion.safetensors the fittest of the last generation, with its config inside
    best.safetensors     the champion with the highest test score so far
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
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from .. import compilation, rollout
from ..compilation import jit
from ..environments import processes
from ..environments.cluster import ClusterLost
from ..environments.host import AbstractHostEnvironment, EnvironmentFailure
from ..playing import devices, players
from ..replay import shapes_alone
from ..types import NOTHING
from . import callbacks, checkpoint, config, files, log, record, screen, segments, weights
from .budget import Budget, fitted, limited
from .folder import free_name, new_folder
from .lock import lock
from .options import RunOptions
from .progress import Progress
from .record import RunError
from .signals import Signals
from .store import BEST, CHAMPION, Run
from .trust import seal, short, signed_here

CHUNK = 64  # generations in one dispatch, at most
DISPATCH = 0.3  # seconds that one dispatch should last
PATIENCE = 5.0  # seconds between two reports of one outside JAX
MOST = 2**31 - 1  # what 32 bits hold


class Interrupted(RunError):
    """Stopped by a signal, saved. `code` is the exit code a shell expects."""

    def __init__(self, message: str, code: int):
        super().__init__(message)
        self.code = code


class Best(eqx.Module):
    """The champion with the highest test score so far; of equal ones the first."""

    policy: PyTree  # its arrays alone
    score: Float[Array, ""]  # NOTHING before the first test
    generation: Int[Array, ""]
    stale: Float[Array, ""]
    """A score of a test before the first that counts, which generations without a test of their own
    repeat; NOTHING if there is none."""

    @classmethod
    def none(cls, policy: PyTree, stale: float = NOTHING) -> "Best":
        """Before the first test, with copies of a policy's arrays: a state is donated."""
        numbers: Any = np.float32(NOTHING), np.int32(0), np.float32(stale)
        return cls(jax.tree.map(np.array, policy), *numbers)

    def beaten(self, score: Any) -> Any:
        """Whether a generation's score is that of a better policy; False of NaN."""
        return (score > self.score) & (score != self.stale)


@screen.calm()
@compilation.float32()
def train(
    algorithm: Any,
    options: RunOptions = RunOptions(),  # noqa: B008
    *,
    seed: int = 0,
    path: str | pathlib.Path | None = None,
    warm_start: str | pathlib.Path | None = None,
    **changes: Any,
) -> Run:
    """Start a run in an empty or new folder and train.

    **Arguments:**

    - `options`: budget, checkpoints, loggers and callbacks; `changes` are fields of it, for a short
      call: `train(algorithm, frames=1e6)`.
    - `seed`: everything random follows from it; 0 to 2^32 - 1.
    - `path`: the run's folder; by default `runs/<algorithm>-<task>-<seed>`.
    - `warm_start`: another run, whose champion this one starts from.

    **Raises:** `RunError` if there is anything in the folder already, if the algorithm cannot start
    from a policy, if weights are no numbers any more, or if an environment outside JAX fails;
    `ValueError` for a seed or an option that cannot be, `TypeError` for an option that is not;
    `Interrupted` after a signal; what a callback raised, once the run is saved.
    """
    options = options.changed(changes)
    heard = callbacks.of(options)
    processes.allow()
    compilation.enable_cache()
    if isinstance(seed, bool) or not (isinstance(seed, int) and 0 <= seed < 2**32):
        raise ValueError(f"seed is {seed}: it must be a whole number from 0 to 2^32 - 1")
    devices.require(options.devices, algorithm.env)
    players.require(options.processes, algorithm.env)
    Budget.of(algorithm, options).require_task(algorithm)
    path = pathlib.Path(path) if path else free_name(algorithm, seed)
    with contextlib.ExitStack() as stack:
        stack.enter_context(_where(algorithm, options))
        said = _said(algorithm, options, seed, warm_start)
        source = None if warm_start is None else Run(warm_start)
        stack.enter_context(new_folder(path))
        fit = fitted(algorithm, Budget(**said["budget"]))
        _begin(path, said, fit, source)
        run = Run(path, trust=True)
        return _train(run, fit, _load(run, fit), options, heard)


@screen.calm()
@compilation.float32()
def resume(
    path: str | pathlib.Path,
    options: RunOptions = RunOptions(),  # noqa: B008
    *,
    trust: bool = False,
    set: Mapping[str, Any] | None = None,
    without_replay: bool = False,
    **changes: Any,
) -> Run:
    """Go on with a run from its newest intact checkpoint, to its own budget or a larger one.

    The result has the same bits as that of a run never stopped (same machine and core count).
    A new budget takes the place of the whole old one: with `generations` alone a limit of frames
    is dropped, and the other way round; without `stop_at` that is dropped too. The generation that
    an old budget of frames cut short (learners with a `share`) stays as it is.

    **Arguments:**

    - `options`, `changes`: as in `train`, none of them taken from the run but its budget.
    - `trust`: as in `Run`; the run is then taken for one of this user's.
    - `set`: other numbers and strings for the algorithm from here on, by the names of its fields:
      `{"learner.actor_lr": 1e-4}`. Population, weights and replay buffer stay; config.json says
      when what was changed.
    - `without_replay`: go on with an empty replay buffer if its files are damaged.

    **Raises:** as `train`; `RunError` if the task or the files are not those of this run.
    """
    options = options.changed(changes)
    heard = callbacks.of(options)
    processes.allow()
    compilation.enable_cache()
    with lock(Run(path, trust=trust).path):  # what is no run gets no lock
        run = Run(path, trust=trust)
        recorded = run.algorithm
        devices.require(options.devices, recorded.env)
        players.require(changes.get("processes"), recorded.env)  # a record may be of older versions
        with _where(recorded, options):
            fit, saved = _reopened(run, options, dict(set or {}), without_replay)
            if run.config != record.read(run.path) or (trust and not signed_here(run.config)):
                record.write(run.path, run.config, sign=run.trusted)
            _warn_of_other_machine(run.config["machine"])
            return _train(run, fit, saved, options, heard)


@contextlib.contextmanager
def _where(algorithm: Any, options: RunOptions) -> Iterator[None]:
    """On the cores and devices, and with the processes, that the run is to have.

    Where learners learn while other processes play this one keeps to a core of its own, in one
    thread, whatever the options say: so the bits are the same with any number of processes. It must
    be known before JAX counts its threads. Raises `RunError` and `ValueError`.
    """
    outside = isinstance(algorithm.env, AbstractHostEnvironment)
    if options.rollouts != "local" and not outside:
        raise ValueError(f"rollouts is {options.rollouts!r}, for tasks outside JAX: leave it out")
    if options.rollouts != "local" and options.progress:
        screen.say(
            f"credo: looks for Ray, by which episodes are played (--rollouts {options.rollouts})"
        )
    beside = outside and getattr(algorithm, "overlap", False)
    with contextlib.ExitStack() as stack:
        if beside:
            stack.enter_context(processes.settled())
        try:
            stack.enter_context(players.using(options.processes, options.rollouts))
        except ClusterLost as error:
            raise RunError(str(error)) from error
        stack.enter_context(devices.using(options.devices))
        yield


# How a run begins.


def _said(
    algorithm: Any, options: RunOptions, seed: int, warm_start: str | pathlib.Path | None
) -> dict[str, Any]:
    """The record of a new run, as far as it is known before anything is opened."""
    tree = config.to_tree(algorithm)
    config.from_tree(tree)  # what cannot be read back should fail now, not at a resume
    said: dict[str, Any] = {"algorithm": tree, "seed": seed, "options": options.record()}
    said |= {
        "budget": dataclasses.asdict(Budget.of(algorithm, options)),
        "machine": config.machine(),
    }
    if warm_start is not None:
        said["warm_start"] = str(warm_start)
    if prompt := config.of_a_prompt(tree):
        said["resumable"] = False
        warnings.warn(
            f"{', '.join(prompt)} was defined at a prompt or in a notebook: this run can go on in "
            "this process alone; put it into a file for one that can be resumed",
            stacklevel=5,
        )
    return said


def _begin(path: pathlib.Path, said: dict[str, Any], algorithm: Any, source: Run | None) -> None:
    """Write the first checkpoint and the record. The checkpoint comes first: what has a record can
    be resumed. The state is read back from it: two may be more than the memory holds."""
    state = _initial(algorithm, jax.random.key(said["seed"]))
    if source is not None:
        state = _warm(algorithm, state, source)
    said["task"] = config.to_tree(record.task_of(algorithm.env))
    files.remove(path / "checkpoints")  # left by a process that died here
    arrays, seals = eqx.filter(state, eqx.is_array), {"record": seal(said)}
    checkpoint.save(path / "checkpoints", 0, arrays, {"frames": 0}, seals=seals)
    record.write(path, said)


@jit
def _initial(algorithm: Any, root: PRNGKeyArray) -> PyTree:
    """The state of generation 0, in one program."""
    return algorithm.init(key=jax.random.fold_in(root, 0))


def _warm(algorithm: Any, state: PyTree, source: Run) -> PyTree:
    """The first state, started from the champion of another run."""
    if not hasattr(algorithm, "warm"):
        raise RunError(
            f"{type(algorithm).__name__} cannot start from another run's champion: only an "
            "algorithm with a method `warm(state, policy)` can"
        )
    try:
        policy = source.restored(state.champion)
    except checkpoint.CheckpointError as error:
        if "does not fit" not in str(error):
            raise  # it is missing or damaged
        raise RunError(_unlike(algorithm, source, error)) from error
    return algorithm.warm(state, policy)


def _unlike(algorithm: Any, source: Run, error: Exception) -> str:
    """Why the champion of another run is none of this algorithm's policies."""
    theirs, flag = source.config["algorithm"], "normalize_observations"
    flags = [bool(theirs.get(flag)), getattr(algorithm, flag, False)]
    if flags[0] != flags[1]:
        return (
            f"the champion of {source.path} was trained with {flag}={flags[0]}, and this run has "
            f"{flag}={flags[1]}: give both the same"
        )
    sizes = ("obs_size", "action_size", "agents")
    tasks = source.config.get("task", {}), record.task_of(algorithm.env)
    before, now = ({name: task.get(name) for name in sizes} for task in tasks)
    told = [
        *config.differences(before, now),
        *config.differences(theirs.get("network"), config.to_tree(algorithm.network), "network"),
    ]
    differ = "; ".join(told[:6]) or str(error).splitlines()[0]
    return (
        f"the champion of {source.path} (left) is none of this run's policies (right): {differ}: "
        "give the same --preset or --network settings, and a task of the same sizes"
    )


# How a run goes on.


def _load(run: Run, algorithm: Any, without_replay: bool = False) -> checkpoint.Checkpoint:
    """The newest intact checkpoint of this very run, its state whole."""
    lost: list[str] = []  # what is wrong with metrics.csv, by checkpoints that are whole

    def check(generation: int, seals: Mapping[str, Any]) -> str | None:
        why = record.stranger(run.config, seals.get("record"))
        if why is None and "metrics" in seals:
            why = run.differs(seals["metrics"])
            lost.extend([why] if why else [])
        # Some generations are soon trained again; a run whose checkpoints are whole never begins
        # anew because another file was lost.
        return lost[0] if why is None and generation == 0 and lost else why

    like = eqx.filter_eval_shape(algorithm.init, key=jax.random.key(0))
    like, static = eqx.partition(like, lambda x: isinstance(x, jax.ShapeDtypeStruct))
    number = [jax.ShapeDtypeStruct((), x) for x in (jnp.float32, jnp.int32, jnp.float32)]
    saved = checkpoint.load(
        run.path / "checkpoints",
        like,
        extra=Best(like.champion, *number),  # pyright: ignore[reportArgumentType]
        without_replay=without_replay,
        check=check,
    )
    return eqx.tree_at(lambda saved: saved.state, saved, eqx.combine(saved.state, static))


def _reopened(
    run: Run, options: RunOptions, settings: dict[str, Any], without_replay: bool
) -> tuple[Any, checkpoint.Checkpoint]:
    """The algorithm with its new settings, and the checkpoint to go on from. What is changed is put
    into the record, which is not written yet.

    A replay buffer gets the largest of the capacities that its budgets and settings, old and new,
    ask for: what it holds must fit. Raises `RunError` for a smaller budget, another task, and
    settings that change what was learned in its shape; `CheckpointError` as `checkpoint.load`.
    """
    algorithm, old = run.algorithm, Budget(**run.config["budget"])
    budget = Budget.of(algorithm, options, old)
    # A smaller budget is refused, but only once it is known how far the run is. A setting may make
    # generations longer: the buffer must hold what either plays.
    either, fit = (algorithm, config.replaced(algorithm, settings)), algorithm
    if hasattr(algorithm, "replay_capacity"):
        rows = [fitted(one, limit).replay_capacity for one in either for limit in (old, budget)]
        fit = dataclasses.replace(algorithm, replay_capacity=max(rows))
    with run.found():
        record.check_task(run.config, algorithm.env)
        saved = _load(run, fit, without_replay)
    budget.refuse_smaller(old, saved.generation, int(saved.counters["frames"]), run.path)
    for change in run.config.get("changes", []):  # of an older checkpoint it begins earlier
        change["generation"] = min(change["generation"], saved.generation)
    if settings:
        fit = _changed(run, fit, settings, saved.generation)
    later = [c for c in run.config.get("changes", []) if c["generation"] >= saved.generation]
    if any(name.startswith("env.") for change in later for name in change.get("set", {})):
        saved = dataclasses.replace(saved, extra=None)  # its score is of another task
    if budget != old:
        _note(run, saved.generation, budget=dataclasses.asdict(old))
        run.config["budget"] = dataclasses.asdict(budget)
    return limited(fit, budget), saved


def _changed(run: Run, fit: Any, settings: dict[str, Any], generation: int) -> Any:
    """The algorithm with other settings, of the same state, and put into the record. Raises
    `RunError` if any of them changes the shape of the state, and `ConfigError` for what is no
    setting."""
    new = config.replaced(fit, settings)
    if "replay_capacity" in settings or _shapes(new) != _shapes(fit):
        told = ", ".join(f"{name}={value!r}" for name, value in settings.items())
        raise RunError(
            f"{told} changes the sizes or the form of what {run.path} has learned: only numbers "
            "that change neither can be set on the way; start a new run"
            + ", with --from for its champion"
            * hasattr(new, "warm")
        )
    was, infomax = (getattr(one, "infomax", None) for one in (fit, new))
    if was and infomax and was.generations <= generation < infomax.generations:
        raise RunError(
            f"infomax.generations={infomax.generations} would end the task at generation "
            f"{generation}: {run.path} evolves for it since generation {was.generations}; leave it "
            f"at {generation} or fewer, or start a new run"
        )
    before, tree = run.config["algorithm"], config.to_tree(config.replaced(run.algorithm, settings))
    if tree != before:
        _note(run, generation, set=settings, before=short(before))
        run.config["algorithm"] = tree
    return new


def _note(run: Run, generation: int, **change: Any) -> None:
    """Put into the record what is changed at a generation."""
    changes = [*run.config.get("changes", []), {"generation": generation, **change}]
    run.config["changes"] = changes


def _shapes(algorithm: Any) -> Any:
    """The structure, shapes and types of an algorithm's state."""
    with shapes_alone():
        like = eqx.filter_eval_shape(algorithm.init, key=jax.random.key(0))
    leaves, structure = jax.tree.flatten(like)
    return structure, [(x.shape, x.dtype) if hasattr(x, "shape") else x for x in leaves]


def _warn_of_other_machine(recorded: dict[str, Any]) -> None:
    """Say under which conditions a run began, if they are others here: bits may differ from then
    on."""
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


# The loop.


def _train(
    run: Run,
    algorithm: Any,
    saved: checkpoint.Checkpoint,
    options: RunOptions,
    heard: list[callbacks.Callback],
) -> Run:
    """From `saved` to the end of the budget. The caller holds the lock."""
    training = _Training(run, algorithm, saved, options, heard)
    del saved  # its state is donated: the old one may not be held
    with Signals(quiet=not options.progress) as signals, training.bar:
        reason = training.go_on(signals)
    if reason == "signal":
        where = training.budget.where(training.generation, training.frames)
        raise Interrupted(
            f"stopped at {where} and saved; go on with {run.advice}", 128 + signals.received
        )
    return run


class _Training:
    """A run that goes on: where it is, what it writes and who hears of it.

    - `generation`, `frames`: how many are done; `safe`: the generation of the newest checkpoint.
    - `state`, `best`: donated to every dispatch, so nothing else may hold them.
    - `reached`: which limit of the budget was reached, in words; `ended`: why else it is to end.
    - `chunk`: generations that the next dispatch may hold, at most `CHUNK`.
    - `began`, `last_save`, `tick`: the clock at the start, at the newest checkpoint and dispatch;
      `before`: seconds of training before.
    """

    def __init__(
        self,
        run: Run,
        algorithm: Any,
        saved: checkpoint.Checkpoint,
        options: RunOptions,
        heard: list[callbacks.Callback],
    ):
        self.run, self.algorithm, self.options = run, algorithm, options
        self.root = jax.random.key(run.config["seed"])
        self.budget = Budget(**run.config["budget"])
        self.generation, self.frames = saved.generation, int(saved.counters["frames"])
        self.safe, self.chunk = saved.generation, 1
        self.journal = log.Log(run.path, self.generation)
        score = float(log.last(run.path / log.METRICS).get("champion_score", -np.inf))
        self.reached = self.budget.reached(self.generation, self.frames, score)
        self.signals = Signals()
        every = getattr(algorithm, "test_every", 1) == 1
        arrays, stale = eqx.filter(saved.state.champion, eqx.is_array), NOTHING if every else score
        self.state, self.best = saved.state, saved.extra or Best.none(arrays, stale)
        self.listeners = callbacks.Listeners(run, heard, score, every)
        self.ended = ""  # why, if neither the budget nor a signal is
        self.bar = Progress(run.path, self.generation, self.frames, self.budget, options.progress)
        self.began = self.last_save = self.tick = time.monotonic()
        self.before = self.journal.elapsed

    def go_on(self, signals: Signals) -> str:
        """Train, save, and say why it ended (see `Callback.on_end`)."""
        self.signals = signals
        if self.reached:
            told = f"is finished: {self.reached}; to go on give a larger --generations or --frames"
            self.bar.say(told)
            self.save()
            return "budget"
        self.state, self.best = devices.everywhere((self.state, self.best))
        self.require_sound(self.state, self.generation)
        self.bar.start([buffer for _, buffer in segments.buffers(self.state)])
        try:
            while not (self.reached or self.ended or signals.received):
                self.dispatch()
            self.save()
        except Exception as error:
            self.listeners.tell("on_end", "error")
            if self.listeners.error not in (None, error):
                error.add_note(f"a callback had raised before: {self.listeners.error!r}")
            raise
        reason = self.reason()
        self.listeners.end(reason)
        return reason

    @property
    def stands(self) -> str:
        """What an error leaves, and how to go on, in words."""
        stands = f"The checkpoint of generation {self.safe} stands"
        return f"{stands}; resume with {self.run.advice}"

    def reason(self) -> str:
        """Why training ended."""
        if self.listeners.error is not None:
            return "error"
        if self.reached:
            return "budget" if self.budget.reached(self.generation, self.frames) else "score"
        return self.ended or "signal"

    def dispatch(self) -> None:
        """Some generations: play, write, tell, and save now and then.

        Raises `RunError` if weights are no numbers any more or a task outside JAX failed, and
        `OSError` or `CheckpointError` if the disk did.
        """
        self.tick = time.monotonic()
        rows = self.play()
        self.require_sound(self.state, self.generation)
        seconds = self.report(rows, time.monotonic())
        now, limit = self.tick, self.options.wall_clock
        if not self.ended and limit is not None and now - self.began >= limit:
            self.ended = "wall clock"
        self.reached = self.budget.reached(self.generation, self.frames, rows[-1]["champion_score"])
        if now - self.last_save >= self.options.checkpoint_every:
            self.save()
            self.last_save = time.monotonic()
        # The first dispatch compiles; from the second on, its length follows the clock.
        # How many generations one dispatch holds is data and changes no result.
        again = int(np.clip(len(rows) * DISPATCH / seconds, 1, CHUNK))
        self.chunk = 2 if self.chunk == 1 else again

    def report(self, rows: list[dict[str, Any]], now: float) -> float:
        """Write and tell of some generations, which were over by `now`; how many seconds they took.
        Raises `OSError`."""
        seconds, self.tick = now - self.tick, now
        self.journal.append(rows, seconds, self.before + now - self.began)
        self.bar.update(rows[-1]["generation"], rows[-1], seconds)
        if self.listeners.hear(rows):
            self.ended = "callback"
        return seconds

    def overdue(self, state: PyTree, rows: list[dict[str, Any]], ended: float) -> bool:
        """Report these generations of a dispatch that goes on, if it is time; whether it was.
        `ended`: when the last of them did. Raises as `dispatch` does."""
        due = bool(rows) and time.monotonic() - self.tick >= PATIENCE
        if due:
            self.require_sound(state, rows[-1]["generation"] + 1)
            self.report(rows, ended)
        return due

    def play(self) -> list[dict[str, Any]]:
        """The next generations; a row of metrics for each."""
        at = (self.algorithm, self.state, self.best, self.root, self.generation, self.frames)
        try:
            if isinstance(self.algorithm.env, AbstractHostEnvironment):
                played = play_outside(*at, self.budget, self.enough, self.overdue)
            else:
                played = play(*at, self.chunk, self.budget)
            self.state, self.best, rows = played
        except (EnvironmentFailure, ClusterLost, players.NotPlayed) as failure:
            # The state was donated: what is on disk is all there is.
            raise RunError(f"{str(failure).rstrip('.')}. {self.stands}") from failure
        self.generation, self.frames = rows[-1]["generation"], rows[-1]["frames"]
        return rows

    def enough(self) -> bool:
        """Whether a dispatch outside JAX is to end with the generation that it has just played."""
        now, limit = time.monotonic(), self.options.wall_clock
        return (
            self.signals.received > 0
            or now - self.last_save >= self.options.checkpoint_every
            or (limit is not None and now - self.began >= limit)
            or self.budget.stop_at is not None
            or bool(self.options.callbacks)  # each is to hear of a generation when it is over
        )

    def require_sound(self, state: PyTree, generation: int) -> None:
        """End a training whose weights are no numbers: nothing can be learned from there."""
        if (what := weights.broken(state)) is None:
            return
        stands = f"The checkpoint of generation {self.safe} stands"
        if generation == self.safe:
            stands = "It began so"
        raise RunError(
            f"the weights of {what} are not finite after generation {generation} of "
            f"{self.run.path}: nothing more can be learned. {stands}; look at the size of rewards "
            "and observations, and at the learning rates (credo resume RUN --set NAME=VALUE)"
        )

    def save(self) -> None:
        """A checkpoint, then the policies: what a policy's file says is never ahead of it.

        Rows of metrics are on the disk before, so that a checkpoint is never ahead of them either.
        Raises `CheckpointError`, `OSError` and `log.DamagedLog`; older checkpoints then stand.
        """
        self.journal.sync()
        path, generation, sealed = self.run.path, self.generation, seal(self.run.config)
        seals: dict[str, Any] = {"record": sealed}
        if generation > 0:
            seals["metrics"] = self.journal.seal()
        checkpoint.save(
            path / "checkpoints",
            generation,
            eqx.filter(self.state, eqx.is_array),
            {"frames": self.frames},
            extra=self.best,
            keep=self.options.keep,
            seals=seals,
        )
        metadata = {"algorithm": json.dumps(self.run.config["algorithm"])}
        metadata |= {"record": json.dumps(sealed, sort_keys=True)}
        told = metadata | {"generation": str(generation)}
        checkpoint.export_policy(path / CHAMPION, self.state.champion, told)
        if self.best.score > NOTHING:
            told = metadata | {"generation": str(int(self.best.generation))}
            told |= {"score": repr(float(self.best.score))}
            checkpoint.export_policy(path / BEST, self.best.policy, told)
        else:
            files.remove(path / BEST)  # of another task
        self.safe = generation


def play(
    algorithm: Any,
    state: PyTree,
    best: Best,
    root: PRNGKeyArray,
    generation: int,
    frames: int,
    n: int,
    budget: Budget,
) -> tuple[PyTree, Best, list[dict[str, Any]]]:
    """The next generations of a task in JAX, at most `n` and `CHUNK`, none beyond the budget.
    `state` and `best` are used up.

    **Returns:** the state, the best policy so far, and a row of metrics, in Python numbers, for
    each generation.
    """
    n = min(n, CHUNK, (budget.generations or MOST) - generation)
    left = MOST if budget.frames is None else min(budget.frames - frames, MOST)
    numbers = (np.int32(generation), np.int32(n), np.int32(left), budget.stop_score)
    state, best, count, metrics = advance((algorithm, root, *numbers), state, best)
    columns, rows = jax.tree.map(np.asarray, metrics), []
    for i in range(int(count)):
        row = _row({name: column[i] for name, column in columns.items()})
        frames += int(row.pop("frames"))
        rows.append({"generation": generation + i + 1, "frames": frames, **row})
    return state, best, rows


def _row(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Metrics of a generation in Python numbers."""
    row = {name: np.asarray(value).item() for name, value in sorted(metrics.items())}
    return {name: np.nan if value == NOTHING else value for name, value in row.items()}


def play_outside(
    algorithm: Any,
    state: PyTree,
    best: Best,
    root: PRNGKeyArray,
    generation: int,
    frames: int,
    budget: Budget,
    enough: Callable[[], bool],
    overdue: Callable[[PyTree, list[dict[str, Any]], float], bool],
) -> tuple[PyTree, Best, list[dict[str, Any]]]:
    """`play` of a task outside JAX: generations until one is `enough` or the budget is reached.
    Rows that are whole and `overdue` are not returned: that has taken them.

    The test of each champion is played beside the next generation's episodes, so its score is put
    into its row, and into the state, one generation late (`rollout.score`); that of the last
    one is waited for. How many generations one call holds changes no number of any.
    """
    rows: list[dict[str, Any]] = []
    ended = time.monotonic()  # when the generation before did
    waiting: tuple[rollout.Postponed, PyTree] | None = None  # a test and the arrays it is of

    def settle(state: PyTree, best: Best, which: slice) -> tuple[PyTree, Best]:
        """With the score of the test that was waited for, of these rows."""
        assert waiting is not None
        score = waiting[0].score()
        for row in rows[which]:
            row["champion_score"] = _row({"score": score})["score"]
        if hasattr(state, "score"):  # for generations that repeat it
            state = eqx.tree_at(lambda state: state.score, state, score)
        number = rows[which][0]["generation"]
        return state, _better(best, np.asarray(score), waiting[1], number)

    while not rows or not (enough() or budget.reached(generation, frames)):
        generation += 1
        with rollout.postponing() as postponed:
            key = jax.random.fold_in(root, generation)
            state, metrics = algorithm.generation(state, key=key)
        row = _row(metrics)
        frames += int(row.pop("frames"))
        rows.append({"generation": generation, "frames": frames, **row})
        if waiting is not None:
            # A generation that made no test of its own repeats the score.
            state, best = settle(state, best, slice(-2, -1 if postponed else None))
            waiting = None
        if overdue(state, rows[:-1], ended):
            rows = rows[-1:]
        ended = time.monotonic()
        arrays = Best.none(eqx.filter(state.champion, eqx.is_array)).policy
        if postponed:
            waiting = postponed[-1], arrays
        else:
            best = _better(best, np.asarray(metrics["champion_score"]), arrays, generation)
    if waiting is not None:
        state, best = settle(state, best, slice(-1, None))
    return state, best, rows


def _better(best: Best, score: Any, arrays: PyTree, generation: int) -> Best:
    """The best policy, where a champion has been tested."""
    number: Any = np.int32(generation)
    return Best(arrays, score, number, best.stale) if best.beaten(score) else best


@jit(donate="all-except-first")
def advance(fixed: tuple[Any, ...], state: PyTree, best: Best):
    """`n` generations, at most `CHUNK`, in one program; fewer if a score reaches `stop_at`, or
    their frames `left`. The memory of `state` is used for the result.

    **Arguments:** `fixed`: the algorithm, the root key, how many generations are done, `n`,
    `left` and `stop_at`.

    **Returns:** the state, the best policy, how many generations ran, and metrics `[CHUNK]` each.
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
        i, left, dynamic, best, _, kept = loop
        dynamic, metrics = one(dynamic, i)
        kept = jax.tree.map(lambda xs, x: xs.at[i].set(x), kept, metrics)
        left, score = left - metrics["frames"].astype(jnp.int32), metrics["champion_score"]
        new = Best(dynamic.champion, score, generation + i + 1, best.stale)
        better = best.beaten(score)
        best = jax.tree.map(lambda a, b: jnp.where(better, b, a), best, new)
        return i + 1, left, dynamic, best, score, kept

    def ongoing(loop):
        i, left, _, _, score, _ = loop
        return (i < n) & (left > 0) & ~(score >= stop_at)

    start = (jnp.int32(0), left, dynamic, best, jnp.float32(-jnp.inf), empty)
    count, _, dynamic, best, _, kept = jax.lax.while_loop(ongoing, body, start)
    return eqx.combine(dynamic, static), best, count, kept
