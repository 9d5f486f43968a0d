"""Surrogates: a learner's critic says which members are worth playing.

Source: Wang et al. (2022), "A surrogate-assisted controller for expensive evolutionary
reinforcement learning". The surrogate of a member is the mean value that the critic gives to its
actions, over states from the replay buffer (their equation 6). They use it in two ways: a whole
generation is evaluated by it with some probability (generation-based control), or more offspring
are bred than are played, and the surrogate picks them (individual-based control). The second one is
built, `Preselection`: every fitness stays a real one, so that elites, lineage and the learners'
share need not tell two kinds apart.

Departures: each slot of the next population goes to the best of several offspring that were bred
for it, not the whole population to the best of all, so that offspring stay as diverse as selection
made them. States are drawn from the whole buffer, or as the hybrid's `sampling` says.
"""

import abc
from dataclasses import replace

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .. import require
from ..replay import Replay
from .base import AbstractLearner, mean, minibatch, require_critic


class AbstractSurrogate(eqx.Module):
    """Ranks members that were not played."""

    candidates: eqx.AbstractVar[int]  # offspring bred for each slot, at least 2

    @abc.abstractmethod
    def __call__(
        self, learner: AbstractLearner, state: PyTree, members: PyTree, replay: Replay, **how
    ) -> Float[Array, " pop"]:
        """What each member promises; more is better. `how`: arguments of `minibatch`."""

    def check(self, breeder: object, learners: tuple[AbstractLearner, ...]) -> None:
        """Raise unless the first learner has a critic, and offspring can be chosen one by one."""
        require_critic(self, learners)
        for name in ("mating", "islands", "extinction"):
            if getattr(breeder, name, None):
                raise ValueError(
                    f"{type(self).__name__} chooses offspring one by one, and {name} of the "
                    f"breeder changes them together: leave {name} out, or the surrogate"
                )


class Preselection(AbstractSurrogate):
    """Of several offspring for each slot the one is played whose actions the critic values most."""

    candidates: int = eqx.field(static=True, default=3)  # offspring bred for each slot, at least 2
    states: int = eqx.field(static=True, default=1024)
    """States from the replay buffer over which values are averaged, the same for all members, at
    least 1."""

    def __check_init__(self):
        require.at_least("candidates", self.candidates, 2)
        require.at_least("states", self.states, 1)

    def __call__(self, learner, state, members, replay, *, key: PRNGKeyArray, **how):
        asked = replace(learner, batch_size=self.states)
        how |= {"together": learner.at_once(state)}
        batch = minibatch(asked, replay, key=key, **how)
        arrays, static = eqx.partition(members, eqx.is_array)

        def one(member: PyTree) -> Float[Array, ""]:
            return mean(learner.value(state, eqx.combine(member, static), batch), batch.active)

        return jax.lax.map(one, arrays)
