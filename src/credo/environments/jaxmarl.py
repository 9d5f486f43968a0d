"""Teams of JaxMARL (Rutherford et al. 2024), in JAX.

    task = JaxMARL("MPE_simple_spread_v3", {"action_type": "Continuous"})
    task = JaxMARL("HeuristicEnemySMAX", {"scenario": "3m"})  # the allies: it plays the enemy

Needs jaxmarl. It is compiled with its policies into one program, like a task of our own. Its
automatic resets are not used: an episode ends where it ends.
"""

import functools
import importlib.util
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .. import require
from ..types import TimeStep
from . import others

if importlib.util.find_spec("jaxmarl") is None:
    raise ModuleNotFoundError("teams of JaxMARL need it: `pip install 'credo[jaxmarl]'`")

with others.importing():
    import jaxmarl  # pyright: ignore[reportMissingImports]
    from jaxmarl.environments import overcooked_layouts  # pyright: ignore[reportMissingImports]
    from jaxmarl.environments.smax.smax_env import (  # pyright: ignore[reportMissingImports]
        MAP_NAME_TO_SCENARIO,
    )
    from jaxmarl.environments.spaces import Box, Discrete  # pyright: ignore[reportMissingImports]

NAMED = {  # settings that are objects, which a word may stand for
    ("HeuristicEnemySMAX", "scenario"): MAP_NAME_TO_SCENARIO,
    ("SMAX", "scenario"): MAP_NAME_TO_SCENARIO,
    ("overcooked", "layout"): overcooked_layouts,
}


class _Made(NamedTuple):
    """An environment, and what all its episodes have in common."""

    env: Any
    spaces: list[Any]  # of actions, by agent
    masks: Any  # of a state what it allows, by agent; None: it does not say
    clock: int  # the step with which its own clock ends an episode; 0: it has none
    form: others.Form
    groups: tuple[int, ...]  # of agents whose spaces are alike


@functools.cache
def _made(id: str, settings: tuple[tuple[str, Any], ...]) -> _Made:
    """An environment by its name. `ValueError` of settings and actions that it cannot have here."""
    given = {name: _meant(id, name, x) for name, x in settings}
    try:
        with others.making():
            env = jaxmarl.make(id, **given)
            if getattr(env, "auto_reset", False):  # those of Brax
                env = jaxmarl.make(id, **(given | {"auto_reset": False}))
        with others.permissive():
            spaces: list[Any] = [env.action_space(name) for name in env.agents]
            obs, state = jax.eval_shape(env.reset, jax.random.key(0))
            if not all(name in obs for name in env.agents):
                raise ValueError(
                    f"{id} does not tell observations by agent, which a policy needs: train "
                    "another team"
                )
            seen = [jax.eval_shape(others.flat, obs[name]).size for name in env.agents]
            masks = _masks(env, spaces, state)
    except (AssertionError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"{id} was not made: {type(error).__name__}: {error}") from error
    if not any(all(isinstance(x, kind) for x in spaces) for kind in (Box, Discrete)):
        raise ValueError(f"{id} has other actions than Box for all agents or Discrete for all")
    steps, clock = _clock(id, env)
    options = {x.n for x in spaces if isinstance(x, Discrete)}
    choices = (int(max(options)),) if options else ()
    width = sum(choices) or max(x.shape[0] for x in spaces)
    masked = bool(choices) and (masks is not None or len(options) > 1)
    form = others.Form(max(seen), width, choices, masked, steps)
    acts = [getattr(x, "n", None) or x.shape[0] for x in spaces]
    kinds = list(zip(seen, map(int, acts), strict=True))
    groups = tuple(list(dict.fromkeys(kinds)).index(kind) for kind in kinds)
    return _Made(env, spaces, masks, clock, form, groups)


def _meant(id: str, name: str, x: Any) -> Any:
    """What a word of a setting stands for. `ValueError` of one that stands for nothing."""
    known = NAMED.get((id, name))
    if known is None or not isinstance(x, str):
        return x
    require.choice(name, x, known)
    return known[x]


def _masks(env: Any, spaces: list[Any], state: Any) -> Any:
    """What says of a state which actions are allowed, by agent; None: nothing does."""
    told = getattr(env, "get_legal_moves", env.get_avail_actions)
    try:
        said = jax.eval_shape(told, state)
    except NotImplementedError:
        return None
    shapes = [said[name].shape for name in env.agents]
    return told if shapes == [(getattr(x, "n", None),) for x in spaces] else None


def _clock(id: str, env: Any) -> tuple[int, int]:
    """Steps of an episode, and the step with which the environment's own clock ends it. Particles
    and SMAX let one step more pass than they say."""
    if hasattr(env, "num_inner_steps"):
        steps = int(env.num_inner_steps * env.num_outer_steps)
    else:
        steps = int(getattr(env, "max_steps", getattr(env, "episode_length", 0)))
    return steps or others.MOST_STEPS, steps + ("MPE" in id or "SMAX" in id)


class TeamState(eqx.Module):
    """A team of JaxMARL between two steps."""

    inner: PyTree  # its own state
    step: Int[Array, ""]
    active: Bool[Array, " agents"]
    allowed: Bool[Array, "agents options"] | None


class JaxMARL(others.AbstractOther):
    """A team of JaxMARL with Box actions or Discrete ones. Agents keep its order.

    Observations are flattened, and padded with zeros to the largest of the team. Of a Box action,
    as long as the largest, -1 is the low and 1 the high. Discrete actions have a mask where the
    environment says which are allowed, and where agents have different numbers of them. The
    scenario of SMAX and the layout of Overcooked are settings that their names may stand for.

    Signals: `local` `[agents]`, what the environment pays each, dead ones too, and `global`, its
    mean, which is reported. Who is done before the others (a unit of SMAX that died) is no longer
    `active`. The clock is the environment's own, its `max_steps`, or 1,000 steps; it truncates.
    """

    signals: ClassVar[tuple[str, ...]] = ("global", "local")
    reported: ClassVar[str] = "global"

    def __check_init__(self):
        require.choice("id", self.id, jaxmarl.registered_envs)
        _ = self._made

    @property
    def _made(self) -> _Made:
        return _made(self.id, self.kwargs)

    @property
    def agents(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return len(self._made.spaces)

    @property
    def groups(self) -> tuple[int, ...]:
        return self._made.groups

    def reset(self, *, key: PRNGKeyArray) -> tuple[TeamState, TimeStep]:
        with others.permissive():
            obs, inner = self._made.env.reset(key)
        inner, everyone = jax.tree.map(jnp.asarray, inner), jnp.ones(self.agents, bool)
        state = TeamState(inner, jnp.int32(0), everyone, self._allowed(inner))
        rewards = {"global": jnp.float32(0.0), "local": jnp.zeros(self.agents)}
        no = jnp.bool_(False)
        return state, TimeStep(self._seen(obs, state), rewards, no, no, everyone, ~everyone)

    def step(
        self, state: TeamState, action: Float[Array, "agents act"], *, key: PRNGKeyArray
    ) -> tuple[TeamState, TimeStep]:
        made, names = self._made, self._made.env.agents
        with others.permissive():
            actions = self._own(action, state.allowed)
            obs, inner, paid, dones, _ = made.env.step_env(key, state.inner, actions)
            local = jnp.stack([jnp.float32(paid[name]).reshape(()) for name in names])
            done = jnp.stack([jnp.asarray(dones[name], bool).reshape(()) for name in names])
        inner, step = others.like(inner, state.inner), state.step + 1
        # Whoever is done with the clock is not done with the task.
        ended = jnp.asarray(dones["__all__"], bool).reshape(()) & (step != made.clock)
        active = state.active & (~done | (step == made.clock))
        gone, late = state.active & ~active, step >= self.max_steps
        rewards = {"global": jnp.mean(local), "local": local}
        state = TeamState(inner, step, active, self._allowed(inner))
        seen = self._seen(obs, state)
        return state, TimeStep(seen, rewards, ended, late & ~ended, active, gone)

    def _allowed(self, inner: PyTree) -> Bool[Array, "agents options"] | None:
        """Which actions a state allows, of those that an agent has."""
        made, width = self._made, sum(self.choices)
        if not self.masked:
            return None
        with others.permissive():
            told = made.masks(inner) if made.masks else {}
        ones = [
            told.get(a, jnp.ones(x.n)) for a, x in zip(made.env.agents, made.spaces, strict=True)
        ]
        return jnp.stack([jnp.pad(x > 0, (0, width - len(x))) for x in ones])

    def _own(self, action: Float[Array, "agents act"], allowed: Any) -> dict[str, Array]:
        """Actions as the environment takes them, by agent."""
        own = {}
        for k, (name, x) in enumerate(zip(self._made.env.agents, self._made.spaces, strict=True)):
            if self.discrete:
                may = None if allowed is None else allowed[k]
                own[name] = others.chosen(action[k], self.choices, may)[0].astype(x.dtype)
            else:
                own[name] = others.scaled(action[k, : x.shape[0]], x.low, x.high, x.shape)
        return own

    def _seen(self, obs: dict[str, Any], state: TeamState) -> Float[Array, "agents obs"]:
        """Observations, one row an agent, its mask before it."""
        rows = [others.flat(obs[name]) for name in self._made.env.agents]
        seen = jnp.stack([jnp.pad(row, (0, self.form.obs_size - row.size)) for row in rows])
        if state.allowed is None:
            return seen
        return jnp.concatenate([state.allowed.astype(jnp.float32), seen], axis=1)
