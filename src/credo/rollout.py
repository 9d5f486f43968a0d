"""Playing episodes: the only place where a policy meets an environment.

There are two ways in. A population plays for its returns: `evaluate`, and `collect`, which also
keeps the transitions. One policy is looked at: `record` keeps an episode of it, moment by moment.
"""

import contextlib
import dataclasses
import math
import threading
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from . import playing, tree
from .compilation import float32, jit
from .environments.base import AbstractEnvironment, AbstractSequenceTask, correct, several
from .environments.host import AbstractHostEnvironment, EnvironmentFailure, Episodes, sound
from .environments.wrappers import Given
from .networks.base import AbstractPolicy
from .playing import acted, devices, each, players, started, world_keys
from .types import Evaluation, Sequence, Trace, Transition, plain

Environment = AbstractEnvironment | AbstractHostEnvironment
See = Callable[[bool], None]


class Experience(eqx.Module):
    """What happened in a rollout, frame by frame and episode by episode."""

    transitions: Transition  # leaves [rows, ...]
    valid: Bool[Array, " rows"] | None  # None: every row, which then come from the host

    def lived(self, played: Evaluation) -> Int[Any, " episodes"]:
        """Rows of each episode: its steps; none of one that is lost."""
        xp: Any = np if self.valid is None else jnp
        returns = xp.asarray(next(iter(played.returns.values()))).reshape(played.steps.size, -1)
        return xp.where(xp.isfinite(returns[:, 0]), played.steps.reshape(-1), 0)

    def late(self, played: Evaluation, signal: str) -> Bool[Any, " episodes"]:
        """Which episodes were paid nothing before their last step."""
        rewards, lived = self.transitions.rewards[signal], self.lived(played)
        paid = (rewards.reshape(len(rewards), math.prod(rewards.shape[1:])) != 0).any(axis=1)
        if self.valid is None:  # the episodes, one behind the other, without the lost ones
            paid[np.cumsum(lived)[lived > 0] - 1] = False
            return np.bincount(np.repeat(np.arange(lived.size), lived), paid, lived.size) == 0
        paid = paid.reshape(lived.size, -1)
        return ~jnp.any(paid & (jnp.arange(paid.shape[1])[None] < lived[:, None] - 1), axis=1)

    def spread(self, played: Evaluation, late_only: bool = False) -> "Experience":
        """With every return of an episode, of whatever signal, paid in equal parts over its frames.

        **Arguments:** `late_only`: of episodes that are paid before their last step, the rewards
        stay as they are.
        """
        steps, lived = played.steps.reshape(-1), self.lived(played)
        length = jnp.maximum(steps, 1).astype(jnp.float32)[:, None]
        frames = max(self.transitions.terminated.shape[0] // steps.size, 1)

        def by_row(x: Any) -> Any:
            if self.valid is None:
                return np.repeat(np.asarray(x), lived, axis=0)
            return jnp.repeat(x, frames, axis=0)

        rewards, xp = {}, np if self.valid is None else jnp
        for name, returns in played.returns.items():
            old = self.transitions.rewards[name]
            rewards[name] = by_row(returns.reshape(steps.size, -1) / length).reshape(old.shape)
            if late_only:
                late = by_row(self.late(played, name)).reshape(-1, *(1,) * (old.ndim - 1))
                rewards[name] = xp.where(late, rewards[name], old)
        return eqx.tree_at(lambda e: e.transitions.rewards, self, rewards)

    def last(self, played: Evaluation) -> Transition:
        """The last transition of every episode, `[pop·episodes, ...]`; that of another one where
        the episode was lost or not played."""
        steps = played.steps.reshape(-1)
        if self.valid is None:  # the episodes, one behind the other, without the lost ones
            at = np.cumsum(self.lived(played)) - 1
        else:
            most = self.transitions.terminated.shape[0] // steps.size
            at = jnp.arange(steps.size) * most + steps - 1
        return jax.tree.map(lambda x: x[at], self.transitions)

    def first(self, leaves: PyTree, played: Evaluation, most: int) -> PyTree:
        """Of some `leaves` of the transitions the first `most` rows of every episode,
        `[pop·episodes, most, ...]`. Those past its end are meaningless, and all of one that was
        lost or not played."""
        rows, number = len(self.transitions.terminated), played.steps.size
        if self.valid is None:  # the episodes, one behind the other, without the lost ones
            lived = self.lived(played)
            at = (np.cumsum(lived) - lived)[:, None] + np.arange(most)[None]
        else:
            at = (jnp.arange(number) * (rows // number))[:, None] + jnp.arange(most)[None]
        return jax.tree.map(lambda x: x[at.clip(0, rows - 1)], leaves)


@float32()
def evaluate(
    env: Environment, population: PyTree, episodes: int, *, common: bool = True, key: PRNGKeyArray
) -> Evaluation:
    """Play `episodes` episodes with every member of a population.

    **Arguments:** `common` gives all members the same worlds, so that a ranking compares members
    and not luck; otherwise each member draws its own.
    """
    if isinstance(env, AbstractHostEnvironment):
        return _play_on_host(env, population, episodes, episodes, common, False, key=key)[0]
    if isinstance(env, Given):
        env.require_once(population, episodes)
    if isinstance(env, AbstractSequenceTask) and getattr(population, "features_first", False):
        return _answer(env, population, episodes, common, key=key)
    play = _play_in_turn if tree.batch(population) < tree.size(population) else _play
    return play(env, _lanes(population, episodes, common, key=key), jnp.int32(episodes), False)[0]


@float32()
def collect(
    env: Environment, population, episodes: int, *, wanted=None, common=True, limit=None, key
) -> tuple[Evaluation, Experience]:
    """`evaluate`, and every transition that was met. Outside JAX a finished episode costs no more
    physics; in JAX all lanes of a device step until the last one of them ends.

    **Arguments:** of its `episodes` each member plays the first `wanted`, None: all; that number is
    data. The others have no steps and a return of 0. Episodes are truncated after `limit` steps,
    which is data too; None: when the task ends them.
    """
    wanted = episodes if wanted is None else wanted
    if isinstance(env, AbstractHostEnvironment):
        return _play_on_host(env, population, episodes, wanted, common, True, limit, key=key)
    return _play(env, _lanes(population, episodes, common, key=key), jnp.int32(wanted), True, limit)


@float32()
def begun(
    env: Environment, population: PyTree, episodes: int, *, wanted=None, common=True, key
) -> Callable[[], tuple[Evaluation, Experience]]:
    """`collect` of what is wanted later: call it for the result. Outside JAX nothing is played
    before that, unless `playing.players.start` lets other processes begin."""
    if not isinstance(env, AbstractHostEnvironment):
        found = collect(env, population, episodes, wanted=wanted, common=common, key=key)
        return lambda: found
    wanted = episodes if wanted is None else wanted
    asked = players.ask(_part(env, population, episodes, wanted, common, True, key=key))
    return lambda: _told(asked.result())


@float32()
def record(
    env: Environment,
    policy: AbstractPolicy,
    *,
    key: PRNGKeyArray,
    padded: bool = False,
    seed: int | None = None,
    see: See = lambda over: None,
) -> Trace:
    """The episode that `evaluate(env, tree.single(policy), 1, key=key)` plays, moment by moment.

    **Arguments:**

    - `padded`, of a task in JAX, for use under `jit` and `vmap`: arrays have room for `max_steps`
      steps, and what stands behind `length` means nothing. Otherwise they end there, in NumPy.
    - `seed`, of a task outside JAX: that of its reset; None: one drawn by `key`.
    - `see(over)`, of a task outside JAX: called at every moment, to draw it.

    **Raises:** `EnvironmentFailure` if the episode of a task outside JAX failed.
    """
    if isinstance(env, AbstractHostEnvironment):
        return _record_on_host(env, policy, seed, see, key=key)
    trace = _record(env, policy, key=key)
    return trace if padded else trace.cut()


def score(
    env: Environment, policy: AbstractPolicy, episodes: int, reward: str = "", *, before=None, key
) -> Float[Array, ""]:
    """Mean return of one policy on fresh episodes, of a reward; "": of that which the task reports.

    **Arguments:** `before`: the last score, given where nothing is decided by the new one before
    the generation is over. Outside JAX it may then be postponed (`postponing`): `before` stands for
    it until it is known. -inf: there was none, and this one is waited for.
    """
    if before is not None and isinstance(env, AbstractHostEnvironment) and _TESTS.wait(before):
        return _postpone(env, policy, episodes, reward, before, key=key)
    played = evaluate(env, tree.single(policy), episodes, key=key)
    return jnp.mean(sound(env, played.of(reward or env.reported)))


@dataclasses.dataclass
class Postponed:
    """A test outside JAX whose episodes are not played yet, or not waited for."""

    env: AbstractHostEnvironment
    asked: players.Asked
    reward: str

    def score(self) -> Float[Array, ""]:
        """What `score` would have said. Raises `EnvironmentFailure` as rollouts do."""
        returns = _evaluated(self.asked.result()).of(self.reward or self.env.reported)
        return jnp.mean(sound(self.env, returns))


class _Tests(threading.local):
    postponed: list[Postponed] | None = None

    def wait(self, before: Any) -> bool:
        """Whether a test may."""
        return self.postponed is not None and before != -np.inf


_TESTS = _Tests()


@contextlib.contextmanager
def postponing() -> Iterator[list[Postponed]]:
    """In here `score` need not wait for episodes outside JAX: they join whatever is played next.
    The list fills with what was postponed."""
    earlier, _TESTS.postponed = _TESTS.postponed, []
    try:
        yield _TESTS.postponed
    finally:
        _TESTS.postponed = earlier


def _postpone(
    env: AbstractHostEnvironment, policy: AbstractPolicy, episodes: int, reward, before, *, key
) -> Float[Array, ""]:
    """The score from before, in the place of one that comes later."""
    assert _TESTS.postponed is not None
    part = _part(env, tree.single(policy), episodes, episodes, True, False, key=key)
    _TESTS.postponed.append(Postponed(env, players.ask(part), reward))
    return jnp.float32(before)


def blank(env: Environment, policy: AbstractPolicy | None = None) -> Transition:
    """A transition of this task, all zeros: its shapes and types; and those of what a `policy`
    remembers."""
    obs_size, action_size, *team = env.sizes
    obs = jnp.zeros((*team, obs_size), getattr(env, "obs_dtype", "float32"))
    action = jnp.zeros((*team, action_size))
    if isinstance(env, AbstractHostEnvironment):
        rewards = {name: jnp.zeros(shape) for name, shape in env.reward_shapes.items()}
        ended, active = jnp.zeros(team, bool), jnp.zeros(team, bool) if team else None
    else:
        _, first = jax.eval_shape(lambda: env.reset(key=jax.random.key(0)))
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), first)
        rewards, ended, active = zeros.rewards, zeros.ended, zeros.active
    memory = jax.tree.map(jnp.zeros_like, policy and policy.first())
    return Transition(obs, action, rewards, obs, ended, jnp.bool_(False), active, memory)


@jit
def _lanes(population: PyTree, episodes: int, common: bool, *, key: PRNGKeyArray) -> PyTree:
    """Policies, and for each episode of each the key of its world and that of the policy."""
    world_key, policy_key = jax.random.split(key)
    worlds = world_keys(tree.size(population), episodes, common, key=world_key)
    return population, worlds, jax.random.split(policy_key, worlds.shape)


@jit
def _answer(
    env: AbstractSequenceTask, population: PyTree, episodes: int, common: bool, *, key: PRNGKeyArray
) -> Evaluation:
    """Sequences are known before anybody acts: they are drawn first and answered together."""
    if isinstance(env, Given):
        given = jax.tree.map(lambda x: x[None], env.sequences)
        return _answer_these(env, (population, given))
    world_key, _ = jax.random.split(key)
    keys = world_keys(1 if common else tree.size(population), episodes, common, key=world_key)
    # An episode resets with the first half of its world key: the same sequences either way.
    sequences = each(lambda key: env.sample(key=jax.random.split(key)[0]))(keys)
    return _answer_these(env, (population, sequences))


@jit
@devices.shared
def _play_in_turn(env: AbstractEnvironment, lanes: PyTree, wanted: Int[Array, ""], record: bool):
    """Large policies some at a time: their weights stay in the cache from step to step."""
    return tree.in_batches(lambda some: _play(env, some, wanted, record), lanes)


@jit
@devices.shared
def _play(
    env: AbstractEnvironment, lanes: PyTree, wanted: Int[Array, ""], record: bool, limit: Any = None
) -> tuple[Evaluation, Any]:
    """All lanes `[pop, episodes]` take each step together, so that a row of the buffer is written
    in place; a `vmap` of whole episodes would copy the buffer at every step. `lanes`: policies
    `[pop]`, keys of worlds and of policies. The second result is the `Experience`; None if nothing
    is to `record`."""
    population, worlds, policy_keys = lanes
    lanes = worlds.shape
    reset_keys, step_keys = jnp.moveaxis(each(jax.random.split)(worlds), 2, 0)
    states, first = each(lambda key: env.reset(key=key))(reset_keys)
    population = eqx.filter_vmap(lambda policy: policy.arranged())(population)
    carries = started(population, policy_keys)
    active = jnp.broadcast_to(jnp.arange(lanes[1]) < wanted, lanes)
    # Where policy or world said NaN the episode goes on, has a return of NaN, and is forgotten.
    lost = active & ~_sound(first.obs)
    totals = (jax.tree.map(jnp.zeros_like, first.rewards), jnp.zeros(lanes, jnp.int32), lost)
    row = (blank(env, tree.take(population, 0)), jnp.bool_(False)) if record else None
    rows = jax.tree.map(lambda x: jnp.zeros((env.max_steps, *lanes, *x.shape), x.dtype), row)
    start = (jnp.int32(0), states, (first.obs, first.active), carries, active, totals, rows)

    def ongoing(loop):
        t, _, _, _, active, _, _ = loop
        return jnp.any(active) & (t < env.max_steps)

    def advance(loop):
        t, states, (obs, acting), carries, active, (returns, steps, lost), rows = loop
        actions, carries, memory = acted(population, obs, carries)
        sound = _sound(actions)
        actions = jnp.where(jnp.isfinite(actions), actions, 0.0)
        keys = each(lambda key: jax.random.fold_in(key, t))(step_keys)
        bounded = jnp.clip(actions, -1.0, 1.0)
        states, step = each(lambda s, a, key: env.step(s, a, key=key))(states, bounded, keys)
        step = step if limit is None else step.cut(t + 1 >= limit)
        for x in jax.tree.leaves((step.obs, step.rewards)):
            sound = sound & _sound(x)
        lost = lost | (active & ~sound)
        paid = jax.tree.map(lambda x: jnp.where(_over(active, x), x, 0.0), step.rewards)
        returns = jax.tree.map(jnp.add, returns, paid)
        steps = steps + active.astype(jnp.int32)
        if record:
            ends = (step.ended, step.truncated, acting, memory)
            row = (Transition(obs, actions, step.rewards, step.obs, *ends), active)
            rows = jax.tree.map(lambda xs, x: xs.at[t].set(x), rows, row)
        active = active & ~(step.terminated | step.truncated)
        return t + 1, states, (step.obs, step.active), carries, active, (returns, steps, lost), rows

    *_, (returns, steps, lost), rows = jax.lax.while_loop(ongoing, advance, start)
    returns = jax.tree.map(lambda x: jnp.where(_over(lost, x), jnp.nan, x), returns)
    # Episode by episode, as they would be met one after the other.
    kept = rows and (rows[0], rows[1] & ~lost[None])
    flat = jax.tree.map(lambda x: jnp.moveaxis(x, 0, 2).reshape(-1, *x.shape[3:]), kept)
    return Evaluation(returns, steps), flat and Experience(*flat)


def _sound(x: Array) -> Bool[Array, "pop episodes"]:
    """In which lanes there are numbers alone."""
    return jnp.all(jnp.isfinite(x).reshape(*x.shape[:2], -1), axis=2)


def _over(lanes: Any, x: Any) -> Any:
    """`lanes` for `x` that may have an axis of agents behind."""
    return lanes.reshape(lanes.shape + (1,) * (x.ndim - lanes.ndim))


@jit
def _record(env: AbstractEnvironment, policy: AbstractPolicy, *, key: PRNGKeyArray) -> Trace:
    world_key, policy_key = jax.random.split(key)
    reset_key, step_key = jax.random.split(world_keys(1, 1, True, key=world_key)[0, 0])
    state, first = env.reset(key=reset_key)
    carry = policy.start(key=jax.random.split(policy_key, (1, 1))[0, 0])

    def advance(loop, t):
        state, (obs, active), carry = loop
        action, carry = policy(obs, carry)
        action = jnp.clip(jnp.where(jnp.isfinite(action), action, 0.0), -1.0, 1.0)
        state, now = env.step(state, action, key=jax.random.fold_in(step_key, t))
        done = (action, now.rewards, active, now.terminated, now.truncated)
        return (state, (now.obs, now.active), carry), ((now.obs, state, carry), done)

    start = (state, (first.obs, first.active), carry)
    _, (later, done) = jax.lax.scan(advance, start, jnp.arange(env.max_steps))
    seen = (first.obs, state, carry)
    seen = jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), seen, later)
    actions, rewards, active, terminated, truncated = done
    over = terminated | truncated
    last = jnp.where(jnp.any(over), jnp.argmax(over), env.max_steps - 1)
    ends = (terminated[last], truncated[last], last + 1)
    return Trace(seen[0], seen[1], seen[2], actions, rewards, active, *ends)


def _record_on_host(
    env: AbstractHostEnvironment, policy: AbstractPolicy, seed: int | None, see: See, *, key
) -> Trace:
    form, arrays = playing.apart(tree.single(policy))
    drawn, keys = playing.draw((1, 1), True, key)
    carry = playing.start(form, arrays, keys)
    seeds = np.array([np.asarray(drawn).item() if seed is None else seed], np.uint32)
    told, carries = Episodes(env, 1, True), [carry]
    obs = told.begin(seeds, np.ones(1, bool))
    see(not told.ongoing)
    while told.ongoing:
        action, carry, _ = playing.act(form, arrays, obs, carry)
        obs = told.advance(np.asarray(action))
        carries.append(carry)
        see(not told.ongoing)
    seen, actions, rewards, later, _, truncated, active, _ = told.rows()
    if not len(seen):
        why = env.copies(1).failure_text(0)
        raise EnvironmentFailure(f"the episode failed, or its policy said NaN: {why}")
    seen = np.concatenate([seen, later[-1:]])
    kept = jax.tree.map(lambda *xs: plain(jnp.stack(xs))[:, 0, 0], *carries)
    played = (np.clip(actions, -1.0, 1.0), rewards, active)
    ends = (~truncated[-1], truncated[-1], np.int32(len(actions)))
    return Trace(seen, None, kept, *played, *ends)


def _play_on_host(
    env: AbstractHostEnvironment, population: PyTree, *how: Any, key: PRNGKeyArray
) -> tuple[Evaluation, Any]:
    """The same with copies outside JAX: actions go there and time steps come back, once per step
    for all lanes together. `how`: arguments of `_part`."""
    return _told(players.ask(_part(env, population, *how, key=key)).result())


def _told(came: playing.Outcome) -> tuple[Evaluation, Any]:
    """An outcome as `evaluate` and `collect` say it."""
    rows = None if came.rows is None else Experience(Transition(*came.rows), None)
    return _evaluated(came), rows


def _part(
    env: AbstractHostEnvironment,
    population: PyTree,
    episodes: int,
    wanted: Int[Array, ""] | int,
    common: bool,
    record: bool,
    limit: Any = None,
    *,
    key: PRNGKeyArray,
) -> playing.Part:
    """Episodes as they are asked for."""
    drawn = playing.draw((tree.size(population), episodes), common, key)
    worlds, policies = map(np.asarray, drawn)
    limit = None if limit is None else int(limit)
    return playing.Part(env, population, worlds, policies, int(wanted), record, limit)


def _evaluated(came: playing.Outcome) -> Evaluation:
    return Evaluation(*jax.tree.map(jnp.asarray, (came.returns, came.steps)))


@devices.shared
def _answer_these(task: AbstractSequenceTask, members: tuple[PyTree, Sequence]) -> Evaluation:
    """Answer labelled sequences with a population of features-first policies.

    The population is packed on the last axis and the sequences on the one before, so that every
    operation is one contiguous loop; the arithmetic is that of one policy.
    Memory does not grow with the sequences' length beyond the sequences themselves.

    **Arguments:** `members`: policies `[pop]` and sequences `[pop or 1, episodes]`; 1 gives all
    the same ones.
    """
    population, sequences = members
    pop = tree.size(population)
    packed = pack(population)
    # [pop or 1, episodes, time, ...] -> [time, ..., episodes, pop or 1]
    inputs, targets, scored = (
        jnp.moveaxis(x, (1, 0), (-2, -1))
        for x in (sequences.inputs, sequences.targets, sequences.scored)
    )
    wide = several(sequences)
    width = targets.shape[1] if wide else 1
    lengths = sequences.length.T
    lanes = (lengths.shape[0], pop)
    carry = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (x.shape[0], *lanes)), packed.start(key=None)
    )

    def body(t, loop):
        x, carry, fitness, rights, perfect = loop
        action, carry = packed(jnp.broadcast_to(x, (len(x), *lanes)), carry)
        target, counts = targets[t], scored[t]
        answer = action if wide else action[0]
        right = correct(answer, target)
        all_right = jnp.all(right, axis=0) if wide else right
        perfect = perfect & (~counts | all_right)
        reward = task.reward(answer, target, counts, perfect)
        fitness = fitness + jnp.where(t < lengths, reward, 0.0)
        hits = jnp.sum(right.astype(jnp.int32), axis=0) if wide else right.astype(jnp.int32)
        rights = rights + jnp.where(counts, hits, 0)
        return inputs[t + 1], carry, fitness, rights, perfect

    # The next input is part of the state: XLA does not vectorize products with a slice of all
    # inputs, and the test of one network takes eight times longer.
    start = (inputs[0], carry)
    start += (jnp.zeros(lanes), jnp.zeros(lanes, jnp.int32), jnp.ones(lanes, bool))
    *_, fitness, rights, perfect = jax.lax.fori_loop(0, jnp.max(lengths), body, start)
    asked = width * jnp.sum(scored.astype(jnp.int32), axis=0)
    returns = {
        "fitness": fitness.T,
        "accuracy": (rights.astype(jnp.float32) / asked.astype(jnp.float32)).T,
        "success": perfect.T.astype(jnp.float32),
    }
    return Evaluation(returns, jnp.broadcast_to(lengths.T, (pop, lanes[0])))


@jit
def remembered(
    task: AbstractSequenceTask, population: PyTree, episodes: int, *, key: PRNGKeyArray
) -> tuple[PyTree, Int[Array, " episodes"]]:
    """The carries of features-first policies behind the last step of fresh sequences, the same for
    all: leaves `[features, episodes, pop]`; and the lengths of these."""
    sequences = jax.vmap(lambda key: task.sample(key=key))(jax.random.split(key, episodes))
    inputs = jnp.moveaxis(sequences.inputs, 0, -1)[..., None]  # [time, features, episodes, 1]
    lengths, packed = sequences.length[:, None], pack(population)
    lanes = (episodes, tree.size(population))
    start = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (x.shape[0], *lanes)), packed.start(key=None)
    )

    def body(t, loop):
        x, carry = loop  # the input as in `_answer_these`
        _, later = packed(jnp.broadcast_to(x, (len(x), *lanes)), carry)
        carry = jax.tree.map(lambda new, old: jnp.where(t < lengths, new, old), later, carry)
        return inputs[t + 1], carry

    _, carry = jax.lax.fori_loop(0, jnp.max(lengths), body, (inputs[0], start))
    return carry, sequences.length


def pack(population: PyTree) -> PyTree:
    """Weights `[pop, *shape]` as `[*shape, 1, pop]`: features first, population last."""
    return jax.tree.map(
        lambda x: jnp.moveaxis(x, 0, -1)[..., None, :] if eqx.is_array(x) else x, population
    )
