"""Does an environment keep the contract? For those who bring their own."""

import dataclasses
import time
import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray, PyTree

from ..types import Sequence, TimeStep
from .base import AbstractEnvironment, AbstractSequenceTask, several
from .host import AbstractCopies, AbstractHostEnvironment, HostStep, failure_of

KEYS = 16  # episodes and sequences that are looked at
HOST_STEPS = 2000  # the most that is played of one episode outside JAX
HOST_SECONDS = 20.0  # the most that all of it may take, but for the last step


def check_environment(env: AbstractEnvironment | AbstractHostEnvironment) -> list[str]:
    """What is wrong with an environment or sequence task, each with its fix; empty if nothing.
    What is accepted, but should be known, is warned of (`UserWarning`).

    Plays 16 episodes of random actions, at most `2 * max_steps` steps each; of a task outside
    JAX (`Gymnasium("Hopper-v5")`) two episodes, each of them twice, for at most about 20 seconds.
    Later checks need what earlier ones established, so mend what is listed and check again. What a
    JAX environment itself raises, or JAX about its code, is not caught: it says more than a line
    here could.
    """
    problems, remarks = examine(env)
    known = env.warnings if remarks and isinstance(env, AbstractHostEnvironment) else ()
    for remark in remarks:
        if remark not in known:  # of those it was warned when the task was opened
            warnings.warn(remark, stacklevel=2)
    return problems


def examine(env: AbstractEnvironment | AbstractHostEnvironment) -> tuple[list[str], list[str]]:
    """What is wrong, as of `check_environment`, and what is accepted but should be known."""
    if isinstance(env, AbstractHostEnvironment):
        return _check_host(env)
    if not isinstance(env, AbstractEnvironment):
        told = (
            f"{type(env).__name__} is not an environment of ours: derive it from "
            "credo.environments.base.AbstractEnvironment, or AbstractSequenceTask for a "
            "labelled sequence; name a Gymnasium environment as Gymnasium(id)"
        )
        return [told], []
    stages: list[Callable[..., list[str]]] = [_spec, _reset_and_step, _repeatable, _episodes]
    if isinstance(env, AbstractSequenceTask):
        stages[1:1] = [_sequence, _sequences, _sequence_reward]
    for stage in stages:
        problems = stage(env)
        if problems:
            return list(dict.fromkeys(problems)), []
    return [], []


def _spec(env: AbstractEnvironment | AbstractHostEnvironment) -> list[str]:
    """Sizes, names of rewards and range, before anything is played."""
    problems = [
        f"{name} is {getattr(env, name)!r}: it must be a Python int of at least 1"
        for name in ("obs_size", "action_size", "max_steps", "agents")
        if not (name == "agents" and env.agents is None)
        and not (isinstance(getattr(env, name), int) and getattr(env, name) >= 1)
    ]
    names = env.signals
    if not (isinstance(names, tuple) and names and all(isinstance(name, str) for name in names)):
        problems.append(f"signals is {names!r}: it must be a tuple of one or more names")
    elif len(set(names)) < len(names):
        problems.append(f"signals is {names!r}: a name occurs twice; give each reward its own")
    problems += _choices(env)
    if isinstance(env, AbstractEnvironment) and not env.obs_range[0] < env.obs_range[1]:
        problems.append(f"obs_range is {env.obs_range}: it must be (least, largest)")
    return problems


def _choices(env: AbstractEnvironment | AbstractHostEnvironment) -> list[str]:
    """What a task says of the choices in its actions."""
    counts = env.choices
    if not isinstance(counts, tuple) or not all(isinstance(n, int) and n >= 1 for n in counts):
        return [f"choices is {counts!r}: it must be a tuple of the options of each, at least 1"]
    n = sum(counts)
    if n > env.action_size:
        return [f"choices has {n} options and action_size is {env.action_size}: it must hold them"]
    if env.masked and not 0 < n < env.obs_size:
        return [
            f"masked is set, choices has {n} options and obs_size is {env.obs_size}: an "
            "observation begins with one number for each option"
        ]
    return []


def _reset_and_step(env: AbstractEnvironment) -> list[str]:
    """Form and content of the first two time steps, without `jit`."""
    state, first = env.reset(key=jax.random.key(0))
    problems = _time_step(env, "reset", first)
    if problems:
        return problems
    for name, reward in first.rewards.items():
        if np.any(np.asarray(reward) != 0):
            problems.append(
                f"reset: reward {name!r} is {np.asarray(reward)}, but nothing was done yet: "
                "return zeros and pay at the first step"
            )
    if bool(first.terminated) or bool(first.truncated):
        problems.append("reset: the episode has already ended: start one that can be played")
    next_state, second = env.step(state, _action(env, 0), key=jax.random.key(1))
    problems += _time_step(env, "step", second)
    return problems or _same_structure((state, first), (next_state, second))


def _time_step(env: AbstractEnvironment, where: str, time_step: TimeStep) -> list[str]:
    """Problems of one time step in JAX: types, shapes, dtypes, and the rewards that it names."""
    if not isinstance(time_step, TimeStep):
        return [f"{where}: the second result is {type(time_step).__name__}: return a TimeStep"]
    team = () if env.agents is None else (env.agents,)
    problems = _array(f"{where}: obs", time_step.obs, (*team, env.obs_size), np.float32)
    given, named = set(time_step.rewards), set(env.signals)
    if given != named:
        problems.append(
            f"{where}: rewards are {sorted(given)} but signals names {sorted(named)}: return "
            "exactly those, every time"
        )
    for name, reward in time_step.rewards.items():
        shape = team if np.ndim(reward) else ()
        problems += _array(f"{where}: reward {name!r}", reward, shape, np.float32)
    for name in ("terminated", "truncated"):
        problems += _array(f"{where}: {name}", getattr(time_step, name), (), np.bool_)
    for name in ("active", "gone"):
        said = getattr(time_step, name)
        if said is not None:
            if not team:
                problems.append(f"{where}: {name} is for teams: leave it None, or set agents")
            problems += _array(f"{where}: {name}", said, team, np.bool_)
    return problems


def _array(what: str, x: Array, shape: tuple[int, ...], dtype: type) -> list[str]:
    """Problems of one value that should be a finite array of this shape and dtype."""
    name = np.dtype(dtype).name
    if not eqx.is_array(x):
        return [f"{what} is a {type(x).__name__}: return a JAX array, {name} of shape {shape}"]
    problems = []
    if x.shape != shape:
        problems.append(f"{what} has shape {x.shape}: it must be {shape}")
    if x.dtype != dtype:
        problems.append(f"{what} is {x.dtype}: it must be {name}; use .astype(jnp.{name})")
    elif not bool(jnp.all(jnp.isfinite(x))):
        problems.append(f"{what} has NaN or inf: guard the division, root or logarithm it is from")
    return problems


def _same_structure(reset: PyTree, step: PyTree) -> list[str]:
    """A loop carries state and time step, so both must keep their form."""
    if jax.tree.structure(reset) != jax.tree.structure(step):
        return [
            "reset and step return different structures: give state and time step the same "
            f"fields in both (reset {jax.tree.structure(reset)}, step {jax.tree.structure(step)})"
        ]
    pairs = zip(jax.tree.leaves_with_path(reset), jax.tree.leaves(step), strict=True)
    return [
        f"{('state', 'time step')[path[0].idx]}{jax.tree_util.keystr(path[1:])} is "
        f"{_form(a)} after reset and {_form(b)} after step: return one form"
        for (path, a), b in pairs
        if _form(a) != _form(b)
    ]


def _form(x) -> str:
    """Dtype and shape, as in float32[3]."""
    return f"{jnp.result_type(x)}{list(np.shape(x))}"


def _repeatable(env: AbstractEnvironment) -> list[str]:
    """Without `jit`: a compiled program would repeat what the host drew while tracing."""

    def play() -> PyTree:
        state, first = env.reset(key=jax.random.key(0))
        seen = [(state, first)]
        for t in range(min(3, env.max_steps)):
            state, time_step = env.step(state, _action(env, t), key=jax.random.key(t))
            seen.append((state, time_step))
            if time_step.terminated or time_step.truncated:
                break
        return seen

    if _equal(play(), play()):
        return []
    return [
        "the same key gave two different episodes: draw everything from `key` with jax.random, "
        "and keep no state outside the one that reset and step return"
    ]


def _episodes(env: AbstractEnvironment) -> list[str]:
    """Whether 16 whole episodes stay finite and within range, end in time, and differ."""
    played = jax.jit(jax.vmap(lambda key: _play(env, key)))(
        jax.random.split(jax.random.key(0), KEYS)
    )
    steps, ended, faults, digest = (np.asarray(x) for x in played)
    told = (
        "obs has NaN or inf at step {}: keep it finite for every action in [-1, 1]",
        f"obs leaves obs_range {env.obs_range} at step {{}}: widen obs_range, or clip",
        "a reward has NaN or inf at step {}: keep it finite for every action in [-1, 1]",
        "what obs begins with at step {} is no mask: give 1 or 0 for each option, and a 1 to each "
        "choice of every agent while the episode goes on",
    )
    problems = [
        "step: " + line.format(at)
        for line, at in zip(told, faults.min(axis=0), strict=True)
        if at < _never(env)
    ]
    if not ended.all():
        problems.append(
            f"an episode had not ended after {steps.max()} steps, and max_steps is "
            f"{env.max_steps}: set truncated when the clock runs out"
        )
    elif steps.max() > env.max_steps:
        problems.append(
            f"an episode took {steps.max()} steps and max_steps is {env.max_steps}: set "
            "truncated there, or raise max_steps"
        )
    if not problems and (digest == digest[:1]).all():
        problems.append(
            f"{KEYS} different keys gave the same episode: draw the start, or the noise of the "
            "steps, from `key`"
        )
    return problems


def _play(env: AbstractEnvironment, key: PRNGKeyArray):
    """One episode of random actions that do not depend on the key.

    **Returns:** steps, whether it ended, the first step of each fault, and numbers that two
    different episodes do not share.
    """
    reset_key, step_key = jax.random.split(key)

    def ongoing(loop):
        _, time_step, step, *_ = loop
        return ~(time_step.terminated | time_step.truncated) & (step < 2 * env.max_steps)

    def advance(loop):
        state, _, step, faults, digest = loop
        action, key = _action(env, step), jax.random.fold_in(step_key, step)
        state, time_step = env.step(state, action, key=key)
        found, numbers = _look(env, time_step, step + 1)
        return state, time_step, step + 1, jnp.minimum(faults, found), digest + numbers

    state, first = env.reset(key=reset_key)
    start = (state, first, jnp.int32(0), *_look(env, first, jnp.int32(0)))
    _, last, step, faults, digest = jax.lax.while_loop(ongoing, advance, start)
    ended = last.terminated | last.truncated
    return step, ended, faults, jnp.append(digest, step.astype(jnp.float32))


def _look(env: AbstractEnvironment, time_step: TimeStep, step: Array) -> tuple[Array, Array]:
    """`step` where a fault shows now, else never; and the content weighted by its time."""
    obs = jnp.ravel(time_step.obs)
    rewards = jnp.concatenate([jnp.ravel(x) for x in time_step.rewards.values()])
    low, high = env.obs_range
    faults = jnp.stack(
        [
            ~jnp.all(jnp.isfinite(obs)),
            jnp.any((obs < low) | (obs > high)),
            ~jnp.all(jnp.isfinite(rewards)),
            _no_mask(env, time_step),
        ]
    )
    content = jnp.nan_to_num(jnp.concatenate([obs, rewards]))
    weight = jnp.cos(step.astype(jnp.float32) + 1.0)
    return jnp.where(faults, step, _never(env)), content * weight


def _no_mask(env: AbstractEnvironment, time_step: TimeStep) -> Array:
    """Whether an observation should begin with what is allowed, and does not."""
    if not env.masked:
        return jnp.bool_(False)
    mask = time_step.obs[..., : env.barrable]
    parts = jnp.split(mask, np.cumsum(env.choices)[:-1].tolist(), axis=-1)
    none = jnp.stack([jnp.any(jnp.max(part, axis=-1) < 0.5) for part in parts]).any()
    ends = time_step.terminated | time_step.truncated
    return jnp.any((mask != 0.0) & (mask != 1.0)) | (none & ~ends)


def _never(env: AbstractEnvironment) -> int:
    """Later than any step that is played."""
    return 3 * env.max_steps


def _action(env: AbstractEnvironment, step) -> Array:
    """A random action; a third of its entries lie on the bounds."""
    shape = (env.action_size,) if env.agents is None else (env.agents, env.action_size)
    key = jax.random.fold_in(jax.random.key(1), step)
    return jnp.clip(jax.random.uniform(key, shape, minval=-1.5, maxval=1.5), -1.0, 1.0)


def _sequence(task: AbstractSequenceTask) -> list[str]:
    """Form of one sequence, drawn without `jit` so that randomness of the host shows."""
    sequence, again = (task.sample(key=jax.random.key(0)) for _ in range(2))
    if not isinstance(sequence, Sequence):
        return [f"sample: the result is {type(sequence).__name__}: return a Sequence"]
    time = (task.max_steps,)
    one = task.action_size == 1 and jnp.ndim(sequence.targets) < 2
    answers = time if one else (*time, task.action_size)
    problems = [
        *_array("sample: inputs", sequence.inputs, (*time, task.obs_size), np.float32),
        *_array("sample: targets", sequence.targets, answers, np.float32),
        *_array("sample: scored", sequence.scored, time, np.bool_),
        *_array("sample: length", sequence.length, (), np.int32),
    ]
    if not problems and not _equal(sequence, again):
        problems.append(
            "sample: the same key gave two different sequences: draw everything from `key` with "
            "jax.random"
        )
    return problems


def _sequences(task: AbstractSequenceTask) -> list[str]:
    """Content of many sequences."""
    keys = jax.random.split(jax.random.key(0), KEYS)
    drawn = jax.jit(jax.vmap(lambda key: task.sample(key=key)))(keys)
    lengths, scored = np.asarray(drawn.length), np.asarray(drawn.scored)
    padding = np.arange(task.max_steps) >= lengths[:, None]
    problems = []
    if lengths.min() < 1 or lengths.max() > task.max_steps:
        problems.append(
            f"sample: lengths are {lengths.min()}..{lengths.max()} and max_steps is "
            f"{task.max_steps}: every length must lie in 1..max_steps"
        )
    if np.any(scored & padding):
        problems.append(
            "sample: a step at or beyond `length` is scored: padding must not count; clear "
            "scored there or correct length"
        )
    if not np.all(np.any(scored & ~padding, axis=1)):
        problems.append(
            "sample: a sequence has no scored step before its `length`: without one every answer "
            "is a success"
        )
    for name in ("inputs", "targets"):
        if not np.all(np.isfinite(getattr(drawn, name))):
            problems.append(f"sample: {name} has NaN or inf for some key: keep them finite")
    if not problems and _equal(
        drawn, jax.tree.map(lambda x: np.broadcast_to(x[:1], x.shape), drawn)
    ):
        problems.append(f"sample: {KEYS} different keys gave the same sequence: draw it from `key`")
    return problems


def _sequence_reward(task: AbstractSequenceTask) -> list[str]:
    """`reward` acts elementwise, but for the axis of several answers: the fast path calls it with
    whole populations."""
    answer, target = jnp.meshgrid(jnp.array([-1.0, 0.0, 0.5, 1.0]), jnp.array([-1.0, 0.0, 1.0]))
    scored, perfect = jnp.ones((3, 4), bool), jnp.zeros((3, 4), bool)
    if several(jax.eval_shape(lambda: task.sample(key=jax.random.key(0)))):
        answer, target = (jnp.stack([x] * task.action_size) for x in (answer, target))
    reward = task.reward(answer, target, scored, perfect)
    problems = _array("reward: its value for answers of shape (3, 4)", reward, (3, 4), np.float32)
    if not problems:
        one = task.reward(answer[..., 1, 2], target[..., 1, 2], scored[1, 2], perfect[1, 2])
        if not np.allclose(one, reward[1, 2]):
            problems.append(
                f"reward: one answer alone earns {one}, within a batch {reward[1, 2]}: work "
                "elementwise, without sums over the batch"
            )
    return problems


def _check_host(env: AbstractHostEnvironment) -> tuple[list[str], list[str]]:
    """Two copies play two seeds, then the same with the seeds exchanged."""
    failure = failure_of(lambda: env.copies(2))
    problems = [str(failure)] if failure else _spec(env)
    if problems:
        return problems, []
    turns = env.turns(np.ones(2, bool))
    look = _Look(env, env.copies(2), HOST_SECONDS / (2 * len(turns)))
    episodes: list[list[list[bytes]]] = []

    def play() -> None:
        for seeds in ([1, 2], [2, 1]):
            seen: list[list[bytes]] = [[], []]
            for turn in turns:
                if not look.problems:
                    look.play(np.array(seeds, np.uint32), turn, seen)
            episodes.append(seen)

    failure = failure_of(play)
    if failure:
        look.problems.append(str(failure))
    if not look.problems:
        (a, b), (c, d) = episodes
        if not (_agree(a, d) and _agree(b, c)):
            look.problems.append(
                "the same seed gave two different episodes: draw everything from self.np_random, "
                "which reset(seed=seed) seeds (a gymnasium.Env does by super().reset(seed=seed)), "
                "and let reset set all state"
            )
    if look.late:
        told = f"stopped after {HOST_SECONDS:g} s: {look.steps:,} steps were looked at"
        look.remarks.append(told)
    remarks = [*env.warnings, *look.remarks]
    return list(dict.fromkeys(look.problems)), list(dict.fromkeys(remarks))


def _agree(a: list[bytes], b: list[bytes]) -> bool:
    """As far as both were played."""
    return all(x == y for x, y in zip(a, b, strict=False))


@dataclasses.dataclass
class _Look:
    """What is seen of two copies. Play stops at the first wrong step."""

    env: AbstractHostEnvironment
    copies: AbstractCopies
    seconds: float  # of one `play`
    problems: list[str] = dataclasses.field(default_factory=list)
    remarks: list[str] = dataclasses.field(default_factory=list)
    steps: int = 0
    late: bool = False

    def play(self, seeds: np.ndarray, active: np.ndarray, seen: list[list[bytes]]) -> None:
        """One episode in every active copy, all with the same random actions; all that was seen is
        added to `seen`, step by step."""
        random, until = np.random.default_rng(0), time.monotonic() + self.seconds
        obs_size, action_size, *team = self.env.sizes
        n, most, dtype = len(active), self.env.max_steps, np.dtype(self.env.obs_dtype).type
        obs = self.copies.reset(seeds, active)
        self.problems += _numbers("reset: obs", obs, (n, *team, obs_size), dtype)
        self._failures(self.copies.failed)
        for i in np.flatnonzero(active) if not self.problems else ():
            seen[i].append(obs[i].tobytes())
            self._range("reset", obs[i])
        for t in range(min(most, HOST_STEPS)):
            if self.problems or not active.any():
                return
            if time.monotonic() > until:
                self.late = True
                return
            action = np.clip(random.uniform(-1.5, 1.5, (1, *team, action_size)), -1.0, 1.0)
            step = self.copies.step(np.repeat(np.float32(action), n, axis=0), active)
            self._look(step, active, t + 1, seen)
            active = active & ~(step.terminated | step.truncated)
        if active.any() and most <= HOST_STEPS:
            self.problems.append(
                f"an episode had not ended after max_steps, {most}: set truncated when the clock "
                "runs out"
            )

    def _look(self, step: HostStep, active: np.ndarray, t: int, seen: list[list[bytes]]) -> None:
        """Problems of step `t`, and what it said, for the comparison of episodes."""
        self._failures(step.failed)
        self.problems += _host_step(self.env, step, active)
        self.steps += int(active.sum())
        for i in np.flatnonzero(active) if not self.problems else ():
            rewards = [step.rewards[name][i].tobytes() for name in self.env.signals]
            seen[i].append(b"".join([step.obs[i].tobytes(), *rewards]))
            self._range(f"step {t}", step.obs[i])

    def _failures(self, failed: np.ndarray | None) -> None:
        """None is tolerated here; copies that fail together do so for one reason."""
        for i in np.flatnonzero(failed)[:1] if failed is not None else ():
            self.problems.append(self.copies.failure_text(int(i)))

    def _range(self, when: str, obs: np.ndarray) -> None:
        """An observation `[*agents, obs]` may leave its space, and that is said once. An agent that
        is away observes 0."""
        low, high = self.env.obs_range
        out = (obs < low) | (obs > high)
        if out.any() and not self.remarks:
            out = out & (obs != 0).any(axis=-1, keepdims=True)
        if out.any() and not self.remarks:
            place = tuple(np.argwhere(out)[0].tolist())
            least, most = (np.broadcast_to(x, obs.shape)[place] for x in (low, high))
            self.remarks.append(
                f"an observation leaves its observation_space at {when}: entry {place[-1]} is "
                f"{obs[place]:g}, and its bounds are {least:g} and {most:g}. Training takes it as "
                "it is: widen the space, or clip"
            )


def _host_step(env: AbstractHostEnvironment, step: HostStep, active: np.ndarray) -> list[str]:
    """Problems of one step of all copies outside JAX."""
    n, (obs_size, _, *team) = len(active), env.sizes
    dtype = np.dtype(env.obs_dtype).type
    problems = _numbers("step: obs", step.obs, (n, *team, obs_size), dtype, active)
    if set(step.rewards) != set(env.signals):
        problems.append(
            f"step: rewards are {sorted(step.rewards)} but signals names {sorted(env.signals)}: "
            "return exactly those, every time"
        )
    for name, reward in step.rewards.items():
        shape = (n, *env.reward_shapes.get(name, ()))
        problems += _numbers(f"step: reward {name!r}", reward, shape, np.floating, active)
    for name in ("terminated", "truncated"):
        problems += _numbers(f"step: {name}", getattr(step, name), (n,), np.bool_)
    if team:
        problems += _numbers("step: active", step.active, (n, *team), np.bool_)
        if step.gone is not None:
            problems += _numbers("step: gone", step.gone, (n, *team), np.bool_)
    return problems


def _numbers(
    what: str,
    x: np.ndarray | None,
    shape: tuple[int, ...],
    dtype: type,
    active: np.ndarray | None = None,
) -> list[str]:
    """Problems of one NumPy array whose `active` rows should be finite."""
    name = "a floating type" if dtype is np.floating else np.dtype(dtype).name
    if not isinstance(x, np.ndarray) or x.shape != shape or not np.issubdtype(x.dtype, dtype):
        given = f"{x.dtype}{list(x.shape)}" if isinstance(x, np.ndarray) else type(x).__name__
        return [f"{what} is {given}: return a NumPy array of {name} and shape {list(shape)}"]
    shown = x if active is None else x[active]
    with np.errstate(over="ignore"):
        if not np.isfinite(shown.astype(np.float32)).all():
            return [
                f"{what} has NaN or inf, or is beyond ±3.4e38: guard the division, root or "
                "logarithm it is from"
            ]
    return []


def _equal(a: PyTree, b: PyTree) -> bool:
    """Whether two trees hold the same numbers."""

    def numbers(x) -> np.ndarray:
        is_key = eqx.is_array(x) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(x) if is_key else x)

    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(numbers(x), numbers(y), equal_nan=True) for x, y in pairs)
