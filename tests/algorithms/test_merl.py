"""MERL: who lies in which slot, who learns what when, and what is counted. Teams that meet."""

import dataclasses
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from evolved import evolved

from credo import rollout, tree
from credo.algorithms.erl import ERL
from credo.algorithms.hybrid import breed
from credo.algorithms.lineage import DRAWN, INJECTED
from credo.algorithms.merl import BREEDER, LOCAL, MERL
from credo.algorithms.neuroevolution import Neuroevolution
from credo.algorithms.off_policy import OffPolicy
from credo.compilation import jit
from credo.environments.extended_tmaze import ExtendedTMaze
from credo.environments.probes import Copy, Meet
from credo.environments.rover import Rover
from credo.environments.server_fleet import ServerFleet
from credo.learners.credit import Even
from credo.learners.sac import SAC
from credo.learners.td3 import TD3, matd3
from credo.networks.exploration import GaussianNoise
from credo.networks.mlp import MLP, Critic
from credo.networks.team import JointCritic, Team
from credo.runs import loop
from credo.types import NOTHING

K, E, EPISODES, WORKERS = 5, 2, 2, 3
NETWORK = Team(trunk=(4,), head=MLP(hidden=()), initializer="normal")
LEARNER = TD3(
    critic=Critic(hidden=(4,)), actor_lr=0.01, critic_lr=0.01, batch_size=4, signal="local"
)
ALGORITHM = MERL(
    Meet(),
    NETWORK,
    (LEARNER,),
    population_size=K,
    breeder=dataclasses.replace(BREEDER, elite_fraction=0.4),
    episodes=EPISODES,
    workers=WORKERS,
    migration_period=2,
    updates_per_frame=0.2,
    warmup_frames=120,
    replay_capacity=150,
    test_episodes=3,
    test_every=2,
)
GENERATIONS = 6


def same(a, b):
    """Whether two pytrees hold the same bits."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y, equal_nan=True) for x, y in pairs)


def key_of(generation, seed=0):
    return jax.random.fold_in(jax.random.key(seed), generation)


def row_of(metrics):
    assert all(jnp.shape(value) == () for value in metrics.values())
    return {name: np.asarray(value).item() for name, value in metrics.items()}


def run(algorithm, generations=GENERATIONS, seed=0):
    """Metrics of each generation and the states between them, replay aside but for the last."""
    state = algorithm.init(key=key_of(0, seed))
    states, rows = [], []
    for g in range(1, generations + 1):
        states.append(eqx.tree_at(lambda s: s.replay, state, None, is_leaf=lambda x: x is None))
        state, metrics = algorithm.generation(state, key=key_of(g, seed))
        rows.append(row_of(metrics))
    return rows, [*states, state]


@pytest.fixture(scope="module")
def merl():
    return run(ALGORITHM)


def played_by(algorithm, state, generation):
    """What the population earned in that generation."""
    key = jax.random.split(key_of(generation), 5)[0]
    return rollout.collect(algorithm.env, state.population, algorithm.episodes, key=key)[0]


def fitness_of(algorithm, state, generation):
    """The team's reward; of a private one the mean over agents."""
    returns = np.asarray(played_by(algorithm, state, generation).returns[algorithm.reward])
    return returns.reshape(K, -1).mean(axis=1)


def test_a_start_is_a_population_of_teams_a_team_that_learns_and_an_empty_buffer():
    state = ALGORITHM.init(key=key_of(0))
    assert tree.size(state.population) == K
    teams = [tree.take(state.population, i) for i in range(K)]
    assert not any(same(teams[i], teams[0]) for i in range(1, K))
    structure = jax.tree.structure(LEARNER.actor(state.learners[0]))
    assert all(jax.tree.structure(team) == structure for team in teams)
    assert [len(teams[0].trunks), len(teams[0].heads), teams[0].agents] == [1, 2, 2]
    assert len(state.learners) == 1
    assert len(state.learners[0].critics) == 2
    assert (state.replay.capacity, int(state.replay.size)) == (150, 0)
    assert state.replay.data.obs.shape == (150, 2, 2)
    assert state.replay.data.rewards["local"].shape == (150, 2)
    assert state.replay.data.rewards["global"].shape == (150,)
    assert state.replay.data.active.shape == (150, 2)
    assert [int(x) for x in (state.frames, state.episodes, state.generation)] == [0, 0, 0]
    assert state.lineage.maker.tolist() == [DRAWN] * K


def test_fitness_is_the_reward_of_all_and_elites_come_first(merl):
    rows, states = merl
    assert (ALGORITHM.reward, ALGORITHM.elites) == ("global", E)
    assert len({row["fitness_mean"] for row in rows}) > 2
    for g, row in enumerate(rows, start=1):
        before, after = states[g - 1], states[g]
        fitness = fitness_of(ALGORITHM, before, g)
        order = np.argsort(-fitness, kind="stable")
        elites = tree.take(before.population, jnp.asarray(order[:E]))
        assert same(tree.take(after.population, jnp.arange(E)), elites)
        assert same(after.champion, tree.take(before.population, int(order[0])))
        assert row["fitness_max"] == pytest.approx(fitness.max(), abs=1e-6)
        assert row["fitness_mean"] == pytest.approx(fitness.mean(), abs=1e-6)


def test_frames_and_episodes_are_those_of_population_and_learner(merl):
    rows, states = merl
    for g, row in enumerate(rows, start=1):
        explore_key = jax.random.split(key_of(g), 5)[2]
        explorer = LEARNER.explorer(states[g - 1].learners[0], jnp.bool_(False))
        theirs, _ = rollout.collect(
            ALGORITHM.env,
            tree.stack(explorer),
            WORKERS,
            wanted=WORKERS,
            common=False,
            key=jax.random.fold_in(explore_key, 0),
        )
        population = played_by(ALGORITHM, states[g - 1], g)
        assert row["frames"] == int(jnp.sum(population.steps)) + int(jnp.sum(theirs.steps))
        assert row["episodes"] == int(states[g].episodes) == g * (K * EPISODES + WORKERS)
        assert int(states[g].frames) == sum(r["frames"] for r in rows[:g])
        assert int(states[g].generation) == g
        assert row["workers_0"] == WORKERS
    assert int(states[-1].replay.written) == int(states[-1].frames)


def test_frames_of_all_teams_are_stored(merl):
    """Once with each agent's part: what stands in the buffer is a game of Meet."""
    data = merl[1][-1].replay.data
    obs, after = (np.asarray(x) for x in (data.obs, data.next_obs))
    action = np.clip(np.asarray(data.action)[..., 0], -1, 1)
    np.testing.assert_allclose(after[..., 0], obs[..., 0] + 0.2 * action, atol=1e-5)
    toward = np.sign(obs[..., 1])
    np.testing.assert_allclose(data.rewards["local"], 0.2 * action * toward, atol=1e-5)
    met = np.abs(after[:, 0, 0] - after[:, 1, 0]) <= 0.2
    assert np.asarray(data.terminated).tolist() == met.tolist()
    np.testing.assert_array_equal(data.rewards["global"], met.astype(np.float32))
    assert np.asarray(data.active).all()


def test_learning_waits_for_the_warm_up_and_makes_its_share_of_updates(merl):
    rows, states = merl
    frames = np.array([row["frames"] for row in rows])
    before = np.cumsum(frames) - frames
    share = (np.float32(0.2) * frames.astype(np.float32)).astype(int)
    expected = np.where(before >= 120, share, 0)
    assert [row["updates"] for row in rows] == expected.tolist()
    assert (expected == 0).sum() == 2
    for g, row in enumerate(rows, start=1):
        assert same(states[g].learners, states[g - 1].learners) == (row["updates"] == 0)
        assert (row["critic_loss_0"] == NOTHING) == (row["updates"] == 0)
        steps = int(states[g].learners[0].step) - int(states[g - 1].learners[0].step)
        assert steps == row["updates"]


def test_the_learners_team_migrates_every_period_into_the_last_slot(merl):
    _, states = merl
    for g in range(1, GENERATIONS + 1):
        last, lineage = tree.take(states[g].population, K - 1), states[g].lineage
        due = g in (4, 6)  # not 2: nobody had learned yet
        assert same(last, LEARNER.actor(states[g].learners[0])) == due
        assert lineage.guest.tolist() == [-1] * (K - 1) + [0 if due else -1]
        if due:
            assert lineage.maker[-1] == INJECTED
            assert lineage.share[-1].tolist() == [0.0, 1.0]


def test_what_became_of_a_migrant_and_the_champions_share(merl):
    rows, states = merl
    for g, row in enumerate(rows, start=1):
        fates = {fate: row[f"{fate}_0"] for fate in ("elite", "selected", "discarded")}
        fitness = fitness_of(ALGORITHM, states[g - 1], g)
        order = np.argsort(-fitness, kind="stable")
        assert sum(fates.values()) == (1 if g == 5 else 0)
        if g == 5:
            assert fates["elite"] == (K - 1 in order[:E].tolist())
        best = int(order[0])
        assert row["champion_maker"] == states[g - 1].lineage.maker[best]
        assert row["champion_share_0"] == float(states[g - 1].lineage.share[best, 1])


def test_scores_are_the_champions_on_fresh_episodes_now_and_then(merl):
    rows, states = merl
    scores = [row["champion_score"] for row in rows]
    assert scores[0] == scores[1]
    assert scores[2] == scores[3]
    for g in (1, 5):
        key = jax.random.split(key_of(g), 5)[4]
        played = rollout.evaluate(ALGORITHM.env, tree.stack(states[g].champion), 3, key=key)
        score = np.asarray(played.returns["global"])
        assert score.shape == (1, 3)
        assert scores[g - 1] == pytest.approx(score.mean(), abs=1e-6)


@pytest.mark.parametrize("period", [1, 3])
def test_a_migration_period_counts_generations(period, merl):
    algorithm = dataclasses.replace(ALGORITHM, migration_period=period, warmup_frames=0)
    _, states = run(algorithm, 4)
    migrated = [int(states[g].lineage.guest[-1]) == 0 for g in range(1, 5)]
    assert migrated == [g % period == 0 for g in range(1, 5)]


def test_without_learners_it_is_evolution_alone(merl):
    """The same as ERL without a learner: one text for both."""
    alone = dataclasses.replace(ALGORITHM, learners=(), warmup_frames=0)
    rows, states = run(alone, 3)
    assert states[-1].replay is None
    assert states[-1].learners == ()
    assert [row["updates"] for row in rows] == [0, 0, 0]
    assert [row["episodes"] for row in rows] == [10, 20, 30]
    assert states[-1].lineage.share.tolist() == [[1.0]] * K
    assert "critic_loss_0" not in rows[0]
    shared = ("population_size", "breeder", "episodes")
    ea = ERL.ea(
        Meet(),
        NETWORK,
        test_episodes=3,
        test_every=2,
        **{name: getattr(alone, name) for name in shared},
    )
    assert ea.breeder == alone.breeder
    assert same(ea.init(key=key_of(0)).population, states[0].population)
    for g, row in enumerate(rows, start=1):
        assert row["frames"] == int(jnp.sum(played_by(alone, states[g - 1], g).steps))
        fitness = fitness_of(alone, states[g - 1], g)
        assert row["fitness_max"] == pytest.approx(fitness.max(), abs=1e-6)


@pytest.mark.parametrize("signal", ["local", "global"])
def test_any_signal_may_be_fitness(signal, merl):
    algorithm = dataclasses.replace(ALGORITHM, fitness=signal, learners=())
    rows, states = run(algorithm, 2)
    for g, row in enumerate(rows, start=1):
        returns = np.asarray(played_by(algorithm, states[g - 1], g).returns[signal])
        assert returns.shape == (K, EPISODES, 2)[: returns.ndim]
        assert returns.ndim == (3 if signal == "local" else 2)
        fitness = returns.reshape(K, -1).mean(axis=1)
        assert row["fitness_max"] == pytest.approx(fitness.max(), abs=1e-5)
        best = tree.take(states[g - 1].population, int(np.argmax(fitness)))
        assert same(states[g].champion, best)
    assert algorithm.env.reported == "global"


def test_learners_on_different_levels_of_credit():
    learners = (
        LEARNER,
        dataclasses.replace(LEARNER, signal="global"),
        matd3(critic=JointCritic(critic=Critic(hidden=(4,))), batch_size=4),
    )
    algorithm = dataclasses.replace(
        ALGORITHM, learners=learners, migration_period=1, warmup_frames=0
    )
    rows, states = run(algorithm, 2)
    assert {"q_0", "q_1", "q_2", "value_2", "discarded_2"} <= rows[0].keys()
    assert [rows[0][f"workers_{i}"] for i in range(3)] == [1, 1, 1]
    assert states[1].lineage.guest.tolist() == [-1, -1, 2, 1, 0]
    for i, learner in enumerate(learners):
        actor = learner.actor(states[1].learners[i])
        assert same(tree.take(states[1].population, K - 1 - i), actor)
    # Nobody meets at first: the value of what all earn is about 0, and own ways are not.
    critics = [
        jnp.concatenate([x.ravel() for x in jax.tree.leaves(s.critics)])
        for s in states[2].learners[:2]
    ]
    assert not np.allclose(*critics)


def test_returns_may_be_spread_over_their_episodes(merl):
    _, states = run(dataclasses.replace(ALGORITHM, redistribute=Even(), learners=(LEARNER,)), 2)
    data, written = states[-1].replay.data, int(states[-1].replay.written)
    kept = min(written, 150)
    rewards = {name: np.asarray(x)[:kept] for name, x in data.rewards.items()}
    assert rewards["local"].shape == (kept, 2)
    together = np.column_stack([rewards["global"], rewards["local"]])
    assert len(np.unique(together, axis=0)) <= states[-1].episodes  # one value per episode
    assert len(np.unique(together, axis=0)) > 10


# Programs and runs


def test_nothing_compiles_after_the_first_generation_that_learns(merl):
    """The fixture was that in this process; frames and updates vary."""
    with compilations() as events:
        jax.jit(lambda x: x - 2.125)(np.float32(1.0))
    assert events  # the count sees a compilation
    with compilations() as events:
        rows, states = run(ALGORITHM, 5)
        others, _ = run(ALGORITHM, 5, seed=3)
    assert events == []
    np.testing.assert_equal(rows, merl[0][:5])
    assert same(states[-1].population, merl[1][5].population)
    assert same(states[-1].learners, merl[1][5].learners)
    assert [row["fitness_mean"] for row in others] != [row["fitness_mean"] for row in rows]


def test_seeds_run_side_by_side_in_one_program(merl):
    algorithm = dataclasses.replace(ALGORITHM, warmup_frames=60)

    @jit
    def generation(state, keys, g):
        return eqx.filter_vmap(
            lambda state, key: algorithm.generation(state, key=jax.random.fold_in(key, g))
        )(state, keys)

    keys = jnp.stack([jax.random.key(seed) for seed in (1, 0)])
    states = eqx.filter_vmap(lambda key: algorithm.init(key=jax.random.fold_in(key, 0)))(keys)
    rows, alone = run(algorithm, 2)
    for g in (1, 2):
        states, metrics = generation(states, keys, jnp.int32(g))
        for name, value in rows[g - 1].items():
            np.testing.assert_allclose(metrics[name][1], value, rtol=1e-3, atol=1e-5, err_msg=name)
    assert (metrics["updates"] > 0).all()
    second = tree.take(states, 1)
    for x, y in zip(jax.tree.leaves(second), jax.tree.leaves(alone[2]), strict=True):
        np.testing.assert_allclose(
            np.asarray(x, np.float64), np.asarray(y, np.float64), rtol=1e-3, atol=1e-4
        )


def test_a_run_that_is_resumed_ends_in_the_same_bytes(tmp_path):
    short = dataclasses.replace(ALGORITHM, test_every=1)
    straight = loop.train(short, seed=1, generations=5, path=tmp_path / "a", tensorboard=False)
    loop.train(short, seed=1, generations=3, path=tmp_path / "b", tensorboard=False)
    resumed = loop.resume(tmp_path / "b", generations=5)
    for name in ("metrics.csv", "champion.safetensors"):
        files = [(tmp_path / run / name).read_bytes() for run in "ab"]
        assert files[0] == files[1]
    assert straight.metrics["updates"].max() > 0
    assert resumed.algorithm == short
    assert resumed.metrics["generation"].tolist() == [1, 2, 3, 4, 5]


def test_it_goes_on_from_a_given_team(merl):
    state = merl[1][2]
    given = NETWORK.init(*Meet().sizes, key=jax.random.key(9))
    warm = ALGORITHM.warm(state, given)
    assert same(tree.take(warm.population, 0), given)
    assert same(tree.take(warm.population, 1), tree.take(state.population, 1))
    assert same(LEARNER.actor(warm.learners[0]), given)


# Learning

SMALL = Team(trunk=(16,), activation="tanh")
FAST = {"actor_lr": 5e-3, "critic_lr": 5e-3, "tau": 0.02, "batch_size": 32, "gamma": 0.9}


@jit
def generation(algorithm, state, key):
    return algorithm.generation(state, key=key)


def scores_of(algorithm, generations, seed=0):
    state, scores = algorithm.init(key=key_of(0, seed)), []
    for g in range(1, generations + 1):
        state, metrics = generation(algorithm, state, key_of(g, seed))
        scores.append(float(metrics["champion_score"]))
    return scores, int(state.frames)


def test_merl_learns_to_meet():
    """Both agents have to walk all the way; at first no team meets."""
    algorithm = MERL.merl(
        Meet(),
        SMALL,
        learners=(dataclasses.replace(LOCAL, critic=Critic(hidden=(16,)), **FAST),),
        population_size=6,
        elite_fraction=0.34,
        episodes=2,
        workers=5,
        warmup_frames=200,
        replay_capacity=2000,
        updates_per_frame=0.5,
        test_episodes=20,
    )
    scores, frames = scores_of(algorithm, 30)
    assert frames < 3_000
    assert scores[0] < 0.9
    assert scores[-1] == 1.0


@pytest.mark.parametrize("name", ["td3", "matd3"])
def test_learners_alone_learn_to_meet(name):
    """On each agent's own reward, whatever the critics see."""
    joint = {"critic": JointCritic(critic=Critic(hidden=(16,))), "noise": GaussianNoise(0.4)}
    own = {"critic": Critic(hidden=(16,)), "noise": GaussianNoise(0.4)}
    learner = {
        "td3": lambda: TD3(signal="local", **own, **FAST),
        "matd3": lambda: matd3(signal="local", **joint, **FAST),
    }[name]()
    algorithm = OffPolicy(
        Meet(),
        SMALL,
        learner,
        episodes=10,
        start_frames=200,
        updates_per_frame=0.5,
        test_every=1,
        test_episodes=20,
        replay_capacity=2000,
    )
    scores, frames = scores_of(algorithm, 50)
    assert frames <= 2_500
    assert scores[0] < 0.9
    assert scores[-1] == 1.0


# What does not go together


@pytest.mark.parametrize(
    ("build", "told"),
    [
        (
            lambda: dataclasses.replace(ALGORITHM, network=MLP()),
            "MLP acts for one agent and Meet has 2",
        ),
        (lambda: OffPolicy(Meet(), MLP()), r"put it on a team, as in Team\(head=MLP\(\.\.\.\)\)"),
        (lambda: Neuroevolution(Meet(), MLP()), r"Meet has 2.*Team\(head=MLP"),
        (lambda: OffPolicy.sac(Meet(), Team()), "Meet has 2 agents: SAC cannot learn that.*TD3"),
        (
            lambda: dataclasses.replace(ALGORITHM, learners=(LEARNER, SAC())),
            "Meet has 2 agents: SAC cannot learn that",
        ),
        (lambda: ERL(Copy(), Team()), "Team acts for a team and Copy has one agent.*MLP"),
        (lambda: OffPolicy.matd3(Copy()), "Team acts for a team and Copy has one agent"),
        (lambda: MERL(Copy()), "Team acts for a team and Copy has one agent"),
    ],
)
def test_teams_need_a_network_and_learners_for_teams(build, told):
    with pytest.raises(ValueError, match=told):
        build().init(key=jax.random.key(0))


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"population_size": 1}, "population_size is 1"),
        ({"migration_period": 0}, "migration_period is 0"),
        ({"workers": 0}, "workers is 0"),
        ({"episodes": 0}, "episodes is 0"),
        ({"test_every": 0}, "test_every is 0"),
        ({"updates_per_frame": -1.0}, "updates_per_frame is -1"),
        ({"crossover_probability": 1.5}, "crossover_probability is 1.5"),
        ({"elite_fraction": 1.0}, r"it must lie in \[0, 1\)"),
        ({"elite_fraction": 0.1}, "must be at least 1"),
        ({"workers": 1, "learners": (LEARNER, LEARNER)}, "1 workers for 2 learners"),
        ({"fitness": "fun"}, "no reward signal 'fun'.*global, local"),
        ({"learners": (TD3(signal="fun"),)}, "no reward signal 'fun'"),
    ],
)
def test_impossible_settings_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        evolved(ALGORITHM, **fields)


def test_the_preset_is_that_of_the_rover_domain():
    merl = MERL.presets()["merl"](Meet())
    assert (merl.population_size, merl.elites, merl.episodes, merl.workers) == (20, 4, 10, 50)
    assert (merl.migration_period, merl.replay_capacity) == (1, 100_000)
    assert (merl.network, merl.learners) == (Team(), (LOCAL,))
    assert (LOCAL.signal, LOCAL.critic.hidden, LOCAL.noise) == (
        "local",
        (100, 100),
        GaussianNoise(0.4),
    )
    assert (LOCAL.target_noise, LOCAL.target_noise_clip, LOCAL.policy_delay) == (0.2, 0.5, 2)
    assert MERL.merl(Meet(), NETWORK, workers=7).workers == 7


def test_the_preset_for_teams_of_equals_differs_from_it_where_docs_say():
    merl, hybrid = MERL.merl(Meet()), MERL.presets()["hybrid"](Meet())
    changes = {"network": Team(sharing="everything"), "redistribute": Even(late_only=True)}
    changes |= {"population_size": 50, "episodes": 4, "updates_per_frame": 0.2, "remember": True}
    changes |= {"learners": 3 * (dataclasses.replace(LOCAL, batch_size=32),)}
    assert evolved(merl, **changes) == hybrid
    assert MERL.hybrid(Meet(), NETWORK, episodes=7).episodes == 7
    assert MERL.hybrid(Meet(), NETWORK).network == NETWORK


def test_teams_may_be_ranked_by_every_generation_that_they_lived_through():
    algorithm = dataclasses.replace(ALGORITHM, remember=True)
    start = jax.random.key(0)  # a generation uses up the state that it is given
    after, _ = algorithm.generation(algorithm.init(key=start), key=jax.random.key(1))
    elites = algorithm.elites
    assert after.lineage.times.tolist() == [1.0] * elites + [0.0] * (K - elites)
    forgetful, _ = ALGORITHM.generation(ALGORITHM.init(key=start), key=jax.random.key(1))
    assert forgetful.lineage.times.tolist() == [0.0] * K
    # One lucky generation does not put a newcomer above an elite that was better in two.
    earned, times = jnp.zeros(K).at[0].set(9.0), jnp.zeros(K).at[0].set(1.0)
    lineage = dataclasses.replace(after.lineage, earned=earned, times=times)
    fitness = jnp.zeros(K).at[0].set(9.0).at[1].set(10.0)
    after = dataclasses.replace(after, lineage=lineage)
    for ranked, best in ((algorithm, 0), (ALGORITHM, 1)):
        state, _ = breed(ranked, after, fitness, key=jax.random.key(2))
        assert same(state.champion, tree.take(after.population, best))


def test_without_a_local_reward_learners_maximise_that_of_the_team_and_say_so():
    """Flags can then name another: before, the preset was refused ahead of them."""
    fleet = ServerFleet(servers=2, devices=4, nefarious=(1, 2))
    for preset in (MERL.merl, MERL.hybrid):
        with pytest.warns(UserWarning, match="ServerFleet has no reward named local"):
            made = preset(fleet)
        assert {learner.signal for learner in made.learners} == {None}
    maze = ExtendedTMaze(robots=2, partner=None, rewards=("score", "difference"))
    with pytest.warns(UserWarning, match="signal names another of score, difference"):
        MERL.merl(maze)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        MERL.merl(fleet, learners=())
        assert MERL.merl(Rover()).learners == (LOCAL,)
