"""CCEA: Khadka (2019), Algorithm 4, the cooperative coevolution of section 4.1.2 (after Potter & De
Jong 1994).

Every agent has a population of its own. Individuals are judged by teams that they are drawn into,
one from each population.

Departures from the printed box:

- Teams are drawn at random (line 5), so that φ is an average and now and then a member is in none:
  it has no fitness and ranks last. `teaming="balanced"` draws permutations instead.
- "Assign reward to each member" (line 8) does not say how several teams make one fitness: it is
  their mean; `assignment="best"` takes the best (Wiegand et al. 2001). With a private signal, such
  as the difference reward, each member is assigned its own.
- All teams of a generation play in the same worlds. With one population a team is its individual,
  and its φ teams would repeat each other: it plays φ·z simulations instead, each in another world,
  and neither `teaming` nor `assignment` changes anything.
- A population may be in `islands` that breed apart; the box has none, and they are off by default.
- The operators are those of Algorithm 2; the author's code drew φ 1 and z 10, and crossed too.
- Feed-forward networks have their biases mutated; the author's code left those alone.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Literal, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from .. import require, tree
from ..compilation import float32, jit
from ..evolution.breeder import Breeder, draw, evolving
from ..evolution.extinction import Extinction
from ..evolution.selection import rankable
from ..learners.fitness_critic import AbstractFitnessCritic
from ..networks.base import AbstractNetwork, AbstractPolicy
from ..networks.mlp import MLP
from ..networks.team import Team, TeamPolicy
from ..normalization import Moments, behind, frozen, play
from ..rollout import Environment, score
from ..types import Metrics
from .criticism import Criticism, judged
from .fitness import objective

Members = Int[Array, "agents teams"]
BREEDER = Breeder(elite_fraction=0.04, extinction=Extinction())


class CCEAState(eqx.Module):
    """What CCEA knows between two generations."""

    populations: PyTree  # leaves [M, k, ...]; bred, not yet evaluated
    champion: AbstractPolicy  # the best of each population, together
    moments: Moments | None  # of all observations; None: they are not normalised
    criticism: Criticism | None = None  # None: returns alone are fitness


class CCEA(eqx.Module):
    """Coevolve a population of `network` policies for each agent of `env`."""

    default_budget: ClassVar[dict[str, int]] = {"generations": 1_000}

    env: Environment
    network: AbstractNetwork = MLP(hidden=(20,))  # of one agent
    population_size: int = eqx.field(static=True, default=100)  # k: members of each population, ≥ 2
    breeder: Breeder = BREEDER  # how each population is followed by the next
    teams: int = eqx.field(static=True, default=5)  # φ: teams of an individual, on average, ≥ 1
    episodes: int = eqx.field(static=True, default=7)  # z: simulations of each team, ≥ 1
    test_episodes: int = eqx.field(static=True, default=15)  # episodes of a champion's test, ≥ 1
    teaming: Literal["random", "balanced"] = eqx.field(static=True, default="random")
    """How teams are drawn: `random`, so that an individual plays in φ on average, or `balanced`, so
    that it plays in exactly φ."""
    assignment: Literal["mean", "best"] = eqx.field(static=True, default="mean")
    """Fitness of an individual: the `mean` over its teams, or the `best` of them."""
    fitness: str | None = eqx.field(static=True, default=None)
    """Name of the reward that is assigned; None: the task\'s first."""
    critic: AbstractFitnessCritic | None = None
    """Judges individuals by single steps: fitness is the most that it says of any step of theirs,
    in place of the return that it predicts. None: fitness is the return."""
    normalize_observations: bool = eqx.field(static=True, default=False)
    """Policies see observations normalised by the running mean and variance of all observations so
    far, which are recorded for it; the champion keeps them."""

    def __check_init__(self):
        if self.network.team:
            raise ValueError(
                f"{type(self.network).__name__} acts for a team, and CCEA evolves a population for "
                "each agent: give a network of one, MMU(...) or MLP(...); teams of one genome are "
                "evolved by Neuroevolution (credo train neuroevolution --preset dmmu)"
            )
        require.fits(self.env, Team(head=self.network))
        for name in ("teams", "episodes", "test_episodes"):
            require.at_least(name, getattr(self, name), 1)
        require.choice("teaming", self.teaming, ("random", "balanced"))
        require.choice("assignment", self.assignment, ("mean", "best"))
        objective(self.env, self.fitness)
        self.breeder.check(self.population_size, self.network)

    @classmethod
    def ccea(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """The settings of section 4.1.2. `overrides`: fields of `CCEA`, and of its breeder."""
        given: dict[str, Any] = {} if network is None else {"network": network}
        return cls(env, **evolving(BREEDER, given | overrides))

    @classmethod
    def presets(cls) -> dict[str, Callable[..., Self]]:
        """Settings by name, for the command line."""
        return {"ccea": cls.ccea}

    @property
    def elites(self) -> int:
        """Members of each population that are kept unchanged, those of all its islands."""
        return self.breeder.elites(self.population_size)

    @property
    def agents(self) -> int:
        """M: populations, and members of a team."""
        return self.env.sizes[2]

    @property
    def reward(self) -> str:
        """The reward that is assigned."""
        return objective(self.env, self.fitness)

    @property
    def simulations(self) -> int:
        """z: of each team; of an individual without partners what its φ teams would have."""
        return self.episodes * (self.teams if self.agents == 1 else 1)

    @property
    def most_frames(self) -> int:
        """Frames of one generation, if every episode lasts until the time limit."""
        return self.population_size * self.teams * self.episodes * self.env.max_steps

    @float32()
    def init(self, *, key: PRNGKeyArray) -> CCEAState:
        """1: Initialize M populations of k neural network policies."""
        keys, k = jax.random.split(key, self.agents), self.population_size
        fresh = partial(draw, self.network, self.env.sizes[:2], k)
        populations = eqx.filter_vmap(lambda key: fresh(key=key))(keys)
        first = jnp.zeros((self.agents, 1), jnp.int32)
        moments = Moments.first(self.env, self.network) if self.normalize_observations else None
        champion = frozen(moments, tree.take(drafted(self, populations, first), 0))
        state = CCEAState(populations, champion, moments)
        if self.critic is None:
            return state
        begun = Criticism.first(self.critic, self.env, jax.random.fold_in(key, 1))
        return replace(state, criticism=begun)

    @float32()
    def generation(self, state: CCEAState, *, key: PRNGKeyArray) -> tuple[CCEAState, Metrics]:
        """Lines 4-21 of Algorithm 4, and the test of the champion team."""
        team_key, play_key, breed_key, test_key = jax.random.split(key, 4)

        # 4-6: for i = 1 … kφ: select a network from each population randomly; they are team T_i.
        members = self.drawn(key=team_key)
        teams = drafted(self, state.populations, members)
        # 7-8: run z independent simulations for team T_i; assign reward to each of its members.
        metrics, criticised = {}, None
        if self.critic is None:
            played, moments = play(self.env, teams, self.simulations, state.moments, key=play_key)
            rewards = played.returns[self.reward]
        else:
            found = judged(self, teams, state, key=play_key)
            played, moments, criticised, rewards, metrics["critic_loss"] = found
        fitness = assigned(self, members, rewards)
        # 9-21: for each population: rank, keep the elites, select, mutate; now and then extinction.
        best = jnp.argmax(rankable(fitness), axis=1)
        champion = behind(state.moments, drafted(self, state.populations, best[:, None]))
        champion = tree.take(champion, 0)
        populations = breed(self, state.populations, fitness, key=breed_key)

        returns, tested = played.of(self.reward), {"before": jnp.nan, "key": test_key}
        metrics |= {
            "fitness_max": jnp.max(rankable(jnp.mean(returns, axis=1))),
            "fitness_mean": jnp.nanmean(returns),
            "fitness_nan": jnp.sum(jnp.isnan(jnp.mean(returns, axis=1))),
            "champion_score": score(self.env, champion, self.test_episodes, **tested),
            "frames": jnp.sum(played.steps),
        }
        return CCEAState(populations, champion, moments, criticised), metrics

    def drawn(self, *, key: PRNGKeyArray) -> Members:
        """Who is in which team."""
        k, agents = self.population_size, self.agents
        if agents == 1:
            return jnp.arange(k)[None]
        if self.teaming == "random":
            return jax.random.randint(key, (agents, k * self.teams), 0, k)
        every = jnp.broadcast_to(jnp.arange(k), (agents, self.teams, k))
        return jax.random.permutation(key, every, axis=2, independent=True).reshape(agents, -1)


@jit
def drafted(ccea: CCEA, populations: PyTree, members: Members) -> TeamPolicy:
    """Teams `[teams, ...]` of these members of each population `[agents, k, ...]`."""
    heads = tuple(tree.take(populations, (i, members[i])) for i in range(ccea.agents))
    config = Team(trunk=(), head=ccea.network, sharing="nothing")
    return TeamPolicy(({},) * ccea.agents, heads, config, ccea.agents)


@jit
def breed(
    ccea: CCEA, populations: PyTree, fitness: Float[Array, "agents k"], *, key: PRNGKeyArray
) -> PyTree:
    """The next generation of each population."""
    fresh = partial(draw, ccea.network, ccea.env.sizes[:2])

    def one(population, fitness, key):
        return ccea.breeder.next(None, population, fitness, fresh, key=key)[0]

    return eqx.filter_vmap(one)(populations, fitness, jax.random.split(key, ccea.agents))


@jit
def assigned(ccea: CCEA, members: Members, returns: Array) -> Float[Array, "agents k"]:
    """Fitness of every individual, from the teams that it was in; -inf if there was none.

    **Arguments:** `members[i, t]`: who of population i is in team t. `returns` `[teams, episodes]`,
    of a private reward `[teams, episodes, agents]`.
    """
    reward = jnp.mean(returns, axis=1)  # over simulations
    reward = reward.T if reward.ndim == 2 else jnp.broadcast_to(reward, members.shape)
    k = ccea.population_size
    mine = members[:, None, :] == jnp.arange(k)[None, :, None]  # [agents, k, teams]
    if ccea.assignment == "best":
        best = jnp.max(jnp.where(mine, rankable(reward)[:, None], -jnp.inf), axis=2)
    else:
        every = jnp.broadcast_to(reward[:, None], mine.shape)
        best = jnp.mean(every, axis=2, where=mine)
    return jnp.where(jnp.any(mine, axis=2), best, -jnp.inf)
