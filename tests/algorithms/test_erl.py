"""ERL and CERL: who lies in which slot, who learns when, and what is counted."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from evolved import evolved
from walk import HostWalk, Walk

from credo import rollout, tree
from credo.algorithms.erl import BREEDER, ERL, TABLE_5_1
from credo.algorithms.hybrid import bred as breed
from credo.algorithms.lineage import CROSSED, DRAWN, INJECTED, MUTATED, Lineage
from credo.algorithms.off_policy import OffPolicy
from credo.compilation import jit
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Copy, Meet
from credo.evolution.crossover import MaskedCrossover
from credo.learners.credit import Even
from credo.learners.decomposed import Decomposed
from credo.learners.manager import UCB
from credo.learners.sac import SAC
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic
from credo.types import NOTHING

K, E = 6, 2
LEARNER = TD3(critic=Critic(hidden=(3,)), actor_lr=0.01, critic_lr=0.01, batch_size=4)
ALGORITHM = ERL(
    HostWalk(spread=0.5),
    MLP(hidden=(3,)),
    (LEARNER,),
    population_size=K,
    breeder=dataclasses.replace(BREEDER, elite_fraction=0.34),
    sync_period=2,
    updates_per_frame=0.5,
    warmup_frames=45,
    replay_capacity=100,
    test_episodes=2,
)
CERL = dataclasses.replace(
    ALGORITHM,
    learners=(
        dataclasses.replace(LEARNER, gamma=0.5),
        LEARNER,
        SAC(critic=Critic(hidden=(3,)), batch_size=4),
    ),
    workers=4,
    manager=UCB(),
    warmup_frames=0,
    test_every=3,
)
GENERATIONS = 7


def same(a, b):
    """Whether two pytrees hold the same bits."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y, equal_nan=True) for x, y in pairs)


def key_of(generation, seed=0):
    return jax.random.fold_in(jax.random.key(seed), generation)


def run(algorithm, generations=GENERATIONS, seed=0):
    """Metrics of each generation and the states between them, replay aside but for the last."""
    state = algorithm.init(key=key_of(0, seed))
    states, rows = [], []
    for g in range(1, generations + 1):
        states.append(eqx.tree_at(lambda s: s.replay, state, None, is_leaf=lambda x: x is None))
        state, metrics = algorithm.generation(state, key=key_of(g, seed))
        rows.append({name: np.asarray(value).item() for name, value in metrics.items()})
        assert all(jnp.shape(value) == () for value in metrics.values())
    return rows, [*states, state]


@pytest.fixture(scope="module")
def erl():
    return run(ALGORITHM)


@pytest.fixture(scope="module")
def cerl():
    return run(CERL)


def played_by(algorithm, state, generation):
    """What the population earned in that generation."""
    key = jax.random.split(key_of(generation), 6)[0]
    return rollout.collect(algorithm.env, state.population, algorithm.episodes, key=key)[0]


def fitness_of(algorithm, state, generation):
    return np.asarray(played_by(algorithm, state, generation).returns["reward"]).mean(axis=1)


def injected(rows):
    """Generations at whose end actors were put into the population."""
    return [g for g, row in enumerate(rows, start=1) if g % 2 == 0 and row["updates"] > 0]


def test_elites_come_first_bit_for_bit_and_the_champion_is_the_best(erl):
    rows, states = erl
    assert ALGORITHM.elites == E
    for g, row in enumerate(rows, start=1):
        before, after = states[g - 1], states[g]
        fitness = fitness_of(ALGORITHM, before, g)
        order = np.argsort(-fitness, kind="stable")
        for slot in range(E):
            assert same(
                tree.take(after.population, slot), tree.take(before.population, int(order[slot]))
            )
        assert same(after.champion, tree.take(before.population, int(order[0])))
        assert row["fitness_max"] == pytest.approx(fitness.max(), rel=1e-6)
        assert row["fitness_mean"] == pytest.approx(fitness.mean(), rel=1e-5)
        assert row["fitness_nan"] == 0


def test_learning_waits_for_the_warm_up_and_makes_its_share_of_updates(erl):
    rows, states = erl
    frames = np.array([row["frames"] for row in rows])
    before = np.cumsum(frames) - frames
    assert len(set(frames.tolist())) > 1
    assert [row["updates"] for row in rows] == np.where(before >= 45, frames // 2, 0).tolist()
    assert [row["updates"] > 0 for row in rows[:4]] == [False, False, True, True]
    for g, row in enumerate(rows, start=1):
        assert same(states[g].learners, states[g - 1].learners) == (row["updates"] == 0)
        assert (row["critic_loss_0"] == NOTHING) == (row["updates"] == 0)
        assert int(states[g].frames) == frames[:g].sum()
        assert row["episodes"] == int(states[g].episodes) == 7 * g
        assert int(states[g].generation) == g
    assert int(states[-1].replay.written) == frames.sum()


def test_frames_are_those_of_population_and_learner(erl):
    rows, states = erl
    explore_key = jax.random.split(key_of(1), 6)[2]
    explorer = LEARNER.explorer(states[0].learners[0], jnp.bool_(False))
    played, _ = rollout.collect(
        ALGORITHM.env,
        tree.stack(explorer),
        1,
        wanted=1,
        common=False,
        key=jax.random.fold_in(explore_key, 0),
    )
    population = played_by(ALGORITHM, states[0], 1)
    assert rows[0]["frames"] == int(jnp.sum(population.steps)) + int(played.steps[0, 0])
    assert rows[0]["value_0"] == pytest.approx(float(played.returns["reward"][0, 0]), rel=1e-6)


def test_the_learners_actor_takes_the_last_slot_every_second_generation_and_only_then(erl):
    rows, states = erl
    assert injected(rows) == [4, 6]  # not 2: nobody had learned yet
    for g in range(1, GENERATIONS + 1):
        guests = states[g].lineage.guest.tolist()
        last = tree.take(states[g].population, K - 1)
        if g in (4, 6):
            assert same(last, states[g].learners[0].actor)
            assert guests == [-1] * (K - 1) + [0]
            assert states[g].lineage.maker[-1] == INJECTED
            assert states[g].lineage.share[-1].tolist() == [0.0, 1.0]
        else:
            assert not same(last, states[g].learners[0].actor)
            assert guests == [-1] * K


def test_what_became_of_an_injected_actor_is_counted_once(erl):
    rows, states = erl
    for g, row in enumerate(rows, start=1):
        fates = [row[f"{fate}_0"] for fate in ("elite", "selected", "discarded")]
        if g in (5, 7):
            fitness = fitness_of(ALGORITHM, states[g - 1], g)
            assert sum(fates) == 1
            assert fates[0] == (np.sum(fitness >= fitness[-1]) <= E)
        else:
            assert fates == [0, 0, 0]


def test_the_champions_origin_is_that_of_the_member_it_was(erl):
    rows, states = erl
    for g, row in enumerate(rows, start=1):
        best = int(np.argmax(fitness_of(ALGORITHM, states[g - 1], g)))
        assert row["champion_maker"] == states[g - 1].lineage.maker[best]
        assert row["champion_share_0"] == float(states[g - 1].lineage.share[best, 1])
    assert rows[0]["champion_maker"] == DRAWN


def test_the_score_is_the_champions_on_fresh_episodes(erl):
    rows, states = erl
    for g in (1, 5):
        key = jax.random.split(key_of(g), 6)[5]
        played = rollout.evaluate(ALGORITHM.env, tree.stack(states[g].champion), 2, key=key)
        played = played.returns[ALGORITHM.env.signals[-1]]
        assert (played.shape, ALGORITHM.test_episodes) == ((1, 2), 2)
        assert rows[g - 1]["champion_score"] == pytest.approx(float(jnp.mean(played)), rel=1e-6)
    assert rows[0]["champion_score"] <= 0.0  # the last signal, effort, is what is reported


def test_the_same_seed_gives_the_same_run_and_compiles_nothing(erl):
    """The fixture learned in this process already; frames and updates vary."""
    with compilations() as events:
        jax.jit(lambda x: x - 4.75)(np.float32(1.0))
    assert events  # the count sees a compilation
    with compilations() as events:
        rows, states = run(ALGORITHM, 5)
        others, _ = run(ALGORITHM, 6, seed=1)
    assert events == []
    assert same(states[-1].population, erl[1][5].population)
    assert same(states[-1].learners, erl[1][5].learners)
    np.testing.assert_equal(rows, erl[0][:5])
    learned = {row["updates"] for row in (*rows, *others)} - {0}
    assert len(learned) > 2
    assert [row["frames"] for row in others] != [row["frames"] for row in erl[0][:6]]


def test_the_old_buffer_is_given_away(erl):
    state = ALGORITHM.init(key=key_of(0))
    ALGORITHM.generation(state, key=key_of(1))
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(state.replay))
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves(state.population))


def test_it_goes_on_from_a_given_policy(erl):
    state = erl[1][2]
    given = ALGORITHM.network.init(2, 1, key=jax.random.key(9))
    warm = ALGORITHM.warm(state, given)
    assert same(tree.take(warm.population, 0), given)
    assert same(tree.take(warm.population, 1), tree.take(state.population, 1))
    assert same(LEARNER.actor(warm.learners[0]), given)


def test_elites_may_be_judged_by_all_their_episodes():
    algorithm = dataclasses.replace(ALGORITHM, remember=True)
    rows, states = run(algorithm, 4)
    assert states[0].lineage.times.tolist() == [0.0] * K
    assert states[1].lineage.times.tolist() == [1.0] * E + [0.0] * (K - E)
    keys = [jax.random.split(key_of(g), 6)[0] for g in (1, 2)]
    pairs = zip(states, keys, strict=False)
    played = [rollout.evaluate(ALGORITHM.env, s.population, 1, key=key) for s, key in pairs]
    fitness = [np.asarray(p.returns["reward"][:, 0]) for p in played]
    order = np.argsort(-fitness[0], kind="stable")
    np.testing.assert_allclose(states[1].lineage.earned[:E], fitness[0][order[:E]], rtol=1e-6)
    standing = (np.r_[fitness[0][order[:E]], np.zeros(K - E)] + fitness[1] + fitness[1].mean()) / (
        np.array([1.0] * E + [0.0] * (K - E)) + 2
    )
    assert same(states[2].champion, tree.take(states[1].population, int(np.argmax(standing))))
    assert rows[1]["fitness_max"] == pytest.approx(float(fitness[1].max()))  # as it was played
    assert max(states[-1].lineage.times.tolist()) >= 1.0


# Breeding, with fitness by hand.

FITNESS = jnp.array([3.0, 0.0, 5.0, 1.0, 4.0, 2.0])
RANK = [2, 5, 0, 4, 1, 3]
MUTATION = BREEDER.mutation
QUIET = evolved(
    ALGORITHM,
    mutation=dataclasses.replace(MUTATION, probability=0.0),
    crossover=MaskedCrossover(probability=1.0),  # a crossed child is its survivor
)


def bred(algorithm, start, seed, fitness=FITNESS, lineage=None):
    """Bred population, its lineage, and the member whose copy each is (-1: changed)."""
    lineage = lineage or Lineage.first(K, 1)
    population, lineage, _, champion, metrics = breed(
        algorithm, None, start.population, lineage, fitness, key=jax.random.key(seed)
    )
    members = [tree.take(start.population, j) for j in range(K)]
    copies = [
        next((j for j in range(K) if same(tree.take(population, i), members[j])), -1)
        for i in range(K)
    ]
    return population, lineage, champion, metrics, copies


def test_offspring_are_ordered_by_the_rank_of_their_parents(erl):
    start, last = erl[1][0], []
    for seed in range(8):
        _, lineage, champion, _, copies = bred(QUIET, start, seed)
        assert copies[:E] == [2, 4]
        ranks = [RANK[j] for j in copies]
        assert ranks[E:] == sorted(ranks[E:])
        last.append(ranks[-1])
        assert same(champion, tree.take(start.population, 2))
        # Of a parent that was drawn repeatedly, the first copy stays and the others are crossed.
        parents = copies[E:]
        repeated = [j in parents[:i] for i, j in enumerate(parents)]
        assert lineage.maker.tolist() == [DRAWN] * E + [CROSSED if r else DRAWN for r in repeated]
    assert max(last) > E  # the last slot does hold the weak


def test_a_member_with_nan_fitness_is_never_elite_nor_selected(erl):
    for seed in range(4):
        *_, copies = bred(QUIET, erl[1][0], seed, FITNESS.at[2].set(jnp.nan))
        assert copies[:E] == [4, 0]
        assert 2 not in copies


def test_elites_are_never_mutated_and_others_are_when_the_gate_opens(erl):
    always = evolved(QUIET, mutation=dataclasses.replace(MUTATION, probability=1.0))
    changed = 0
    for seed in range(8):
        _, lineage, _, _, copies = bred(always, erl[1][0], seed)
        assert copies[:E] == [2, 4]
        made = lineage.maker.tolist()
        assert [maker % 2 == MUTATED for maker in made] == [copy < 0 for copy in copies]
        changed += sum(copy < 0 for copy in copies)
    assert changed > 6


def test_crossing_takes_rows_of_an_elite(erl):
    crossing = evolved(QUIET, crossover=MaskedCrossover(probability=0.0), crossover_probability=1.0)
    _, lineage, _, _, copies = bred(crossing, erl[1][0], 0)
    assert set(copies) == {2, 4}  # nothing of the survivor is left
    assert lineage.maker.tolist() == [DRAWN] * E + [CROSSED] * (K - E)


def test_fates_and_shares_of_a_guest_by_hand(erl):
    guests = Lineage.first(K, 1).inject(2, 0)
    _, lineage, _, metrics, copies = bred(QUIET, erl[1][0], 0, lineage=guests)
    assert [int(metrics[f"{fate}_0"]) for fate in ("elite", "selected", "discarded")] == [1, 0, 0]
    assert (int(metrics["champion_maker"]), float(metrics["champion_share_0"])) == (INJECTED, 1.0)
    assert lineage.share[0].tolist() == [0.0, 1.0]
    for seed in range(4):
        _, _, _, metrics, copies = bred(
            QUIET, erl[1][0], seed, lineage=Lineage.first(K, 1).inject(1, 0)
        )  # the weakest
        chosen = 1 in copies
        fates = [int(metrics[f"{fate}_0"]) for fate in ("elite", "selected", "discarded")]
        assert fates == [0, chosen, not chosen]


# Without a learner, and with several.


def test_evolution_alone_has_no_replay_and_no_updates(erl):
    alone = dataclasses.replace(ALGORITHM, learners=(), warmup_frames=0)
    rows, states = run(alone, 3)
    assert states[-1].replay is None
    assert states[-1].learners == ()
    assert [row["updates"] for row in rows] == [0, 0, 0]
    assert [row["episodes"] for row in rows] == [6, 12, 18]
    assert states[-1].lineage.share.tolist() == [[1.0]] * K
    for g, row in enumerate(rows, start=1):
        assert row["frames"] == int(jnp.sum(played_by(alone, states[g - 1], g).steps))
        assert "critic_loss_0" not in row


def test_each_learner_has_a_slot_of_its_own_and_no_elites(cerl):
    rows, states = cerl
    assert injected(rows) == [2, 4, 6]
    for g in range(1, GENERATIONS + 1):
        sync = g in (2, 4, 6)
        guests = [-1, -1, -1, 2, 1, 0] if sync else [-1] * K
        assert states[g].lineage.guest.tolist() == guests
        fitness = fitness_of(CERL, states[g - 1], g)
        order = np.argsort(-fitness, kind="stable")
        elites = tree.take(states[g - 1].population, jnp.asarray(order[:E]))
        assert same(tree.take(states[g].population, jnp.arange(E)), elites)
        for i, learner in enumerate(CERL.learners):
            actor = learner.actor(states[g].learners[i])
            assert same(tree.take(states[g].population, K - 1 - i), actor) == sync


def test_there_must_be_room_for_elites_and_for_every_learners_actor():
    with pytest.raises(ValueError, match=r"elite_fraction is 0\.7 of 6.*leave 3 for offspring"):
        evolved(CERL, elite_fraction=0.7)
    assert evolved(CERL, elite_fraction=0.5).elites == 3
    with pytest.raises(ValueError, match="at least 1"):
        evolved(CERL, elite_fraction=0.1)
    with pytest.raises(ValueError, match=r"lie in \[0, 1\)"):
        evolved(ALGORITHM, elite_fraction=1.0)


def test_workers_go_in_turn_at_first_and_always_are_as_many(cerl):
    rows, states = cerl
    assert states[0].allocation.tolist() == [0, 1, 2, 0]
    for g, row in enumerate(rows):
        counts = np.bincount(np.asarray(states[g].allocation), minlength=3)
        assert [row[f"workers_{i}"] for i in range(3)] == counts.tolist()
        assert counts.sum() == 4
        assert row["episodes"] == (g + 1) * (K + 4)
    assert len({tuple(state.allocation.tolist()) for state in states}) > 2
    assert states[-1].ledger.count.sum() == 4 * GENERATIONS


def test_the_ledger_follows_the_returns_of_the_workers(cerl):
    rows, states = cerl
    values, counts = [0.0] * 3, [0] * 3
    for g in range(1, 4):
        explore_key = jax.random.split(key_of(g), 6)[2]
        for i, learner in enumerate(CERL.learners):
            explorer = learner.explorer(states[g - 1].learners[i], jnp.bool_(False))
            n = rows[g - 1][f"workers_{i}"]
            played, _ = rollout.collect(
                CERL.env,
                tree.stack(explorer),
                4,
                wanted=n,
                common=False,
                key=jax.random.fold_in(explore_key, i),
            )
            for earned in np.asarray(played.returns["reward"])[0, :n].tolist():
                values[i] = earned if counts[i] == 0 else 0.2 * earned + 0.8 * values[i]
                counts[i] += 1
            assert rows[g - 1][f"value_{i}"] == pytest.approx(values[i], rel=1e-4)
        assert states[g].ledger.count.tolist() == counts


def test_allocation_draws_from_the_bounds(cerl):
    _, states = cerl
    for g in range(1, GENERATIONS + 1):
        key = jax.random.split(key_of(g), 6)[4]
        bounds = np.asarray(UCB().bounds(states[g].ledger))
        drawn = jax.random.choice(key, 3, (4,), p=jnp.asarray(bounds / bounds.sum()))
        assert states[g].allocation.tolist() == drawn.tolist()


def test_columns_stay_the_same_and_scores_are_kept_between_tests(cerl):
    rows, _ = cerl
    assert all(row.keys() == rows[0].keys() for row in rows)
    assert {"critic_loss_0", "q_1", "alpha_2", "workers_2", "discarded_2"} <= rows[0].keys()
    scores = [row["champion_score"] for row in rows]
    assert scores[0] == scores[1] == scores[2]
    assert scores[3] == scores[4] == scores[5]
    assert len(set(scores)) == 3
    updates = [row["updates"] for row in rows]
    assert updates == [row["frames"] // 2 for row in rows]


def test_learners_that_differ_in_a_discount_learn_differently(cerl):
    _, states = cerl
    assert not same(states[2].learners[0].critics, states[2].learners[1].critics)


# The same file inside JAX.

NATIVE = dataclasses.replace(ALGORITHM, env=Walk(), warmup_frames=20)


@pytest.fixture(scope="module")
def native():
    return run(NATIVE, 3)


def test_seeds_run_side_by_side_in_one_program(native):
    """Two generations, of which the second learns."""

    @jit
    def generation(state, keys, g):
        return eqx.filter_vmap(
            lambda state, key: NATIVE.generation(state, key=jax.random.fold_in(key, g))
        )(state, keys)

    keys = jnp.stack([jax.random.key(seed) for seed in (1, 0)])
    states = eqx.filter_vmap(lambda key: NATIVE.init(key=jax.random.fold_in(key, 0)))(keys)
    rows, alone = native
    for g in (1, 2):
        states, metrics = generation(states, keys, jnp.int32(g))
        for name, value in rows[g - 1].items():
            np.testing.assert_allclose(metrics[name][1], value, rtol=1e-3, err_msg=name)
    assert (metrics["updates"] > 0).all()
    second = tree.take(eqx.tree_at(lambda s: s.replay, states, None), 1)
    for x, y in zip(jax.tree.leaves(second), jax.tree.leaves(alone[2]), strict=True):
        if jnp.issubdtype(x.dtype, jnp.inexact):
            np.testing.assert_allclose(x, y, atol=1e-4)
        else:
            np.testing.assert_array_equal(x, y)
    assert not same(tree.take(states.population, 0), second.population)


def test_inside_jax_too_nothing_compiles_after_the_first_generation_that_learns(native):
    assert native[0][1]["updates"] > 0
    with compilations() as events:
        rows, _ = run(NATIVE, 4, seed=3)
    assert events == []
    assert len({row["updates"] for row in rows}) > 2


# Settings.


@pytest.mark.parametrize("task", TABLE_5_1)
def test_erl_has_its_tasks_column_of_table_5_1(task):
    ψ, ξ, ω = TABLE_5_1[task]
    algorithm = ERL.erl(Gymnasium(f"{task}-v5"))
    assert (algorithm.breeder.elite_fraction, algorithm.episodes, algorithm.sync_period) == (
        ψ,
        ξ,
        ω,
    )
    assert algorithm.elites == round(10 * ψ)
    assert (algorithm.population_size, algorithm.test_episodes) == (10, 5)


def test_presets_and_what_they_share():
    presets = {name: make(Copy()) for name, make in ERL.presets().items()}
    assert set(presets) == {"erl", "ours", "hybrid", "ea", "cerl"}
    erl, ea, cerl = presets["erl"], presets["ea"], presets["cerl"]
    assert dataclasses.replace(erl, learners=()) == ea
    assert (erl.breeder.elite_fraction, erl.episodes, erl.sync_period) == (0.1, 1, 10)
    assert (erl.learners[0].actor_lr, erl.learners[0].critic_lr) == (5e-5, 5e-4)
    mutation = erl.breeder.mutation
    assert (mutation.probability, mutation.fraction, mutation.strength) == (0.9, 0.1, 0.1)
    assert (mutation.super_probability, mutation.reset_probability) == (0.05, 0.05)
    assert (mutation.vectors, mutation.limit) == (False, 1e6)
    assert [learner.gamma for learner in cerl.learners] == [0.9, 0.99, 0.997, 0.9995]
    assert (cerl.workers, cerl.manager, cerl.elites) == (10, UCB(), 2)
    assert (cerl.sync_period, cerl.test_episodes, cerl.replay_capacity) == (5, 10, 1_000_000)
    assert ERL.cerl(Copy(), workers=3).workers == 3


def test_the_hybrid_and_its_learner_alone_differ_in_nothing_else():
    hybrid, alone = ERL.hybrid(Copy()), OffPolicy.hybrid(Copy())
    assert (alone.learner,) == hybrid.learners
    for name in ("network", "redistribute", "normalize_observations", "sampling"):
        assert getattr(alone, name) == getattr(hybrid, name)
    assert alone.updates_per_frame == hybrid.updates_per_frame == 1.0
    assert hybrid.redistribute == Decomposed()  # dense rewards stay as they are
    evolution = ERL.hybrid(Copy(), learners=())  # needs nothing that asks a learner
    assert (evolution.share, evolution.horizon) == (None, None)
    assert evolution.breeder == hybrid.breeder
    assert ERL.hybrid(Copy(), elite_fraction=0.3).breeder.elite_fraction == 0.3
    with pytest.raises(ValueError, match="train a team by merl"):
        ERL.hybrid(Meet())


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"population_size": 1}, "population_size is 1"),
        ({"sync_period": 0}, "sync_period is 0"),
        ({"workers": 0}, "workers is 0"),
        ({"updates_per_frame": -1.0}, "updates_per_frame is -1"),
        ({"crossover_probability": 1.5}, "crossover_probability is 1.5"),
        ({"fitness": "fun"}, "no reward signal 'fun'.*reward, effort"),
        ({"learners": (TD3(signal="fun"),)}, "no reward signal 'fun'"),
    ],
)
def test_impossible_settings_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        evolved(ALGORITHM, **fields)


def test_where_rewards_are_not_late_the_hybrid_redistributes_nothing():
    def after(how):
        task = Copy()
        fields = {"population_size": K, "warmup_frames": 10, "updates_per_frame": 0.2}
        algorithm = ERL.hybrid(task, MLP(hidden=(8,)), redistribute=how, **fields)
        algorithm = dataclasses.replace(algorithm, replay_capacity=500)
        state = algorithm.init(key=jax.random.key(0))
        for g in range(3):
            state, metrics = algorithm.generation(state, key=jax.random.key(g))
        return state, metrics

    (decomposed, told), (even, _) = after(Decomposed()), after(Even(late_only=True))
    assert told["updates"] > 0
    assert told["redistribution_loss"] == NOTHING
    for name in ("population", "learners", "replay"):
        assert same(getattr(decomposed, name), getattr(even, name))
