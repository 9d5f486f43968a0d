"""Curriculum: a short task first, a longer one once it is solved."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .. import require
from .base import AbstractEnvironment, AbstractSequenceTask
from .host import AbstractHostEnvironment
from .wrappers import Shortened


class Curriculum(eqx.Module):
    """Ask `start` questions per sequence, and one more whenever the best member answers enough
    sequences without a mistake."""

    start: int = eqx.field(static=True, default=3)  # questions per sequence at first, at least 1
    whole: AbstractSequenceTask | None = None
    """The task at the last level; None: the algorithm's own. It may be longer than the task that is
    tested: what is right at depth 101 is less likely to be right at depth 21 by luck."""
    threshold: float = 0.9
    """Share of sequences that the best member must answer without a mistake, in [0, 1]."""

    def __check_init__(self):
        require.at_least("start", self.start, 1)
        require.within("threshold", self.threshold, 0, 1)

    def task(
        self, env: AbstractEnvironment | AbstractHostEnvironment, level: Int[Array, ""]
    ) -> Shortened:
        """What is played at this level, where `env` is the algorithm's task."""
        env = env if self.whole is None else self.whole
        if not isinstance(env, AbstractSequenceTask):
            raise TypeError(f"{type(env).__name__} is no sequence task: it has no questions to cut")
        return Shortened(env, level)

    def next(self, level: Int[Array, ""], success: Float[Array, ""]) -> Int[Array, ""]:
        """The level after a generation whose best member had this success."""
        # Past the task's last question a level means the whole task.
        return level + (success >= self.threshold).astype(jnp.int32)
