"""Tasks of MuJoCo Playground (Zakka et al. 2025), the DeepMind Control Suite and robots in JAX.

    task = Playground("CheetahRun")  # credo train ppo playground:CheetahRun

Needs playground. It is compiled with its policies into one program, like a task of our own.
"""

import functools
import importlib.util
from collections.abc import Iterator
from typing import Any, Literal

import equinox as eqx
import jax

from .. import require
from . import bodies, others
from .makers import hear_mujoco

if importlib.util.find_spec("mujoco_playground") is None:
    raise ModuleNotFoundError(
        "tasks of MuJoCo Playground need it: `pip install 'credo[playground]'`"
    )

with others.importing():
    from mujoco_playground import registry  # pyright: ignore[reportMissingImports]


def _names(config: Any, start: str = "") -> Iterator[str]:
    """Of all settings, with dots between what is nested."""
    for name, x in config.items():
        inner = _names(x, f"{start}{name}.") if hasattr(x, "items") else (start + name,)
        yield from inner


@functools.cache
def _made(id: str, impl: str, settings: tuple[tuple[str, Any], ...]) -> bodies.Made:
    """An environment by its name, with these settings."""
    hear_mujoco()
    config = registry.get_default_config(id)
    known = [name for name in _names(config) if name != "impl"]  # it has a field of its own
    for name, _ in settings:
        require.choice("setting", name, known)
    new = ({"impl": impl} if "impl" in config else {}) | dict(settings)
    try:
        config.update_from_flattened_dict(new)
    except TypeError as error:
        raise ValueError(f"{id} was not made: {error}") from error
    repeat, length = int(config.action_repeat), int(config.episode_length)
    for name, n in (("action_repeat", repeat), ("episode_length", length)):
        require.at_least(name, n, 1)
    steps = -(-length // repeat)  # the last action in full, as Brax counts
    return bodies.made(lambda: registry.load(id, config), id, steps, repeat)


class Playground(bodies.AbstractBodies):
    """A task of `mujoco_playground.registry`.

    Its settings are those of the task's configuration, with dots between what is nested, such as
    `reward_config.scales.energy`. An episode has `episode_length` steps of the task, an action is
    played `action_repeat` of them. Of several observations a policy sees that named `state`.
    Robots other than those of the Control Suite are downloaded by Playground when first made.
    """

    impl: Literal["jax", "warp"] = eqx.field(static=True, default="jax")
    """The physics: MuJoCo's in JAX, or in Warp, which is Playground's own default and needs a GPU
    of NVIDIA. Both are one simulation, apart from contacts and rounding."""

    def __check_init__(self):
        require.literals(self)
        require.choice("id", self.id, registry.ALL_ENVS)
        if self.impl == "warp" and jax.default_backend() != "gpu":
            raise ValueError(
                f"impl is 'warp', and JAX runs on {jax.default_backend()}: "
                "MuJoCo's Warp needs a GPU of NVIDIA; 'jax' runs anywhere"
            )
        _ = self._made

    @property
    def _made(self) -> bodies.Made:
        return _made(self.id, self.impl, self.kwargs)
