"""One learner alone: it learns, and its frames, updates and tests are what they say."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from walk import HostWalk, Walk

from credo import rollout, tree
from credo.algorithms.erl import ERL
from credo.algorithms.neuroevolution import Neuroevolution
from credo.algorithms.off_policy import OffPolicy
from credo.algorithms.ppo import PPO
from credo.compilation import jit
from credo.environments.gymnasium import Gymnasium
from credo.environments.hidden import hidden
from credo.environments.last_step import with_last_step
from credo.environments.probes import Choose, Copy, Meet
from credo.environments.wrappers import NoisyObservations, delayed
from credo.learners import td3 as learners
from credo.learners.coach import Coached
from credo.learners.dqn import DQN
from credo.learners.fitness_critic import Criticised, FitnessCritic
from credo.learners.sac import SAC
from credo.learners.td3 import TD3, ddpg
from credo.networks.choosing import choosing
from credo.networks.exploration import OrnsteinUhlenbeck
from credo.networks.mlp import MLP, Critic
from credo.networks.recurrent import Recurrent
from credo.networks.team import Team
from credo.replay import Sampling
from credo.types import NOTHING

FAST = {"actor_lr": 0.01, "critic_lr": 0.01, "tau": 0.05, "gamma": 0.5, "batch_size": 64}
CRITIC = Critic(hidden=(16,))
LEARNERS = {
    "td3": TD3(critic=CRITIC, **FAST),
    "ddpg": ddpg(critic=CRITIC, noise=OrnsteinUhlenbeck(scale=1.0), **FAST),
    "sac": SAC(critic=CRITIC, alpha_lr=0.01, target_entropy=-2.0, **FAST),
}
SETTINGS = {"episodes": 2, "start_frames": 60, "replay_capacity": 1000, "test_episodes": 20}


@jit
def generation(algorithm, state, key):
    return algorithm.generation(state, key=key)


def run(algorithm, generations, play=generation, seed=0):
    """Metrics of each generation, and the last state."""
    root, rows = jax.random.key(seed), []
    state = algorithm.init(key=jax.random.fold_in(root, 0))
    for g in range(1, generations + 1):
        state, metrics = play(algorithm, state, jax.random.fold_in(root, g))
        rows.append({name: np.asarray(value).item() for name, value in metrics.items()})
    return rows, state


def same(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in pairs)


@pytest.mark.parametrize("name", LEARNERS)
def test_it_learns_to_copy(name):
    """The best return is 0; whoever does nothing earns -10/3."""
    network = MLP(hidden=(16,), activation="relu", initializer="uniform")
    algorithm = OffPolicy(Copy(), network, LEARNERS[name], test_every=20, **SETTINGS)
    rows, _ = run(algorithm, 25)
    assert sum(row["updates"] for row in rows) == 25 * 20 - 60
    assert rows[0]["champion_score"] < -0.9
    assert rows[-1]["champion_score"] > -0.3


ALGORITHM = OffPolicy(
    HostWalk(),
    MLP(hidden=(3,)),
    TD3(critic=Critic(hidden=(3,)), actor_lr=0.01, batch_size=4),
    episodes=2,
    start_frames=20,
    updates_per_frame=0.5,
    test_every=30,
    test_episodes=2,
    replay_capacity=100,
)


def eager(algorithm, state, key):
    return algorithm.generation(state, key=key)


@pytest.fixture(scope="module")
def host():
    """Rows of metrics and, after each generation, the state but for its replay buffer."""
    root, rows, states = jax.random.key(0), [], []
    state = ALGORITHM.init(key=jax.random.fold_in(root, 0))
    for g in range(1, 13):
        states.append(eqx.tree_at(lambda s: s.replay, state, None))
        state, metrics = ALGORITHM.generation(state, key=jax.random.fold_in(root, g))
        rows.append({name: np.asarray(value).item() for name, value in metrics.items()})
    return rows, [*states, state]


def test_updates_are_the_share_of_all_frames_once_random_actions_are_over(host):
    rows, states = host
    frames = np.cumsum([row["frames"] for row in rows])
    assert len({row["frames"] for row in rows}) > 1
    before = np.concatenate([[0], frames[:-1]])
    expected = np.where(frames > 20, frames // 2 - before // 2, 0)
    assert [row["updates"] for row in rows] == expected.tolist()
    assert (expected == 0).any()
    for i, row in enumerate(rows):
        assert same(states[i].learner, states[i + 1].learner) == (row["updates"] == 0)
        assert (row["critic_loss"] == NOTHING) == (row["updates"] == 0)
    assert int(states[-1].frames) == frames[-1]
    assert int(states[-1].replay.written) == frames[-1]


def test_tests_come_every_so_many_frames_and_the_champion_is_the_actor(host):
    rows, states = host
    frames = np.concatenate([[0], np.cumsum([row["frames"] for row in rows])])
    dues = [i == 0 or frames[i + 1] // 30 > frames[i] // 30 for i in range(len(rows))]
    for i, due in enumerate(dues):
        assert same(states[i + 1].champion, ALGORITHM.learner.actor(states[i + 1].learner))
        if not due:
            assert rows[i]["champion_score"] == rows[i - 1]["champion_score"]
    assert 2 <= sum(dues) < len(dues)
    scores = [row["champion_score"] for row in rows]
    assert 2 <= len(set(scores)) <= sum(dues)


def test_the_score_is_the_actors_without_noise(host):
    rows, states = host
    key = jax.random.split(jax.random.fold_in(jax.random.key(0), 1), 3)[2]
    played = rollout.evaluate(ALGORITHM.env, tree.stack(states[1].champion), 2, key=key)
    played = played.returns[ALGORITHM.env.signals[-1]]
    assert (played.shape, ALGORITHM.test_episodes) == ((1, 2), 2)
    assert float(jnp.mean(played)) == pytest.approx(rows[0]["champion_score"], rel=1e-6)
    # Of the task's last signal, which is what is reported.
    assert rows[0]["champion_score"] <= 0.0


def test_first_actions_are_random_and_then_the_actors_with_noise(host):
    _, states = host
    data = states[-1].replay.data
    action = np.asarray(data.action)[: int(states[-1].frames)]
    assert np.abs(action[:20]).mean() == pytest.approx(0.5, abs=0.2)
    assert (np.abs(action) <= 1.0).all()
    assert len(np.unique(action)) > 0.8 * len(action)


def test_nothing_compiles_after_the_first_generation_that_learns(host):
    """In this process the fixture was that."""
    state, root, seen = ALGORITHM.init(key=jax.random.key(1)), jax.random.key(1), []
    with compilations() as events:
        for g in range(10):
            state, metrics = ALGORITHM.generation(state, key=jax.random.fold_in(root, g))
            seen.append((int(metrics["frames"]), int(metrics["updates"])))
    assert events == []
    assert len({frames for frames, updates in seen if updates}) > 1


def test_it_goes_on_from_a_given_policy():
    state = ALGORITHM.init(key=jax.random.key(0))
    given = ALGORITHM.network.init(2, 1, key=jax.random.key(9))
    warm = ALGORITHM.warm(state, given)
    assert same(warm.champion, given)
    assert same(ALGORITHM.learner.actor(warm.learner), given)


def test_a_policy_that_goes_on_is_tested_at_once():
    state = ALGORITHM.init(key=jax.random.key(0))
    warm = ALGORITHM.warm(state, ALGORITHM.network.init(2, 1, key=jax.random.key(9)))
    after, metrics = ALGORITHM.generation(warm, key=jax.random.key(1))
    assert np.isfinite(metrics["champion_score"])
    assert same(after.champion, ALGORITHM.learner.actor(after.learner))


CART = Gymnasium("CartPole-v1", in_process=True)
HIDDEN = hidden(NoisyObservations(Choose(), 0.1), "0")


@pytest.mark.parametrize("build", [OffPolicy, ERL])
@pytest.mark.parametrize(
    "env",
    [CART, delayed(CART), Choose(), delayed(Choose()), with_last_step(Choose()), HIDDEN],
)
def test_tasks_without_a_gradient_are_refused(build, env):
    told = (
        r"has Discrete actions: (TD3|DDPG) cannot learn that\. Give DQN .* evolve without a learner"
    )
    with pytest.raises(ValueError, match=told):
        build(env, MLP((4,))).init(key=jax.random.key(0))


def test_dqn_is_refused_where_there_is_nothing_to_choose():
    with pytest.raises(ValueError, match=r"Copy has Box actions: DQN cannot .* Give TD3, DDPG or"):
        OffPolicy.dqn(Copy()).init(key=jax.random.key(0))


@pytest.mark.parametrize("build", [lambda *x: OffPolicy(*x, DQN()), PPO])
def test_outputs_that_saturate_are_refused_where_they_choose(build):
    with pytest.raises(ValueError, match=r"give choosing\(task, MLP"):
        build(Choose(), MLP((4,))).init(key=jax.random.key(0))


def test_a_network_of_other_choices_is_refused():
    for env in (Copy(), Choose(size=4)):
        network = choosing(Choose(), MLP((4,)))
        told = f"{type(env).__name__} has choices of .* and the network makes choices of .3"
        for build in (OffPolicy.td3, PPO.ppo, ERL.ea, Neuroevolution):
            with pytest.raises(ValueError, match=told):
                build(env, network)


def test_what_wraps_a_learner_learns_what_it_does():
    learner = Criticised(DQN(), FitnessCritic())
    with pytest.raises(ValueError, match="Copy has Box actions: Criticised cannot learn that"):
        OffPolicy(Copy(), MLP((4,)), learner).init(key=jax.random.key(0))
    assert learner.teams
    assert not Criticised(SAC(), FitnessCritic()).teams


def test_there_is_no_gradient_for_a_coach_through_a_choice():
    with pytest.raises(ValueError, match="none through the discrete actions of DQN: give no coach"):
        ERL.erl(Choose(), coach=Coached())


@pytest.mark.parametrize("env", [Choose(), CART])
def test_the_last_action_is_told_as_a_choice(env):
    """Whatever numbers chose it: else a policy would see in tests what it never saw while it
    learned."""
    network = MLP((4,))
    for build in (OffPolicy.dqn, PPO.ppo):
        algorithm = build(with_last_step(env), network, test_episodes=2, test_every=1)
        _, state = run(algorithm, 2, play=eager if env is CART else generation)
        told = np.asarray(state.replay.data.next_obs)[: int(state.replay.size)]
        told = told[:, env.obs_size : env.obs_size + env.action_size]
        assert set(np.unique(told).tolist()) == {-1.0, 1.0}
        assert ((told > 0).sum(axis=1) == 1).all()


CHOOSING = {
    "dqn": lambda: OffPolicy.dqn(
        Choose(),
        MLP((16,), "tanh", initializer="fan_in"),
        learner=DQN(learning_rate=0.01, tau=0.1, gamma=0.5, exploration=100, batch_size=32),
        **SETTINGS | {"test_every": 100},
    ),
    "dqn with memory": lambda: OffPolicy.dqn(
        Choose(),
        Recurrent("gru", 16, "tanh", "fan_in"),
        learner=DQN(learning_rate=0.01, tau=0.1, gamma=0.5, exploration=100, batch_size=64),
        sampling=Sampling(window=10, burn_in=0),
        updates_per_frame=0.5,
        **SETTINGS | {"test_every": 100},
    ),
    "ppo": lambda: PPO.ppo(
        Choose(),
        horizon=160,
        copies=16,
        batch_size=40,
        learning_rate=3e-3,
        entropy_weight=0.01,
        test_every=100,
    ),
    "ppo with memory": lambda: PPO.ppo(
        Choose(),
        Recurrent("gru", 16, "tanh", "fan_in"),
        window=10,
        horizon=160,
        copies=16,
        batch_size=40,
        learning_rate=3e-3,
    ),
}


@pytest.mark.parametrize("name", CHOOSING)
def test_it_learns_to_choose(name):
    """By chance 3.3 of 10 are right."""
    rows, _ = run(CHOOSING[name](), 40)
    assert max(row["champion_score"] for row in rows[-5:]) >= 9.5
    assert rows[0]["fitness_mean"] < 6.0


def test_a_population_and_dqn_learn_to_choose_together():
    network = MLP((8,), "tanh", initializer="fan_in")
    learner = DQN(learning_rate=0.01, tau=0.1, gamma=0.5, exploration=100, batch_size=32)
    settings = {"population_size": 4, "elite_fraction": 0.25, "sync_period": 1}
    algorithm = ERL.erl(
        Choose(), network, learners=(learner,), warmup_frames=50, replay_capacity=1000, **settings
    )
    rows, _ = run(algorithm, 30)
    assert rows[-1]["champion_score"] >= 9.5


def test_evolution_takes_discrete_actions():
    env = Gymnasium("CartPole-v1", in_process=True)
    algorithm = ERL.ea(env, population_size=3, elite_fraction=0.4, test_episodes=1)
    start = algorithm.init(key=jax.random.key(0))
    metrics = algorithm.generation(start, key=jax.random.key(1))[1]
    assert metrics["fitness_max"] >= 8.0  # no pole falls sooner


def test_a_host_task_and_the_same_in_jax_start_alike():
    """Random actions, worlds and bookkeeping are one text for both."""
    inside = dataclasses.replace(ALGORITHM, env=Walk(), start_frames=1000)
    outside = dataclasses.replace(inside, env=HostWalk())
    rows, state = run(inside, 3)
    other_rows, other = run(outside, 3, play=eager)
    for a, b in zip(rows, other_rows, strict=True):
        assert a.keys() == b.keys()
        for metric, value in a.items():
            np.testing.assert_allclose(value, b[metric], rtol=1e-4, err_msg=metric)
    for x, y in zip(jax.tree.leaves(state.replay), jax.tree.leaves(other.replay), strict=True):
        assert x.dtype == y.dtype
    # The rows come in another order: step by step, of all lanes or lane after lane.
    size = int(state.replay.size)
    a, b = (np.asarray(s.replay.data.obs)[:size] for s in (state, other))
    np.testing.assert_allclose(np.sort(a, axis=0), np.sort(b, axis=0), rtol=1e-4, atol=1e-6)


def test_presets_have_the_constants_of_their_authors():
    teams = ("matd3", "maddpg")
    presets = {
        name: make(Meet() if name in teams else Copy())
        for name, make in OffPolicy.presets().items()
    }
    assert set(presets) == {"td3", "ddpg", "sac", "dqn", "matd3", "maddpg", "hybrid"}
    td3, sac = presets["td3"], presets["sac"]
    assert isinstance(td3.learner, TD3)
    assert (td3.start_frames, td3.network.hidden, td3.learner.policy_delay) == (
        25_000,
        (256, 256),
        2,
    )
    assert (td3.learner.batch_size, td3.learner.tau, td3.learner.gamma) == (256, 0.005, 0.99)
    assert presets["ddpg"].network.normalization == "before"
    assert (presets["ddpg"].start_frames, presets["ddpg"].learner.critics) == (1_000, 1)
    assert isinstance(sac.learner, SAC)
    assert (sac.start_frames, sac.learner.target_entropy) == (10_000, -1.0)
    matd3, maddpg = presets["matd3"], presets["maddpg"]
    assert (matd3.learner, maddpg.learner) == (learners.matd3(), learners.maddpg())
    assert matd3.network == maddpg.network == Team()
    assert (matd3.episodes, matd3.start_frames, matd3.updates_per_frame) == (10, 5_000, 0.1)
    assert dataclasses.replace(matd3, learner=maddpg.learner) == maddpg
    assert OffPolicy.td3(Meet()).network == Team()
    own = OffPolicy.sac(Copy(), MLP(hidden=(2,)), start_frames=5)
    assert (own.network, own.start_frames) == (MLP(hidden=(2,)), 5)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"episodes": 0}, "episodes is 0"),
        ({"start_frames": -1}, "start_frames is -1"),
        ({"updates_per_frame": -0.5}, "updates_per_frame is -0.5"),
        ({"learner": TD3(signal="fun")}, "no reward signal 'fun'.*reward"),
    ],
)
def test_impossible_settings_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        OffPolicy(Copy(), **fields)
