"""The records that cross module borders. Every one is a pytree."""

from dataclasses import replace
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

Metrics = dict[str, Array]  # one scalar per name
NOTHING = float(np.finfo(np.float32).min)
"""A metric that says nothing in this generation; `metrics.csv` has NaN there. Inside JAX a NaN of
Credo's own would stop whoever looks for theirs with `jax_debug_nans`."""


class TimeStep(eqx.Module):
    """What an environment says after `reset` or one `step` (one episode, no batch).

    For a team, `obs` has a leading agent axis, a reward is a scalar (shared) or `[agents]`
    (private), `active` says who acts at the next step (busy, joined or left), and `gone` for whom
    the task ended with this step, whoever goes on: its value ends, its truncation is not in it.
    """

    obs: Float[Array, "..."]
    rewards: dict[str, Float[Array, "..."]]  # one entry per name in the environment's `signals`
    terminated: Bool[Array, ""]  # the task ended: do not bootstrap
    truncated: Bool[Array, ""]  # the clock ran out: do bootstrap
    active: Bool[Array, " agents"] | None = None
    gone: Bool[Array, " agents"] | None = None  # None: none before the episode ends

    @property
    def ended(self) -> Bool[Array, "*agents"]:
        """For whom the task ended: do not bootstrap. Of each agent, where `gone` tells them
        apart."""
        return self.terminated if self.gone is None else self.terminated[..., None] | self.gone

    def cut(self, over: Bool[Array, ""]) -> "TimeStep":
        """Truncated here if it is `over`, unless the task ended just now."""
        return replace(self, truncated=self.truncated | (over & ~self.terminated))


class Sequence(eqx.Module):
    """One labelled sequence, padded to a fixed number of steps.

    `targets` are signed: above 0 the right answer is +1, below 0 it is -1, at 0 anything goes.
    Their size may carry meaning for a task's own reward (a running sum, say). A task that asks for
    several numbers at a step has one target for each: `[time, act]`, all scored at the same steps.
    """

    inputs: Float[Array, "time in"]
    targets: Float[Array, "time *act"]
    scored: Bool[Array, " time"]  # where the answer counts
    length: Int[Array, ""]  # steps before the padding


class Evaluation(eqx.Module):
    """What a population earned: undiscounted sums of every reward signal."""

    returns: dict[str, Float[Array, "pop episodes"]]  # a private one has [agents] behind
    steps: Int[Array, "pop episodes"]  # environment steps taken; padding is not counted

    def of(self, signal: str) -> Float[Array, "pop episodes"]:
        """The returns of one signal; of a private one the mean over agents."""
        returns = self.returns[signal]
        return returns if returns.ndim == 2 else jnp.mean(returns, axis=2)


class Transition(eqx.Module):
    """One frame as learners see it, or rows of them behind a leading axis.

    Of a team it is the joint frame: `obs`, `action`, private rewards and `active` have an axis of
    agents behind that of the rows.
    """

    obs: Float[Array, "*rows obs"]
    action: Float[Array, "*rows act"]
    rewards: dict[str, Float[Array, "*rows"]]
    next_obs: Float[Array, "*rows obs"]
    terminated: Bool[Array, "*rows"]  # the task ended; by agent where agents end on their own
    truncated: Bool[Array, "*rows"]  # the clock ran out
    active: Bool[Array, "*rows agents"] | None = None  # whose action counted; None: everybody's
    memory: Float[Array, "*rows memory"] | None = None
    """What the policy remembered before it saw `obs` (`AbstractPolicy.remembered`), of a team by
    agent; None: it has no memory."""

    def followed(self, later: "Transition", where: Any, discount: Any) -> "Transition":
        """Up to the end of a `later` transition, whose rewards are added with a `discount`, in
        those rows `where` there is one."""
        rewards = {
            name: x + jnp.where(where, discount * later.rewards[name], 0.0)
            for name, x in self.rewards.items()
        }

        def last(new: Any, old: Any) -> Any:
            return jnp.where(where.reshape(where.shape + (1,) * (new.ndim - where.ndim)), new, old)

        next_obs = last(later.next_obs, self.next_obs)
        ends = (last(later.terminated, self.terminated), last(later.truncated, self.truncated))
        return Transition(self.obs, self.action, rewards, next_obs, *ends, self.active, self.memory)


class Windows(eqx.Module):
    """Rows that follow each other in an episode, for networks with memory.

    The rows of a minibatch are then those of the first window in order of time, of the second, and
    so on: windows times `length` rows.
    """

    fresh: Bool[Array, "windows *agents"]  # which begin where an episode does
    memory: Float[Array, "windows *agents memory"]  # what who played remembered at the first row
    length: int = eqx.field(static=True)  # rows of each window
    burn_in: int = eqx.field(static=True)
    """Rows that refresh the memory of a window that is not `fresh`: no gradient flows through
    them."""


class Batch(eqx.Module):
    """A minibatch for a learner: transitions with the one reward it optimises. Of a team every
    entry has an axis of agents behind that of the batch."""

    obs: Float[Array, "batch obs"]
    action: Float[Array, "batch act"]
    reward: Float[Array, " batch"]
    next_obs: Float[Array, "batch obs"]
    terminated: Bool[Array, " batch"]
    truncated: Bool[Array, " batch"]
    active: Bool[Array, "batch *agents"] | None = None
    """Which rows count: whose action did, and that are no padding; None: all."""
    discount: Float[Array, " batch"] | None = None
    """γ to the number of steps from `obs` to `next_obs`, whose rewards `reward` sums up discounted;
    None: it is one step."""
    windows: Windows | None = None  # how rows follow each other; None: they are frames on their own


class Trace(eqx.Module):
    """One episode of one policy, as `credo.rollout.record` keeps it: what viewers, films and the
    probes of `credo.analysis` take.

    Moments are counted from 0, the start, to `length`; step t leads from moment t to t + 1.
    """

    observations: Float[Any, "moments *agents obs"]
    states: PyTree  # of a task in JAX, leaves [moments, ...]; None: the task is outside JAX
    carries: PyTree  # the policy's memory, leaves [moments, ...]
    actions: Float[Any, "steps *agents act"]  # as they were played: finite, in [-1, 1]
    rewards: dict[str, Float[Any, "steps *agents"]]
    active: Bool[Any, "steps agents"] | None  # whose action counted; None: no team
    terminated: Bool[Any, ""]  # the task ended the episode
    truncated: Bool[Any, ""]  # the clock did
    length: Int[Any, ""]  # steps

    def cut(self) -> "Trace":
        """Without padding, in NumPy."""
        steps = int(self.length)

        def until(last: int, part: Any) -> Any:
            return jax.tree.map(lambda x: plain(x)[:last], part)

        return Trace(
            observations=until(steps + 1, self.observations),
            states=until(steps + 1, self.states),
            carries=until(steps + 1, self.carries),
            actions=until(steps, self.actions),
            rewards=until(steps, self.rewards),
            active=until(steps, self.active),
            terminated=np.asarray(self.terminated),
            truncated=np.asarray(self.truncated),
            length=np.int32(steps),
        )


class Bound(NamedTuple):
    """A mean return that no policy exceeds."""

    value: float
    kind: Literal["optimal", "upper bound"]  # some policy reaches it, or perhaps none does


def plain(x: Array | np.ndarray) -> np.ndarray:
    """An array in NumPy; of random keys their bits."""
    if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        x = jax.random.key_data(x)
    return np.asarray(x)
