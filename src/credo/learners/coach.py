"""Coaches: members of a population that are moved by the gradient of a learner's critic before they
are evaluated.

Sources: Pourchot & Sigaud (2019), "CEM-RL", section 4.2: half of a sample descends the gradient of
the critic before all of it is evaluated. Nilsson & Cully (2021), "Policy gradient assisted
MAP-Elites", section 4.2: the same as a mutation of some offspring, beside those that are mutated at
random.

Departures: CEM-RL makes as many steps of every such member as frames were played in the generation
before, which costs more than the learner itself; here all of them together make a share of the
learner's updates. A member starts without a state of Adam, as in both papers.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray, PyTree

from .. import require
from ..compilation import jit
from ..replay import Replay
from .base import AbstractLearner, adam_state, descend, mean, minibatch, require_critic


class AbstractCoach(eqx.Module):
    """Which part of a population a learner improves, and by how many gradient steps."""

    share: eqx.AbstractVar[float]  # of the population, in (0, 1]
    per_update: eqx.AbstractVar[float]  # steps of all members together, per update of the learner

    def count(self, population: int) -> int:
        """Members that are coached."""
        return int(self.share * population)

    def steps(self, updates: Int[Array, ""], population: int) -> Int[Array, ""]:
        """Gradient steps of each of them, after so many updates of the learner."""
        all_ = updates.astype(jnp.float32) * self.per_update
        return jnp.floor(all_ / self.count(population)).astype(jnp.int32)

    def check(self, population: int, kept: int, learners: tuple[AbstractLearner, ...]) -> None:
        """Raise unless the first learner has a critic, and so many members are neither `kept` as
        elites nor actors of learners."""
        require_critic(self, learners)
        if learners[0].discrete:
            raise ValueError(
                f"{type(self).__name__} moves members by the gradient of a critic, and there is "
                f"none through the discrete actions of {type(learners[0]).__name__}: give no coach"
            )
        most = population - kept - len(learners)
        if not 1 <= self.count(population) <= most:
            raise ValueError(
                f"share is {self.share} of {population} members: coached are members that are no "
                f"elites ({kept}) and no learner's actor ({len(learners)}), at least one and at "
                f"most {most}; give a share of up to {most / population:g}"
            )

    @abc.abstractmethod
    def __call__(
        self, learner: AbstractLearner, state: PyTree, members: PyTree, replay: Replay, steps, **how
    ) -> PyTree:
        """The `members`, moved. `steps` is data. `how`: arguments of `minibatch`."""


class Coached(AbstractCoach):
    """Steps of Adam up the value that the learner's critic gives to what a member would do."""

    share: float = eqx.field(static=True, default=0.5)
    """Share of the population that is coached, in (0, 1]; rounded down."""
    per_update: float = 0.5
    """Gradient steps of all coached members together per update of the learner, ≥ 0. A step takes
    the gradient through one critic and none of that critic's weights."""
    learning_rate: float = 1e-3  # step size of Adam, ≥ 0

    def __check_init__(self):
        require.within("share", self.share, 0, 1, without=0)
        for name in ("per_update", "learning_rate"):
            require.at_least(name, getattr(self, name), 0)

    def __call__(self, learner, state, members, replay, steps, **how):
        return _moved(self.learning_rate, learner, state, members, replay, steps, **how)


@jit
def _moved(rate, learner, state, members, replay, steps, *, key: PRNGKeyArray, **how) -> PyTree:
    """One member after the other, each on minibatches of its own."""
    arrays, static = eqx.partition(members, eqx.is_array)
    how |= {"together": learner.at_once(state)}

    def loss(member, batch):
        return -mean(learner.value(state, member, batch), batch.active), None

    def one(given: tuple[Any, Any]) -> PyTree:
        key, member = given[0], eqx.combine(given[1], static)

        def step(i, loop):
            batch = minibatch(learner, replay, key=jax.random.fold_in(key, i), **how)
            member, opt = eqx.combine(loop[0], static), loop[1]
            member, opt, _ = descend(loss, (member, batch), opt, rate)
            return eqx.filter(member, eqx.is_array), opt

        return jax.lax.fori_loop(0, steps, step, (given[1], adam_state(member)))[0]

    n = jax.tree.leaves(arrays)[0].shape[0]
    return eqx.combine(jax.lax.map(one, (jax.random.split(key, n), arrays)), static)
