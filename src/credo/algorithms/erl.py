"""ERL and CERL: Khadka (2019), Algorithms 6 and 10 (Khadka & Tumer 2018; Khadka et al. 2019).

A population evolves on whole returns, a portfolio of learners descends gradients, and all share
one replay buffer. ERL is the portfolio of one without a resource manager, EA the empty portfolio.

Departures from the printed boxes:

- A generation makes as many updates as frames were played (line 21 of Algorithm 10); Algorithm 6
  prints a single one. `updates_per_frame` scales it, and nothing is learned in the generation in
  which the buffer reaches `warmup_frames`.
- The box selects k-e members and then fills up to k-e: of a member that was drawn repeatedly,
  the repetitions are crossed with an elite, as in the author's code.
- The new population is ordered: elites, then offspring by the rank of their parents. A learner's
  actor takes the last slots, never an elite's; the author's could overwrite one.
- Line 23 weighs up the weakest of a population just bred, of which none has a fitness yet; it is
  the offspring of the weakest parent here.
- Mutation adds noise in proportion to a weight and hits matrices alone, as the author's code.
- All members of a generation play in the same worlds; crossover draws rows independently.
- A learner's first return is its value, and returns that are no numbers leave it as it is.
- Of discrete actions the learner is DQN, and CERL's are four of it; networks with memory learn from
  windows, at an update per four frames.
- Time limits bootstrap, both gradients are clipped, and OU noise starts anew with each episode.
- No actor is injected in a generation without updates.
- Non-finite episodes (an observation, action or reward that is NaN or infinite) are discarded: they
  do not enter the replay buffer.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from .. import require
from ..compilation import float32
from ..evolution.breeder import AbstractBreeder, Breeder, evolving, overridden
from ..evolution.mutation import MatrixMutation
from ..learners.base import AbstractLearner, in_windows
from ..learners.coach import AbstractCoach
from ..learners.credit import AbstractRedistribution, Even
from ..learners.decomposed import Decomposed
from ..learners.dqn import DQN
from ..learners.horizon import AbstractHorizon, Truncated
from ..learners.manager import UCB, AbstractManager
from ..learners.sac import HYBRID_NETWORK, modern
from ..learners.share import AbstractShare, Earned
from ..learners.surrogate import AbstractSurrogate
from ..learners.td3 import ERL_NETWORK, TD3, TD3_NETWORK, ddpg
from ..networks.base import AbstractNetwork
from ..networks.choosing import choosing
from ..networks.mlp import MLP, Critic
from ..networks.team import Team
from ..replay import Sampling
from ..rollout import Environment
from ..types import Metrics
from .aid import coached, play_ahead, preselect
from .hybrid import Hybrid, HybridState, balance, breed, inject, play, teach, tested
from .overlap import overlapped

TABLE_5_1 = {  # task: (ψ, ξ, ω)
    "HalfCheetah": (0.1, 1, 10),
    "Swimmer": (0.1, 1, 10),
    "Reacher": (0.2, 5, 10),
    "Ant": (0.3, 1, 1),
    "Hopper": (0.3, 5, 1),
    "Walker2d": (0.2, 3, 10),
}
BREEDER = Breeder(
    mutation=MatrixMutation(
        gate="genome", super_probability=0.05, reset_probability=0.05, vectors=False
    ),
    cross_repeated=True,
    ordered=True,
)
"""How ERL, CERL and MERL breed; see the departures above."""


class ERL(Hybrid):
    """Evolve `network` policies on `env` beside a portfolio of learners."""

    default_budget: ClassVar[dict[str, int]] = {"frames": 1_000_000}

    env: Environment
    network: AbstractNetwork = ERL_NETWORK
    learners: tuple[AbstractLearner, ...] = (ddpg(),)
    """The portfolio: each learns from the experience of all. Empty: evolution alone."""
    population_size: int = eqx.field(static=True, default=10)  # k: members, at least 2
    breeder: AbstractBreeder = BREEDER  # how the next population is made
    episodes: int = eqx.field(static=True, default=1)  # ξ: episodes per fitness value, ≥ 1
    remember: bool = eqx.field(static=True, default=False)
    """Rank a member by the average fitness over all generations that it lived through, not by the
    last one alone."""
    redistribute: AbstractRedistribution | None = None
    """How learners are paid an episode's return where it comes late; None: as the task pays."""
    workers: int = eqx.field(static=True, default=1)  # b: learners' episodes per generation, ≥ 1
    manager: AbstractManager | None = None  # allocates workers to learners; None: they go in turn
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
    sync_period: int = eqx.field(static=True, default=10)  # ω: generations between injections, ≥ 1
    sampling: Sampling = Sampling()  # how minibatches are drawn from the replay buffer
    updates_per_frame: float = 1.0  # gradient updates of each learner per frame played, ≥ 0
    warmup_frames: int = eqx.field(static=True, default=1_000)  # frames before learning begins, ≥ 0
    replay_capacity: int = eqx.field(
        static=True, default=1_000_000
    )  # transitions in the buffer, ≥ 1
    test_episodes: int = eqx.field(static=True, default=5)  # episodes of a champion's test, ≥ 1
    test_every: int = eqx.field(static=True, default=1)  # generations from test to test, ≥ 1
    fitness: str | None = eqx.field(static=True, default=None)
    """Name of the reward that fitness sums up; None: the task\'s first."""
    normalize_observations: bool = eqx.field(static=True, default=False)
    """Policies see observations normalised by the running mean and variance of all observations so
    far; the champion keeps them."""
    overlap: bool = eqx.field(static=True, default=False)
    """Learners learn from what was played up to the generation before, while this one is played;
    of tasks outside JAX at the same time, in other processes. It is another algorithm, and faster
    where both take long. False: after it, from all of it."""

    def __check_init__(self):
        require.at_least("sync_period", self.sync_period, 1)

    @classmethod
    def erl(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """Section 5.4, with the task's column of Table 5.1; HalfCheetah's where it has none.
        `overrides`: fields of `ERL`, and of its breeder."""
        inner = getattr(env, "env", env)  # a delayed task is still that task
        name = str(getattr(inner, "id", "")).partition("-v")[0]
        ψ, ξ, ω = TABLE_5_1.get(name, TABLE_5_1["HalfCheetah"])
        settings: dict[str, Any] = {"elite_fraction": ψ, "episodes": ξ, "sync_period": ω}
        if overrides.get("learners", True):
            settings |= {"learners": (DQN() if env.discrete else ddpg(),)}
            settings = in_windows(env, network, settings)
        network = choosing(env, network or (Team() if env.agents is not None else ERL_NETWORK))
        return cls(env, network, **evolving(BREEDER, settings, overrides))

    @classmethod
    def ours(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """ERL for a reward that comes late, in thousands: a TD3 learner with a long horizon that
        sees returns spread over their episodes and joins the population every generation, and many
        elites, ranked by their average fitness. Chosen by looking at the hard double pendulum,
        seeds 0, 100 to 103 and 200 to 202."""
        alone = MLP(hidden=(64, 64), activation="relu", initializer="uniform")
        network = network or (alone if env.agents is None else Team())
        rates: dict[str, Any] = {"actor_lr": 1e-3, "critic_lr": 1e-3, "batch_size": 128}
        critic = Critic(hidden=(128, 128))
        learner = TD3(critic=critic, gamma=0.999, reward_scale=0.01, **rates)
        settings = {"learners": (learner,), "elite_fraction": 0.4, "sync_period": 1}
        settings |= {"remember": True, "redistribute": Even(), "updates_per_frame": 2.0}
        return cls.erl(env, network, **overridden(in_windows(env, network, settings), overrides))

    @classmethod
    def hybrid(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """One preset for dense and late rewards: policies that mutation moves, judged by 200 steps
        and what follows from them and the critic, beside a learner of this decade that earns its
        frames, joins every generation, and sees late returns decomposed. Chosen on seeds from 1000
        on; docs, hybrid, say by what."""
        if env.agents is not None:
            raise ValueError("hybrid is for one agent: train a team by merl, or MERL.merl(env)")
        settings: dict[str, Any] = {"learners": (modern(),), "share": Earned(0.6, 0.85)}
        settings |= {"elite_fraction": 0.2, "sync_period": 1, "redistribute": Decomposed()}
        settings |= {"warmup_frames": 5_000, "horizon": Truncated(200)}
        if not overrides.get("learners", True):  # evolution alone: nobody to share with or to ask
            settings |= {"share": None, "horizon": None, "redistribute": None}
        elif network is not None and network.remembers:  # the critic cannot judge single steps
            settings = in_windows(env, network, settings) | {"horizon": None}
        return cls(env, network or HYBRID_NETWORK, **evolving(BREEDER, settings, overrides))

    @classmethod
    def ea(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """The same evolution without a learner."""
        return cls.erl(env, network, **{"learners": ()} | overrides)

    @classmethod
    def cerl(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """Chapter 6: TD3 (of discrete actions DQN) at four discounts, ten workers, UCB. What the
        text leaves open is the author's: ω = 5, a fifth are elites."""
        kind = DQN if env.discrete else TD3
        learners = tuple(kind(gamma=γ) for γ in (0.9, 0.99, 0.997, 0.9995))
        settings = {"learners": learners, "workers": 10, "manager": UCB(), "elite_fraction": 0.2}
        settings |= {"sync_period": 5, "test_episodes": 10, "test_every": 5}
        settings = in_windows(env, network, settings)
        network = choosing(env, network or (TD3_NETWORK if env.agents is None else Team()))
        return cls(env, network, **evolving(BREEDER, settings, overrides))

    @classmethod
    def presets(cls) -> dict[str, Callable[..., Self]]:
        """Settings by name, for the command line."""
        return {
            "erl": cls.erl,
            "ours": cls.ours,
            "hybrid": cls.hybrid,
            "ea": cls.ea,
            "cerl": cls.cerl,
        }

    @float32()
    def generation(self, state: HybridState, *, key: PRNGKeyArray) -> tuple[HybridState, Metrics]:
        """One pass of the outer loop of Algorithms 6 and 10."""
        play_key, breed_key, explore_key, learn_key, manage_key, test_key = jax.random.split(key, 6)
        # 6-7: for actor in pop: fitness, R = Evaluate(actor, R, noise=None, ξ)
        if self.overlap:  # and what lines 16-29 say, meanwhile
            state, played, learned = overlapped(
                self, state, keys=(play_key, explore_key, learn_key)
            )
        else:
            playing = play if self.horizon is None else play_ahead
            state, played = playing(self, state, state.population, self.episodes, key=play_key)
        fitness = jnp.mean(played.of(self.reward), axis=1)

        if self.share is not None:
            state = balance(self, state, fitness)

        # 8-15: rank, keep the elites, select, cross and mutate.
        breeding = breed if self.surrogate is None else preselect
        state, bred = breeding(self, state, fitness, key=breed_key)

        # 16-29: learners play too, with noise, and their mean return is their value; then as many
        # updates as frames, each learner on minibatches of its own.
        if not self.overlap:
            state, learned = teach(
                self, state, jnp.sum(played.steps), keys=(explore_key, learn_key)
            )

        # 30-33: allocate the workers of the next generation.
        if self.manager is not None and self.learners:
            allocation = self.manager.allocate(state.ledger, self.workers, key=manage_key)
            state = replace(state, allocation=allocation)

        # 34-36: every ω generations, copy each learner's actor over the weakest.
        due = (state.generation % self.sync_period == 0) & (learned["updates"] > 0)
        state = inject(self, state, due)
        if self.coach is not None:
            state, learned = coached(self, state, learned, key=jax.random.fold_in(key, 6))

        return tested(self, state, fitness, bred | learned, key=test_key)
