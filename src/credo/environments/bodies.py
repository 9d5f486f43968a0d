"""What tasks of simulated bodies in JAX have in common: Brax and MuJoCo Playground speak alike.

A state holds its observation, `reward` and `done`, which terminates an episode; the clock is not
the environment's and truncates. Their wrappers are not used.
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from ..types import TimeStep
from . import others


class Made(NamedTuple):
    """An environment, whose functions are traced once for all programs that play it."""

    reset: Callable[[PRNGKeyArray], Any]
    step: Callable[[Any, Array], Any]
    form: others.Form


def made(load: Callable[[], Any], name: str, max_steps: int, repeat: int = 1) -> Made:
    """The environment that `load` returns, each of whose actions is played `repeat` times, for
    `max_steps` steps of these. `ValueError` of what the environment does not have, and of one that
    fails with the JAX that is here, as does the swimmer of Brax 0.14."""

    def step(state: Any, action: Array) -> Any:
        state, rewards = jax.lax.scan(
            lambda state, _: _one(env, state, action), state, length=repeat
        )
        return state.replace(reward=rewards.sum())

    try:
        with others.making():
            env = load()
            size = int(env.action_size)
        functions = jax.jit(env.reset), jax.jit(env.step if repeat == 1 else step)
        with others.permissive():
            state = jax.eval_shape(functions[0], jax.random.key(0))
            state = jax.eval_shape(functions[1], state, jnp.zeros(size))
            seen = jax.eval_shape(_seen, state.obs)
    except (KeyError, TypeError) as error:
        raise ValueError(f"{name} was not made: {error}") from error
    return Made(*functions, others.Form(seen.size, size, max_steps=max_steps))


def _one(env: Any, state: Any, action: Array) -> tuple[Any, Float[Array, ""]]:
    """One step and its reward; nothing moves or is paid behind an end."""
    new = others.like(env.step(state, action), state)
    new = jax.tree.map(lambda x, y: jnp.where(state.done > 0.5, x, y), state, new)
    return new, jnp.where(state.done > 0.5, 0.0, new.reward)


def _seen(obs: PyTree) -> Float[Array, " obs"]:
    """What a policy may see: of several observations that named `state`, for others are what a
    critic alone may know."""
    return others.flat(obs["state"] if isinstance(obs, dict) and "state" in obs else obs)


class BodiesState(eqx.Module):
    """A task of simulated bodies between two steps."""

    inner: PyTree  # its own state
    step: Int[Array, ""]


class AbstractBodies(others.AbstractOther):
    """A task of simulated bodies. The one signal is `reward`. A simulation that diverges ends its
    episode; what is not a number in its last observation and reward is 0."""

    signals: ClassVar[tuple[str, ...]] = ("reward",)

    @property
    @abc.abstractmethod
    def _made(self) -> Made:
        """The environment."""

    def reset(self, *, key: PRNGKeyArray) -> tuple[BodiesState, TimeStep]:
        with others.permissive():
            inner = self._made.reset(key)
        inner, no = jax.tree.map(jnp.asarray, inner), jnp.bool_(False)
        now = TimeStep(_seen(inner.obs), {"reward": jnp.float32(0.0)}, no, no)
        return BodiesState(inner, jnp.int32(0)), now

    def step(
        self, state: BodiesState, action: Float[Array, " act"], *, key: PRNGKeyArray
    ) -> tuple[BodiesState, TimeStep]:
        with others.permissive():
            inner = others.like(self._made.step(state.inner, action), state.inner)
        state = BodiesState(inner, state.step + 1)
        obs, reward = _seen(inner.obs), inner.reward.astype(jnp.float32)
        finite = jnp.isfinite(obs).all() & jnp.isfinite(reward)
        obs, reward = (jnp.where(jnp.isfinite(x), x, 0.0) for x in (obs, reward))
        over = (inner.done > 0.5) | ~finite
        now = TimeStep(obs, {"reward": reward}, over, jnp.bool_(False))
        return state, now.cut(state.step >= self.max_steps)
