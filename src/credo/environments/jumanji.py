"""Tasks of Jumanji (Bonnet et al. 2024), puzzles and routing problems in JAX.

    task = Jumanji("Game2048-v1")

Needs jumanji. It is compiled with its policies into one program, like a task of our own. Its
automatic resets are not used: an episode ends where it ends.
"""

import functools
import importlib.util
import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .. import require
from ..types import TimeStep
from . import others

if importlib.util.find_spec("jumanji") is None:
    raise ModuleNotFoundError("tasks of Jumanji need it: `pip install 'credo[jumanji]'`")

with others.importing():
    import jumanji  # pyright: ignore[reportMissingImports]

LAST = 2  # as dm_env counts: the kind of an episode's last step


class _Made(NamedTuple):
    """An environment, and what all its episodes have in common."""

    spec: Any  # of actions
    reset: Callable[[Array], Any]  # traced once for all programs, as is the next
    step: Callable[[Any, Array], Any]
    options: tuple[int, ...]  # of each number of an action; (): they are no choices
    form: others.Form


@functools.cache
def _made(id: str, settings: tuple[tuple[str, Any], ...]) -> _Made:
    """An environment by its name. `ValueError` of settings that it does not have, and of levels
    that it cannot download."""
    try:
        with others.making():
            env = jumanji.make(id, **dict(settings))
            spec = env.action_spec
        with others.permissive():
            functions = jax.jit(env.reset), jax.jit(env.step)
            _, first = jax.eval_shape(env.reset, jax.random.key_data(jax.random.key(0)))
            seen, mask = jax.eval_shape(_parted, first.observation)
            image = others.image_in(_fields(first.observation))
    except (KeyError, OSError, TypeError) as error:
        raise ValueError(f"{id} was not made: {type(error).__name__}: {error}") from error
    options, choices = _choices(spec, None if mask is None else mask.shape)
    steps = int(getattr(env, "time_limit", None) or others.MOST_STEPS)
    size = sum(choices) or math.prod(spec.shape)
    form = others.Form(seen.size, size, choices, mask is not None, steps, image)
    return _Made(spec, *functions, options, form)


def _parted(observation: Any) -> tuple[Float[Array, " obs"], Bool[Array, "..."] | None]:
    """The numbers of an observation, and its mask of actions, if it has one."""
    return others.flat(_fields(observation)), observation._asdict().get("action_mask")


def _fields(observation: Any) -> dict[str, Any]:
    """What an observation has beside its mask, by name."""
    return {name: x for name, x in observation._asdict().items() if name != "action_mask"}


def _choices(spec: Any, mask: tuple[int, ...] | None) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Options of each number of an action, and the choices that a policy has. A mask has an axis
    for each number, or one row for each."""
    if not jnp.issubdtype(spec.dtype, jnp.integer):
        return (), ()
    options = tuple(int(n) for n in np.ravel(getattr(spec, "num_values", ())))
    if mask is not None and mask == options:
        return options, (math.prod(options),)
    if mask is not None:
        options = (mask[1],) * mask[0]
    return options, options


class PuzzleState(eqx.Module):
    """A task of Jumanji between two steps."""

    inner: PyTree  # its own state
    step: Int[Array, ""]
    allowed: Bool[Array, " options"] | None


class Jumanji(others.AbstractOther):
    """A task of Jumanji; its teams as tasks of one agent, which acts for all and earns their sum.

    Observations are all numbers but the `action_mask`, which is put before them. An action of
    several numbers is as many choices, or a single one among all their combinations where the mask
    is one of combinations. Of a Box action -1 is the low and 1 the high. The one signal is
    `reward`. Jumanji says of most tasks that their clock, `time_limit`, terminates an episode; here
    the step with which it runs out always truncates it.
    """

    signals: ClassVar[tuple[str, ...]] = ("reward",)

    def __check_init__(self):
        require.choice("id", self.id, jumanji.registered_environments())
        _ = self._made

    @property
    def _made(self) -> _Made:
        return _made(self.id, self.kwargs)

    def reset(self, *, key: PRNGKeyArray) -> tuple[PuzzleState, TimeStep]:
        with others.permissive():
            inner, first = self._made.reset(jax.random.key_data(key))
        return self._told(jax.tree.map(jnp.asarray, inner), jnp.int32(0), first)

    def step(
        self, state: PuzzleState, action: Float[Array, " act"], *, key: PRNGKeyArray
    ) -> tuple[PuzzleState, TimeStep]:
        with others.permissive():
            inner, now = self._made.step(state.inner, self._own(action, state.allowed))
        return self._told(others.like(inner, state.inner), state.step + 1, now)

    def _told(self, inner: PyTree, step: Array, now: Any) -> tuple[PuzzleState, TimeStep]:
        """What Jumanji says, as a time step of ours."""
        obs, mask = _parted(now.observation)
        if mask is not None:
            mask = jnp.ravel(mask).astype(bool)
            obs = jnp.concatenate([mask.astype(jnp.float32), obs])
        last, late = now.step_type == LAST, step >= self.max_steps
        ended = last & jnp.all(now.discount == 0.0) & ~late
        reward = {"reward": jnp.sum(now.reward).astype(jnp.float32)}
        return PuzzleState(inner, step, mask), TimeStep(obs, reward, ended, (last & ~ended) | late)

    def _own(self, action: Float[Array, " act"], allowed: Bool[Array, " options"] | None) -> Array:
        """An action as the environment takes it."""
        spec, options = self._made.spec, self._made.options
        if not options:
            return others.scaled(action, spec.minimum, spec.maximum, spec.shape)
        parts = others.chosen(action, self.choices, allowed)
        if self.choices != options:
            parts = jnp.stack(jnp.unravel_index(parts[0], options))
        return parts.reshape(spec.shape).astype(spec.dtype)
