"""What CCEA with a fitness critic does between a rollout and its ranking: see
`learners.fitness_critic`."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from ..compilation import jit
from ..learners.fitness_critic import AbstractFitnessCritic
from ..normalization import Moments, behind, seen, watched
from ..replay import Replay
from ..rollout import Environment, Experience, blank, collect
from ..types import Evaluation, Transition

Fitness = Float[Array, "teams episodes agents"]


class Criticism(eqx.Module):
    """A critic between two generations, and the steps that it learns from."""

    critic: PyTree
    replay: Replay  # of steps, with the return of their episode as the reward

    @classmethod
    def first(cls, critic: AbstractFitnessCritic, env: Environment, key: PRNGKeyArray) -> Any:
        row = _labelled(blank(env), jnp.float32(0.0))
        return cls(critic.init(*env.sizes, key=key), Replay.empty(row, critic.capacity))


Played = tuple[Evaluation, Moments | None, Criticism, Fitness, Float[Array, ""]]


def judged(ccea: Any, teams: PyTree, state: Any, *, key: PRNGKeyArray) -> Played:
    """Play, let the critic learn from it, and judge.

    **Returns:** the returns, the statistics of observations, critic and buffer, for each agent in
    each episode the most that its critic said of any step, and the critic's error.
    """
    play_key, learn_key = jax.random.split(key)
    acting = behind(state.moments, teams)
    played, experience = collect(ccea.env, acting, ccea.simulations, key=play_key)
    moments = watched(state.moments, experience)
    rows, valid = _in_lanes(experience, played, ccea.env.max_steps)
    given = (ccea.critic, state.criticism, rows, valid, played.returns[ccea.reward], moments)
    criticism, fitness, loss = _learned(*given, key=learn_key)
    return played, moments, criticism, fitness, loss


@jit
def _learned(critic, criticism: Criticism, rows: Transition, valid, returns, moments, *, key):
    shape, steps = returns.shape[:2], len(valid) // (returns.shape[0] * returns.shape[1])
    of_step = jnp.repeat(returns.reshape(-1, *returns.shape[2:]), steps, axis=0)
    # An episode of which nothing is known, its return NaN, has no valid step.
    labelled = _labelled(rows, jnp.where(jnp.isfinite(of_step), of_step, 0.0))
    replay = criticism.replay.extend(labelled, valid)

    def step(i, loop):
        state, total = loop
        drawn, _ = replay.sample(critic.batch_size, key=jax.random.fold_in(key, i))
        seen_rows = (seen(moments, drawn.obs), drawn.action, drawn.rewards["return"], drawn.active)
        state, loss = critic.update(state, *seen_rows)
        return state, total + loss

    dynamic, static = eqx.partition(criticism.critic, eqx.is_array)

    def body(i, loop):
        state, total = step(i, (eqx.combine(loop[0], static), loop[1]))
        return eqx.filter(state, eqx.is_array), total

    known = (replay.size > 0).astype(jnp.int32)
    dynamic, total = jax.lax.fori_loop(0, known * critic.updates, body, (dynamic, jnp.float32(0)))
    state = eqx.combine(dynamic, static)
    said = critic.value(state, seen(moments, rows.obs), rows.action)
    said = jnp.where(valid[:, None], said, -jnp.inf).reshape(*shape, steps, -1)
    return Criticism(state, replay), jnp.max(said, axis=2), total / max(critic.updates, 1)


def _labelled(rows: Transition, returns: Array) -> Transition:
    """Steps as the critic learns from them: what comes next it need not know."""
    ends = (rows.terminated, rows.truncated, rows.active)
    return Transition(rows.obs, rows.action, {"return": returns}, rows.obs[..., :0], *ends)


def _in_lanes(experience: Experience, played: Evaluation, steps: int) -> tuple[Transition, Array]:
    """All episodes with room for `steps` steps each, and which of them there were; from outside JAX
    they come one behind the other, without the lost ones."""
    if experience.valid is not None:
        return experience.transitions, experience.valid
    valid = (np.arange(steps)[None] < experience.lived(played)[:, None]).reshape(-1)

    def spaced(x: Any) -> Array:
        room = np.zeros((len(valid), *x.shape[1:]), x.dtype)
        room[valid] = x
        return jnp.asarray(room)

    return jax.tree.map(spaced, experience.transitions), jnp.asarray(valid)
