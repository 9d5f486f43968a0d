"""CCEA: Khadka (2019), Algorithm 4, the cooperative coevolution of section 4.1.2 (after Potter & De
Jong 1994).

Every agent has a population of its own. Individuals are judged by teams that they are drawn into,
one from each population.

Departures from the printed box:

- Teams are drawn at random (line 5), so that φ is an average and now and then somebody is in none:
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
from functools import partial
from typing import Any, ClassVar, Literal, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from .. import require, tree
from ..compilation import float32, jit
from ..evolution.crossover import AbstractCrossover, MaskedCrossover
from ..evolution.extinction import Extinction
from ..evolution.islands import Islands
from ..evolution.mutation import AbstractMutation, MatrixMutation
from ..evolution.selection import AbstractSelection, Tournament, rankable
from ..networks.base import AbstractNetwork, AbstractPolicy
from ..networks.mlp import MLP
from ..networks.team import Team, TeamPolicy
from ..normalization import Moments, behind, frozen, play
from ..rollout import Environment, evaluate
from ..types import Metrics
from .neuroevolution import breed


class CCEAState(eqx.Module):
    populations: PyTree  # leaves [M, k, ...]; bred, not yet evaluated
    champion: AbstractPolicy  # the best of each population, together
    moments: Moments | None  # of what was seen; None: observations are as they are


class CCEA(eqx.Module):
    """Coevolve a population of `network` policies for each agent of `env`."""

    default_budget: ClassVar[dict[str, int]] = {"generations": 1_000}

    env: Environment
    network: AbstractNetwork = MLP(hidden=(20,))  # of one agent
    population_size: int = eqx.field(static=True, default=100)  # k, of each population
    elite_fraction: float = eqx.field(static=True, default=0.04)
    teams: int = eqx.field(static=True, default=5)  # φ: per individual, on average
    episodes: int = eqx.field(static=True, default=7)  # z: simulations of each team
    test_episodes: int = eqx.field(static=True, default=15)  # fresh ones, for the champion team
    teaming: Literal["random", "balanced"] = eqx.field(static=True, default="random")
    assignment: Literal["mean", "best"] = eqx.field(static=True, default="mean")
    selection: AbstractSelection = Tournament()
    mutation: AbstractMutation = MatrixMutation()
    crossover: AbstractCrossover = MaskedCrossover()
    crossover_probability: float = 0.0
    cross_repeated: bool = eqx.field(static=True, default=False)
    mating: tuple[AbstractCrossover, ...] = ()  # as in Neuroevolution
    extinction: Extinction = Extinction()
    islands: Islands | None = None
    """Of each population. Every island then has its share of the elites, its own tournaments, mates
    and events of extinction."""
    fitness: str | None = eqx.field(static=True, default=None)  # signal; None: the task's first
    normalize_observations: bool = eqx.field(static=True, default=False)
    """All populations see observations by the running mean and variance of all that was seen; the
    champion keeps them. A generation's observations are recorded for it."""

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
        require.within("crossover_probability", self.crossover_probability, 0, 1)
        require.choice("teaming", self.teaming, ("random", "balanced"))
        require.choice("assignment", self.assignment, ("mean", "best"))
        require.signal(self.fitness, self.env.signals)
        require.at_least("population_size", self.population_size, 2)
        if self.islands is None:
            require.room(self.elite_fraction, self.population_size, 0, 0)
        elif isinstance(self.islands, Islands):
            size = self.islands.size(self.population_size)
            require.room(self.elite_fraction, size, 0, 0, "members of an island")
        else:
            raise TypeError(f"islands is {self.islands!r}: give Islands(number=4), or None")

    @classmethod
    def ccea(cls, env: Environment, network: AbstractNetwork | None = None, **overrides):
        """The settings of section 4.1.2."""
        given: dict[str, Any] = {} if network is None else {"network": network}
        return cls(env, **given | overrides)

    @classmethod
    def presets(cls) -> dict[str, Callable[..., Self]]:
        """Settings by name, for the command line."""
        return {"ccea": cls.ccea}

    @property
    def elites(self) -> int:
        """Of each population, those of all its islands."""
        n = self.islands.number if self.islands else 1
        return n * int(self.elite_fraction * (self.population_size // n))

    @property
    def agents(self) -> int:
        """M: populations, and members of a team."""
        return self.env.sizes[2]

    @property
    def signal(self) -> str:
        """The reward that is assigned."""
        return self.fitness or self.env.signals[0]

    @property
    def simulations(self) -> int:
        """z: of each team; of an individual without partners what its φ teams would have."""
        return self.episodes * (self.teams if self.agents == 1 else 1)

    def new_population(self, size: int | None = None, *, key: PRNGKeyArray) -> PyTree:
        """`size` members instead of `population_size`."""
        return eqx.filter_vmap(lambda key: self.network.init(*self.env.sizes[:2], key=key))(
            jax.random.split(key, self.population_size if size is None else size)
        )

    @float32()
    def init(self, *, key: PRNGKeyArray) -> CCEAState:
        # 1: Initialize M populations of k neural network policies.
        keys = jax.random.split(key, self.agents)
        populations = eqx.filter_vmap(lambda key: self.new_population(key=key))(keys)
        first = jnp.zeros((self.agents, 1), jnp.int32)
        moments = Moments.first(self.env, self.network) if self.normalize_observations else None
        champion = frozen(moments, tree.take(drafted(self, populations, first), 0))
        return CCEAState(populations, champion, moments)

    @float32()
    def generation(self, state: CCEAState, *, key: PRNGKeyArray) -> tuple[CCEAState, Metrics]:
        """Lines 4-21 of Algorithm 4, and the test of the champion team."""
        team_key, play_key, breed_key, test_key = jax.random.split(key, 4)

        # 4-6: for i = 1 … kφ: select a network from each population randomly; they are team T_i.
        members = self.drawn(key=team_key)
        teams = drafted(self, state.populations, members)
        # 7-8: run z independent simulations for team T_i; assign reward to each of its members.
        played, moments = play(self.env, teams, self.simulations, state.moments, key=play_key)
        fitness = assigned(self, members, played.returns[self.signal])
        # 9-21: for each population: rank, keep the elites, select, mutate; now and then extinction.
        best = jnp.argmax(rankable(fitness), axis=1)
        champion = behind(state.moments, drafted(self, state.populations, best[:, None]))
        populations = bred(self, state.populations, fitness, key=breed_key)

        test = evaluate(self.env, champion, self.test_episodes, key=test_key)
        returns = played.of(self.signal)
        metrics = {
            "fitness_max": jnp.max(rankable(jnp.mean(returns, axis=1))),
            "fitness_mean": jnp.nanmean(returns),
            "fitness_nan": jnp.sum(jnp.isnan(jnp.mean(returns, axis=1))),
            "champion_score": jnp.mean(test.of(self.env.reported)),
            "frames": jnp.sum(played.steps),
        }
        return CCEAState(populations, tree.take(champion, 0), moments), metrics

    def drawn(self, *, key: PRNGKeyArray) -> Int[Array, "agents teams"]:
        """Who is in which team."""
        k, agents = self.population_size, self.agents
        if agents == 1:
            return jnp.arange(k)[None]
        if self.teaming == "random":
            return jax.random.randint(key, (agents, k * self.teams), 0, k)
        every = jnp.broadcast_to(jnp.arange(k), (agents, self.teams, k))
        return jax.random.permutation(key, every, axis=2, independent=True).reshape(agents, -1)


@jit
def drafted(ccea: CCEA, populations: PyTree, members: Int[Array, "agents teams"]) -> TeamPolicy:
    """Teams `[teams, ...]` of these members of each population `[agents, k, ...]`."""
    heads = tuple(tree.take(populations, (i, members[i])) for i in range(ccea.agents))
    config = Team(trunk=(), head=ccea.network, sharing="nothing")
    return TeamPolicy(({},) * ccea.agents, heads, config, ccea.agents)


@jit
def bred(
    ccea: CCEA, populations: PyTree, fitness: Float[Array, "agents k"], *, key: PRNGKeyArray
) -> PyTree:
    """The next generation of each population."""
    keys = jax.random.split(key, ccea.agents)

    def one(population, fitness, key):
        if ccea.islands is None:
            return breed(ccea, population, fitness, key=key)
        size = ccea.islands.size(ccea.population_size)
        breed_key, fresh_key = jax.random.split(key)
        return ccea.islands(
            partial(breed, ccea),
            lambda: ccea.new_population(size, key=fresh_key),
            population,
            fitness,
            key=breed_key,
        )

    return eqx.filter_vmap(one)(populations, fitness, keys)


@jit
def assigned(
    ccea: CCEA,
    members: Int[Array, "agents teams"],
    returns: Float[Array, "teams episodes *agents"],
) -> Float[Array, "agents k"]:
    """Fitness of every individual, from the teams that it was in; -inf if there was none.

    **Arguments:** `members[i, t]`: who of population i is in team t. `returns` of a private signal
    have an axis of agents.
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
