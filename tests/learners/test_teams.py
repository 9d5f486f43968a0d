"""TD3 for teams: updates as in a NumPy version that goes agent by agent."""

import copy
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from credo.compilation import jit
from credo.learners.base import learn
from credo.learners.sac import SAC
from credo.learners.td3 import TD3, ddpg, maddpg, matd3
from credo.networks.mlp import MLP, Critic
from credo.networks.team import JointCritic, Team
from credo.replay import Replay
from credo.types import Batch, Transition

OBS, ACT, AGENTS, N = 2, 1, 3, 5
NETWORK = Team(trunk=(3,), head=MLP(hidden=(), initializer="uniform"))
CRITIC = Critic(hidden=(4,))
FAST = {"gamma": 0.9, "actor_lr": 0.01, "critic_lr": 0.02, "tau": 0.1, "batch_size": N}
NOISY = FAST | {"target_noise": 0.5, "target_noise_clip": 0.3}
LEARNERS = {
    "td3": TD3(critic=CRITIC, **NOISY),
    "ddpg": TD3(critic=CRITIC, critics=1, policy_delay=1, target_noise=0.0, **FAST),
    "matd3": matd3(critic=JointCritic(critic=CRITIC), **NOISY),
    "maddpg": maddpg(critic=JointCritic(critic=CRITIC), **FAST),
}


@jit
def update(learner, state, batch, key):
    return learner.update(state, batch, key=key)


@jit
def bellman_target(learner, state, batch, key):
    return learner.bellman_target(state, batch, key=key)[0]  # of means there is one sample


def batch_of(seed, agents=AGENTS, active=True):
    draw = np.random.default_rng(seed).uniform(-1, 1, (5, N, agents, OBS)).astype(np.float32)
    obs, action, reward, next_obs, end = draw
    acts = np.random.default_rng(seed + 50).random((N, agents)) < 0.7 if active else None
    ends = np.broadcast_to(end[:, :1, 0] > 0, (N, agents))
    return Batch(
        obs, action[..., :ACT], 3 * reward[..., 0], next_obs, ends, np.zeros_like(ends), acts
    )


def start(name, agents=AGENTS):
    return LEARNERS[name].init(NETWORK, OBS, ACT, agents, key=jax.random.key(0))


def same(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y, equal_nan=True) for x, y in pairs)


def assert_close(a, b, atol=1e-6):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, atol=atol)


def weights_of(policy):
    """Trunk and heads as dicts of float64."""
    double = [policy.trunks[0], *(head.weights for head in policy.heads)]
    return [{name: np.asarray(w, np.float64) for name, w in part.items()} for part in double]


def action_of(weights, obs, agent):
    """What one agent does in each row."""
    x = np.tanh(reference.layer(weights[0], 0, obs[:, agent]))
    return np.tanh(reference.layer(weights[1 + agent], 0, x))


class ByHand:
    """The learner in NumPy: agents one by one, weights in float64."""

    def __init__(self, learner, state):
        self.learner, self.step, self.joint = learner, 0, learner.critic.joint
        self.actor = weights_of(state.actor)
        self.critics = [
            reference.numpy_of(critic.networks if self.joint else critic)
            for critic in state.critics
        ]
        self.target_actor = copy.deepcopy(self.actor)
        self.target_critics = copy.deepcopy(self.critics)
        self.actor_adam = reference.Adam(learner.actor_lr)
        self.critic_adam = reference.Adam(learner.critic_lr)

    def q(self, w, obs, action, agent):
        """Q of one agent: `[n]`."""
        if not self.joint:
            return reference.critic(w, obs[:, agent], action[:, agent])
        own = {name: x[agent] for name, x in w.items()}
        return reference.critic(own, obs.reshape(N, -1), action.reshape(N, -1))

    def target(self, batch, key):
        t = self.learner
        noise = t.target_noise * np.asarray(jax.random.normal(key, batch.action.shape))
        noise = np.clip(noise, -t.target_noise_clip, t.target_noise_clip)
        acts = [action_of(self.target_actor, batch.next_obs, k) for k in range(AGENTS)]
        action = np.clip(np.stack(acts, axis=1) + noise, -1, 1)
        y = np.zeros((N, AGENTS))
        for k in range(AGENTS):
            q = np.min([self.q(w, batch.next_obs, action, k) for w in self.target_critics], axis=0)
            y[:, k] = batch.reward[:, k] + t.gamma * np.where(batch.terminated[:, k], 0.0, q)
        return y

    def error(self, critics, batch, y):
        total = 0.0
        for w in critics:
            q = np.stack([self.q(w, batch.obs, batch.action, k) for k in range(AGENTS)], axis=1)
            total += np.mean((q - y)[batch.active] ** 2)
        return total

    def loss(self, actor, batch):
        """Each agent does as its policy says while the others do what is in the batch."""
        values = np.zeros((N, AGENTS))
        for k in range(AGENTS):
            action = np.array(batch.action, np.float64)
            action[:, k] = action_of(actor, batch.obs, k)
            values[:, k] = self.q(self.critics[0], batch.obs, action, k)
        return -np.mean(values[batch.active])

    def update(self, batch, key):
        y = self.target(batch, key)
        critic_loss = self.error(self.critics, batch, y)
        slopes = reference.gradient(lambda critics: self.error(critics, batch, y), self.critics)
        self.critic_adam(self.critics, slopes)
        if self.step % self.learner.policy_delay == 0:
            slopes = reference.gradient(lambda actor: self.loss(actor, batch), self.actor)
            self.actor_adam(self.actor, slopes)
            reference.follow(self.target_actor, self.actor, self.learner.tau)
            reference.follow(self.target_critics, self.critics, self.learner.tau)
        self.step += 1
        return critic_loss


def assert_team(policy, weights):
    for part, w in zip(
        (policy.trunks[0], *(h.weights for h in policy.heads)), weights, strict=True
    ):
        assert part.keys() == w.keys()
        for name, values in w.items():
            np.testing.assert_allclose(part[name], values, atol=2e-5, err_msg=name)


@pytest.mark.parametrize("name", LEARNERS)
def test_updates_are_those_of_the_equations_agent_by_agent(name):
    learner, state = LEARNERS[name], start(name)
    by_hand, networks = ByHand(learner, state), lambda critics: critics
    assert len(by_hand.critics) == (2 if "td3" in name else 1)
    if by_hand.joint:
        networks = lambda critics: [critic.networks for critic in critics]  # noqa: E731
    for step in range(3):
        batch, key = batch_of(step), jax.random.key(step)
        assert batch.active.any()
        assert not batch.active.all()
        np.testing.assert_allclose(
            bellman_target(learner, state, batch, key), by_hand.target(batch, key), atol=1e-5
        )
        state, metrics = update(learner, state, batch, key)
        assert float(metrics["critic_loss"]) == pytest.approx(by_hand.update(batch, key), rel=1e-3)
        assert_team(state.actor, by_hand.actor)
        assert_team(state.target_actor, by_hand.target_actor)
        reference.assert_weights(networks(state.critics), by_hand.critics)
        reference.assert_weights(networks(state.target_critics), by_hand.target_critics)


@pytest.mark.parametrize("name", LEARNERS)
def test_a_team_of_one_learns_as_one_agent_does(name):
    """From the same weights; what the trunk is to a team, the first layer is to an MLP."""
    learner, team = LEARNERS[name], start(name, agents=1)
    alone_learner = dataclasses.replace(learner, critic=CRITIC)
    alone = alone_learner.init(MLP(hidden=(3,)), OBS, ACT, key=jax.random.key(0))

    def actor_of(state):
        trunk, head = state.actor.trunks[0], state.actor.heads[0].weights
        return trunk | {f"{kind}_1": head[f"{kind}_0"] for kind in "Wb"}

    def critics_of(state):
        nets = [c.networks if learner.critic.joint else c for c in state.critics]
        shape = (lambda x: x[0]) if learner.critic.joint else (lambda x: x)
        return [{key: shape(w) for key, w in net.weights.items()} for net in nets]

    policy = eqx.tree_at(lambda p: p.weights, alone.actor, actor_of(team))
    alone = alone_learner.warm(alone, policy)
    critics = tuple(
        eqx.tree_at(lambda c: c.weights, critic, w)
        for critic, w in zip(alone.critics, critics_of(team), strict=True)
    )
    alone = eqx.tree_at(lambda s: (s.critics, s.target_critics), alone, (critics, critics))
    for step in range(2):
        batch, key = batch_of(step, agents=1, active=False), jax.random.key(step)
        team, told = update(learner, team, batch, key)
        single = jax.tree.map(lambda x: x[:, 0], batch)
        alone, expected = update(alone_learner, alone, single, key)
        assert_close(told, expected, atol=1e-5)
        assert_close(actor_of(team), alone.actor.weights, atol=1e-5)
        assert_close(critics_of(team), [c.weights for c in alone.critics], atol=1e-5)


def garbage(batch, fields):
    """The batch with anything where nobody acted."""
    draw = np.random.default_rng(9)

    def spoiled(x):
        mask = batch.active.reshape(batch.active.shape + (1,) * (x.ndim - 2))
        if x.dtype == bool:
            return np.where(mask, x, ~x)
        return np.where(mask, x, 50 * draw.normal(size=x.shape)).astype(x.dtype)

    values = [spoiled(getattr(batch, field)) for field in fields]
    return eqx.tree_at(lambda b: [getattr(b, field) for field in fields], batch, values)


@pytest.mark.parametrize("name", LEARNERS)
def test_who_did_not_act_changes_nothing(name):
    """Critics of a whole team do see what those who did not act observe and say."""
    fields = ["reward", "terminated"]
    if not LEARNERS[name].critic.joint:
        fields += ["obs", "action", "next_obs"]
    batch = batch_of(0)
    results = [
        update(LEARNERS[name], start(name), b, jax.random.key(0))
        for b in (batch, garbage(batch, fields))
    ]
    assert_close(results[0], results[1], atol=1e-5)
    everybody = eqx.tree_at(lambda b: b.active, batch, np.ones_like(batch.active))
    other, _ = update(LEARNERS[name], start(name), everybody, jax.random.key(0))
    assert not same(other.actor, results[0][0].actor)


@pytest.mark.parametrize("name", ["td3", "matd3"])
def test_where_nobody_acted_nothing_is_learned(name):
    """Agents that draw frames of their own may all draw one in which they did not act."""
    batch, before = batch_of(0), start(name)
    idle = eqx.tree_at(lambda b: b.active, batch, np.zeros_like(batch.active))
    after, metrics = update(LEARNERS[name], before, idle, jax.random.key(0))
    assert float(metrics["critic_loss"]) == 0.0
    assert same((after.actor, after.critics), (before.actor, before.critics))


@pytest.mark.parametrize("name", ["ddpg", "maddpg"])
def test_everybody_acts_where_nobody_says_who_does(name):
    batch = batch_of(0)
    full = eqx.tree_at(lambda b: b.active, batch, np.ones_like(batch.active))
    none = eqx.tree_at(lambda b: b.active, batch, None)
    told, silent = (update(LEARNERS[name], start(name), b, jax.random.key(0)) for b in (full, none))
    assert_close(told, silent, atol=1e-5)


# Through replay

ROWS = 7


@pytest.fixture(scope="module")
def rows():
    """Joint frames whose `private` reward is for each agent what `shared` is for all."""
    draw = np.random.default_rng(4).uniform(-1, 1, (4, ROWS, AGENTS, OBS)).astype(np.float32)
    shared = draw[3, :, 0, 0]
    own = np.ascontiguousarray(np.broadcast_to(shared[:, None], (ROWS, AGENTS)))
    rewards = {"shared": shared, "private": own, "other": draw[3, :, :, 1]}
    ends = (draw[3, :, 1, 0] > 0.5, draw[3, :, 1, 0] > 9)
    acts = np.ones((ROWS, AGENTS), bool)
    acts[::2, 1] = False
    return Transition(draw[0], draw[1, ..., :ACT], rewards, draw[2], *ends, acts)


def ring(rows):
    return Replay(jax.tree.map(jnp.asarray, rows), jnp.int32(ROWS))


@pytest.mark.parametrize("name", ["td3", "matd3"])
def test_a_reward_of_all_is_the_reward_of_each(name, rows):
    learner, key = LEARNERS[name], jax.random.key(1)
    states = {
        signal: learn(learner, start(name), ring(rows), jnp.int32(3), signal=signal, key=key)[0]
        for signal in rows.rewards
    }
    assert_close(states["shared"], states["private"])
    assert not same(states["shared"].critics, states["other"].critics)
    own = dataclasses.replace(learner, signal="other")
    named, _ = learn(own, start(name), ring(rows), jnp.int32(3), signal="shared", key=key)
    assert_close(named, states["other"])


@pytest.mark.parametrize("name", ["td3", "matd3"])
def test_agents_learn_from_the_same_frames_if_a_critic_sees_them_all(name, rows):
    learner, key = LEARNERS[name], jax.random.key(1)
    assert learner.together == (name == "matd3")
    learned, metrics = learn(
        learner, start(name), ring(rows), jnp.int32(1), signal="other", key=key
    )
    sample_key, update_key = jax.random.split(jax.random.fold_in(key, 0))
    x = ring(rows).sample(N, together=learner.together, key=sample_key)[0]
    batch = Batch(
        x.obs, x.action, x.rewards["other"], x.next_obs, x.terminated, x.truncated, x.active
    )
    expected, told = update(learner, start(name), batch, update_key)
    assert_close((learned, metrics), (expected, told), atol=1e-5)


def test_frames_in_which_an_agent_did_not_act_do_not_reach_it(rows):
    """Neither its observation nor its action nor its reward matter."""

    def spoiled(x):
        if x.ndim == 1:
            return x
        mask = rows.active.reshape(rows.active.shape + (1,) * (x.ndim - 2))
        return np.where(mask, x, np.float32(30.0)).astype(x.dtype)

    other = jax.tree.map(spoiled, eqx.tree_at(lambda r: r.active, rows, None))
    other = eqx.tree_at(lambda r: r.active, other, rows.active, is_leaf=lambda x: x is None)
    a, b = (
        learn(
            LEARNERS["td3"],
            start("td3"),
            ring(r),
            jnp.int32(4),
            signal="other",
            key=jax.random.key(0),
        )[0]
        for r in (rows, other)
    )
    assert_close((a.actor, a.critics), (b.actor, b.critics), atol=1e-5)


# Settings


def test_what_the_learners_of_a_team_are():
    twin, single = matd3(), maddpg()
    assert (twin.critics, twin.policy_delay, twin.target_noise) == (2, 2, 0.2)
    assert (single.critics, single.policy_delay, single.target_noise) == (1, 1, 0.0)
    for learner in (twin, single):
        assert learner.together
        assert (learner.gamma, learner.batch_size, learner.noise.std) == (0.97, 128, 0.4)
    assert matd3(gamma=0.5).gamma == maddpg(gamma=0.5).gamma == 0.5
    assert (maddpg(critics=2).critics, maddpg(tau=0.3).tau) == (2, 0.3)
    assert not TD3().together
    assert (TD3.teams, SAC.teams) == (True, False)


def test_a_policy_without_delay_moves_at_every_update():
    for name, delayed in (("matd3", True), ("maddpg", False)):
        state, moved = start(name), []
        for step in range(4):
            after, _ = update(LEARNERS[name], state, batch_of(step), jax.random.key(step))
            moved.append(not same(after.actor, state.actor))
            state = after
        assert moved == ([True, False, True, False] if delayed else [True] * 4)


def test_a_team_explores_agent_by_agent():
    learner, state = LEARNERS["td3"], start("td3")
    obs = batch_of(0).obs[0]
    quiet = eqx.tree_at(lambda t: t.noise.std, learner, 0.0)
    still, noisy, random = (
        x.explorer(state, jnp.bool_(flag))
        for x, flag in ((quiet, False), (learner, False), (learner, True))
    )
    said, moved, drawn = (
        np.asarray(x(jnp.asarray(obs), x.start(key=jax.random.key(0)))[0])
        for x in (still, noisy, random)
    )
    assert said.shape == moved.shape == drawn.shape == (AGENTS, ACT)
    weights = weights_of(state.actor)
    expected = np.concatenate([action_of(weights, obs[None], k) for k in range(AGENTS)])
    np.testing.assert_allclose(said, expected, atol=1e-5)
    assert len(np.unique(np.round(moved - said, 6))) == AGENTS
    assert len(np.unique(drawn)) == AGENTS
    assert (np.abs(drawn) <= 1.0).all()


def test_the_actor_of_a_team_may_start_small():
    full, small = (
        TD3(critic=CRITIC, actor_scale=scale).init(NETWORK, OBS, ACT, AGENTS, key=jax.random.key(0))
        for scale in (1.0, 0.1)
    )
    assert same(full.actor.trunks, small.actor.trunks)
    for a, b in zip(full.actor.heads, small.actor.heads, strict=True):
        for name in ("W_0", "b_0"):
            np.testing.assert_allclose(b.weights[name], 0.1 * a.weights[name], rtol=1e-6)
    assert same(small.actor, small.target_actor)


def test_ddpg_learns_for_a_team_too():
    learner = ddpg(batch_size=N)
    state = learner.init(NETWORK, OBS, ACT, AGENTS, key=jax.random.key(0))
    after, _ = update(learner, state, batch_of(0), jax.random.key(0))
    moves = [
        np.abs(b - a).max()
        for a, b in zip(*map(jax.tree.leaves, (state.actor, after.actor)), strict=True)
    ]
    assert max(moves) == pytest.approx(5e-5, rel=0.05)  # its rate
