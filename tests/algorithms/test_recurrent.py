"""Networks with memory learn by gradient, alone, beside a population, and in a team."""

import dataclasses

import jax
import numpy as np
import pytest
from compilations import compilations
from test_off_policy import run, same
from walk import HostWalk

from credo import tree
from credo.algorithms.erl import ERL
from credo.algorithms.merl import LOCAL, MERL
from credo.algorithms.off_policy import OffPolicy
from credo.algorithms.ppo import PPO, _rows, _told_in_windows, prepare
from credo.compilation import jit
from credo.environments.passive_tmaze import PassiveTMaze
from credo.environments.probes import Meet, Remember
from credo.evolution.breeder import Breeder
from credo.learners.coach import Coached
from credo.learners.horizon import Truncated
from credo.learners.sac import SAC
from credo.learners.surrogate import Preselection
from credo.learners.td3 import TD3, ddpg
from credo.networks.dmmu import DMMU
from credo.networks.exploration import GaussianNoise
from credo.networks.history import HistoryCritic
from credo.networks.mlp import MLP, Critic
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent
from credo.networks.team import Centralized, Team
from credo.replay import Sampling

GRU = Recurrent("gru", 8, "tanh", "fan_in")
CRITIC = HistoryCritic(Critic(hidden=(16,)), Recurrent("gru", 8, initializer="fan_in"), units=8)
FAST = {"critic": CRITIC, "actor_lr": 0.01, "critic_lr": 0.01, "tau": 0.05, "gamma": 0.9}
FAST |= {"batch_size": 128}
NOISE = GaussianNoise(0.5)
LEARNERS = {
    "td3": TD3(**FAST | {"actor_lr": 0.003}, noise=NOISE),
    "ddpg": ddpg(**FAST | {"actor_lr": 0.003}),
    "sac": SAC(**FAST, alpha_lr=0.01, temperature=0.1),
}
TASK = Remember(delay=3)
SETTINGS = {"episodes": 4, "start_frames": 60, "replay_capacity": 2000, "test_episodes": 20}
SETTINGS |= {"sampling": Sampling(window=4, burn_in=0), "test_every": 1}


PPO_SETTINGS = {"horizon": 64, "copies": 16, "batch_size": 16, "window": 4, "test_episodes": 20}
PPO_SETTINGS |= {"learning_rate": 0.01, "test_every": 1}


@pytest.mark.parametrize("network", [GRU, MMU(8, initializer="fan_in")], ids=["gru", "mmu"])
@pytest.mark.parametrize("name", LEARNERS)
def test_learners_learn_to_remember(name, network):
    """Without memory nobody is right more than half of the time."""
    alone = OffPolicy(TASK, network, LEARNERS[name], **SETTINGS)
    rows, _ = run(alone, 60)
    assert max(row["champion_score"] for row in rows) == 1.0
    assert rows[0]["champion_score"] < 1.0


@pytest.mark.parametrize("window", [4, 6])
def test_ppo_learns_to_remember(window):
    ppo = PPO(TASK, GRU, Critic(hidden=(16,)), **PPO_SETTINGS | {"window": window})
    rows, _ = run(ppo, 40)
    assert max(row["champion_score"] for row in rows[-10:]) == 1.0


def test_ppo_sees_in_windows_what_it_saw_in_order():
    """Windows of 3 in episodes of 4 frames, the last of which is not full."""
    ppo = PPO(TASK, MMU(4), Critic(hidden=(16,)), **PPO_SETTINGS | {"window": 3})
    _, state = run(ppo, 1)
    networks, replay = (state.actor, state.critic), state.replay
    sample = jit(prepare)(ppo, networks, replay)
    n = -(-replay.capacity // 3)
    rows = jit(_rows)(sample, np.arange(n), 3)
    assert rows.counts.sum() == replay.size == 64
    means, values = jit(_told_in_windows)(ppo, networks, rows)
    density = state.actor.log_density(means, rows.action)[:64]
    np.testing.assert_allclose(density, sample.log_density[:64], rtol=1e-4, atol=1e-4)
    before, memory = state.actor.mean.start(), state.critic.memory.start()
    for t in range(64):
        if t % 4 == 0:
            before, memory = state.actor.mean.start(), state.critic.memory.start()
        action, before = state.actor.mean(replay.data.obs[t], before)
        told, memory = state.critic.memory(replay.data.obs[t], memory)
        np.testing.assert_allclose(means[t], action, atol=1e-4)
        seen = np.concatenate([told, replay.data.obs[t]])
        np.testing.assert_allclose(values[t], state.critic.critic(seen, np.zeros(0)), atol=1e-4)


def test_a_population_remembers_beside_a_learner():
    how = {"population_size": 4, "breeder": Breeder(elite_fraction=0.25), "warmup_frames": 60}
    how |= {"sync_period": 1, "replay_capacity": 2000, "sampling": SETTINGS["sampling"]}
    erl = ERL(TASK, GRU, (LEARNERS["ddpg"],), test_episodes=20, **how)
    rows, state = run(erl, 40)
    assert max(row["champion_score"] for row in rows) == 1.0
    last = erl.learners[0].actor(state.learners[0])
    guest = jax.tree.map(lambda x: x[-1], state.population)
    assert same(guest, last)
    helped = dataclasses.replace(erl, coach=Coached(), surrogate=Preselection(states=64))
    rows, _ = run(helped, 8)
    assert rows[-1]["coach_updates"] > 0


def test_what_is_stored_is_what_the_policy_remembered():
    """In JAX and outside, and through all that stands around a policy."""
    network = Recurrent("lstm", 3, "tanh")
    for task, normalized in ((TASK, False), (TASK, True), (HostWalk(), True)):
        alone = OffPolicy(task, network, LEARNERS["td3"], **SETTINGS)
        alone = dataclasses.replace(alone, start_frames=10**6, normalize_observations=normalized)
        state = alone.init(key=jax.random.key(0))
        actor, before = state.champion, state.frames
        play = alone.generation if task != TASK else jit(alone.generation)
        state, _ = play(state, key=jax.random.key(1))
        n = int(state.frames - before)
        rows = jax.tree.map(np.asarray, tree.take(state.replay.data, np.arange(n)))
        over, carry = True, None
        for t in range(len(rows.terminated)):
            carry = actor.start(key=jax.random.key(0)) if over else carry
            np.testing.assert_allclose(rows.memory[t], actor.remembered(carry), atol=1e-5)
            _, carry = actor(rows.obs[t], carry)
            over = rows.terminated[t] or rows.truncated[t]
        assert np.abs(rows.memory).max() > 0


def team_of(network, critic=None, **learner):
    settings = {"population_size": 4, "workers": 4, "episodes": 2, "replay_capacity": 2000}
    settings |= {"warmup_frames": 50, "updates_per_frame": 0.3, "test_episodes": 5}
    given = {"critic": critic or Critic(hidden=(16,)), "batch_size": 64, **learner}
    local = dataclasses.replace(LOCAL, **given)
    settings["breeder"] = Breeder(elite_fraction=0.25)
    return MERL(Meet(), network, (local,), sampling=Sampling(window=3, burn_in=1), **settings)


@pytest.mark.parametrize(
    "network",
    [
        Team(trunk=(4,), head=GRU),
        Team(trunk=(4,), head=MMU(4, initializer="fan_in"), sharing="nothing"),
        DMMU(hidden=4, access="everyone", initializer="fan_in"),
        Centralized(GRU),
    ],
    ids=["heads", "apart", "dmmu", "centralized"],
)
def test_teams_with_memory_are_evolved_and_learn(network):
    merl = team_of(network, actor_lr=0.01)
    rows, state = run(merl, 25)
    assert rows[-1]["updates"] > 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.learners))
    assert max(row["champion_score"] for row in rows) == 1.0


@pytest.mark.parametrize("sharing", ["trunk", "nothing"])
def test_a_team_with_memory_learns_without_evolution(sharing):
    """From windows of which some begin within an episode."""
    learner = TD3(signal="local", **FAST | {"critic": Critic(hidden=(16,)), "batch_size": 64})
    learner = dataclasses.replace(learner, noise=GaussianNoise(0.5), reward_scale=5.0)
    network = Team(trunk=(8,), head=GRU, sharing=sharing)
    how = SETTINGS | {"sampling": Sampling(window=2, burn_in=1), "updates_per_frame": 0.5}
    rows, _ = run(OffPolicy(Meet(), network, learner, **how), 60)
    assert max(row["champion_score"] for row in rows) == 1.0
    assert rows[0]["champion_score"] < 1.0


def test_nothing_compiles_after_the_first_learning_generation():
    alone = OffPolicy(HostWalk(spread=0.5), GRU, LEARNERS["td3"], **SETTINGS)
    state = alone.init(key=jax.random.key(0))
    for i in range(20):
        with compilations() as events:
            state, metrics = alone.generation(state, key=jax.random.key(i))
        if i > 10:
            assert metrics["updates"] > 0
            assert events == []


def test_what_memory_cannot_have_is_refused():
    with pytest.raises(ValueError, match="steps is 3 and Recurrent has memory"):
        OffPolicy(TASK, GRU, LEARNERS["td3"], sampling=Sampling(steps=3))
    with pytest.raises(
        ValueError, match=r"batch_size is 128 and .* windows of 200 frames behind 16"
    ):
        OffPolicy(TASK, GRU, LEARNERS["td3"], sampling=Sampling(window=200))
    with pytest.raises(ValueError, match=r"room for 60 frames.* windows of 64 frames"):
        OffPolicy(TASK, GRU, LEARNERS["td3"], replay_capacity=60)
    with pytest.raises(
        ValueError, match="batch_size is 16 and window is 20: a network with memory"
    ):
        PPO(TASK, GRU, batch_size=16, window=20)
    with pytest.raises(ValueError, match="a horizon asks the critic about single steps"):
        ERL(TASK, GRU, (LEARNERS["td3"],), horizon=Truncated(2))
    with pytest.raises(TypeError, match="HistoryCritic values windows of an episode"):
        run(OffPolicy(TASK, MLP(), LEARNERS["td3"], **SETTINGS), 20)


@pytest.mark.parametrize("preset", ["td3", "ddpg", "sac"])
def test_presets_have_windows_in_their_batches(preset):
    make = OffPolicy.presets()[preset]
    with_memory, without = make(TASK, GRU), make(TASK, MLP())
    assert with_memory.learner.batch_size == 1024
    assert with_memory.updates_per_frame == 0.25
    assert without.learner.batch_size in (128, 256)
    assert without.updates_per_frame == 1.0
    assert make(TASK, GRU, updates_per_frame=2.0).updates_per_frame == 2.0
    assert ERL.hybrid(TASK, GRU).horizon is None
    assert ERL.hybrid(TASK, MLP()).horizon is not None
    assert ERL.cerl(TASK, GRU).learners[3].batch_size == 1024
    assert ERL.ea(TASK, GRU).updates_per_frame == 1.0
    assert PPO.ppo(TASK, GRU).batch_size == 8 * TASK.max_steps
    assert PPO.ppo(TASK, MLP()).batch_size == 64
    assert MERL.hybrid(Meet(), Team(head=GRU)).learners[0].batch_size == 1024


def test_presets_see_short_episodes_whole():
    """A window of 64 cannot hold sign and junction of a corridor of 100 steps together."""
    gru = Recurrent("gru", 4)
    for make in (OffPolicy.td3, OffPolicy.sac, OffPolicy.ddpg, ERL.erl, ERL.cerl, ERL.hybrid):
        assert make(PassiveTMaze(100), gru).sampling == Sampling(window=101, burn_in=0)
        assert make(PassiveTMaze(10), gru).sampling == Sampling(window=11, burn_in=0)
        assert make(PassiveTMaze(128), gru).sampling == Sampling(window=64, burn_in=16)
    ppo = PPO.ppo(PassiveTMaze(100), gru)
    assert (ppo.window, ppo.batch_size) == (101, 808)
    assert OffPolicy.td3(PassiveTMaze(100)).sampling == Sampling()
