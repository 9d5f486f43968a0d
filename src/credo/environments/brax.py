"""Tasks of Brax (Freeman et al. 2021), simulated bodies in JAX.

    task = Brax("halfcheetah")  # credo train ppo brax:halfcheetah

Needs brax. It is compiled with its policies into one program, like a task of our own.
"""

import functools
import importlib.util
from typing import Any, Literal

import equinox as eqx

from .. import require
from . import bodies, others
from .makers import hear_mujoco

if importlib.util.find_spec("brax") is None:
    raise ModuleNotFoundError("tasks of Brax need it: `pip install 'credo[brax]'`")

with others.importing():
    from brax import envs  # pyright: ignore[reportMissingImports]


@functools.cache
def _made(id: str, backend: str, settings: tuple[tuple[str, Any], ...]) -> bodies.Made:
    """An environment by its name, with these settings."""
    hear_mujoco()

    def load() -> Any:
        return envs.get_environment(id, backend=backend, **dict(settings))

    return bodies.made(load, id, others.MOST_STEPS)


class Brax(bodies.AbstractBodies):
    """A task of `brax.envs`, for 1,000 steps."""

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
    def _made(self) -> bodies.Made:
        return _made(self.id, self.backend, self.kwargs)
