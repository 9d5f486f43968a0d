"""Whole agents change places between teams, and within one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import tree
from credo.evolution.agents import AgentCrossover, Homogenize
from credo.networks.dmmu import DMMU
from credo.networks.mlp import MLP
from credo.networks.team import Team

AGENTS, CHILDREN = 3, 300
NETWORKS = {
    "dmmu": DMMU(hidden=2),
    "own networks": Team(trunk=(2,), head=MLP(hidden=()), sharing="nothing"),
}


def team(name, number):
    """A team whose agent i has `10 * number + i` for every weight."""
    made = NETWORKS[name].init(3, 2, AGENTS, key=jax.random.key(0))
    return made.with_members(
        tuple(
            jax.tree.map(lambda x, i=i: jnp.full_like(x, 10.0 * number + i), member)
            for i, member in enumerate(made.members)
        )
    )


def whose(operator, *teams):
    """Which agent each agent of many children is, `[children, agents]`."""
    keys = jax.random.split(jax.random.key(1), CHILDREN)
    made = eqx.filter_jit(eqx.filter_vmap(lambda key: operator(*teams, key=key)))(keys)
    found = []
    for member in made.members:
        leaves = [np.asarray(x).reshape(CHILDREN, -1) for x in jax.tree.leaves(member)]
        every = np.concatenate(leaves, axis=1)
        assert (every == every[:, :1]).all()  # whole agents alone
        found.append(every[:, 0])
    return np.stack(found, axis=1)


@pytest.mark.parametrize("name", NETWORKS)
def test_agents_of_the_mate_take_their_own_place(name):
    found = whose(AgentCrossover(probability=0.3), team(name, 0), team(name, 1))
    np.testing.assert_array_equal(found % 10, np.broadcast_to(np.arange(AGENTS), found.shape))
    assert (found >= 10).mean() == pytest.approx(0.3, abs=0.06)
    assert len({tuple(row) for row in (found >= 10)}) == 2**AGENTS  # each on its own


def test_or_any_place():
    found = whose(AgentCrossover(0.5, source="any"), team("dmmu", 0), team("dmmu", 1))
    stays, comes = found[found < 10], found[found >= 10]
    assert len(comes) / found.size == pytest.approx(0.5, abs=0.06)
    np.testing.assert_allclose(np.bincount(comes.astype(int) - 10) / len(comes), 1 / 3, atol=0.08)
    assert set(stays) == {0.0, 1.0, 2.0}


def test_one_agent_overwrites_others():
    found = whose(Homogenize(probability=1.0, share=0.5), team("dmmu", 0))
    for row in found:  # one model, and who is not it is itself
        others = [x for i, x in enumerate(row) if x != i]
        assert len(set(others)) <= 1
    changed = (found != np.arange(AGENTS)).mean()
    assert changed == pytest.approx(0.5 * 2 / 3, abs=0.06)
    rarely = whose(Homogenize(probability=0.1, share=1.0), team("dmmu", 0))
    same = (rarely == rarely[:, :1]).all(axis=1).mean()
    assert same == pytest.approx(0.1, abs=0.05)


def test_teams_of_unlike_agents_exchange_those_of_one_index():
    network = DMMU(hidden=(2, 3), memory=3)
    a, b = (network.init(3, 2, 2, key=jax.random.key(k)) for k in (0, 1))
    child = AgentCrossover(probability=1.0)(a, b, key=jax.random.key(2))
    assert eqx.tree_equal(child.members, b.members)
    with pytest.raises(ValueError, match="differ in size"):
        AgentCrossover(1.0, source="any")(a, b, key=jax.random.key(2))


def test_shared_weights_are_no_agents():
    shared = Team(trunk=(2,)).init(3, 2, AGENTS, key=jax.random.key(0))
    with pytest.raises(TypeError, match=r"TeamPolicy has no agents.*Team\(sharing='nothing'\)"):
        AgentCrossover()(shared, shared, key=jax.random.key(0))
    alone = MLP().init(3, 2, key=jax.random.key(0))
    with pytest.raises(TypeError, match="MLPPolicy has no agents"):
        Homogenize()(alone, key=jax.random.key(0))


def test_populations_are_crossed_member_by_member():
    operator, keys = AgentCrossover(probability=0.5), jax.random.split(jax.random.key(3), 2)
    pairs = [(team("dmmu", 0), team("dmmu", 1)), (team("dmmu", 2), team("dmmu", 3))]
    a, b = (tree.stack(*teams) for teams in zip(*pairs, strict=True))
    together = eqx.filter_vmap(lambda a, b, key: operator(a, b, key=key))(a, b, keys)
    for i, (one, other) in enumerate(pairs):
        assert eqx.tree_equal(tree.take(together, i), operator(one, other, key=keys[i]))
