"""One learner alone: act, remember, learn. The baselines of ERL and CERL.

TD3 is Algorithm 1 of Fujimoto et al. (2018), DDPG that of Lillicrap et al. (2016), SAC that of
Haarnoja et al. (2018). Departure from all three: a generation plays whole episodes and then
makes as many updates as frames were played, so that its end is a state to resume from.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from .. import require, tree
from ..compilation import float32
from ..learners.base import AbstractLearner, in_windows, learn, require_windows
from ..learners.credit import AbstractRedistribution
from ..learners.decomposed import Decomposed
from ..learners.discrete_sac import DiscreteSAC
from ..learners.dqn import DQN, DQN_NETWORK
from ..learners.sac import HYBRID_NETWORK, SAC, modern
from ..learners.td3 import ERL_NETWORK, TD3, TD3_NETWORK, TEAM, ddpg, maddpg, matd3
from ..networks.base import AbstractNetwork, AbstractPolicy
from ..networks.choosing import choosing
from ..networks.team import Team
from ..normalization import Moments, behind, frozen, warmed, watched
from ..replay import Replay, Sampling, extend
from ..rollout import Environment, blank, collect
from ..types import Metrics
from .fitness import objective, retested


class OffPolicyState(eqx.Module):
    """What a learner alone knows between two generations."""

    learner: PyTree
    replay: Replay
    champion: AbstractPolicy  # the actor
    score: Float[Array, ""]  # of its last test; -inf: none
    frames: Int[Array, ""]
    moments: Moments | None  # of all observations; None: they are not normalised
    known: PyTree = None  # what a redistribution knows


class OffPolicy(eqx.Module):
    """Train `learner` on `env` from its own experience."""

    default_budget: ClassVar[dict[str, int]] = {"frames": 1_000_000}

    env: Environment
    network: AbstractNetwork = TD3_NETWORK
    learner: AbstractLearner = TD3()  # what learns from the replay buffer: TD3, DDPG, SAC, …
    episodes: int = eqx.field(static=True, default=1)  # episodes between rounds of updates, ≥ 1
    start_frames: int = eqx.field(static=True, default=25_000)  # frames of random actions, ≥ 0
    updates_per_frame: float = 1.0  # gradient updates per environment frame, at least 0
    sampling: Sampling = Sampling()  # how minibatches are drawn from the replay buffer
    redistribute: AbstractRedistribution | None = None
    """How the learner is paid an episode's return where it comes late; None: as the task pays."""
    test_episodes: int = eqx.field(static=True, default=10)  # episodes of an actor's test, ≥ 1
    test_every: int = eqx.field(static=True, default=5_000)  # frames between tests, at least 1
    replay_capacity: int = eqx.field(
        static=True, default=1_000_000
    )  # transitions in the buffer, ≥ 1
    normalize_observations: bool = eqx.field(static=True, default=False)
    """Actor and critics see observations normalised by the running mean and variance of all
    observations so far; the champion keeps them."""

    def __check_init__(self):
        for name in ("episodes", "test_episodes", "test_every", "replay_capacity"):
            require.at_least(name, getattr(self, name), 1)
        require.fits(self.env, self.network, self.learner)
        require_windows(self.network, self.sampling, self.replay_capacity, self.learner)
        require.at_least("start_frames", self.start_frames, 0)
        require.at_least("updates_per_frame", self.updates_per_frame, 0)
        objective(self.env, self.learner.signal)

    @classmethod
    def td3(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """The constants of TD3's authors, second version; for a team those of `matd3`, with critics
        of each agent's own frames."""
        if env.agents is not None:
            return cls._team(TD3(**TEAM), env, network, overrides)
        settings = in_windows(env, network, {"learner": TD3()})
        return cls(env, network or TD3_NETWORK, **settings | overrides)

    @classmethod
    def ddpg(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """The constants of ERL's learner (Khadka 2019, section 5.4)."""
        settings = in_windows(env, network, {"learner": ddpg(), "start_frames": 1_000})
        return cls(env, network or ERL_NETWORK, **settings | overrides)

    @classmethod
    def sac(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """The constants of SAC's authors, with a learned temperature; of discrete actions
        `DiscreteSAC`."""
        settings: dict[str, Any] = {"learner": SAC(), "start_frames": 10_000}
        if env.choices:
            settings = {"learner": DiscreteSAC(), "start_frames": 1_000}
        network = network or (TD3_NETWORK if env.agents is None else Team())
        return cls(env, choosing(env, network), **in_windows(env, network, settings) | overrides)

    @classmethod
    def dqn(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """Discrete actions: double Q-learning of returns of three steps, an update per frame. For a
        network with memory, which learns from windows, they are of one step."""
        settings: dict[str, Any] = {"learner": DQN(), "start_frames": 1_000}
        settings = {"sampling": Sampling(steps=3)} | in_windows(env, network, settings)
        network = network or (DQN_NETWORK if env.agents is None else Team())
        return cls(env, choosing(env, network), **settings | overrides)

    @classmethod
    def hybrid(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """The learner of `ERL.hybrid` alone, with the same network and the same view of rewards."""
        settings: dict[str, Any] = {"learner": modern(), "start_frames": 5_000}
        settings |= {"redistribute": Decomposed()}
        return cls(env, network or HYBRID_NETWORK, **in_windows(env, network, settings) | overrides)

    @classmethod
    def matd3(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """A team, in ten worlds at a time, with the team's constants of MERL."""
        return cls._team(matd3(), env, network, overrides)

    @classmethod
    def maddpg(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """As `matd3`."""
        return cls._team(maddpg(), env, network, overrides)

    @classmethod
    def _team(cls, learner: TD3, env: Environment, network, overrides: dict[str, Any]) -> Self:
        settings: dict[str, Any] = {"learner": learner, "episodes": 10, "start_frames": 5_000}
        settings |= {"updates_per_frame": 0.1, "replay_capacity": 100_000}
        return cls(env, network or Team(), **in_windows(env, network, settings) | overrides)

    @classmethod
    def presets(cls) -> dict[str, Callable[..., Self]]:
        """Settings by name, for the command line."""
        names = ("td3", "ddpg", "sac", "dqn", "matd3", "maddpg", "hybrid")
        return {name: getattr(cls, name) for name in names}

    @property
    def most_frames(self) -> int:
        """Frames of one generation, at most."""
        return self.episodes * self.env.max_steps

    @float32()
    def init(self, *, key: PRNGKeyArray) -> OffPolicyState:
        """A fresh learner and an empty replay buffer."""
        env = self.env
        require.actions(env, self.network, self.learner)
        learner = self.learner.init(self.network, *env.sizes, key=key)
        moments = Moments.first(env, self.network) if self.normalize_observations else None
        return OffPolicyState(
            learner=learner,
            replay=Replay.empty(blank(env, self.learner.actor(learner)), self.replay_capacity),
            champion=frozen(moments, self.learner.actor(learner)),
            score=jnp.float32(-jnp.inf),
            frames=jnp.int32(0),
            moments=moments,
            known=self._known(key=jax.random.fold_in(key, 1)),
        )

    def _known(self, *, key: PRNGKeyArray) -> PyTree:
        """What a redistribution knows at the start."""
        if self.redistribute is None:
            return None
        return self.redistribute.init(self.env, self.episodes, self.replay_capacity, key=key)

    def warm(self, state: OffPolicyState, policy: AbstractPolicy) -> OffPolicyState:
        """`state` that goes on from a saved policy of the same network, without random actions. Its
        critics are new."""
        actor, moments = warmed(policy, state.moments)
        learner = self.learner.warm(state.learner, actor)
        state = replace(state, learner=learner, champion=policy, moments=moments)
        return replace(state, frames=jnp.int32(self.start_frames))

    @float32()
    def generation(self, state: OffPolicyState, *, key: Any) -> tuple[OffPolicyState, Metrics]:
        """Play, learn, and test now and then."""
        explore_key, learn_key, test_key = jax.random.split(key, 3)

        # Act with noise (at first at random), and remember every transition.
        explorer = tree.single(
            self.learner.explorer(state.learner, state.frames < self.start_frames)
        )
        how = {"common": False, "key": explore_key}
        explorer = behind(state.moments, explorer)
        played, experience = collect(self.env, explorer, self.episodes, **how)
        moments = watched(state.moments, experience)
        replay, known, how = state.replay, state.known, self.redistribute
        rows = experience if how is None else how.stored(experience, played)
        replay = paid = extend(replay, rows.transitions, rows.valid)
        new = jnp.sum(played.steps)
        frames = state.frames + new

        # Learn from minibatches, once random actions are over.
        total, before = (
            jnp.floor(x.astype(jnp.float32) * self.updates_per_frame)
            for x in (frames, state.frames)
        )
        updates = jnp.where(frames > self.start_frames, total - before, 0.0).astype(jnp.int32)
        reward = objective(self.env, self.learner.signal)
        given = {"signal": reward, "moments": moments, "sampling": self.sampling}
        told: Metrics = {}
        if how is not None:
            known = how.noted(known, replay, experience, played)
            fresh = jax.random.fold_in(key, 3)
            known, paid, told = how.taught(known, replay, moments, new, key=fresh)
        learner, metrics = learn(self.learner, state.learner, paid, updates, **given, key=learn_key)
        metrics |= told

        # Test the actor without noise, now and then.
        actor = frozen(moments, self.learner.actor(learner))
        due = frames // self.test_every > state.frames // self.test_every
        due = due | (state.score == -jnp.inf)
        score = retested(self.env, actor, self.test_episodes, due, state.score, key=test_key)
        returns = played.of(reward)
        metrics |= {
            "fitness_max": jnp.max(returns),
            "fitness_mean": jnp.mean(returns),
            "champion_score": score,
            "frames": new,
            "updates": updates,
        }
        state = replace(state, learner=learner, replay=replay, champion=actor)
        state = replace(state, score=score, frames=frames, moments=moments, known=known)
        return state, metrics
