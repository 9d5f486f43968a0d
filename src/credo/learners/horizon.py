"""Horizons: the population plays the first steps of an episode, and a learner's critic says what
the rest is worth.

Source: Hao et al. (2023), "ERL-Re²: efficient evolutionary reinforcement learning with shared state
representation and individual policy representation", whose surrogate fitness is that of H steps and
the value of the last state.

A member's fitness is its return until it is cut off, and what the rest is worth, the lesser of two
accounts:

- the critic's value of the state in which it is, with the member's own action there, as far as the
  learner's discount looks ahead, about 1/(1 - γ) steps, also where fewer are left. Of a member that
  no learner has trained it is a guess, and of its learner's newest actor too high;
- what the member earned per step in the second half, for as many further steps as are left, but no
  more than 1/(1 - γ); and by how much the critic values the state in which it is above the mean of
  all those before. There the critic's level cancels, as in a differential value (Sutton & Barto
  2018, section 10.3), but so does the fall that it expects.

All members of a generation are cut after the same number of steps, so that their fitness is
comparable; a member whose episode terminated before has its return alone. Tests of champions and
the learners' own episodes are whole ones, and so are all while no member was ever paid before the
last step of an episode: what is cut off there is the whole return.

Departures: they discount the H rewards too, take the value as it is, of a value function that has
the policy as an input, and evaluate like this with some probability; here it is the learner's own
critic, in every generation.
"""

import equinox as eqx

from .. import require
from .base import AbstractLearner, require_critic
from .credit import AbstractRedistribution


class AbstractHorizon(eqx.Module):
    """How far the population's episodes go."""

    steps: eqx.AbstractVar[int]  # most steps of an episode of the population, at least 1

    def check(
        self,
        reward: str,
        credit: AbstractRedistribution | None,
        learners: tuple[AbstractLearner, ...],
    ) -> None:
        """Raise unless the first learner has a critic, and one of the reward that is the fitness,
        frame by frame."""
        require_critic(self, learners)
        signal = learners[0].signal or reward
        credit = None if credit is not None and credit.late_only else credit
        if signal != reward or credit is not None:
            paid = "by a redistribution" if credit else f"{signal!r}"
            raise ValueError(
                f"{type(self).__name__} adds the critic's account to a return of {reward!r}, and "
                f"the first learner is paid {paid}: put a learner of {reward!r} first, without "
                "redistribute or with one that is late_only, or leave the horizon out"
            )


class Truncated(AbstractHorizon):
    """The same number of steps in every generation."""

    steps: int = eqx.field(static=True, default=200)
    """Most steps of an episode of the population, at least 1."""

    def __check_init__(self):
        require.at_least("steps", self.steps, 1)
