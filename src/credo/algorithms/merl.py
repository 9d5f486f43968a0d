"""MERL: Khadka (2019), Algorithms 13 and 14 (Majumdar et al. 2020).

Teams evolve on the sparse reward of all, `global`; a team of the same form descends the gradient of
each agent's own dense reward, `local`, and joins them. Any reward signal may take either place, and
each of several learners may optimise a signal of its own: a level of credit per optimiser.

Departures from the printed box:

- Of discrete actions the learner is DQN, of each agent's own values.
- On a task without a reward `local` the preset's learner maximises what evolution does.
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

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from .. import require
from ..compilation import float32
from ..evolution.breeder import AbstractBreeder, evolving
from ..learners.base import AbstractLearner, in_windows
from ..learners.coach import AbstractCoach
from ..learners.credit import AbstractRedistribution, Even
from ..learners.dqn import DQN
from ..learners.horizon import AbstractHorizon
from ..learners.share import AbstractShare
from ..learners.surrogate import AbstractSurrogate
from ..learners.td3 import TD3, TEAM
from ..networks.base import AbstractNetwork
from ..networks.choosing import choosing
from ..networks.team import Team
from ..replay import Sampling
from ..rollout import Environment
from ..types import Metrics
from .aid import coached, play_ahead, preselect
from .erl import BREEDER as ERL_BREEDER
from .hybrid import Hybrid, HybridState, balance, breed, inject, play, teach, tested
from .overlap import overlapped

LOCAL = TD3(signal="local", **TEAM)
"""The learner of the team: one twin critic that all agents share (lines 2 and 16-21)."""
CHOOSING = DQN(signal="local", gamma=LOCAL.gamma, exploration=2_000)
"""The learner of a team with discrete actions: each agent's own values."""
BREEDER = replace(ERL_BREEDER, elite_fraction=0.2, crossover_probability=0.1)


def _local(env: Environment) -> TD3 | DQN:
    """`LOCAL`, of discrete actions `CHOOSING`; or on a task without such a reward its twin for what
    evolution maximises, with a warning."""
    learner = CHOOSING if env.choices else LOCAL
    if "local" in env.signals:
        return learner
    several = len(env.signals) > 1
    told = f"; learners.0.signal names another of {', '.join(env.signals)}" if several else ""
    warnings.warn(
        f"{type(env.unwrapped).__name__} has no reward named local: learners maximise what "
        f"evolution does{told}",
        stacklevel=2,
    )
    return replace(learner, signal=None)


class MERL(Hybrid):
    """Evolve teams on `fitness` beside learners of each agent's own reward."""

    default_budget: ClassVar[dict[str, int]] = {"frames": 2_000_000}

    env: Environment
    network: AbstractNetwork = Team()
    learners: tuple[AbstractLearner, ...] = (LOCAL,)  # of the whole team, each of its own reward
    population_size: int = eqx.field(static=True, default=20)  # k: teams, at least 2
    breeder: AbstractBreeder = BREEDER  # how the next population is made
    episodes: int = eqx.field(static=True, default=10)  # ξ: episodes per fitness value, ≥ 1
    workers: int = eqx.field(static=True, default=50)  # learners' episodes per generation, ≥ 1
    share: AbstractShare | None = None
    """What part of all frames the learners play, in rounds of `workers` episodes that are each
    learned from; None: one round per generation."""
    coach: AbstractCoach | None = None
    """Members that are moved by the gradient of the first learner's critic before they are
    evaluated; None: none are."""
    surrogate: AbstractSurrogate | None = None
    """Breeds more offspring than are played, of which the critic of the first learner chooses;
    None: all are played."""
    horizon: AbstractHorizon | None = None
    """Cuts the population's episodes short, and says what the rest is worth by the critic of the
    first learner; None: episodes are played to the end."""
    migration_period: int = eqx.field(static=True, default=1)  # generations between migrations, ≥ 1
    sampling: Sampling = Sampling()  # how minibatches are drawn from the replay buffer
    updates_per_frame: float = 0.1  # updates of each learner, for all agents, per frame played, ≥ 0
    warmup_frames: int = eqx.field(static=True, default=5_120)  # frames before learning begins, ≥ 0
    replay_capacity: int = eqx.field(static=True, default=100_000)  # transitions in the buffer, ≥ 1
    test_episodes: int = eqx.field(static=True, default=10)  # episodes of a champion's test, ≥ 1
    test_every: int = eqx.field(static=True, default=1)  # generations from test to test, ≥ 1
    fitness: str | None = eqx.field(static=True, default=None)
    """Name of the reward that fitness sums up; None: the task\'s first."""
    redistribute: AbstractRedistribution | None = None
    """How learners are paid an episode's return where it comes late; None: as the task pays."""
    remember: bool = eqx.field(static=True, default=False)
    """Rank a team by the average fitness over all generations that it lived through, not by the
    last one alone."""
    normalize_observations: bool = eqx.field(static=True, default=False)
    """Policies see observations normalised by the running mean and variance of all observations so
    far; the champion keeps them."""
    overlap: bool = eqx.field(static=True, default=False)
    """Learners learn from what was played up to the generation before, while this one is played;
    of tasks outside JAX at the same time, in other processes. It is another algorithm, and faster
    where both take long. False: after it, from all of it."""

    def __check_init__(self):
        require.at_least("migration_period", self.migration_period, 1)

    @classmethod
    def merl(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """The defaults, for the command line; of a task without a reward `local` the learner has
        that of the team, with a warning. `overrides`: fields of `MERL`, and of its breeder."""
        settings: dict[str, Any] = {"updates_per_frame": 0.1}
        if "learners" not in overrides:
            settings |= {"learners": (_local(env),)}
        settings = in_windows(env, network, settings)
        return cls(env, choosing(env, network or Team()), **evolving(BREEDER, settings, overrides))

    @classmethod
    def hybrid(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """One preset for teams of equals: one policy that all agents share, more teams that are
        judged by fewer episodes in each of the generations they live through, three learners that
        differ by chance, smaller batches, and late local rewards spread. Chosen on seeds from 1000
        on; docs, merl, say by what."""
        settings: dict[str, Any] = {}
        if "learners" not in overrides:
            settings |= {"learners": 3 * (replace(_local(env), batch_size=32),)}
        settings |= {"population_size": 50, "episodes": 4, "remember": True}
        settings |= {"updates_per_frame": 0.2, "redistribute": Even(late_only=True)}
        settings = in_windows(env, network, settings)
        return cls.merl(env, network or Team(sharing="everything"), **settings | overrides)

    @classmethod
    def presets(cls) -> dict[str, Callable[..., Self]]:
        """Settings by name, for the command line."""
        return {"merl": cls.merl, "hybrid": cls.hybrid}

    @property
    def manager(self) -> None:
        """Workers play for the learners in turn."""

    @float32()
    def generation(self, state: HybridState, *, key: PRNGKeyArray) -> tuple[HybridState, Metrics]:
        """One pass of the outer loop of Algorithm 13."""
        rollout_key, breed_key, explore_key, learn_key, test_key = jax.random.split(key, 5)
        # 6-9: for team π: g, R = Rollout(π, R, noise=None, ξ); g is π's fitness.
        if self.overlap:  # and what lines 16-29 say, meanwhile
            state, played, learned = overlapped(
                self, state, keys=(rollout_key, explore_key, learn_key)
            )
        else:
            playing = play if self.horizon is None else play_ahead
            state, played = playing(self, state, state.population, self.episodes, key=rollout_key)
        fitness = jnp.mean(played.of(self.reward), axis=1)

        if self.share is not None:
            state = balance(self, state, fitness)

        # 10-14: rank, keep e elites, select k-e by tournament, cross with elites; and mutate.
        breeding = breed if self.surrogate is None else preselect
        state, bred = breeding(self, state, fitness, key=breed_key)

        # 8: Rollout(π_pg, R, noise=W_g, ξ=1), in parallel worlds.
        # 15-21: for agent k: a minibatch from R^k; descend the critic's loss; follow the gradient
        # of Q with head k; move the targets.
        if not self.overlap:
            state, learned = teach(
                self, state, jnp.sum(played.steps), keys=(explore_key, learn_key)
            )

        # 22: Migrate: the weakest teams become copies of π_pg.
        due = (state.generation % self.migration_period == 0) & (learned["updates"] > 0)
        state = inject(self, state, due)
        if self.coach is not None:
            state, learned = coached(self, state, learned, key=jax.random.fold_in(key, 6))

        return tested(self, state, fitness, bred | learned, key=test_key)
