"""Episodes outside JAX: what some members of a population play, in this process or in another.

A `Part` says it all: who plays, which worlds, and the keys of what policies draw. Whoever plays it,
and whatever else is played beside it, the bits are the same; so parts can be shared out among
processes, and played again where one of these died.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree, UInt32

from ..environments.host import AbstractHostEnvironment, Episodes


@dataclasses.dataclass(frozen=True)
class Part:
    """Members that play, in arrays of NumPy.

    `policies`: the data of a key for each episode, by which a policy starts. Of its episodes each
    member plays the first `wanted`, of `limit` steps at most; None: as many as the task has.
    `record`: whether transitions are kept.
    """

    env: AbstractHostEnvironment
    population: PyTree  # leaves [members, ...]
    worlds: UInt32[np.ndarray, "members episodes"]
    policies: UInt32[np.ndarray, "members episodes 2"]
    wanted: int
    record: bool
    limit: int | None = None


@dataclasses.dataclass
class Outcome:
    """What came of a part."""

    returns: dict[str, Float[np.ndarray, "members episodes *agents"]]
    steps: Int[np.ndarray, "members episodes"]
    rows: tuple[Any, ...] | None
    """The fields of a `Transition`, one episode behind the other, member by member; None if they
    were not recorded."""


class _Group:
    """A part as it is played beside others: its policies, and which of all lanes are theirs."""

    def __init__(self, part: Part, first: int):
        self.lanes = slice(first, first + part.worlds.size)
        self._form, arrays = apart(part.population)
        self._arrays = jax.device_put(arrays)  # once, not at every step
        self._start = start(self._form, self._arrays, jnp.asarray(part.policies))
        _, actions, *team = part.env.sizes
        self._idle = np.zeros((part.worlds.size, *team, actions), np.float32)
        self.memory = self._nothing(part) if part.record else None
        """What its policies remembered before the last step; None: nothing ever."""
        self.begin()

    def _nothing(self, part: Part) -> np.ndarray | None:
        """What they remember, as zeros."""
        first = _first(self._form, tuple(x if x is None else _form_of(x) for x in self._arrays))
        if first is None:
            return None
        return np.zeros((part.worlds.size, *first.shape[1:]), first.dtype)

    def begin(self) -> None:
        """The memories with which a turn begins."""
        self._carry = self._start

    def act(self, obs: np.ndarray, active: np.ndarray) -> Any:
        """Actions of its lanes, which may still be under way; zeros where none is active."""
        if not active[self.lanes].any():
            return self._idle
        remembers = self.memory is not None
        given = (self._form, self._arrays, obs[self.lanes], self._carry, remembers)
        action, self._carry, self.memory = act(*given)
        return action


def _form_of(x: Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape, x.dtype)


@functools.lru_cache(maxsize=256)  # to find out takes as long as to play twenty steps
def _first(
    form: "Form", arrays: tuple[jax.ShapeDtypeStruct | None, ...]
) -> jax.ShapeDtypeStruct | None:
    """The form of what a population remembers at the start of an episode."""
    first = eqx.filter_vmap(lambda one: one.first())
    return jax.eval_shape(lambda arrays: first(form.filled(list(arrays))), arrays)


def play(parts: Sequence[Part]) -> list[Outcome]:
    """Play parts of one task here. All take each step together, so that it is asked once."""
    env, sizes = parts[0].env, [part.worlds.size for part in parts]
    groups = [_Group(part, sum(sizes[:i])) for i, part in enumerate(parts)]
    record = np.repeat([part.record for part in parts], sizes)
    limits = [env.max_steps if part.limit is None else part.limit for part in parts]
    told = Episodes(env, sum(sizes), record, np.repeat(limits, sizes))
    wanted = [np.tile(np.arange(p.worlds.shape[1]) < p.wanted, len(p.worlds)) for p in parts]
    turns = env.turns(np.concatenate(wanted))
    for turn in turns:  # more are added below
        obs = told.begin(np.concatenate([part.worlds.reshape(-1) for part in parts]), turn)
        for group in groups:
            group.begin()
        while told.ongoing:
            actions = [group.act(obs, told.active) for group in groups]
            actions = np.concatenate(actions) if len(groups) > 1 else np.asarray(*actions)
            obs = told.advance(actions, _memory(groups))
        if told.again.any():
            turns.append(told.again)
    return [_outcome(part, told, group) for part, group in zip(parts, groups, strict=True)]


def _memory(groups: Sequence[_Group]) -> np.ndarray | None:
    """What the policies of all lanes remembered before a step; zeros of those that are not
    recorded, and None if there is nothing."""
    shape = next((group.memory.shape[1:] for group in groups if group.memory is not None), None)
    if shape is None:
        return None
    none = [np.zeros((x.lanes.stop - x.lanes.start, *shape), np.float32) for x in groups]
    pairs = zip(groups, none, strict=True)
    return np.concatenate([zero if x.memory is None else x.memory for x, zero in pairs])


def _outcome(part: Part, told: Episodes, group: _Group) -> Outcome:
    """What came of a group's lanes."""
    lanes = group.lanes
    shape = part.worlds.shape
    returns = {name: x[lanes].reshape(*shape, *x.shape[1:]) for name, x in told.returns().items()}
    rows = told.rows(lanes) if part.record else None
    if rows is not None and group.memory is None:  # others did, who were played beside it
        rows = (*rows[:-1], None)
    return Outcome(returns, told.steps[lanes].reshape(shape), rows)


Share = list[tuple[int, int, int]]
"""What one process plays: of which part, from which member on, and up to which."""


def shared(parts: Sequence[Part], most: int) -> list[Share]:
    """Parts shared out among at most so many processes, about as many episodes to each.

    A population is cut between its members, two or more to a slice: a lone member would be computed
    by another program, that may differ in the last bit. A single policy is played by one process.
    """
    load, shares = [0] * most, list[Share]([] for _ in range(most))
    for i, part in sorted(
        enumerate(parts), key=lambda x: (len(x[1].worlds) > 1, -x[1].worlds.size)
    ):
        members, episodes = part.worlds.shape
        counts = _dealt(members, episodes, load)
        load = [old + episodes * count for old, count in zip(load, counts, strict=True)]
        for k, count in enumerate(counts):
            done = sum(counts[:k])
            if count:
                shares[k].append((i, done, done + count))
    return [share for share in shares if share]


def _dealt(members: int, episodes: int, load: Sequence[int]) -> list[int]:
    """How many of some members each process plays, to whom so many episodes are given already."""
    counts = [0] * len(load)

    def busy(k: int) -> tuple[int, bool]:
        return load[k] + episodes * counts[k], load[k] > 0  # two parts cost more than one

    for _ in range(members):
        counts[min(range(len(load)), key=busy)] += 1
    while members > 1 and 1 in counts:
        lone = counts.index(1)
        others = [k for k, count in enumerate(counts) if count and k != lone]
        rich = [k for k in others if counts[k] > 2]
        heir, giver = min(others, key=busy), max(rich, key=busy, default=None)
        if giver is None or busy(heir) <= busy(lone):
            counts[heir], counts[lone] = counts[heir] + 1, 0
        else:
            counts[giver], counts[lone] = counts[giver] - 1, 2
    return counts


def cut(parts: Sequence[Part], share: Share) -> list[Part]:
    """The slices of a share."""
    return [_some(parts[i], slice(first, last)) for i, first, last in share]


def _some(part: Part, members: slice) -> Part:
    chosen = jax.tree.map(lambda x: x[members] if eqx.is_array(x) else x, part.population)
    worlds, policies = part.worlds[members], part.policies[members]
    return dataclasses.replace(part, population=chosen, worlds=worlds, policies=policies)


def joined(outcomes: Sequence[Outcome]) -> Outcome:
    """The slices of one part again, in order."""
    if len(outcomes) == 1:
        return outcomes[0]
    parts = [(x.returns, x.steps, x.rows) for x in outcomes]
    return Outcome(*jax.tree.map(lambda *xs: np.concatenate(xs), *parts))


@dataclasses.dataclass(frozen=True)
class Form:
    """A population without its arrays: what a program is compiled for. `equinox.filter_jit` would
    look at every leaf anew at every step, which takes longer than the step."""

    structure: Any
    rest: tuple[Any, ...]

    def filled(self, arrays: list[Array | None]) -> PyTree:
        """The population again."""
        leaves = [x if y is None else y for x, y in zip(arrays, self.rest, strict=True)]
        return jax.tree.unflatten(self.structure, leaves)


def apart(population: PyTree) -> tuple[Form, list[Array | None]]:
    """A population as its form and its arrays."""
    leaves, structure = jax.tree.flatten(population)
    arrays = [x if eqx.is_array(x) else None for x in leaves]
    return Form(structure, tuple(None if eqx.is_array(x) else x for x in leaves)), arrays


@functools.partial(jax.jit, static_argnums=(0, 1))
def draw(shape: tuple[int, int], common: bool, key: PRNGKeyArray):
    """Seeds of the worlds, and the data of the policies' keys, of all lanes `shape`."""
    world_key, policy_key = jax.random.split(key)
    seeds = each(jax.random.bits)(world_keys(*shape, common, key=world_key))
    return seeds, jax.random.key_data(jax.random.split(policy_key, shape))


@functools.partial(jax.jit, static_argnums=0)
def start(form: Form, arrays, policies: Array):
    """The carries of all lanes."""
    return started(form.filled(arrays), jax.random.wrap_key_data(policies))


@functools.partial(jax.jit, static_argnums=(0, 4))
def act(form: Form, arrays, obs: Array, carry: PyTree, record: bool = False):
    """Actions, one lane behind the other, carries, and what was remembered before, if that is to be
    recorded and anything was."""
    pop = next(x.shape[0] for x in arrays if x is not None)
    obs = obs.reshape(pop, -1, *obs.shape[1:]).astype(jnp.float32)
    actions, carry, memory = acted(form.filled(arrays), obs, carry)
    actions, memory = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (actions, memory))
    return actions, carry, memory if record else None


def world_keys(pop: int, episodes: int, common: bool, *, key: PRNGKeyArray) -> PRNGKeyArray:
    """A key per member and episode: what happens in the world, whoever acts."""
    if common:
        return jnp.broadcast_to(jax.random.split(key, episodes), (pop, episodes))
    return jax.random.split(key, (pop, episodes))


def each(function):
    """`function` of one lane for lanes `[pop, episodes]`."""
    return jax.vmap(jax.vmap(function))


def started(population: PyTree, keys: PRNGKeyArray) -> PyTree:
    """Carries of all lanes; keys `[pop, episodes]`."""
    return eqx.filter_vmap(lambda p, keys: jax.vmap(lambda key: p.start(key=key))(keys))(
        population, keys
    )


def acted(population: PyTree, obs: Float[Array, "pop episodes obs"], carries: PyTree):
    """Actions and next carries of all lanes, and what they remembered before."""

    def one(policy, obs, carries):
        return jax.vmap(lambda x, own: (*policy(x, own), policy.remembered(own)))(obs, carries)

    return eqx.filter_vmap(one)(population, obs, carries)
