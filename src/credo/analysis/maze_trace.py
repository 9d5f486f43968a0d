"""What a finished team does in one episode of the Extended T-Maze, trial by trial."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from ..compilation import jit
from ..environments.extended_tmaze import ExtendedTMaze
from ..networks.base import AbstractPolicy
from ..networks.team import TeamPolicy
from ..rollout import world_keys
from .memory import memory_of


class MazeTrace(eqx.Module):
    """An episode of T-maze robots. A robot is told of a trial at the start of the next one."""

    goal: Int[Array, " trials"]  # the endpoint with the reward
    observed: Bool[Array, " trials"]  # whether the team observed it
    endpoint: Int[Array, "trials robots"]  # of those that learn
    partner: Int[Array, " trials"] | None  # the endpoint of the static robot; None: there is none
    company: Bool[Array, "trials robots"]  # as told, by the rule of the task's `presence`
    reward: Bool[Array, "trials robots"]  # as told, by the rule of its `feedback`
    memory: Float[Array, "trials robots cells"] | None
    """With which each robot ends the trial, not yet told of it; None: the policy is no `Team`, or
    its carry is not one that `memory_of` knows."""


def trace_maze(env: ExtendedTMaze, policy: AbstractPolicy, *, key: PRNGKeyArray) -> MazeTrace:
    """The episode that `evaluate(env, tree.stack(policy), 1, key=key)` plays."""
    return _trace_maze(env, policy, key)


@jit
def _trace_maze(env: ExtendedTMaze, policy: AbstractPolicy, key: PRNGKeyArray) -> MazeTrace:
    world_key, policy_key = jax.random.split(key)
    reset_key, step_key = jax.random.split(world_keys(1, 1, True, key=world_key)[0, 0])
    state, first = env.reset(key=reset_key)
    carry = policy.start(key=jax.random.split(policy_key, (1, 1))[0, 0])

    def advance(loop):
        t, state, now, carry = loop
        action, carry = policy(now.obs, carry)
        action = jnp.clip(jnp.where(jnp.isfinite(action), action, 0.0), -1.0, 1.0)
        state, now = env.step(state, action, key=jax.random.fold_in(step_key, t))
        return t + 1, state, now, carry

    def walk(loop, trial):
        partner = loop[1].partner  # at its end it is already that of the next trial
        loop = jax.lax.while_loop(lambda loop: loop[1].trial == trial, advance, loop)
        _, state, now, carry = loop
        goal, observed = state.goals[trial >> env.depth], now.rewards["score"] > 0.0
        company, reward = now.obs[:, 1] > 0.0, now.obs[:, 2] > 0.0
        seen = (state.endpoint, partner, company, reward, _memory(policy, carry))
        return loop, (goal, observed, *seen)

    start = (jnp.int32(0), state, first, carry)
    return MazeTrace(*jax.lax.scan(walk, start, jnp.arange(env.trials))[1])


def _memory(policy: AbstractPolicy, carry: PyTree) -> Float[Array, "robots cells"] | None:
    known = eqx.is_array(carry) or (isinstance(carry, tuple) and len(carry) == 2)
    return memory_of(carry) if known and isinstance(policy, TeamPolicy) else None
