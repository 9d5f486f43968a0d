"""Tasks of Brax (Freeman et al. 2021), simulated bodies in JAX.

    task = Brax("halfcheetah")  # credo train ppo brax:halfcheetah

Needs brax. It is compiled with its policies into one program, like a task of our own. Its wrappers
are not used: an episode ends where it ends, and `terminated` and `truncated` are told apart.
"""

import functools
import importlib.util
from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from .. import require
from ..types import TimeStep
from . import others
from .adapters import hear_mujoco

if importlib.util.find_spec("brax") is None:
    raise ModuleNotFoundError("tasks of Brax need it: `pip install brax`")

with others.importing():
    from brax import envs  # pyright: ignore[reportMissingImports]


class _Made(NamedTuple):
    """An environment, whose functions are traced once for all programs that play it."""

    reset: Callable[[PRNGKeyArray], Any]
    step: Callable[[Any, Array], Any]
    form: others.Form


@functools.cache
def _made(id: str, backend: str, settings: tuple[tuple[str, Any], ...]) -> _Made:
    """An environment by its name. `ValueError` of a setting or a backend that it does not have, and
    of one that fails with the JAX that is here, as does the swimmer of Brax 0.14."""
    hear_mujoco()
    try:
        with others.making():
            env = envs.get_environment(id, backend=backend, **dict(settings))
            reset, step, size = jax.jit(env.reset), jax.jit(env.step), int(env.action_size)
        with others.permissive():
            state = jax.eval_shape(reset, jax.random.key(0))
            obs = jax.eval_shape(step, state, jnp.zeros(size)).obs
    except TypeError as error:
        raise ValueError(f"{id} was not made: {error}") from error
    return _Made(reset, step, others.Form(obs.shape[-1], size))


class BraxState(eqx.Module):
    """A task of Brax between two steps."""

    inner: PyTree  # its own state
    step: Int[Array, ""]


class Brax(others.AbstractOther):
    """A task of `brax.envs`. The one signal is `reward`. Its `done` terminates an episode, and the
    clock, of 1,000 steps, truncates it."""

    signals: ClassVar[tuple[str, ...]] = ("reward",)

    backend: Literal["generalized", "mjx", "positional", "spring"] = eqx.field(
        static=True, default="generalized"
    )
    """The physics. `generalized`, Brax's own default, moves joints by their angles; so does `mjx`,
    MuJoCo's, the slowest on a CPU. `positional` and `spring` move bodies that joints pull together,
    mostly with other time steps and gears: policies and returns of one are none of another."""

    def __check_init__(self):
        require.literals(self)
        require.choice("id", self.id, envs._envs)
        _ = self._made

    @property
    def _made(self) -> _Made:
        return _made(self.id, self.backend, self.kwargs)

    @property
    def form(self) -> others.Form:
        return self._made.form

    def reset(self, *, key: PRNGKeyArray) -> tuple[BraxState, TimeStep]:
        with others.permissive():
            inner = self._made.reset(key)
        inner, no = jax.tree.map(jnp.asarray, inner), jnp.bool_(False)
        now = TimeStep(others.flat(inner.obs), {"reward": jnp.float32(0.0)}, no, no)
        return BraxState(inner, jnp.int32(0)), now

    def step(
        self, state: BraxState, action: Float[Array, " act"], *, key: PRNGKeyArray
    ) -> tuple[BraxState, TimeStep]:
        with others.permissive():
            inner = others.like(self._made.step(state.inner, action), state.inner)
        state = BraxState(inner, state.step + 1)
        rewards = {"reward": inner.reward.astype(jnp.float32)}
        now = TimeStep(others.flat(inner.obs), rewards, inner.done > 0.5, jnp.bool_(False))
        return state, now.cut(state.step >= self.max_steps)
