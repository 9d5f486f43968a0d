"""The contract every gradient learner keeps, an `init`/`update` pair as in Optax, and what they
share."""

import abc
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from .. import require
from ..compilation import jit
from ..environments.base import AbstractTask
from ..networks.base import AbstractNetwork, AbstractPolicy, features_first
from ..networks.history import by_row, unrolled
from ..networks.history import moments as seen_in
from ..normalization import seen
from ..replay import UNIFORM, Replay, Sampling
from ..types import NOTHING, Batch, Metrics

Learned = tuple[PyTree, Metrics]  # state and metrics
Returns = Float[Array, "samples batch *agents"]
Value = Float[Array, "batch *agents"]
WHOLE = 128  # steps of an episode that a window has room for


class AbstractLearner(eqx.Module):
    """Learns a policy, the *actor*, from minibatches of experience, whoever collected it.

    Hyper-parameters that fix no shape are data: learners that differ in γ are one program.
    """

    signal: eqx.AbstractVar[str | None]  # the reward it optimises; None: the task's first
    batch_size: eqx.AbstractVar[int]  # transitions per update
    gamma: eqx.AbstractVar[float]  # γ: discount per step
    reward_scale: eqx.AbstractVar[float | None]  # factor of rewards; None: it follows the buffer
    metrics: eqx.AbstractClassVar[tuple[str, ...]]  # names of what `update` reports
    teams: ClassVar[bool] = False  # whether it learns for all agents of a team
    discrete: ClassVar[bool] = False  # whether it learns a choice, and no other actions

    @abc.abstractmethod
    def init(self, network: AbstractNetwork, *sizes: int, key: PRNGKeyArray) -> PyTree:
        """Fresh networks and optimiser states for a task of these `sizes` (`env.sizes`). The actor
        is one of `network`'s policies, so that it can join a population of them."""

    @property
    def together(self) -> bool:
        """Whether the agents of a team learn from the same frames; else each draws its own."""
        return False

    def at_once(self, state: PyTree) -> bool:
        """Whether the agents of a team learn from the frames of one moment, as it, or as its actor,
        has to."""
        return self.together or self.actor(state).together

    @abc.abstractmethod
    def update(self, state: PyTree, batch: Batch, *, key: PRNGKeyArray) -> tuple[PyTree, Metrics]:
        """One gradient step on one minibatch."""

    @abc.abstractmethod
    def actor(self, state: PyTree) -> AbstractPolicy:
        """What has been learned, without noise."""

    @abc.abstractmethod
    def explorer(self, state: PyTree, random: Bool[Array, ""]) -> AbstractPolicy:
        """The actor with this learner's noise, or with random actions."""

    def value(self, state: PyTree, policy: AbstractPolicy, batch: Batch) -> Value:
        """What the critic says of the return from each observation on where `policy` acts, in units
        of the rewards that critics see. A learner without it cannot judge or coach members."""
        raise NotImplementedError(f"{type(self).__name__} has no value of other policies")

    @abc.abstractmethod
    def warm(self, state: PyTree, actor: AbstractPolicy) -> PyTree:
        """`state` that goes on from a given actor."""


def windows_of(env: AbstractTask) -> Sampling:
    """Windows for a task: whole episodes if none has more than 128 steps, else 64 rows behind 16 of
    burn-in. What is asked for at an episode's end was often told at its start."""
    whole = env.max_steps <= WHOLE
    return Sampling(window=env.max_steps, burn_in=0) if whole else Sampling(window=64, burn_in=16)


def in_windows(
    env: AbstractTask, network: AbstractNetwork | None, settings: dict[str, Any]
) -> dict[str, Any]:
    """Settings of an algorithm with its `learner`, or `learners`, for a network that may have
    memory: windows of `windows_of` the task, minibatches of at least 1,024 rows, and four frames to
    an update. It costs 2.4 times that of as many frames without memory (docs, recurrent)."""
    if network is None or not network.remembers:
        return settings

    def larger(learner: Any) -> Any:
        return replace(learner, batch_size=max(learner.batch_size, 1024))

    found: dict[str, Any] = {"sampling": windows_of(env)} | settings
    if "learner" in found:
        found["learner"] = larger(found["learner"])
    if "learners" in found:
        found["learners"] = tuple(map(larger, found["learners"]))
    return found | {"updates_per_frame": min(found.get("updates_per_frame", 1.0), 0.25)}


def learn(learner: AbstractLearner, state, replay: Replay, updates, **rest) -> Learned:
    """`updates` gradient steps, each on a minibatch of its own, in one program. Their number is
    data.

    **Arguments:** `signal`: what a learner optimises that names no reward itself. `moments`:
    what observations are normalised by. `sampling`: how minibatches are drawn. `key`.

    **Returns:** the new state and the mean of each metric; NOTHING if there was no update.
    """
    if not isinstance(updates, jax.core.Tracer) and updates == 0:
        # Nothing need be compiled for it: the first fitness of a run comes sooner.
        return state, {name: jnp.float32(NOTHING) for name in learner.metrics}
    return _learn(learner, state, replay, updates, **rest)


@jit
def _learn(learner, state, replay: Replay, updates, *, signal, key, **how):
    signal = learner.signal or signal
    learner = learner if learner.reward_scale is not None else scaled(learner, replay, signal)
    how |= {"signal": signal, "together": learner.at_once(state)}
    dynamic, static = eqx.partition(state, eqx.is_array)

    def body(i, loop):
        dynamic, total = loop
        sample_key, update_key = jax.random.split(jax.random.fold_in(key, i))
        batch = minibatch(learner, replay, **how, key=sample_key)
        state, metrics = learner.update(eqx.combine(dynamic, static), batch, key=update_key)
        return eqx.filter(state, eqx.is_array), jax.tree.map(jnp.add, total, metrics)

    zeros = {name: jnp.float32(0.0) for name in learner.metrics}
    dynamic, total = jax.lax.fori_loop(0, updates, body, (dynamic, zeros))
    return eqx.combine(dynamic, static), averaged(total, updates)


def minibatch(learner, replay: Replay, *, signal, moments=None, sampling=UNIFORM, **how) -> Batch:
    """What a learner learns from in one step. Arguments as of `learn`; `how`: `together`, as
    `AbstractLearner.at_once` says, and `key`."""
    drawn: Any = replay.sample if replay.data.memory is None else replay.windows
    rows, *about = drawn(learner.batch_size, sampling, learner.gamma, **how)
    reward, ends = rows.rewards[signal], (rows.terminated, rows.truncated)
    obs, after = seen(moments, rows.obs), seen(moments, rows.next_obs)
    return Batch(obs, rows.action, reward, after, *ends, rows.active, *about)


def scaled(learner: Any, replay: Replay, signal: str) -> Any:
    """With the scale at which the usual reward, paid at every step, makes a return of 1."""
    usual = jnp.maximum(replay.spread(signal), 1e-8)
    return replace(learner, reward_scale=jnp.maximum(1.0 - learner.gamma, 1e-4) / usual)


def bellman(learner: AbstractLearner, batch: Batch, after: Returns, ended: Array) -> Returns:
    """Reward and discounted value of the next state: what returns are worth of which `after` is a
    sample there, unless the episode `ended`. `learn` puts a number where `reward_scale` is None."""
    reward: Any = learner.reward_scale * batch.reward  # pyright: ignore[reportOptionalOperand]
    discount = learner.gamma if batch.discount is None else batch.discount[None]
    return reward[None] + discount * jnp.where(ended[None], 0.0, after)


def averaged(total: Metrics, count: Int[Array, ""]) -> Metrics:
    """Means of sums over `count`; NOTHING if that is 0."""
    n = jnp.maximum(count, 1).astype(jnp.float32)
    return jax.tree.map(lambda x: jnp.where(count > 0, x / n, NOTHING), total)


def adam(weights, gradient, state, rate, max_norm=None) -> tuple[PyTree, optax.OptState]:
    """One step of Adam (Kingma & Ba 2015) down the gradient, clipped to a global norm unless that
    is None. **Returns:** the weights, and the state of Adam."""
    # Optax multiplies counters by floats, which strict promotion of dtypes would refuse.
    with jax.numpy_dtype_promotion("standard"):
        if max_norm is not None:
            gradient, _ = optax.clip_by_global_norm(max_norm).update(gradient, optax.EmptyState())
        step, state = optax.adam(rate).update(gradient, state)
    return eqx.apply_updates(weights, step), state


def adam_state(weights: PyTree) -> optax.OptState:
    """The state of Adam before its first step."""
    return optax.adam(0.0).init(eqx.filter(weights, eqx.is_inexact_array))


def adam_steps(state: optax.OptState) -> Int[Array, ""]:
    """How many steps of `adam` a state has behind it."""
    return optax.tree.get(state, "count")


def descend(loss: Callable[..., Any], given, state, rate, max_norm=None) -> tuple[Any, Any, Any]:
    """One step of `adam` down the gradient of `loss(*given)` by its first argument, the weights.

    **Returns:** the weights, the state of Adam, and what the loss returned: its value and a second
    thing.
    """
    said, gradient = eqx.filter_value_and_grad(loss, has_aux=True)(*given)
    return *adam(given[0], gradient, state, rate, max_norm), said


def polyak(target: PyTree, source: PyTree, tau: Float[Array, ""] | float) -> PyTree:
    """θ' ← τθ + (1-τ)θ', leaf by leaf."""
    new, old = (eqx.filter(x, eqx.is_inexact_array) for x in (source, target))
    return eqx.combine(optax.incremental_update(new, old, tau), target)


def mean(x: Float[Array, "*batch"], active: Bool[Array, "*batch"] | None) -> Float[Array, ""]:
    """The mean over the agents that acted; 0 if none did."""
    return jnp.mean(x) if active is None else _mean_where(x, active)


def _mean_where(x: Array, active: Array) -> Array:
    return jnp.sum(x, where=active) / jnp.maximum(jnp.sum(active.astype(x.dtype)), 1.0)


def acts(policy: AbstractPolicy, batch: Batch, later: bool = False) -> Array:
    """What a policy does in the rows of a batch, or after them: `[batch, *agents, act]`."""
    if batch.windows is None:
        return act(policy, batch.next_obs if later else batch.obs)
    return by_row(unrolled(policy, seen_in(batch, later), batch.windows), later)


def act(policy: AbstractPolicy, obs: Float[Array, "batch *agents obs"]) -> Array:
    """Actions `[batch, *agents, act]` of a memoryless policy, for a batch."""
    if policy.features_first:  # one matrix product per layer
        return policy(obs.T, policy.start(key=None))[0].T  # pyright: ignore[reportArgumentType]
    start = policy.start(key=jax.random.key(0))
    return jax.vmap(lambda x: policy(x, start)[0])(obs)


def spoken(
    policy: AbstractPolicy, batch: Batch, later: bool = False, stored: bool = True
) -> tuple[Float[Array, "units batch *agents"], Float[Array, "act batch *agents"]]:
    """What a policy's output layer is given, and says before its activation, in the rows of a batch
    or after them. `stored` as of `unrolled`."""
    if batch.windows is None:
        return said_at_once(policy, batch.next_obs if later else batch.obs)

    def step(policy: AbstractPolicy):
        def parts(obs, carry):
            features, said, carry = policy.spoken(obs, carry)
            return (features, said), carry

        return parts

    told = unrolled(policy, seen_in(batch, later), batch.windows, stored, said=step)
    features, said = (features_first(by_row(x, later)) for x in told)
    return features, said


def said_at_once(policy: AbstractPolicy, obs: Float[Array, "batch *agents obs"]):
    """The same of a policy without memory, for observations of a batch."""
    if policy.features_first:
        return policy.spoken(obs.T, ())[:2]
    start = policy.start(key=jax.random.key(0))
    features, said = jax.vmap(lambda x: policy.spoken(x, start)[:2])(obs)
    return features_first(features), features_first(said)


def valued(
    q: Float[Array, "act batch *agents"], action: Float[Array, "batch *agents act"]
) -> Value:
    """Of the values of all actions those of some, of which the largest entry is what is taken."""
    taken = jnp.argmax(features_first(action), axis=0)[None]
    return jnp.take_along_axis(q, taken, axis=0)[0]


def output_layer(
    network: AbstractNetwork, policy: AbstractPolicy, obs_size: int, who: str, *agents: int
) -> int:
    """How many numbers a policy's output layer is given. Raises `TypeError` if it has none that is
    told apart; `who` needs it."""

    def parts():
        obs, key = jnp.zeros((*agents, obs_size)), jax.random.key(0)
        return policy.spoken(obs, policy.start(key=key))

    try:
        return jax.eval_shape(parts)[0].shape[-1]
    except NotImplementedError:
        raise TypeError(
            f"{who} needs what a network's output layer says before its activation, and {network} "
            "does not tell: give MLP, RNN, GRU, LSTM, MMU, NTM or DNC"
        ) from None


def require_windows(network: AbstractNetwork, sampling: Sampling, capacity: int, *learners) -> None:
    """Raise if minibatches for a network with memory are asked for that there are not."""
    length, least = sampling.window + sampling.burn_in, min(x.batch_size for x in learners)
    if (least < sampling.window or length > capacity) and network.remembers:
        raise ValueError(
            f"batch_size is {least} and the replay buffer has room for {capacity:,} frames, and "
            f"{require.named(network)} has memory, which learns from windows of {sampling.window} "
            f"frames behind {sampling.burn_in} others: give more, or a smaller sampling.window"
        )
    if sampling.steps > 1 and network.remembers:
        raise ValueError(
            f"steps is {sampling.steps} and {require.named(network)} has memory, which learns from "
            "returns of one step: give steps=1, or a network without memory"
        )


def require_critic(asked: Any, learners: tuple[AbstractLearner, ...]) -> None:
    """Raise unless the first learner can say what other policies are worth."""
    name = type(asked).__name__
    if not learners:
        raise ValueError(
            f"{name} asks a learner's critic, and there is no learner: give learners, or None in "
            f"place of {name}"
        )
    if type(learners[0]).value is AbstractLearner.value:
        raise ValueError(
            f"{name} asks the critic of the first learner, and {type(learners[0]).__name__} has no "
            "method `value`: put TD3, DDPG, SAC or DQN first"
        )
