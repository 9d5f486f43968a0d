"""One battery over every member of each family: whoever joins is listed here."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import compilation, tree
from credo.environments.base import AbstractEnvironment
from credo.environments.distracted_cue import DistractedCue
from credo.environments.double_pole import DoublePole
from credo.environments.endless_tmaze import EndlessTMaze
from credo.environments.passive_tmaze import PassiveTMaze
from credo.environments.probes import Copy, Locked, Meet, Remember, Xor
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.sequence_copy import RepeatCopy, SequenceCopy
from credo.environments.sequence_recall import SequenceRecall
from credo.environments.wrappers import NoisyObservations, delayed
from credo.evolution.crossover import AbstractCrossover, MaskedCrossover, OnePointCrossover
from credo.evolution.extinction import Extinction
from credo.evolution.mutation import GaussianMutation, MatrixMutation, Mutations
from credo.evolution.selection import Tournament, Truncation
from credo.networks.dnc import DNC
from credo.networks.graph import Graph
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.ntm import NTM
from credo.networks.recurrent import Recurrent

N = 3  # members, worlds or genomes at once
NETWORKS = {
    "mmu": MMU(hidden=2),
    "general mmu": MMU(hidden=3, memory=2, alpha=0.5, encoder="learned", decoder="learned"),
    "rnn": Recurrent(cell="rnn", hidden=2),
    "gru": Recurrent(cell="gru", hidden=2),
    "lstm": Recurrent(cell="lstm", hidden=2),
    "mlp": MLP(hidden=(2,)),
    "ntm": NTM("lstm", hidden=2, rows=4, width=2),
    "feed-forward ntm": NTM("feedforward", 2, 3, 2, write_heads=2, start_memory="constant"),
    "dnc": DNC(hidden=2, rows=3, width=2, read_heads=2),
    "graph": Graph(hidden=2, passes=2),
    "graph of lstms": Graph(hidden=2, cells="lstm"),
}
ENVIRONMENTS = {
    "classification": SequenceClassification(depth=2, min_gap=0, max_gap=2),
    "recall": SequenceRecall(depth=2, min_corridor=1, max_corridor=2),
    "sequence copy": SequenceCopy(bits=2, max_length=2),
    "repeat copy": RepeatCopy(bits=2, max_length=2, max_repeats=2),
    "copy": Copy(size=2, max_steps=2),
    "locked": Locked(size=1, hold=1, max_steps=2),
    "remember": Remember(delay=1),
    "xor": Xor(),
    "passive tmaze": PassiveTMaze(2),
    "endless tmaze": EndlessTMaze(2, 1, 2),
    "distracted cue": DistractedCue(0, 2),
    "double pole": DoublePole(max_steps=3, spread=1.0),
    "meet": Meet(),
    "delayed": delayed(Meet()),
    "noisy": NoisyObservations(Meet(), 0.1, spared=1),
}
GENETICS = {
    "matrix mutation": MatrixMutation(super_probability=0.1, reset_probability=0.1),
    "up to a fraction": MatrixMutation(up_to_fraction=True, gate="genome"),
    "one in a row": MatrixMutation(one_in=3),
    "gaussian mutation": GaussianMutation(),
    "mutations": Mutations((GaussianMutation(), MatrixMutation())),
    "matrix crossover": MaskedCrossover(part="matrix"),
    "row crossover": MaskedCrossover(part="row"),
    "entry crossover": MaskedCrossover(part="entry"),
    "one point crossover": OnePointCrossover(probability=0.5),
    "one row crossover": OnePointCrossover(probability=0.5, taken="row"),
    "extinction": Extinction(probability=0.5),
}
SELECTIONS = {"tournament": Tournament(), "truncation": Truncation()}


def keys(seed=0):
    return jax.random.split(jax.random.key(seed), N)


class Counted:
    """A function under our `jit`, and how often it was traced."""

    def __init__(self, function):
        self.traces = 0

        def counted(*args):
            self.traces += 1
            return function(*args)

        self.compiled = compilation.jit(counted)

    def __call__(self, *args):
        return self.compiled(*args)


def form(pytree):
    """Structure, shapes and dtypes."""
    leaves, structure = jax.tree.flatten(eqx.filter(pytree, eqx.is_array))
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]


def assert_float32(pytree):
    leaves = jax.tree.leaves(eqx.filter(pytree, eqx.is_inexact_array))
    assert leaves
    assert {leaf.dtype for leaf in leaves} == {jnp.dtype(jnp.float32)}
    assert all(np.isfinite(leaf).all() for leaf in leaves)


def assert_close(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-5)


@pytest.mark.parametrize("name", NETWORKS)
def test_networks(name):
    net, obs_size, action_size = NETWORKS[name], 3, 2
    init = Counted(
        lambda keys: eqx.filter_vmap(lambda k: net.init(obs_size, action_size, key=k))(keys)
    )
    population = init(keys())
    assert form(init(keys(1))) == form(population)
    assert init.traces == 1
    assert_float32(population)
    assert tree.size(population) == N
    assert all(leaf.shape[0] == N for leaf in jax.tree.leaves(population))

    def act(policy, obs):
        carry = policy.start(key=jax.random.key(0))
        first, after = policy(obs, carry)
        return first, policy(obs, after)[0], carry, after

    alone, together = Counted(act), Counted(eqx.filter_vmap(act))
    obs = jax.random.normal(jax.random.key(2), (N, obs_size))
    batch = together(population, obs)
    for i in range(N):
        single = alone(tree.take(population, i), obs[i])
        assert_close(single, jax.tree.map(lambda x, i=i: x[i], batch))
        assert form(single[2]) == form(single[3])  # a carry keeps its form
    together(population, obs + 1.0)
    assert alone.traces == together.traces == 1
    assert batch[0].shape == (N, action_size)
    assert_float32(batch)
    assert (np.abs(batch[0]) <= 1.0).all()
    assert dataclasses.replace(net) == net


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_environments(name):
    env: AbstractEnvironment = ENVIRONMENTS[name]
    team = () if env.agents is None else (env.agents,)
    action = jnp.full((*team, env.action_size), 0.5)

    def begin(key):
        state, first = env.reset(key=key)
        return first, env.step(state, action, key=jax.random.fold_in(key, 1))[1]

    alone, together = Counted(begin), Counted(jax.vmap(begin))
    batch = together(keys())
    for i, key in enumerate(keys()):
        single = alone(key)
        assert form(single[0]) == form(single[1])
        assert_close(single, jax.tree.map(lambda x, i=i: x[i], batch))
    together(keys(1))
    assert alone.traces == together.traces == 1
    assert_float32(batch)
    for time_step in batch:
        assert time_step.obs.shape == (N, *team, env.obs_size)
        assert (time_step.obs >= env.obs_range[0]).all()
        assert (time_step.obs <= env.obs_range[1]).all()
        assert set(time_step.rewards) == set(env.signals)
        assert all(r.shape in {(N,), (N, *team)} for r in time_step.rewards.values())
        assert time_step.terminated.dtype == time_step.truncated.dtype == jnp.bool_
    assert all((reward == 0.0).all() for reward in batch[0].rewards.values())
    assert len({str(np.asarray(batch[0].obs[i])) for i in range(N)}) > 1 or name == "remember"


def operate(operator, genomes, others, key):
    """One operator on `N` genomes."""
    if isinstance(operator, Extinction):
        return operator(genomes, lambda: others, key=key)
    split = jax.random.split(key, N)
    if isinstance(operator, AbstractCrossover):
        return eqx.filter_vmap(lambda a, b, key: operator(a, b, key=key))(genomes, others, split)
    return eqx.filter_vmap(lambda genome, key: operator(genome, key=key))(genomes, split)


@pytest.fixture(scope="module")
def genomes():
    net = NETWORKS["mmu"]
    made = compilation.jit(eqx.filter_vmap(lambda key: net.init(1, 1, key=key)))
    return made(keys()), made(keys(1))


@pytest.mark.parametrize("name", GENETICS)
def test_genetic_operators(name, genomes):
    operator = GENETICS[name]
    run = Counted(operate)
    before = jax.tree.map(np.array, genomes)
    made = run(operator, *genomes, jax.random.key(0))
    assert form(made) == form(genomes[0])
    assert made.config == genomes[0].config
    assert_float32(made)
    assert_close(made, run(operator, *genomes, jax.random.key(0)))
    draws = [run(operator, *genomes, jax.random.key(seed)) for seed in range(1, 8)]
    assert run.traces == 1
    assert len({np.asarray(draw.N_i).tobytes() for draw in draws}) > 1
    assert_close(genomes, before)  # the parents are as they were


@pytest.mark.parametrize("name", SELECTIONS)
def test_selections(name):
    selection = SELECTIONS[name]
    run = Counted(lambda selection, fitness, key: selection(fitness, 7, key=key))
    fitness = jnp.array([3.0, 1.0, 2.0, jnp.nan, 5.0])
    chosen = run(selection, fitness, jax.random.key(0))
    assert chosen.shape == (7,)
    assert jnp.issubdtype(chosen.dtype, jnp.integer)
    assert set(np.asarray(chosen).tolist()) <= {0, 1, 2, 4}
    many = jax.vmap(lambda key: selection(fitness, 7, key=key))(keys())
    np.testing.assert_array_equal(many[1], run(selection, fitness, keys()[1]))
    assert run.traces == 1
