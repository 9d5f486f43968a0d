"""Evolution strategies of evosax as breeders."""

import importlib.util
import typing
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from compilations import compilations

from credo import compilation, tree
from credo.algorithms.erl import ERL
from credo.algorithms.lineage import SAMPLED
from credo.algorithms.neuroevolution import Neuroevolution
from credo.cli import train
from credo.cli.line import Line
from credo.environments.double_pole import DoublePole
from credo.environments.probes import Copy
from credo.evolution.breeder import draw
from credo.evolution.strategies import Method, Strategy, _theirs
from credo.learners.coach import Coached
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic
from credo.runs import config, loop

needed = pytest.mark.skipif(
    importlib.util.find_spec("evosax") is None, reason="the extra strategies is not installed"
)
METHODS = typing.get_args(Method)
NETWORK = MLP((3,))
FRESH = partial(draw, NETWORK, (2, 1))
K = 16
POLE = DoublePole(velocities=True)


def rows(population):
    return np.asarray(tree.packed(population)[0][0])


def stepping(strategy):
    """`next`, compiled."""
    return compilation.jit(
        lambda memory, population, fitness, key: strategy.next(
            memory, population, fitness, FRESH, key=key
        )
    )


def squares(population):
    """The sphere: 0 where every weight is 1, and negative elsewhere."""
    return -jnp.sum(jnp.square(rows(population) - 1.0), axis=1)


def grown(strategy, generations=300):
    """First population, last one and memory on the sphere."""
    step = stepping(strategy)
    first, memory = strategy.first(FRESH(K, key=jax.random.key(0)), key=jax.random.key(1))
    population = first
    for g in range(generations):
        key = jax.random.key(2 + g)
        population, _, memory = step(memory, population, squares(population), key)
    return first, population, memory


@needed
@pytest.mark.parametrize("method", METHODS)
def test_every_method_finds_the_least_of_a_sum_of_squares(method):
    """To 2 % of where it began, at last; and what it remembers is finite even after its
    distribution has shrunk to a point."""
    first, last, memory = grown(Strategy(method))
    assert squares(last).max() > 0.02 * squares(first).max()
    finite = [bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(memory.replace(best_fitness=0))]
    assert all(finite)


@needed
@pytest.mark.parametrize("method", METHODS)
def test_a_distribution_that_is_a_point_stays_where_it_is(method):
    """evosax alone divides 0 by 0 then, in most methods: the mean would be NaN."""
    strategy = Strategy(method)
    _, memory = strategy.first(FRESH(K, key=jax.random.key(0)), key=jax.random.key(1))
    shrunk = memory.replace(std=jnp.zeros_like(memory.std))
    point = jnp.tile(memory.mean[None], (K, 1))
    (_, rest), _, unpack = tree.packed(FRESH(K, key=jax.random.key(0)))
    given = (shrunk, unpack((point, rest)), jnp.arange(float(K)), jax.random.key(2))
    population, _, after = stepping(strategy)(*given)
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(after.replace(best_fitness=0)))
    assert np.isfinite(rows(population)).all()


@needed
@pytest.mark.parametrize("method", METHODS)
def test_it_asks_for_what_evosax_alone_asks_for(method):
    """With the same keys and the negative fitness, of which one is NaN."""
    import evosax.algorithms

    population = FRESH(K, key=jax.random.key(0))
    ours = Strategy(method, std=0.5)
    if method in ("Open_ES", "PGPE"):  # with an optimizer of ours: compared where both have one
        es, params = ours._made(rows(population))
    else:
        with _theirs():
            es = getattr(evosax.algorithms, method)(K, rows(population)[0])
            params = es.default_params
        params = params.replace(std_init=jnp.float32(0.5))
    start, ask = jax.random.split(jax.random.key(1))
    mine, memory = ours.first(population, key=jax.random.key(1))
    with _theirs():
        state = es.init(start, rows(population)[0], params)
        theirs, state = es.ask(ask, state, params)
    for g in range(3):
        np.testing.assert_array_equal(rows(mine), theirs)
        fitness = squares(mine).at[3].set(jnp.nan)
        tell, ask = jax.random.split(jax.random.key(2 + g))
        mine, descent, memory = ours.next(memory, mine, fitness, FRESH, key=jax.random.key(2 + g))
        with _theirs():
            state, _ = es.tell(tell, theirs, -fitness, state, params)
            theirs, state = es.ask(ask, state, params)
        assert (descent.parent == jnp.nanargmax(fitness)).all()
    np.testing.assert_array_equal(rows(mine), theirs)


@needed
@pytest.mark.parametrize("method", METHODS)
def test_a_fitness_that_is_no_number_ranks_last(method):
    """As the worst of all does; and where there is none at all, nothing is learned."""
    strategy = Strategy(method)
    step = stepping(strategy)
    population, memory = strategy.first(FRESH(K, key=jax.random.key(0)), key=jax.random.key(1))
    fitness = squares(population)
    worst = jnp.argmin(fitness)
    ranked = step(memory, population, fitness, jax.random.key(2))
    lost = step(memory, population, fitness.at[worst].set(jnp.nan), jax.random.key(2))
    np.testing.assert_array_equal(rows(ranked[0]), rows(lost[0]))
    _, _, after = step(memory, population, jnp.full(K, jnp.nan), jax.random.key(2))
    np.testing.assert_array_equal(after.mean, memory.mean)
    np.testing.assert_array_equal(after.std, memory.std)


@needed
def test_the_optimizers_have_the_rates_of_the_papers():
    """The first step of Adam is its rate in every weight; that of ClipUp its rate in all."""
    n = rows(FRESH(2, key=jax.random.key(0))).shape[1]
    lengths = {}
    for method in ("Open_ES", "PGPE"):
        for rate in (None, 0.01):
            strategy = Strategy(method, std=0.2, learning_rate=rate)
            population, memory = strategy.first(
                FRESH(K, key=jax.random.key(0)), key=jax.random.key(1)
            )
            after = strategy.next(
                memory, population, squares(population), FRESH, key=jax.random.key(2)
            )[2]
            lengths[method, rate] = float(jnp.linalg.norm(after.mean - memory.mean))
    assert lengths["Open_ES", None] == pytest.approx(0.1 * n**0.5, rel=1e-3)
    assert lengths["Open_ES", 0.01] == pytest.approx(0.01 * n**0.5, rel=1e-3)
    assert lengths["PGPE", None] == pytest.approx(0.2 * n**0.5 / 30, rel=1e-3)
    assert lengths["PGPE", 0.01] == pytest.approx(0.01, rel=1e-3)


@needed
def test_parameters_of_evosax_are_set_by_name():
    pgpe = Strategy("PGPE", settings={"std_lr": 0.0})
    assert pgpe == config.from_tree(config.to_tree(pgpe))
    population, memory = pgpe.first(FRESH(K, key=jax.random.key(0)), key=jax.random.key(1))
    after = pgpe.next(memory, population, squares(population), FRESH, key=jax.random.key(2))[2]
    np.testing.assert_array_equal(after.std, memory.std)
    with pytest.raises(ValueError, match="setting is 'rate': it must be one of std_init, std_lr"):
        Strategy("PGPE", settings={"rate": 1.0}).first(population, key=jax.random.key(0))


@needed
def test_it_goes_on_from_a_policy():
    ea = ERL.ea(Copy(), MLP((4,)), breeder=Strategy("PGPE"), population_size=4)
    state = ea.init(key=jax.random.key(0))
    policy = MLP((4,)).init(*ea.env.sizes, key=jax.random.key(7))
    warm = ea.warm(state, policy)
    mean = rows(tree.single(policy))[0]
    np.testing.assert_array_equal(warm.breeding.mean, mean)
    away = rows(warm.population) - mean[None]
    np.testing.assert_allclose(away, rows(state.population) - state.breeding.mean[None], atol=1e-6)
    after, metrics = jax.jit(ea.generation)(warm, key=jax.random.key(1))
    assert metrics["frames"] > 0
    assert (after.lineage.maker == SAMPLED).all()


@needed
def test_a_network_learns_to_balance_two_poles():
    """Which no policy that was just drawn does, of a hundred that stand for 1,000 steps."""
    es = Neuroevolution.es(POLE, MLP(), breeder=Strategy("SNES"), episodes=1, test_episodes=1)
    state = es.init(key=jax.random.key(0))
    step, scores = compilation.jit(lambda state, key: es.generation(state, key=key)), []
    for g in range(60):
        state, metrics = step(state, jax.random.key(g))
        scores.append(float(metrics["champion_score"]))
    assert scores[0] < 200
    assert max(scores[-5:]) == 1000


@needed
def test_nothing_is_compiled_after_the_first_generation():
    es = Neuroevolution.es(Copy(), MLP((4,)), population_size=8, episodes=1, test_episodes=1)
    root = jax.random.key(0)
    state = compilation.jit(lambda key: es.init(key=key))(root)
    step = compilation.jit(lambda state, key: es.generation(state, key=key))
    keys = [jax.random.key(g) for g in range(4)]
    state, _ = step(state, keys[0])
    with compilations() as events:
        for key in keys[1:]:
            state, _ = step(state, key)
    assert events == []


def results(path):
    champion = safetensors.numpy.load_file(path / "champion.safetensors")
    named = {name: array.tobytes() for name, array in champion.items()}
    return named | {"metrics": (path / "metrics.csv").read_bytes()}


@needed
@pytest.mark.parametrize("method", ["CMA_ES", "Open_ES"])
def test_stopped_and_resumed_is_bit_for_bit_the_straight_run(method, tmp_path):
    breeder = Strategy(method)
    es = Neuroevolution.es(
        Copy(), MLP((4,)), breeder=breeder, population_size=8, episodes=1, test_episodes=1
    )
    quiet = {"tensorboard": False, "progress": False}
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    loop.train(es, generations=4, path=straight, **quiet)
    loop.train(es, generations=2, path=stopped, **quiet)
    loop.resume(stopped, generations=4, **quiet)
    assert results(straight) == results(stopped)


def test_it_has_words():
    argv = ["es", "double-pole", "--method", "PGPE", "--std", "0.2", "--learning-rate", "0.05"]
    line = Line("train", argv)
    made = train._algorithm(line, line.command(train.Train))
    line.done()
    assert made.breeder == Strategy("PGPE", std=0.2, learning_rate=0.05)


def test_without_evosax_it_says_what_to_install(monkeypatch):
    find = importlib.util.find_spec
    absent = lambda name, *more: None if name == "evosax" else find(name, *more)  # noqa: E731
    monkeypatch.setattr(importlib.util, "find_spec", absent)
    es = Neuroevolution.es(Copy(), MLP((4,)), breeder=Strategy(std=0.123))  # one that is not cached
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'credo\[strategies\]'"):
        es.init(key=jax.random.key(0))


LEARNERS = {"learners": (TD3(critic=Critic(hidden=(4,))),)}


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Strategy("CMA"), "method is 'CMA'"),
        (lambda: Strategy(std=0.0), "std is 0.0: it must be above 0"),
        (lambda: Strategy("PGPE", learning_rate=-1.0), "learning_rate is -1.0"),
        (lambda: Strategy("SNES", learning_rate=0.1), "SNES has no learning_rate"),
        (lambda: Neuroevolution.es(POLE, NETWORK, population_size=3), "at least 4"),
        (
            lambda: Neuroevolution.es(POLE, NETWORK, population_size=5, breeder=Strategy("PGPE")),
            "population_size is 5: PGPE draws pairs",
        ),
        (lambda: ERL.erl(Copy(), breeder=Strategy(), **LEARNERS), "cannot take in actors"),
        (
            lambda: ERL.erl(Copy(), breeder=Strategy(), coach=Coached(), **LEARNERS),
            "cannot take in actors",
        ),
        (
            lambda: ERL.ea(Copy(), breeder=Strategy(), elite_fraction=0.3),
            "Strategy has no elite_fraction",
        ),
        (
            lambda: Strategy().first(
                {"w": jnp.zeros((4, 20_001), jnp.float32)}, key=jax.random.key(0)
            ),
            "CMA_ES of 20,001 weights has a matrix",
        ),
    ],
)
def test_bad_settings_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
