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
    endings: list[str] = dataclasses.field(default_factory=list)
    """Of episodes whose failures are judged elsewhere: "", or why one failed."""


def play(part: Part) -> Outcome:
    """Play it here."""
    shape = part.worlds.shape
    form, arrays = apart(part.population)
    first = start(form, arrays, jnp.asarray(part.policies))
    told = Episodes(part.env, part.worlds.size, part.record, part.limit)
    for turn in part.env.turns(np.tile(np.arange(shape[1]) < part.wanted, shape[0])):
        obs, carry = told.begin(part.worlds.reshape(-1), turn), first
        while told.ongoing:
            action, carry = act(form, arrays, obs, carry)
            obs = told.advance(np.asarray(action))
    returns = {name: x.reshape(*shape, *x.shape[1:]) for name, x in told.returns().items()}
    rows = told.rows() if part.record else None
    return Outcome(returns, told.steps.reshape(shape), rows)


def split(part: Part, most: int) -> list[Part]:
    """The same in at most so many parts, of two members or more: a lone member would be computed by
    another program, that may differ in the last bit."""
    members = len(part.worlds)
    number = max(1, min(most, members // 2))
    ends = [members * (i + 1) // number for i in range(number)]
    return [_some(part, slice(a, b)) for a, b in zip([0, *ends], ends, strict=False)]


def _some(part: Part, members: slice) -> Part:
    chosen = jax.tree.map(lambda x: x[members] if eqx.is_array(x) else x, part.population)
    worlds, policies = part.worlds[members], part.policies[members]
    return dataclasses.replace(part, population=chosen, worlds=worlds, policies=policies)


def joined(outcomes: Sequence[Outcome]) -> Outcome:
    """The parts of one again, in order."""
    if len(outcomes) == 1:
        return outcomes[0]
    parts = [(x.returns, x.steps, x.rows) for x in outcomes]
    endings = [why for x in outcomes for why in x.endings]
    returns, steps, rows = jax.tree.map(lambda *xs: np.concatenate(xs), *parts)
    return Outcome(returns, steps, rows, endings)


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


@functools.partial(jax.jit, static_argnums=0)
def act(form: Form, arrays, obs: Array, carry: PyTree):
    """Actions, one lane behind the other, and carries."""
    pop = next(x.shape[0] for x in arrays if x is not None)
    obs = obs.reshape(pop, -1, *obs.shape[1:]).astype(jnp.float32)
    actions, carry = acted(form.filled(arrays), obs, carry)
    return actions.reshape(-1, *actions.shape[2:]), carry


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
    """Actions and carries of all lanes."""
    return eqx.filter_vmap(
        lambda p, obs, carries: jax.vmap(lambda x, carry: p(x, carry))(obs, carries)
    )(population, obs, carries)
