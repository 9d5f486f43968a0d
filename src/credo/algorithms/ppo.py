"""PPO: Schulman et al. (2017), Algorithm 1, with the clipped objective (equation 7) and
generalized advantages (equation 11): the on-policy baseline of Chapter 5.

Departures: a generation plays whole episodes, as many as last time's length says `horizon` frames
need (at most `copies`), so that its end is a state to resume from. Observations and rewards are
normalised with `normalize_observations` and `normalize_rewards` alone; most implementations do both
in silence. The clipped gradient, the first deviation and the tanh around the mean are not the
paper's.

A team's agents learn independently (de Witt et al. 2020, "Is independent learning all you need in
the StarCraft multi-agent challenge?"): each by its own observations, with a critic that all share.
Who does not act is not learned from.
"""

import functools
import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .. import require, tree
from ..compilation import float32, jit
from ..learners.base import act, adam, adam_state, averaged, mean, said_at_once, windows_of
from ..networks.base import AbstractNetwork, AbstractPolicy, features_first
from ..networks.choosing import choosing, chosen
from ..networks.exploration import Categorical, Explorer, GaussianNoise
from ..networks.history import HistoryCriticNetwork, remembering, through
from ..networks.mlp import MLP, AbstractCriticNetwork, Critic
from ..networks.team import Team
from ..normalization import Moments, behind, frozen, seen, warmed, watched, with_rows
from ..replay import Replay, extend
from ..rollout import Environment, blank, collect
from ..types import Metrics, Transition
from .fitness import objective, retested

NETWORK = MLP(hidden=(64, 64), activation="tanh", initializer="fan_in", output_scale=0.01)
TEAM_NETWORK = Team(
    trunk=(64, 64), head=MLP((), initializer="uniform", output_scale=0.01), sharing="everything"
)
METRICS = ("policy_loss", "critic_loss", "clipped")


class Actor(eqx.Module):
    """A Gaussian around a policy's action; its spread is the same everywhere."""

    mean: AbstractPolicy
    log_std: Float[Array, " act"]

    def log_density(
        self, mean: Float[Array, "*batch act"], action: Float[Array, "*batch act"]
    ) -> Float[Array, "*batch"]:
        log_std = self.log_std.reshape((1,) * (mean.ndim - 1) + (-1,))
        z = (action - mean) / jnp.exp(log_std)
        each = -0.5 * jnp.square(z) - log_std - 0.5 * jnp.log(2.0 * jnp.pi)
        return jnp.sum(each, axis=-1)

    def entropy(self, mean: Float[Array, "*batch act"]) -> Float[Array, "*batch"]:
        each = self.log_std + 0.5 * jnp.log(2.0 * jnp.pi * jnp.e)
        return jnp.broadcast_to(jnp.sum(each), mean.shape[:-1])

    def says(self, policy: AbstractPolicy) -> Callable[..., Any]:
        """What `log_density` takes, step by step: actions."""
        return policy

    def told(self, obs: Float[Array, "rows *agents obs"]) -> Float[Array, "rows *agents act"]:
        """The same of a policy without memory, for a batch."""
        return act(self.mean, obs)

    def explorer(self, size: int | tuple[int, ...]) -> AbstractPolicy:
        """Who plays, for actions of this shape."""
        std: Any = jnp.broadcast_to(jnp.exp(self.log_std), size)
        return Explorer(self.mean, GaussianNoise(std), jnp.bool_(False), size, clipped=False)


class Choice(eqx.Module):
    """A distribution over the options of each choice, softmax of what a policy says before its
    output activation; choices are independent. Of an action the largest entry of each is the one
    that was taken."""

    mean: AbstractPolicy  # whose largest outputs are the likeliest options

    def log_density(
        self, said: Float[Array, "*batch act"], action: Float[Array, "*batch act"]
    ) -> Float[Array, "*batch"]:
        each = []
        for part, done in zip(self._parts(said), self._parts(action), strict=True):
            taken = jnp.argmax(done, axis=-1, keepdims=True)
            log_p = jax.nn.log_softmax(part, axis=-1)
            each.append(jnp.take_along_axis(log_p, taken, axis=-1)[..., 0])
        return functools.reduce(jnp.add, each)

    def entropy(self, said: Float[Array, "*batch act"]) -> Float[Array, "*batch"]:
        log_p = [jax.nn.log_softmax(part, axis=-1) for part in self._parts(said)]
        return functools.reduce(jnp.add, [-jnp.sum(jnp.exp(p) * p, axis=-1) for p in log_p])

    def _parts(self, x: Float[Array, "*batch act"]) -> list[Float[Array, "*batch options"]]:
        ends = itertools.accumulate(chosen(self.mean).choices[:-1])
        return jnp.split(x, list(ends), axis=-1)

    def says(self, policy: AbstractPolicy) -> Callable[..., Any]:
        def step(obs, carry):
            _, said, carry = policy.spoken(obs, carry)
            return said, carry

        return step

    def told(self, obs: Float[Array, "rows *agents obs"]) -> Float[Array, "rows *agents act"]:
        return jnp.moveaxis(said_at_once(self.mean, obs)[1], 0, -1)

    def explorer(self, size: int | tuple[int, ...]) -> AbstractPolicy:
        return Categorical(self.mean)


Networks = tuple[Actor | Choice, AbstractCriticNetwork]


class Sample(eqx.Module):
    """What an update learns from, one row per frame."""

    obs: Float[Array, "rows *agents obs"]
    action: Float[Array, "rows *agents act"]
    log_density: Float[Array, "rows *agents"]  # of the action when it was drawn
    advantage: Float[Array, "rows *agents"]
    value: Float[Array, "rows *agents"]  # what the critic should have said
    counts: Bool[Array, "rows *agents"] | None = None  # which are frames, of who acts; None: all
    begins: Bool[Array, " rows"] | None = None
    """Of networks with memory: where an episode begins; and what they remembered before each row.
    """
    memories: tuple[Float[Array, "rows memory"], Float[Array, "rows memory"]] | None = None


class PPOState(eqx.Module):
    """What PPO knows between two generations."""

    actor: Actor | Choice
    critic: AbstractCriticNetwork
    optimizer: optax.OptState
    replay: Replay  # the frames of one generation
    champion: AbstractPolicy
    score: Float[Array, ""]  # of the champion's last test; -inf: none
    length: Float[Array, ""]  # mean frames of an episode, last time
    frames: Int[Array, ""]
    moments: Moments | None  # of all observations; None: they are not normalised
    paid: Moments | None = None  # of all discounted returns; None: rewards are not normalised


class PPO(eqx.Module):
    """Train a policy on its own fresh experience alone."""

    default_budget: ClassVar[dict[str, int]] = {"frames": 1_000_000}
    teams: ClassVar[bool] = True
    discrete: ClassVar[bool] = True  # and others too

    env: Environment
    network: AbstractNetwork = NETWORK
    critic: Critic = Critic(hidden=(64, 64), activation="tanh", initializer="fan_in")
    horizon: int = eqx.field(static=True, default=2048)  # frames between updates, about, ≥ 1
    copies: int = eqx.field(static=True, default=32)  # episodes between rounds, at most; ≥ 1
    epochs: int = eqx.field(static=True, default=10)  # passes over these frames, at least 1
    batch_size: int = eqx.field(static=True, default=64)  # frames per update, at least 1
    window: int = eqx.field(static=True, default=64)
    """Frames in a row through which a network with memory is followed back, at least 1."""
    gamma: float = 0.99  # γ: discount per step, in [0, 1]
    gae: float = 0.95  # λ of generalized advantages, in [0, 1]
    clip: float = 0.2  # ε: how far from 1 a probability ratio counts, at least 0
    learning_rate: float = 3e-4  # of Adam, at least 0
    value_weight: float = 0.5  # of the critic's squared error in the loss, at least 0
    max_norm: float = 0.5  # norm to which the gradient is clipped, at least 0
    entropy_weight: float = 0.0  # of the policy's entropy in the objective, at least 0
    first_std: float = 0.6  # of the noise at first, ≥ 0, in units of actions, which lie in [-1, 1]
    test_episodes: int = eqx.field(static=True, default=10)  # episodes of a policy's test, ≥ 1
    test_every: int = eqx.field(static=True, default=5_000)  # frames between tests, at least 1
    signal: str | None = eqx.field(static=True, default=None)
    """Name of the reward that is maximised; None: the task\'s first."""
    normalize_observations: bool = eqx.field(static=True, default=False)
    """Actor and critic see observations normalised by the running mean and variance of all
    observations so far; the champion keeps them."""
    normalize_rewards: bool = eqx.field(static=True, default=False)
    """The learner sees rewards divided by the standard deviation of all discounted returns so far,
    and clipped to [-10, 10], as in OpenAI's Baselines. What is reported stays as it is."""

    def __check_init__(self):
        require.fits(self.env, self.network, self)
        counts = ("horizon", "copies", "epochs", "batch_size", "window")
        for name in (*counts, "test_episodes", "test_every"):
            require.at_least(name, getattr(self, name), 1)
        if self.batch_size < self.window and self.network.remembers:
            raise ValueError(
                f"batch_size is {self.batch_size} and window is {self.window}: a network with "
                "memory learns from whole windows; give a larger batch_size, or a smaller window"
            )
        for name in ("gamma", "gae"):
            require.within(name, getattr(self, name), 0, 1)
        for name in (
            "clip",
            "learning_rate",
            "value_weight",
            "max_norm",
            "first_std",
            "entropy_weight",
        ):
            require.at_least(name, getattr(self, name), 0)
        objective(self.env, self.signal)
        if self.network.team and self.network.remembers:
            raise ValueError(
                f"{require.named(self.network)} acts for a team and has memory: PPO learns for "
                "teams without memory; give MLP heads, or train it by merl, matd3, ccea"
            )

    @classmethod
    def ppo(cls, env: Environment, network: AbstractNetwork | None = None, **overrides) -> Self:
        """The constants of its authors for MuJoCo, and what the paper leaves open. For a network
        with memory minibatches hold 8 windows, of whole episodes where those are short."""
        network = network or (NETWORK if env.agents is None else TEAM_NETWORK)
        given: dict[str, Any] = {"network": choosing(env, network)}
        if network.remembers:
            window = windows_of(env).window
            given |= {"window": window, "batch_size": 8 * window}
        return cls(env, **given | overrides)

    @classmethod
    def presets(cls) -> dict[str, Callable[..., Self]]:
        """Settings by name, for the command line."""
        return {"ppo": cls.ppo}

    @float32()
    def init(self, *, key: PRNGKeyArray) -> PPOState:
        """Fresh networks, and room for the frames of one generation."""
        env = self.env
        if env.choices:
            require.choices(env, self.network, self)
        actor_key, critic_key = jax.random.split(key)
        mean = self.network.init(*env.sizes, key=actor_key)
        std = jnp.full(env.action_size, jnp.log(self.first_std))
        actor = Choice(mean) if env.discrete else Actor(mean, std)
        values = self.critic if mean.first() is None else remembering(self.critic)
        critic = values.init(env.obs_size, 0, key=critic_key)  # a value of states
        # Room for a round of episodes that are all much longer than the last ones.
        most = min(self.copies * env.max_steps, self.horizon + 8 * env.max_steps)
        moments = Moments.first(env, self.network) if self.normalize_observations else None
        return PPOState(
            actor=actor,
            critic=critic,
            optimizer=adam_state((actor, critic)),
            replay=Replay.empty(blank(env, mean), most),
            champion=frozen(moments, mean),
            score=jnp.float32(-jnp.inf),
            length=jnp.float32(min(self.horizon, env.max_steps)),
            frames=jnp.int32(0),
            moments=moments,
            paid=Moments.of_returns(env) if self.normalize_rewards else None,
        )

    @float32()
    def generation(self, state: PPOState, *, key: PRNGKeyArray) -> tuple[PPOState, Metrics]:
        """Play, learn, and test now and then."""
        explore_key, learn_key, test_key = jax.random.split(key, 3)

        # Run the policy for about T frames.
        wanted = jnp.clip(jnp.ceil(self.horizon / state.length).astype(jnp.int32), 1, self.copies)
        _, size, *team = self.env.sizes
        explorer = state.actor.explorer((*team, size) if team else size)
        explorer = behind(state.moments, tree.single(explorer))
        how = {"wanted": wanted, "common": False, "key": explore_key}
        played, experience = collect(self.env, explorer, self.copies, **how)
        empty = Replay(state.replay.data, jnp.int32(0))
        replay = extend(empty, experience.transitions, experience.valid)
        new = jnp.sum(played.steps)
        frames = state.frames + new

        # Compute advantages; optimize the surrogate with K epochs of minibatches.
        networks, paid = (state.actor, state.critic), earned(self, state.paid, replay)
        actor, critic, opt, metrics = improve(
            self, networks, state.optimizer, replay, (state.moments, paid), key=learn_key
        )
        champion, moments = frozen(state.moments, actor.mean), watched(state.moments, experience)

        # Test the policy without noise, now and then.
        due = frames // self.test_every > state.frames // self.test_every
        due = due | (state.score == -jnp.inf)
        score = retested(self.env, champion, self.test_episodes, due, state.score, key=test_key)
        returns = played.of(objective(self.env, self.signal))[0]
        length = new.astype(jnp.float32) / wanted.astype(jnp.float32)
        metrics |= {
            "fitness_max": jnp.max(jnp.where(jnp.arange(self.copies) < wanted, returns, -jnp.inf)),
            "fitness_mean": jnp.sum(returns) / wanted.astype(jnp.float32),
            "champion_score": score,
            "frames": new,
        }
        state = replace(state, actor=actor, critic=critic, optimizer=opt, replay=replay)
        state = replace(state, champion=champion, score=score, length=length, frames=frames)
        return replace(state, moments=moments, paid=paid), metrics

    def warm(self, state: PPOState, policy: AbstractPolicy) -> PPOState:
        """`state` that goes on from a saved policy of the same network."""
        mean, moments = warmed(policy, state.moments)
        actor = replace(state.actor, mean=mean)
        return replace(state, actor=actor, champion=policy, moments=moments)


@jit
def improve(
    ppo: PPO,
    networks: Networks,
    opt: optax.OptState,
    replay: Replay,
    moments: tuple[Moments | None, Moments | None] = (None, None),
    *,
    key: Any,
) -> tuple[Actor | Choice, AbstractCriticNetwork, optax.OptState, Metrics]:
    """K epochs of minibatches of M frames. How many frames there are is data."""
    sample = prepare(ppo, networks, replay, *moments)
    together = ppo.window if sample.begins is not None else 1  # rows that stay together
    pieces = -(-replay.capacity // together)
    some = min(max(ppo.batch_size // together, 1), pieces)
    ready = -(-replay.size // together)
    batches = jnp.maximum(ready // some, 1)  # of few frames one, which is not full
    weights, static = eqx.partition(networks, eqx.is_inexact_array)

    def epoch(k, loop):
        # A permutation of the frames, in minibatches; what is left over is left out.
        u = jax.random.uniform(jax.random.fold_in(key, k), (pieces,))
        order = jnp.argsort(jnp.where(jnp.arange(pieces) < ready, u, 2.0))

        def step(i, loop):
            weights, opt, total = loop
            index = jax.lax.dynamic_slice_in_dim(order, i * some, some)
            rows = _rows(sample, index, together)
            (_, metrics), gradient = jax.value_and_grad(
                lambda w: surrogate(ppo, eqx.combine(w, static), rows), has_aux=True
            )(weights)
            weights, opt = adam(weights, gradient, opt, ppo.learning_rate, ppo.max_norm)
            return weights, opt, jax.tree.map(jnp.add, total, metrics)

        return jax.lax.fori_loop(0, batches, step, loop)

    zeros = {name: jnp.float32(0.0) for name in METRICS}
    weights, opt, total = jax.lax.fori_loop(0, ppo.epochs, epoch, (weights, opt, zeros))
    actor, critic = eqx.combine(weights, static)
    return actor, critic, opt, averaged(total, ppo.epochs * batches)


@jit
def earned(ppo: PPO, paid: Moments | None, replay: Replay) -> Moments | None:
    """The statistics of discounted returns with those of all frames: of each what was paid before
    it in its episode, as it was then discounted."""
    if paid is None:
        return None
    rows: Transition = replay.data
    reward = _by_agent(rows.rewards[objective(ppo.env, ppo.signal)], rows)
    over = _by_agent(rows.terminated | rows.truncated, rows)
    begins = jnp.concatenate([jnp.ones_like(over[:1]), over[:-1]])

    def on(so_far, row):
        now = row[0] + ppo.gamma * jnp.where(row[1], 0.0, so_far)
        return now, now

    returns = jax.lax.scan(on, jnp.zeros_like(reward[0]), (reward, begins))[1]
    filled = jnp.arange(replay.capacity) < replay.size
    return with_rows(paid, returns[..., None], rows.active, filled)


def prepare(
    ppo: PPO,
    networks: Networks,
    replay: Replay,
    moments: Moments | None = None,
    paid: Moments | None = None,
) -> Sample:
    """Advantages by equation 11 and what goes with them, normalised over the frames; observations
    as they were when the policy acted."""
    actor, critic = networks
    rows: Transition = replay.data
    filled = jnp.arange(replay.capacity) < replay.size
    reward = rows.rewards[objective(ppo.env, ppo.signal)]
    obs, next_obs = seen(moments, rows.obs), seen(moments, rows.next_obs)
    reward, terminated, truncated = (
        _by_agent(x, rows) for x in (reward, rows.terminated, rows.truncated)
    )
    if paid is not None:
        reward = jnp.clip(reward / paid.std[None, ..., 0], -10.0, 10.0)
    over = terminated | truncated
    if rows.obs.ndim > 2:
        filled = _by_agent(filled, rows) & (rows.active if rows.active is not None else True)
    before: Any = {"counts": filled}
    if rows.memory is not None:
        begins = jnp.append(True, over[:-1])
        means, value, after, memories = _told_in_order(networks, obs, next_obs, begins)
        before |= {"begins": begins, "memories": memories}
    else:
        means, value, after = actor.told(obs), _value(critic, obs), _value(critic, next_obs)
    delta = reward + ppo.gamma * jnp.where(terminated, 0.0, after) - value
    # Rows come episode by episode.
    goes_on = ~over & jnp.concatenate([filled[1:], jnp.zeros_like(filled[:1])])
    advantage = advantages(delta, goes_on, ppo.gamma * ppo.gae)
    n = jnp.maximum(jnp.sum(filled), 1).astype(jnp.float32)
    average = jnp.sum(jnp.where(filled, advantage, 0.0)) / n
    variance = jnp.sum(jnp.where(filled, jnp.square(advantage - average), 0.0)) / n
    return Sample(
        obs,
        rows.action,
        actor.log_density(means, rows.action),
        (advantage - average) / (jnp.sqrt(variance) + 1e-8),
        advantage + value,
        **before,
    )


def _by_agent(x: Array, rows: Transition) -> Array:
    """What is said of a frame, or of its agents each, of each."""
    shape = rows.obs.shape[:-1]
    return jnp.broadcast_to(x.reshape(x.shape + (1,) * (len(shape) - x.ndim)), shape)


def advantages(
    delta: Float[Array, "rows *agents"], goes_on: Bool[Array, "rows *agents"], decay: Any
) -> Float[Array, "rows *agents"]:
    """A_t = δ_t + γλ A_{t+1}, up to the end of each episode."""

    def back(later, row):
        δ, more = row
        now = δ + decay * jnp.where(more, later, 0.0)
        return now, now

    return jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, goes_on), reverse=True)[1]


def surrogate(ppo: PPO, networks: Networks, rows: Sample) -> tuple[Float[Array, ""], Metrics]:
    """Minus the clipped objective (equation 7) and the critic's squared error."""
    actor, critic = networks
    if rows.memories is None:
        means, value = actor.told(rows.obs), _value(critic, rows.obs)
    else:
        means, value = _told_in_windows(ppo, networks, rows)
    change = actor.log_density(means, rows.action) - rows.log_density
    if rows.counts is not None:  # what is no frame must not overflow
        change = jnp.where(rows.counts, change, 0.0)
    ratio = jnp.exp(change)
    bounded = jnp.clip(ratio, 1.0 - ppo.clip, 1.0 + ppo.clip)
    gain = jnp.minimum(ratio * rows.advantage, bounded * rows.advantage)
    policy_loss = -mean(gain, rows.counts)
    critic_loss = mean(jnp.square(value - rows.value), rows.counts)
    clipped = mean((ratio != bounded).astype(jnp.float32), rows.counts)
    entropy = mean(actor.entropy(means), rows.counts)
    metrics = {"policy_loss": policy_loss, "critic_loss": critic_loss, "clipped": clipped}
    loss = policy_loss + ppo.value_weight * critic_loss - ppo.entropy_weight * entropy
    return loss, metrics


def _rows(sample: Sample, pieces: Int[Array, " some"], together: int) -> Sample:
    """The rows of some pieces, each of so many that follow one another; those behind the last frame
    do not count."""
    if together == 1:
        return jax.tree.map(lambda x: x[pieces], sample)
    index = (pieces[:, None] * together + jnp.arange(together)[None]).reshape(-1)
    rows = jax.tree.map(lambda x: x[jnp.minimum(index, len(x) - 1)], sample)
    return replace(rows, counts=rows.counts & (index < len(sample.value)))


def _told_in_order(networks: Networks, obs: Array, next_obs: Array, begins: Array):
    """What networks with memory say of all frames, one after the other.

    **Returns:** the actor's actions, the critic's values of each frame and of what follows it, and
    what both remembered before each.
    """
    actor, critic = networks[0], _with_history(networks[1])
    means, remembered = through(actor.mean, obs, begins, said=actor.says)

    def ahead(policy):
        def step(given, carry):
            told, carry = policy(given[0], carry)
            return (told, policy(given[1], carry)[0]), carry

        return step

    told, known = through(critic.memory, (obs, next_obs), begins, said=ahead)
    values = [_value_of(critic, *pair) for pair in zip(told, (obs, next_obs), strict=True)]
    return means, *values, (remembered, known)


def _told_in_windows(ppo: PPO, networks: Networks, rows: Sample):
    """The actor's actions and the critic's values of windows, from what was remembered at their
    first rows."""
    actor, critic = networks[0], _with_history(networks[1])
    assert rows.memories is not None

    def split(x):
        return x.reshape(-1, ppo.window, *x.shape[1:])

    def follow(policy, memory, said=lambda policy: policy):
        told = jax.vmap(lambda *given: through(policy, *given, said=said)[0])
        told = told(split(rows.obs), split(rows.begins), split(memory)[:, 0])
        return told.reshape(-1, told.shape[-1])

    means = follow(actor.mean, rows.memories[0], actor.says)
    return means, _value_of(critic, follow(critic.memory, rows.memories[1]), rows.obs)


def _with_history(critic: AbstractCriticNetwork) -> HistoryCriticNetwork:
    assert isinstance(critic, HistoryCriticNetwork)
    return critic


def _value_of(critic: HistoryCriticNetwork, told: Array, obs: Array) -> Float[Array, " rows"]:
    """By what the critic's memory told it, and what is seen now."""
    return _value(critic.critic, jnp.concatenate([told, obs], axis=1))


def _value(
    critic: AbstractCriticNetwork, obs: Float[Array, "rows *agents obs"]
) -> Float[Array, "rows *agents"]:
    return critic(features_first(obs), jnp.zeros((0, *obs.shape[:-1])))
