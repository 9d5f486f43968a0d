"""Networks with memory on windows of an episode, beside a plain loop over its steps."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.networks.dmmu import DMMU
from credo.networks.dnc import DNC
from credo.networks.history import HistoryCritic, by_row, moments, through, unrolled
from credo.networks.mlp import MLP, Critic
from credo.networks.mmu import MMU
from credo.networks.ntm import NTM
from credo.networks.recurrent import Recurrent
from credo.networks.team import Centralized, JointCritic, Team
from credo.types import Batch, Windows

OBS, ACT, AGENTS = 3, 2, 3
N, LENGTH, BURN_IN = 4, 6, 2
FRESH = np.array([True, False, False, True])
ALONE = {
    "rnn": Recurrent("rnn", 4),
    "gru": Recurrent("gru", 4),
    "lstm": Recurrent("lstm", 4),
    "mmu": MMU(4),
    "mmu-learned": MMU(4, 3, alpha=0.5, encoder="learned", decoder="learned"),
    "ntm": NTM(hidden=5, rows=4, width=3),
    "dnc": DNC(hidden=5, rows=4, width=3),
}
TEAMS = {
    "heads": Team(trunk=(4,), head=MMU(4)),
    "apart": Team(trunk=(4,), head=Recurrent("lstm", 4), sharing="nothing"),
    "shared": Team(trunk=(4,), head=Recurrent("gru", 4), sharing="everything"),
    "dmmu": DMMU(hidden=3, access="everyone"),
    "centralized": Centralized(MMU(4)),
}


def made(network):
    sizes = (OBS, ACT, AGENTS) if network.team else (OBS, ACT)
    return network.init(*sizes, key=jax.random.key(0))


def windows_of(network, policy, seed=0):
    """Windows, and what is observed in them; such a policy could remember what they hold."""
    rng, team = np.random.default_rng(seed), (AGENTS,) if network.team else ()
    seen = rng.uniform(-1, 1, (N, LENGTH, *team, OBS)).astype(np.float32)
    memory = []
    for _ in range(N):
        carry = policy.start(key=jax.random.key(0))
        for obs in rng.uniform(-1, 1, (3, *team, OBS)).astype(np.float32):
            _, carry = policy(obs, carry)
        memory.append(policy.remembered(carry))
    fresh = np.broadcast_to(FRESH.reshape(-1, *(1,) * len(team)), (N, *team))
    return seen, Windows(jnp.asarray(fresh), jnp.stack(memory), LENGTH, BURN_IN)


def looped(policy, seen, windows, weights):
    """A weighted sum of what is said, step by step; nothing flows through a burn-in but in fresh
    windows."""
    total = 0.0
    for i in range(N):
        if FRESH[i]:
            carry = policy.start(key=jax.random.key(0))
        else:
            carry = policy.recalled(windows.memory[i], key=jax.random.key(0))
        for t in range(LENGTH):
            if t == BURN_IN and not FRESH[i]:
                carry = jax.lax.stop_gradient(carry)
            said, carry = policy(seen[i, t], carry)
            total = total + jnp.sum(weights[i, t] * said)
    return total


@pytest.mark.parametrize("name", [*ALONE, *TEAMS])
def test_gradients_are_those_of_a_plain_loop(name):
    network = (ALONE | TEAMS)[name]
    policy = made(network)
    seen, windows = windows_of(network, policy)
    weights = np.random.default_rng(1).normal(size=(*seen.shape[:-1], ACT)).astype(np.float32)

    def ours(policy):
        return jnp.sum(weights * unrolled(policy, seen, windows))

    value, gradient = eqx.filter_jit(eqx.filter_value_and_grad(ours))(policy)
    expected = eqx.filter_value_and_grad(looped)(policy, seen, windows, weights)
    np.testing.assert_allclose(value, expected[0], rtol=1e-4, atol=1e-5)
    pairs = zip(*map(jax.tree.leaves, (gradient, expected[1])), strict=True)
    for mine, theirs in pairs:
        np.testing.assert_allclose(mine, theirs, rtol=2e-3, atol=2e-5)


@pytest.mark.parametrize("name", [*ALONE, *TEAMS])
def test_what_is_remembered_is_recalled(name):
    network = (ALONE | TEAMS)[name]
    assert network.remembers
    policy = made(network)
    seen, _ = windows_of(network, policy)
    for one in (policy, policy.arranged()):
        carry = one.start(key=jax.random.key(0))
        for t in range(3):
            _, carry = one(seen[0, t], carry)
        memory = one.remembered(carry)
        assert memory.shape[:-1] == ((AGENTS,) if network.team else ())
        again = one.recalled(memory, key=jax.random.key(0))
        jax.tree.map(np.testing.assert_array_equal, again, carry)


def test_memoryless_networks_remember_nothing():
    for network in (MLP(), Team(), Centralized()):
        assert not network.remembers
        policy = made(network)
        assert policy.remembered(policy.start(key=jax.random.key(0))) is None


def test_moments_follow_each_other():
    obs = jnp.arange(N * LENGTH * OBS, dtype=jnp.float32).reshape(-1, OBS)
    fresh = Windows(jnp.asarray(FRESH), jnp.zeros((N, 1)), LENGTH, 0)
    rest = [None] * 4
    batch = Batch(obs, obs[:, :ACT], *rest[:1], obs + 100, *rest[:2], None, None, fresh)
    later = moments(batch, later=True)
    assert later.shape == (N, LENGTH + 1, OBS)
    np.testing.assert_array_equal(by_row(later, later=True), obs + 100)
    np.testing.assert_array_equal(by_row(moments(batch)), obs)
    np.testing.assert_array_equal(later[:, 0], obs.reshape(N, LENGTH, OBS)[:, 0])


@pytest.mark.parametrize("critic", [Critic(hidden=(8,)), JointCritic(Critic(hidden=(8,)))])
def test_a_critic_remembers_what_was_seen_and_done(critic):
    team = (AGENTS,) if critic.joint else ()
    config = HistoryCritic(critic, Recurrent("gru", 4), units=2)
    network = config.init(OBS, ACT, *team, key=jax.random.key(0))
    rng = np.random.default_rng(0)
    obs, after = rng.uniform(-1, 1, (2, N * LENGTH, *team, OBS)).astype(np.float32)
    after.reshape(N, LENGTH, -1)[:, :-1] = obs.reshape(N, LENGTH, -1)[:, 1:]  # one episode
    action = rng.uniform(-1, 1, (N * LENGTH, *team, ACT)).astype(np.float32)
    fresh = np.broadcast_to(FRESH.reshape(-1, *(1,) * len(team)), (N, *team))
    windows = Windows(jnp.asarray(fresh), jnp.zeros((N, *team, 1)), LENGTH, 0)
    zeros = np.zeros(N * LENGTH, np.float32)
    batch = Batch(obs, action, zeros, after, zeros > 1, zeros > 1, None, None, windows)
    now, later = (np.asarray(network.sees(batch, later)) for later in (False, True))
    assert now.shape == (OBS + 2, N * LENGTH, *team)
    memory = network.memory
    for i in range(N):
        for agent in range(AGENTS) if team else [()]:
            carry, before = memory.start(), np.zeros(ACT, np.float32)
            for t in range(LENGTH):
                row = (i * LENGTH + t, *np.atleast_1d(agent)) if team else (i * LENGTH + t,)
                told, carry = memory(np.concatenate([obs[row], before]), carry)
                before = action[row]
                expected = np.concatenate([told, obs[row]])
                np.testing.assert_allclose(now[(slice(None), *row)], expected, atol=1e-5)
                ahead, _ = memory(np.concatenate([after[row], before]), carry)
                expected = np.concatenate([ahead, after[row]])
                np.testing.assert_allclose(later[(slice(None), *row)], expected, atol=1e-5)


def test_a_critic_needs_windows_and_a_network_with_memory():
    frames = Batch(jnp.zeros((4, OBS)), jnp.zeros((4, ACT)), *[None] * 4)
    with pytest.raises(TypeError, match="HistoryCritic values windows of an episode"):
        HistoryCritic().init(OBS, ACT, key=jax.random.key(0)).sees(frames)
    with pytest.raises(ValueError, match="memory is MLP: give a network with memory"):
        HistoryCritic(memory=MLP())


@pytest.mark.parametrize("name", ALONE)
def test_one_episode_behind_the_other(name):
    policy = made(ALONE[name])
    seen = np.random.default_rng(0).uniform(-1, 1, (8, OBS)).astype(np.float32)
    begins = np.array([True, False, False, True, False, False, False, True])
    said, before = jax.jit(lambda: through(policy, seen, begins))()
    carry = None
    for t in range(8):
        carry = policy.start() if begins[t] else carry
        np.testing.assert_allclose(before[t], policy.remembered(carry), atol=1e-5)
        expected, carry = policy(seen[t], carry)
        np.testing.assert_allclose(said[t], expected, atol=1e-5)
    rest, _ = through(policy, seen[2:], begins[2:], before[2])
    np.testing.assert_allclose(rest, said[2:], atol=1e-5)
