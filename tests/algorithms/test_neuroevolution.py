"""Neuroevolution: its bookkeeping, what it compiles, and that it learns."""

import contextlib
import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evolved import evolved

from credo import rollout, tree
from credo.algorithms.neuroevolution import Neuroevolution, breed
from credo.environments.curriculum import Curriculum
from credo.environments.probes import Copy
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.server_fleet import ServerFleet
from credo.evolution.agents import AgentCrossover
from credo.evolution.crossover import MaskedCrossover, NoCrossover, OnePointCrossover
from credo.evolution.extinction import Extinction
from credo.evolution.mutation import MatrixMutation
from credo.networks.dmmu import DMMU
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.team import Centralized

TASK = SequenceClassification(depth=3, min_gap=1, max_gap=2)
ALGORITHM = Neuroevolution.as_written(
    TASK, MMU(hidden=3), population_size=20, elite_fraction=0.2, episodes=4, test_episodes=8
)
KEY = jax.random.key(0)
ELITES = {16, 17, 18, 19}  # where fitness is the index
BACKEND_COMPILE = "/jax/core/compile/backend_compile_duration"


@pytest.fixture(scope="module")
def start():
    return ALGORITHM.init(key=jax.random.key(0))


@pytest.fixture(scope="module")
def after(start):
    return ALGORITHM.generation(start, key=jax.random.key(1))


def same(a, b):
    """Whether two genomes hold the same weights."""
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in leaves)


def fitness_of(state, key):
    """What `generation` sees: the mean over its episodes."""
    evaluation = rollout.evaluate(TASK, state.population, ALGORITHM.episodes, key=key)
    return np.asarray(evaluation.returns["fitness"]).mean(axis=1)


def test_elites_come_first_unchanged_and_the_champion_is_the_best(start, after):
    state, metrics = after
    evaluate_key = jax.random.split(jax.random.key(1), 3)[0]
    fitness = fitness_of(start, evaluate_key)
    best = np.argsort(-fitness, kind="stable")
    assert ALGORITHM.elites == 4
    for slot in range(4):
        assert same(tree.take(state.population, slot), tree.take(start.population, best[slot]))
    changed = [
        not any(
            same(tree.take(state.population, i), tree.take(start.population, j)) for j in range(20)
        )
        for i in range(4, 20)
    ]
    assert np.mean(changed) > 0.7
    assert same(state.champion, tree.take(start.population, int(np.argmax(fitness))))
    assert float(metrics["fitness_max"]) == pytest.approx(fitness.max(), rel=1e-5)
    assert float(metrics["fitness_mean"]) == pytest.approx(fitness.mean(), rel=1e-5)


def test_metrics_are_scalars_with_the_frames_of_the_population(start, after):
    _, metrics = after
    evaluate_key = jax.random.split(jax.random.key(1), 3)[0]
    steps = rollout.evaluate(TASK, start.population, 4, key=evaluate_key).steps
    assert int(metrics["frames"]) == int(np.sum(steps))
    assert 20 * 4 * 5 <= int(metrics["frames"]) <= 20 * 4 * 7
    assert int(metrics["fitness_nan"]) == 0
    assert all(jnp.shape(value) == () for value in metrics.values())
    assert 8 * float(metrics["champion_score"]) in range(9)


def test_a_member_with_nan_fitness_is_counted_and_never_wins(start):
    spoilt = tree.put(
        start.population,
        2,
        jax.tree.map(lambda w: jnp.full_like(w, jnp.nan), tree.take(start.population, 2)),
    )
    state = eqx.tree_at(lambda s: s.population, start, spoilt)
    bred, metrics = ALGORITHM.generation(state, key=jax.random.key(1))
    assert int(metrics["fitness_nan"]) == 1
    assert np.isfinite(metrics["fitness_max"])
    weights = [
        *jax.tree.leaves(tree.take(bred.population, jnp.arange(4))),
        *jax.tree.leaves(bred.champion),
    ]
    assert all(np.isfinite(w).all() for w in weights)
    again = jnp.mean(rollout.evaluate(TASK, spoilt, 4, key=jax.random.key(3)).returns["fitness"], 1)
    assert np.flatnonzero(np.isnan(again)).tolist() == [2]


def test_the_same_seed_gives_the_same_weights(start, after):
    again, _ = ALGORITHM.generation(ALGORITHM.init(key=jax.random.key(0)), key=jax.random.key(1))
    other, _ = ALGORITHM.generation(start, key=jax.random.key(2))
    assert same(again, after[0])
    assert not same(other, after[0])


QUIET = evolved(ALGORITHM, mutation=MatrixMutation(probability=0.0))


def ancestors(bred, start):
    """With mutation off: the member that each bred genome is a copy of."""
    members = [tree.take(start.population, j) for j in range(20)]
    return [next(j for j in range(20) if same(tree.take(bred, i), members[j])) for i in range(20)]


def test_offspring_come_from_the_selected(start):
    """With mutation off every offspring is a member, the fitter the more often."""
    parents = ancestors(breed(QUIET, start, jnp.arange(20.0), key=KEY)[0], start)
    assert parents[:4] == [19, 18, 17, 16]
    assert np.mean(parents[4:]) > 12  # the best of three of 0..19: 14.7 on average


def row_parents(child, population):
    """For each row of each matrix, the members that have it."""
    for rows, all_rows in zip(jax.tree.leaves(child), jax.tree.leaves(population), strict=True):
        for r, row in enumerate(np.asarray(rows)):
            yield {
                j for j, member in enumerate(np.asarray(all_rows)) if np.array_equal(member[r], row)
            }


def test_crossover_mixes_an_elite_into_the_selected(start):
    crossing = evolved(QUIET, crossover_probability=1.0)
    bred = breed(crossing, start, jnp.arange(20.0), key=KEY)[0]
    mixed = 0
    for i in range(4, 20):
        parents = list(row_parents(tree.take(bred, i), start.population))
        assert all(parents)  # every row is somebody's
        everyone = set().union(*parents)
        assert everyone & ELITES
        assert len(everyone) <= 2
        mixed += len(everyone) == 2
    assert mixed >= 8


def test_as_coded_is_the_authors_program_and_can_be_overridden():
    coded = Neuroevolution.as_coded(TASK, MMU(hidden=3))
    assert coded.breeder.cross_repeated
    assert (coded.population_size, coded.elites, coded.episodes) == (100, 10, 10)
    mutation = coded.breeder.mutation
    assert isinstance(mutation, MatrixMutation)
    assert (mutation.gate, mutation.probability) == ("genome", 0.9)
    assert (mutation.fraction, mutation.up_to_fraction, mutation.strength) == (0.2, True, 0.2)
    assert (mutation.super_probability, mutation.super_strength) == (0.05, 10.0)
    assert coded.breeder.selection.size == 3
    assert (coded.elite_memory, coded.curriculum, coded.fitness) == (1, None, ())
    smaller = Neuroevolution.as_coded(TASK, MMU(hidden=3), population_size=10, cross_repeated=False)
    assert (smaller.population_size, smaller.breeder.cross_repeated) == (10, False)


def test_repeated_survivors_are_crossed(start):
    fitness = jnp.arange(20.0)
    parents = ancestors(breed(QUIET, start, fitness, key=KEY)[0], start)
    crossing = evolved(QUIET, cross_repeated=True)
    bred = breed(crossing, start, fitness, key=KEY)[0]
    changed = 0
    for i in range(4, 20):
        child, parent = tree.take(bred, i), tree.take(start.population, parents[i])
        if parents[i] not in parents[4:i]:
            assert same(child, parent)
        else:
            assert set().union(*row_parents(child, start.population)) <= {parents[i], *ELITES}
            changed += not same(child, parent)  # an elite may be crossed with itself
    assert changed >= 4


def test_offspring_mate_with_each_other_behind_mutation(start):
    """Algorithm 5, lines 15-23: both parents are of S, one of them the offspring itself."""
    fitness = jnp.arange(20.0)
    alone = ancestors(breed(QUIET, start, fitness, key=KEY)[0], start)
    mating = evolved(QUIET, mating=(MaskedCrossover(part="matrix"),))
    bred = breed(mating, start, fitness, key=KEY)[0]
    assert all(same(tree.take(bred, i), tree.take(start.population, alone[i])) for i in range(4))
    mates = set()
    for i in range(4, 20):
        parents = list(row_parents(tree.take(bred, i), start.population))
        others = set().union(*parents) - {alone[i]}
        assert any(alone[i] in found for found in parents)
        assert len(others) <= 1
        mates |= others
    assert mates <= set(alone[4:])
    assert len(mates) >= 4


def test_algorithm_5_as_a_preset():
    fleet = ServerFleet(servers=2, devices=3, nefarious=1)
    team = Neuroevolution.dmmu(fleet, DMMU(hidden=3))
    assert team.breeder.mating == (OnePointCrossover(0.05), AgentCrossover(0.05))
    assert (team.population_size, team.elites, team.episodes, team.test_episodes) == (
        100,
        4,
        10,
        10,
    )
    extinction, mutation = team.breeder.extinction, team.breeder.mutation
    assert (extinction.probability, extinction.magnitude) == (0.004, 0.5)
    assert (mutation.gate, mutation.probability, mutation.strength) == ("matrix", 0.9, 0.1)
    central = Neuroevolution.dmmu(fleet, Centralized(MLP(hidden=(3,))), population_size=30)
    assert central.breeder.mating == (OnePointCrossover(0.05),)
    assert central.population_size == 30


def test_a_fleet_learns_by_algorithm_5():
    """One of two devices is nefarious: who sticks to one earns 0 on average."""
    fleet = ServerFleet(servers=2, devices=2, requests=3, nefarious=1, max_steps=5)
    team = Neuroevolution.dmmu(fleet, DMMU(hidden=3), population_size=30, episodes=20)
    team = evolved(team, elite_fraction=0.1, test_episodes=100)
    state, key = team.init(key=KEY), jax.random.key(1)
    for g in range(30):
        state, metrics = team.generation(state, key=jax.random.fold_in(key, g))
    assert float(metrics["champion_score"]) > 0.5


def test_extinction_spares_the_elites(start):
    doomed = evolved(ALGORITHM, extinction=Extinction(probability=1.0, magnitude=1.0))
    bred = breed(doomed, start, jnp.arange(20.0), key=KEY)[0]
    assert all(same(tree.take(bred, i), tree.take(start.population, 19 - i)) for i in range(4))
    # The others are fresh: their weights are standard normal again, whoever was selected.
    fresh = np.asarray(bred.N_i[4:])
    assert not np.isin(fresh, np.asarray(start.population.N_i)).any()
    assert fresh.std() == pytest.approx(1.0, rel=0.2)


@contextlib.contextmanager
def compilations():
    """A list that grows by one for every program that is compiled or loaded meanwhile."""
    events = []

    def listen(event, duration, **details):
        if event == BACKEND_COMPILE:
            events.append(details)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield events
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def test_nothing_compiles_after_the_first_generation(start):
    root = jax.random.key(5)
    with compilations() as events:
        jax.jit(lambda x: x + 17.5)(jnp.float32(1.0))
    assert events  # the count sees a compilation
    state, _ = ALGORITHM.generation(start, key=jax.random.fold_in(root, 0))
    with compilations() as events:
        for g in range(1, 4):
            state, _ = ALGORITHM.generation(state, key=jax.random.fold_in(root, g))
        jax.block_until_ready(state)
    assert events == []


def test_a_new_hyper_parameter_compiles_nothing(start):
    algorithm = evolved(ALGORITHM, extinction=Extinction(probability=0.0))
    state, _ = algorithm.generation(start, key=jax.random.key(6))
    stronger = evolved(
        algorithm,
        mutation=MatrixMutation(strength=0.5, fraction=0.3),
        crossover_probability=0.1,
        extinction=Extinction(probability=0.01),
    )
    with compilations() as events:
        changed, _ = jax.block_until_ready(stronger.generation(state, key=jax.random.key(7)))
    assert events == []
    plain, _ = algorithm.generation(state, key=jax.random.key(7))
    assert not same(changed.population, plain.population)  # and it has an effect


def success_by_enumeration(answers):
    """Share of all depth-3 sequences for which `answers(signals)` is right at every signal."""
    solved = []
    for signals in itertools.product([-1, 1], repeat=3):
        right = [1 if total >= 0 else -1 for total in itertools.accumulate(signals)]
        solved.append(right == answers(signals))
    return np.mean(solved)


def test_it_learns_to_count_to_three():
    floors = (
        success_by_enumeration(lambda s: [s[0]] * 3),
        success_by_enumeration(list),
        success_by_enumeration(lambda s: [1, 1, 1]),
    )
    assert max(floors) == 0.625
    algorithm = Neuroevolution.as_coded(TASK, MMU(hidden=5), population_size=50)
    state = algorithm.init(key=KEY)
    for g in range(300):
        state, metrics = algorithm.generation(state, key=jax.random.fold_in(KEY, g))
        if metrics["champion_score"] == 1.0:  # of 50 sequences
            break
    champion = jax.tree.map(lambda w: w[None], state.champion)
    success = rollout.evaluate(TASK, champion, 200, key=jax.random.key(2)).returns["success"]
    assert float(jnp.mean(success)) > 0.9


def test_it_names_the_signal_it_maximises_and_the_one_it_reports(start, after):
    swapped = dataclasses.replace(ALGORITHM, fitness="success", score="fitness")
    _, metrics = swapped.generation(start, key=jax.random.key(1))
    assert 4 * float(metrics["fitness_max"]) in range(5)
    assert float(metrics["fitness_mean"]) != pytest.approx(float(after[1]["fitness_mean"]))


def test_fitness_is_a_signal_or_the_sum_of_several(start, after):
    keys = jax.random.split(jax.random.key(1), 3)
    returns = rollout.evaluate(TASK, start.population, 4, key=keys[0]).returns
    several = dataclasses.replace(ALGORITHM, fitness=("accuracy", "success"))
    _, metrics = several.generation(start, key=jax.random.key(1))
    total = np.mean(np.asarray(returns["accuracy"]) + np.asarray(returns["success"]), axis=1)
    assert float(metrics["fitness_max"]) == pytest.approx(total.max(), rel=1e-5)
    assert float(metrics["fitness_mean"]) == pytest.approx(total.mean(), rel=1e-5)
    assert dataclasses.replace(ALGORITHM, fitness="success").fitness == ("success",)
    assert ALGORITHM.fitness == ()
    assert dataclasses.replace(ALGORITHM, fitness="fitness").generation(
        start, key=jax.random.key(1)
    )[1]["fitness_max"] == pytest.approx(float(after[1]["fitness_max"]))


def test_without_memory_an_elite_is_judged_by_its_last_generation(after):
    state, _ = after
    assert np.asarray(state.age).tolist() == [0] * 20
    _, metrics = ALGORITHM.generation(state, key=jax.random.key(2))
    fitness = fitness_of(state, jax.random.split(jax.random.key(2), 3)[0])
    assert float(metrics["fitness_max"]) == pytest.approx(fitness.max(), rel=1e-5)


def test_elite_memory_averages_the_generations_of_an_elite(start):
    """Two generations back and this one: a mean of at most three, kept by hand beside it."""
    algorithm = dataclasses.replace(ALGORITHM, elite_memory=3)
    state, record, age = start, np.zeros(20), np.zeros(20, int)
    full = 0
    for g in range(8):
        key = jax.random.key(g)
        now = fitness_of(state, jax.random.split(key, 3)[0])
        fitness = (record * age + now) / (age + 1)
        order = np.argsort(-fitness, kind="stable")
        before = state
        state, metrics = algorithm.generation(state, key=key)
        assert float(metrics["fitness_max"]) == pytest.approx(fitness.max(), rel=1e-4)
        assert float(metrics["fitness_mean"]) == pytest.approx(now.mean(), rel=1e-4)
        assert same(state.champion, tree.take(before.population, order[0]))
        elite = np.arange(20) < 4
        record = np.where(elite, fitness[order], 0.0)
        full += np.sum(age[order][:4] == 2)
        age = np.where(elite, np.minimum(age[order] + 1, 2), 0)
        np.testing.assert_allclose(state.record, record, rtol=1e-4)
        np.testing.assert_array_equal(state.age, age)
    assert full > 0  # an elite was kept whose memory was full


def levelled(**fields):
    return dataclasses.replace(ALGORITHM, curriculum=Curriculum(start=1, **fields))


def test_the_level_rises_only_when_the_best_member_reaches_the_threshold(start):
    algorithm = levelled(threshold=0.0)
    state = algorithm.init(key=jax.random.key(0))
    assert int(state.level) == 1
    assert same(state.population, start.population)
    key = jax.random.key(1)
    task = algorithm.curriculum.task(TASK, state.level)
    keys = jax.random.split(key, 3)
    returns = rollout.evaluate(task, state.population, 4, key=keys[0]).returns
    best = int(np.argmax(np.asarray(returns["fitness"]).mean(axis=1)))
    success = float(np.asarray(returns["success"])[best].mean())
    assert 0 < success < 0.99
    for threshold, level in ((0.0, 2), (success, 2), (success - 0.01, 2), (success + 0.01, 1)):
        after, metrics = levelled(threshold=threshold).generation(state, key=key)
        assert int(after.level) == level
        assert int(metrics["level"]) == 1  # the level that was played
        assert int(metrics["frames"]) == 20 * 4  # one question, at the first step
    population, champion = after.population, after.champion
    hopeless = eqx.tree_at(
        lambda s: s.population, state, jax.tree.map(lambda w: w * jnp.nan, state.population)
    )
    after, _ = levelled(threshold=0.01).generation(hopeless, key=key)
    assert int(after.level) == 1
    assert not same(population, state.population)
    assert same(champion, tree.take(state.population, best))


def test_a_level_past_the_last_question_is_the_whole_task(start, after):
    algorithm = levelled(threshold=0.9)
    state = eqx.tree_at(lambda s: s.level, algorithm.init(key=jax.random.key(0)), jnp.int32(99))
    bred, metrics = algorithm.generation(state, key=jax.random.key(1))
    assert same(bred.population, after[0].population)
    assert int(metrics["frames"]) == int(after[1]["frames"])


def test_a_curriculum_may_train_on_a_longer_task_and_tests_on_the_algorithms_own():
    longer = SequenceClassification(depth=5, min_gap=2, max_gap=2)
    algorithm = levelled(whole=longer)
    state = eqx.tree_at(lambda s: s.level, algorithm.init(key=jax.random.key(0)), jnp.int32(5))
    after, metrics = algorithm.generation(state, key=jax.random.key(1))
    assert int(metrics["frames"]) == 20 * 4 * (5 + 4 * 2)
    test_key = jax.random.split(jax.random.key(1), 3)[2]
    own = rollout.evaluate(TASK, tree.stack(after.champion), 8, key=test_key)
    assert own.steps.max() <= TASK.max_steps
    assert float(metrics["champion_score"]) == pytest.approx(
        float(jnp.mean(own.returns["success"]))
    )


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"population_size": 1}, "population_size is 1"),
        ({"elite_fraction": 1.0}, "elite_fraction is 1.0"),
        ({"episodes": 0}, "episodes is 0"),
        ({"test_episodes": 0}, "test_episodes is 0"),
        ({"elite_memory": 0}, "elite_memory is 0"),
        ({"crossover_probability": 1.5}, "crossover_probability is 1.5"),
        ({"fitness": ("reward", "speed")}, "no reward signal 'speed'"),
        ({"fitness": "speed"}, "no reward signal 'speed': this task has reward"),
        ({"score": "speed"}, "no reward signal 'speed'"),
        ({"crossover": NoCrossover(), "cross_repeated": True}, "nothing would be crossed"),
        ({"mating": (AgentCrossover(),)}, "agents of MMU have no weights of their own"),
    ],
)
def test_impossible_settings_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        Neuroevolution.as_written(Copy(), MMU(hidden=2), **fields)


def test_large_genomes_are_bred_in_batches_as_they_are_together(monkeypatch):
    fleet = Neuroevolution.dmmu(
        ServerFleet.case_study(),
        DMMU(hidden=2),
        population_size=8,
        elite_fraction=0.13,
        crossover=MaskedCrossover(),
        crossover_probability=0.5,
        mating=(OnePointCrossover(probability=0.5), AgentCrossover(probability=0.5)),
    )
    state, fitness = fleet.init(key=KEY), jnp.arange(8.0)
    # Compiled under other names: what fits into a cache is read while a program is made.
    together = eqx.filter_jit(lambda s: breed(fleet, s, fitness, key=KEY)[0])(state)
    weights = sum(x[0].size for x in jax.tree.leaves(state.population))
    monkeypatch.setattr(tree, "CACHED", 3 * weights)
    assert tree.batch(state.population) == 3
    apart = eqx.filter_jit(lambda s: breed(fleet, s, fitness, key=KEY)[0])(state)
    for a, b in zip(jax.tree.leaves(apart), jax.tree.leaves(together), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
