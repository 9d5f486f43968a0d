"""Tasks of gymnax (Lange 2022), in JAX.

    task = Gymnax("CartPole-v1")  # credo train ppo gymnax:CartPole-v1

Needs gymnax 1.0 or later. It is compiled with its policies into one program, like a task of our
own. Its automatic resets are not used: an episode ends where it ends, and `terminated` and
`truncated` are told apart.
"""

import functools
import importlib.metadata
import importlib.util
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .. import require
from ..types import TimeStep
from . import others
from .base import AbstractEnvironment


def _old() -> str | None:
    """The version of gymnax, if it is one that speaks otherwise."""
    version = importlib.metadata.version("gymnax")
    return version if version.startswith("0.") else None


if importlib.util.find_spec("gymnax") is None:
    raise ModuleNotFoundError(
        "tasks of gymnax need it, and a Gymnasium below 1.4: `pip install gymnax six` in an "
        "environment of their own"
    )

if version := _old():
    raise ModuleNotFoundError(
        f"tasks of gymnax need 1.0 or later, and {version} is installed, which JaxMARL wants: "
        "make an environment of their own, with `pip install gymnax six`"
    )

try:
    with others.importing():
        import gymnax  # pyright: ignore[reportMissingImports]
        from gymnax.environments import spaces  # pyright: ignore[reportMissingImports]
except ModuleNotFoundError as error:  # 1.0.1 does not name all that it imports
    raise ModuleNotFoundError(f"gymnax needs {error.name}: `pip install {error.name}`") from error


@functools.cache
def _made(id: str, settings: tuple[tuple[str, Any], ...]) -> tuple[Any, Any]:
    """The environment, and its parameters with these settings."""
    with others.permissive():
        env, params = gymnax.make(id)
    known = [name for name in vars(params) if not name.startswith("_")]
    for name, _ in settings:
        require.choice("setting", name, known)
    return env, params.replace(**dict(settings))


class Gymnax(AbstractEnvironment):
    """An environment of gymnax with Box or Discrete actions.

    Observations are flattened, a Discrete one is one-hot. Of a Box action -1 is its low and 1 its
    high; of Discrete actions the largest number is taken. The one signal is `reward`. The clock is
    the environment's own, `max_steps_in_episode`.
    """

    signals: ClassVar[tuple[str, ...]] = ("reward",)

    id: str = eqx.field(static=True)  # as in gymnax.registered_envs, such as CartPole-v1
    kwargs: tuple[tuple[str, Any], ...] = eqx.field(static=True, converter=others.pairs, default=())
    """Parameters of the environment by name, such as max_steps_in_episode; others stay."""

    def __check_init__(self):
        known = gymnax.registered_envs
        require.choice("id", self.id, known)
        action = self._env.action_space(self._params)
        if not isinstance(action, spaces.Box | spaces.Discrete):
            raise ValueError(
                f"{self.id} has actions of {type(action).__name__}: a Box or a Discrete is needed"
            )

    @property
    def _env(self) -> Any:
        return _made(self.id, self.kwargs)[0]

    @property
    def _params(self) -> Any:
        return _made(self.id, self.kwargs)[1]

    @property
    def obs_size(self) -> int:
        return _size(self._env.observation_space(self._params))

    @property
    def action_size(self) -> int:
        return _size(self._env.action_space(self._params))

    @property
    def choices(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        space = self._env.action_space(self._params)
        return (int(space.n),) if isinstance(space, spaces.Discrete) else ()

    @property
    def image(self) -> tuple[int, int, int, int] | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        shape = getattr(self._env.observation_space(self._params), "shape", ())
        if len(shape) != 3:
            return None
        height, width, channels = map(int, shape)
        return 0, height, width, channels

    @property
    def max_steps(self) -> int:
        return int(self._params.max_steps_in_episode)

    def reset(self, *, key: PRNGKeyArray) -> tuple[PyTree, TimeStep]:
        with others.permissive():
            obs, state = self._env.reset_env(key, self._params)
        state, no = jax.tree.map(jnp.asarray, state), jnp.bool_(False)  # its clock is a plain 0
        return state, TimeStep(self._flat(obs), {"reward": jnp.float32(0.0)}, no, no)

    def step(
        self, state: PyTree, action: Float[Array, " act"], *, key: PRNGKeyArray
    ) -> tuple[PyTree, TimeStep]:
        with others.permissive():
            obs, state, reward, over, _ = self._env.step_env(
                key, state, self._own(action), self._params
            )
            late = jnp.asarray(self._env.is_truncated(state, self._params), bool)
        over = jnp.asarray(over, bool)
        rewards = {"reward": jnp.asarray(reward, jnp.float32).reshape(())}
        return state, TimeStep(self._flat(obs), rewards, over, late & ~over)

    def _own(self, action: Float[Array, " act"]) -> Any:
        """An action as the environment takes it."""
        space = self._env.action_space(self._params)
        if self.choices:
            return jnp.argmax(action).astype(space.dtype)
        low, high = (np.broadcast_to(x, space.shape) for x in (space.low, space.high))
        return low + (action.reshape(space.shape) + 1.0) / 2.0 * (high - low)

    def _flat(self, obs: Any) -> Float[Array, " obs"]:
        """An observation as numbers."""
        space = self._env.observation_space(self._params)
        if isinstance(space, spaces.Discrete):
            return jax.nn.one_hot(obs, space.n, dtype=jnp.float32)
        parts = [jnp.asarray(x, jnp.float32).reshape(-1) for x in jax.tree.leaves(obs)]
        return jnp.concatenate(parts)


def _size(space: Any) -> int:
    """Numbers in a flat observation or action."""
    if isinstance(space, spaces.Discrete):
        return int(space.n)
    if isinstance(space, spaces.Dict):
        return sum(_size(part) for part in space.spaces.values())
    return int(np.prod(space.shape))
