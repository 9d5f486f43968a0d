"""What learners are paid where a task pays late: an episode's return in parts over its frames.

A learner follows rewards from step to step, and a return that comes at the last of a thousand steps
tells it little. A redistribution pays the same return earlier. Evolution does not see it: fitness
is the true return.
"""

import equinox as eqx
from jaxtyping import Array, Int, PRNGKeyArray, PyTree

from ..normalization import Moments
from ..replay import Replay
from ..rollout import Environment, Experience
from ..types import Evaluation, Metrics

Taught = tuple[PyTree, Replay, Metrics]
"""What a redistribution knows, the buffer as learners see it, and metrics."""


class AbstractRedistribution(eqx.Module):
    """How learners are paid an episode's return. Sums over an episode stay what they were."""

    late_only: eqx.AbstractVar[bool]
    """Whether episodes that are paid anything before their last step keep their rewards."""

    def init(self, env: Environment, episodes: int, capacity: int, *, key: PRNGKeyArray) -> PyTree:
        """What it knows at the start, for rounds of `episodes` and a buffer of this `capacity`.

        **Raises:** `ValueError` for a task that it cannot serve.
        """
        return None

    def stored(self, experience: Experience, played: Evaluation) -> Experience:
        """A rollout as it goes into the replay buffer."""
        return experience

    def noted(self, known: PyTree, replay: Replay, experience: Experience, played: Evaluation):
        """With the episodes of a rollout that was just written to the buffer."""
        return known

    def taught(
        self,
        known: PyTree,
        replay: Replay,
        moments: Moments | None,
        frames: Int[Array, ""],
        *,
        key: PRNGKeyArray,
    ) -> Taught:
        """Learn from what the buffer holds, with new `frames` in it, and pay learners by that.
        `moments`: what observations are normalised by."""
        return known, replay, {}


class Even(AbstractRedistribution):
    """Every return in equal parts over the frames of its episode: uniform redistribution (Gangwani
    et al. 2020, "Learning Guidance Rewards with Trajectory-space Smoothing"; Ren et al. 2022,
    section 3)."""

    late_only: bool = eqx.field(static=True, default=False)
    """Episodes that are paid anything before their last step keep their rewards."""

    def stored(self, experience, played):
        return experience.spread(played, self.late_only)
