"""Playing episodes: the only place where a policy meets an environment."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from . import tree
from .compilation import jit
from .environments.base import AbstractEnvironment, AbstractSequenceTask, correct
from .networks.base import AbstractPolicy
from .types import Evaluation, Sequence


@jit
def evaluate(
    env: AbstractEnvironment,
    population: PyTree,
    episodes: int,
    *,
    common: bool = True,
    key: PRNGKeyArray,
) -> Evaluation:
    """Play `episodes` episodes with every member of a population.

    **Arguments:** `common` gives all members the same worlds, so that a ranking compares members
    and not luck; otherwise each member draws its own.
    """
    pop = tree.size(population)
    world_key, policy_key = jax.random.split(key)
    if common:
        keys = jnp.broadcast_to(jax.random.split(world_key, episodes), (pop, episodes))
    else:
        keys = jax.random.split(world_key, (pop, episodes))
    if isinstance(env, AbstractSequenceTask) and getattr(population, "features_first", False):
        drawn = keys[:1] if common else keys
        # An episode resets with the first half of its world key: the same sequences either way.
        sample = jax.vmap(jax.vmap(lambda key: env.sample(key=jax.random.split(key)[0])))
        sequences = sample(drawn)
        return play_sequences(env, population, sequences)
    play = eqx.filter_vmap(
        eqx.filter_vmap(
            lambda policy, world, key: episode(env, policy, world_key=world, policy_key=key),
            in_axes=(None, 0, 0),
        )
    )
    returns, steps = play(population, keys, jax.random.split(policy_key, (pop, episodes)))
    return Evaluation(returns, steps)


def episode(
    env: AbstractEnvironment,
    policy: AbstractPolicy,
    *,
    world_key: PRNGKeyArray,
    policy_key: PRNGKeyArray,
) -> tuple[dict[str, Float[Array, "..."]], Int[Array, ""]]:
    """Play one episode to its end: the undiscounted return of every signal, and its steps."""
    reset_key, step_key = jax.random.split(world_key)
    state, time_step = env.reset(key=reset_key)
    returns = jax.tree.map(jnp.zeros_like, time_step.rewards)
    start = (state, time_step, policy.start(key=policy_key), returns, jnp.int32(0))

    def ongoing(loop):
        _, time_step, _, _, steps = loop
        ended = time_step.terminated | time_step.truncated
        return ~ended & (steps < env.max_steps)

    def advance(loop):
        state, time_step, carry, returns, steps = loop
        action, carry = policy(time_step.obs, carry)
        key = jax.random.fold_in(step_key, steps)
        state, time_step = env.step(state, action, key=key)
        returns = jax.tree.map(jnp.add, returns, time_step.rewards)
        return state, time_step, carry, returns, steps + 1

    *_, returns, steps = jax.lax.while_loop(ongoing, advance, start)
    return returns, steps


def play_sequences(
    task: AbstractSequenceTask, population: PyTree, sequences: Sequence
) -> Evaluation:
    """Answer labelled sequences with a population of features-first policies.

    The population is packed on the last axis and the sequences on the one before, so that every
    operation is one contiguous loop; the arithmetic is that of one policy.
    Memory does not grow with the sequences' length beyond the sequences themselves.

    **Arguments:** `sequences` `[pop or 1, episodes]`; 1 gives all members the same ones.
    """
    pop = tree.size(population)
    packed = pack(population)
    # [pop or 1, episodes, time, ...] -> [time, ..., episodes, pop or 1]
    inputs = jnp.transpose(sequences.inputs, (2, 3, 1, 0))
    targets, scored = (jnp.transpose(x, (2, 1, 0)) for x in (sequences.targets, sequences.scored))
    lengths = sequences.length.T
    lanes = (lengths.shape[0], pop)
    carry = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (x.shape[0], *lanes)), packed.start(key=None)
    )

    def body(t, loop):
        carry, fitness, rights, perfect = loop
        x = jnp.broadcast_to(inputs[t], (inputs.shape[1], *lanes))
        answer, carry = packed(x, carry)
        target, counts = targets[t], scored[t]
        right = correct(answer[0], target)
        perfect = perfect & (~counts | right)
        reward = task.reward(answer[0], target, counts, perfect)
        fitness = fitness + jnp.where(t < lengths, reward, 0.0)
        return carry, fitness, rights + (counts & right).astype(jnp.int32), perfect

    start = (carry, jnp.zeros(lanes), jnp.zeros(lanes, jnp.int32), jnp.ones(lanes, bool))
    _, fitness, rights, perfect = jax.lax.fori_loop(0, jnp.max(lengths), body, start)
    asked = jnp.sum(scored.astype(jnp.int32), axis=0)
    returns = {
        "fitness": fitness.T,
        "accuracy": (rights.astype(jnp.float32) / asked.astype(jnp.float32)).T,
        "success": perfect.T.astype(jnp.float32),
    }
    return Evaluation(returns, jnp.broadcast_to(lengths.T, (pop, lanes[0])))


def pack(population: PyTree) -> PyTree:
    """Weights `[pop, *shape]` as `[*shape, 1, pop]`: features first, population last."""
    return jax.tree.map(
        lambda x: jnp.moveaxis(x, 0, -1)[..., None, :] if eqx.is_array(x) else x, population
    )


@jit
def trace(policy: AbstractPolicy, inputs: Float[Array, "time in"]):
    """Feed inputs to one policy and keep everything.

    **Returns:** actions `[time, act]` and the carry after each step, leaves `[time, ...]`.
    """

    def body(carry, x):
        action, carry = policy(x, carry)
        return carry, (action, carry)

    return jax.lax.scan(body, policy.start(key=jax.random.key(0)), inputs)[1]
