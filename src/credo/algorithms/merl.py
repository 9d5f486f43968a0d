"""MERL: Khadka (2019), Algorithms 13 and 14 (Majumdar et al. 2020).

Teams evolve on the sparse reward of all, `global`; a team of the same form descends the gradient of
each agent's own dense reward, `local`, and joins them. Any reward signal may take either place, and
each of several learners may optimise a signal of its own: a level of credit per optimiser.

Departures from the printed box:

- Line 8 lets every team play with noise; as the text (7.3) and the author's code say, only the
  learner's team does.
- The box prints no mutation; the text and the code mutate. Operators are those of ERL.
- Lines 15-21 update critic and policy agent by agent; here one step descends the mean over agents,
  each of which draws frames of its own. As many steps as frames, times `updates_per_frame`.
- Line 14 crosses with a single point, always; here rows come from either parent, for members that
  were drawn before and for a tenth of the others, as the author's code.
- One buffer of joint frames is an ensemble of one buffer per agent that are written together.
- "Periodically" is every `migration_period` generations, and the slots are those of the weakest
  teams' offspring, as in ERL. The author's code migrated into any slot and kept four more elites by
  their ancestors' fitness.
- γ is a field, the same for every method in an experiment; the author had 0.5 here and 0.97 for
  the baselines. Ends of episodes are stored, and learning rates are larger: the author's 5e-5, 1e-5
  and τ 1e-5 hardly move a network. Batches have 128 frames (the author's 512), critics relu (tanh),
  rewards are not multiplied by 10.
"""

from collections.abc import Callable
from typing import ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from .. import require
from ..compilation import float32
from ..evolution.crossover import AbstractCrossover, MaskedCrossover
from ..evolution.mutation import AbstractMutation
from ..evolution.selection import AbstractSelection, Tournament
from ..learners.base import AbstractLearner
from ..learners.td3 import TD3, TEAM
from ..networks.base import AbstractNetwork, AbstractPolicy
from ..networks.team import Team
from ..normalization import behind, frozen
from ..rollout import Environment, collect
from ..types import Metrics
from .erl import (
    MUTATION,
    ERLState,
    begin,
    breed,
    explore,
    improve,
    inject,
    most_frames,
    stored,
    tested,
    warm,
)

LOCAL = TD3(signal="local", **TEAM)
"""The learner of the team: one twin critic that all agents share (lines 2 and 16-21)."""


class MERL(eqx.Module):
    """Evolve teams on `fitness` beside learners of each agent's own reward."""

    default_budget: ClassVar[dict[str, int]] = {"frames": 2_000_000}

    env: Environment
    network: AbstractNetwork = Team()
    learners: tuple[AbstractLearner, ...] = (LOCAL,)
    population_size: int = eqx.field(static=True, default=20)  # k
    elite_fraction: float = eqx.field(static=True, default=0.2)
    episodes: int = eqx.field(static=True, default=10)  # ξ: per fitness
    selection: AbstractSelection = Tournament()
    crossover: AbstractCrossover = MaskedCrossover()
    crossover_probability: float = 0.1  # chance to cross an offspring drawn once
    mutation: AbstractMutation = MUTATION
    workers: int = eqx.field(static=True, default=50)  # episodes that learners play, in turn
    migration_period: int = eqx.field(static=True, default=1)  # in generations
    updates_per_frame: float = 0.1  # of each learner, for all agents
    warmup_frames: int = eqx.field(static=True, default=5_120)  # stored before anybody learns
    replay_capacity: int = eqx.field(static=True, default=100_000)  # joint transitions
    test_episodes: int = eqx.field(static=True, default=10)  # of the champion; not counted
    test_every: int = eqx.field(static=True, default=1)  # generations between tests
    fitness: str | None = eqx.field(static=True, default=None)  # signal; None: what is reported
    redistribute: bool = eqx.field(static=True, default=False)  # as in ERL
    normalize_observations: bool = eqx.field(static=True, default=False)  # as in ERL

    def __check_init__(self):
        for name, least in (("population_size", 2), ("episodes", 1), ("workers", 1)):
            require.at_least(name, getattr(self, name), least)
        for name in ("migration_period", "replay_capacity", "test_episodes", "test_every"):
            require.at_least(name, getattr(self, name), 1)
        require.within("crossover_probability", self.crossover_probability, 0, 1)
        require.at_least("updates_per_frame", self.updates_per_frame, 0)
        require.fits(self.env, self.network, *self.learners)
        for signal in (self.fitness, *(learner.signal for learner in self.learners)):
            require.signal(signal, self.env.signals)
        require.room(self.elite_fraction, self.population_size, len(self.learners), self.workers)

    @classmethod
    def merl(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """The defaults, for the command line."""
        return cls(env, network or Team(), **overrides)

    @classmethod
    def presets(cls) -> dict[str, Callable[..., Self]]:
        """Settings by name, for the command line."""
        return {"merl": cls.merl}

    @property
    def elites(self) -> int:
        return int(self.elite_fraction * self.population_size)

    @property
    def manager(self) -> None:
        """Workers play for the learners in turn."""

    @property
    def signal(self) -> str:
        """The reward that evolution maximises."""
        return self.fitness or self.env.reported

    @property
    def most_frames(self) -> int:
        """Frames of one generation, at most."""
        return most_frames(self)

    @float32()
    def init(self, *, key: PRNGKeyArray) -> ERLState:
        # 1-4: a population of k multi-head teams; learners with a shared critic; replay buffers.
        return begin(self, key=key)

    def warm(self, state: ERLState, policy: AbstractPolicy) -> ERLState:
        return warm(self, state, policy)

    @float32()
    def generation(self, state: ERLState, *, key: PRNGKeyArray) -> tuple[ERLState, Metrics]:
        """One pass of the outer loop of Algorithm 13."""
        rollout_key, breed_key, explore_key, learn_key, test_key = jax.random.split(key, 5)

        # 6-9: for team π: g, R = Rollout(π, R, noise=None, ξ); g is π's fitness.
        population = behind(state.moments, state.population)
        played, experience = collect(self.env, population, self.episodes, key=rollout_key)
        fitness = jnp.mean(played.of(self.signal), axis=1)
        memory = stored(self, (state.replay, state.moments), played, experience)

        # 10-14: rank, keep e elites, select k-e by tournament, cross with elites; and mutate.
        population, lineage, champion, bred = breed(
            self, state.population, state.lineage, fitness, key=breed_key
        )
        # 8: Rollout(π_pg, R, noise=W_g, ξ=1), in parallel worlds.
        memory, ledger, counts, explored = explore(self, state, memory, key=explore_key)
        frames, episodes = jnp.sum(played.steps) + counts[0], played.steps.size + counts[1]

        # 15-21: for agent k: a minibatch from R^k; descend the critic's loss; follow the gradient
        # of Q with head k; move the targets.
        learners, learned = improve(self, state, memory, frames, key=learn_key)

        # 22: Migrate: the weakest teams become copies of π_pg.
        generation = state.generation + 1
        due = (generation % self.migration_period == 0) & (learned["updates"] > 0)
        migrants = [learner.actor(s) for learner, s in zip(self.learners, learners, strict=True)]
        population, lineage = inject(population, lineage, migrants, due)

        champion = frozen(state.moments, champion)
        after = (population, lineage, learners, memory[0], ledger, state.allocation, champion)
        counted = (state.frames + frames, state.episodes + episodes, generation, memory[1])
        metrics = {"frames": frames} | bred | explored | learned
        state = ERLState(*after, state.score, *counted)
        return tested(self, state, fitness, metrics, key=test_key)
