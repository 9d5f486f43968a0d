"""Teams: who shares which weights, what each agent does, and critics that see everybody."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import tree
from credo.networks.mlp import MLP, Critic
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent
from credo.networks.team import Centralized, JointCritic, Team, TeamPolicy

OBS, ACT, AGENTS = 3, 2, 4
KEY = jax.random.key(0)
TEAM = Team(trunk=(5,), head=MLP(hidden=(3,), initializer="uniform"))
TEAMS = {
    sharing: dataclasses.replace(TEAM, sharing=sharing)
    for sharing in ("trunk", "everything", "nothing")
}
RECURRENT = {
    "mmu": MMU(hidden=2),
    "gru": Recurrent(cell="gru", hidden=2),
    "lstm": Recurrent(cell="lstm", hidden=2),
}


def made(config, seed=0, agents=AGENTS):
    return config.init(OBS, ACT, agents, key=jax.random.key(seed))


def observations(seed=1, *shape):
    draw = np.random.default_rng(seed).normal(size=(*shape, AGENTS, OBS))
    return jnp.asarray(draw, jnp.float32)


@eqx.filter_jit
def act(policy, obs, carry):
    return policy(obs, carry)


def first(policy, obs):
    """What a team does at the first step."""
    return act(policy, obs, policy.start(key=KEY))[0]


def double(weights):
    return {name: np.asarray(w, np.float64) for name, w in weights.items()}


def layer(w, i, x):
    return w[f"W_{i}"] @ x + w[f"b_{i}"]


def by_hand(policy, obs):
    """Trunk and head of each agent, one hidden layer each, in float64."""
    actions = []
    for agent, x in enumerate(np.asarray(obs, np.float64)):
        trunk, head = (
            double(weights)
            for weights in (
                policy.trunks[agent % len(policy.trunks)],
                policy.heads[agent % len(policy.heads)].weights,
            )
        )
        x = np.tanh(layer(trunk, 0, x))
        actions.append(np.tanh(layer(head, 1, np.tanh(layer(head, 0, x)))))
    return np.stack(actions)


# The policy


@pytest.mark.parametrize(
    ("sharing", "trunks", "heads"),
    [("trunk", 1, AGENTS), ("everything", 1, 1), ("nothing", AGENTS, AGENTS)],
)
def test_a_leaf_is_one_matrix_of_a_trunk_or_of_a_head(sharing, trunks, heads):
    shapes = [x.shape for x in jax.tree.leaves(made(TEAMS[sharing]))]
    trunk, head = [(5, OBS), (5,)], [(3, 5), (3,), (ACT, 3), (ACT,)]
    assert sorted(shapes) == sorted(trunks * trunk + heads * head)
    leaves = [np.asarray(x).ravel()[0] for x in jax.tree.leaves(made(TEAMS[sharing]))]
    assert len(set(leaves)) == len(leaves)  # each is drawn for itself


@pytest.mark.parametrize("sharing", TEAMS)
def test_actions_are_those_of_each_agents_trunk_and_head(sharing):
    policy, obs = made(TEAMS[sharing]), observations()
    actions = first(policy, obs)
    assert actions.shape == (AGENTS, ACT)
    assert actions.dtype == jnp.float32
    np.testing.assert_allclose(actions, by_hand(policy, obs), atol=1e-5)
    assert np.std(actions) > 0.01


@pytest.mark.parametrize(
    "config",
    [
        Team(trunk=(), head=MLP(hidden=(3,))),
        Team(trunk=(4, 6), activation="relu", head=MLP(hidden=(), output_activation="sigmoid")),
    ],
)
def test_a_trunk_has_as_many_layers_as_it_says(config):
    policy, obs = made(config), observations()
    expected = []
    for head, x in zip(policy.heads, np.asarray(obs, np.float64), strict=True):
        w, h = double(policy.trunks[0]), double(head.weights)
        for i in range(len(config.trunk)):
            x = np.maximum(layer(w, i, x), 0.0)
        if config.head.hidden:
            expected.append(np.tanh(layer(h, 1, np.tanh(layer(h, 0, x)))))
        else:
            expected.append(2 / (1 + np.exp(-layer(h, 0, x))) - 1)
    np.testing.assert_allclose(first(policy, obs), expected, atol=1e-5)


@pytest.mark.parametrize(("sharing", "alike"), [("trunk", 0), ("everything", 1), ("nothing", 0)])
def test_agents_that_see_the_same_agree_only_if_they_share_everything(sharing, alike):
    obs = jnp.broadcast_to(observations()[:1], (AGENTS, OBS))
    actions = np.asarray(first(made(TEAMS[sharing]), obs))
    for agent in range(1, AGENTS):
        assert np.allclose(actions[agent], actions[0], atol=1e-6) == alike


def test_an_agent_does_not_see_what_others_see():
    policy, obs = made(TEAMS["trunk"]), observations()
    moved = first(policy, obs.at[2].set(-obs[2]))
    changed = np.any(np.abs(moved - first(policy, obs)) > 1e-4, axis=1)
    assert changed.tolist() == [False, False, True, False]


def test_a_trunk_is_everybodys_and_a_head_one_agents():
    policy, obs = made(TEAMS["trunk"]), observations()
    before = np.asarray(first(policy, obs))
    trunk = eqx.tree_at(lambda p: p.trunks[0]["b_0"], policy, policy.trunks[0]["b_0"] + 1.0)
    assert (np.abs(np.asarray(first(trunk, obs)) - before).max(axis=1) > 1e-3).all()
    bias = policy.heads[1].weights["b_1"]
    head = eqx.tree_at(lambda p: p.heads[1].weights["b_1"], policy, bias + 1.0)
    changed = np.abs(np.asarray(first(head, obs)) - before).max(axis=1) > 1e-3
    assert changed.tolist() == [False, True, False, False]


@pytest.mark.parametrize("sharing", TEAMS)
def test_permuting_heads_and_trunks_permutes_agents(sharing):
    policy, obs = made(TEAMS[sharing]), observations()
    order = np.array([2, 0, 3, 1])
    parts = [
        tuple(part[i] for i in order) if len(part) > 1 else part
        for part in (policy.trunks, policy.heads)
    ]
    permuted = eqx.tree_at(lambda p: (p.trunks, p.heads), policy, tuple(parts))
    np.testing.assert_allclose(
        first(permuted, obs[order]), np.asarray(first(policy, obs))[order], atol=1e-6
    )


def test_a_team_of_one_is_an_agent():
    policies = [made(config, agents=1) for config in TEAMS.values()]
    obs = observations()[:1]
    actions = [np.asarray(first(policy, obs)) for policy in policies]
    for policy, action in zip(policies, actions, strict=True):
        assert action.shape == (1, ACT)
        np.testing.assert_allclose(action, by_hand(policy, obs), atol=1e-5)
    shapes = [jax.tree.map(jnp.shape, jax.tree.leaves(policy)) for policy in policies]
    assert shapes[0] == shapes[1] == shapes[2]


@pytest.mark.parametrize("sharing", TEAMS)
@pytest.mark.parametrize("name", RECURRENT)
def test_each_agent_remembers_for_itself(sharing, name):
    """As if its head alone met what the trunk makes of its own observations."""
    config = dataclasses.replace(TEAMS[sharing], head=RECURRENT[name])
    policy, steps = made(config), observations(2, 3)
    carry, actions = policy.start(key=KEY), []
    assert all(x.shape[0] == AGENTS for x in jax.tree.leaves(carry))
    for obs in steps:
        action, carry = act(policy, obs, carry)
        actions.append(action)
    run = eqx.filter_jit(lambda head, x, carry: head(x, carry))
    for agent in range(AGENTS):
        trunk = double(policy.trunks[agent % len(policy.trunks)])
        head = policy.heads[agent % len(policy.heads)]
        own = head.start(key=KEY)
        for t, obs in enumerate(np.asarray(steps, np.float64)):
            x = jnp.asarray(np.tanh(layer(trunk, 0, obs[agent])), jnp.float32)
            action, own = run(head, x, own)
            np.testing.assert_allclose(actions[t][agent], action, atol=1e-5)


def test_what_one_agent_saw_before_moves_that_agent_alone():
    policy = made(dataclasses.replace(TEAM, head=RECURRENT["mmu"]))
    past, now = observations(3, 2)
    start = policy.start(key=KEY)
    same, other = (act(policy, obs, start)[1] for obs in (past, past.at[1].set(-3.0 * past[1])))
    a, b = (np.asarray(act(policy, now, carry)[0]) for carry in (same, other))
    assert (np.abs(a - b).max(axis=1) > 1e-5).tolist() == [False, True, False, False]


@pytest.mark.parametrize("config", [*TEAMS.values(), dataclasses.replace(TEAM, head=MMU(hidden=2))])
def test_a_population_of_teams_acts_member_by_member(config):
    keys = jax.random.split(KEY, 3)
    population = eqx.filter_vmap(lambda key: config.init(OBS, ACT, AGENTS, key=key))(keys)
    obs = observations(4, 3)
    carry = eqx.filter_vmap(lambda p, key: p.start(key=key))(population, keys)
    together, after = eqx.filter_jit(eqx.filter_vmap(lambda p, x, c: p(x, c)))(
        population, obs, carry
    )
    for i in range(3):
        action, own = act(tree.take(population, i), obs[i], tree.take(carry, i))
        np.testing.assert_allclose(together[i], action, atol=1e-5)
        for x, y in zip(jax.tree.leaves(tree.take(after, i)), jax.tree.leaves(own), strict=True):
            np.testing.assert_allclose(x, y, atol=1e-5)
    assert len(np.unique(np.asarray(together)[:, 0, 0])) == 3


def test_a_team_is_told_by_its_config():
    assert (Team.team, MLP.team) == (True, False)
    assert made(TEAM).config == TEAM
    assert jax.tree.structure(made(TEAM)) == jax.tree.structure(made(TEAM, seed=1))
    default = Team()
    assert (default.trunk, default.sharing, default.activation) == ((100, 100), "trunk", "tanh")


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"trunk": (5, 0)}, r"trunk\[1\] is 0: it must be at least 1"),
        (
            {"sharing": "heads"},
            "sharing is 'heads': it must be one of everything, groups, nothing",
        ),
        ({"activation": "swish"}, "activation is 'swish'"),
        ({"initializer": "zeros"}, "initializer is 'zeros'.*uniform"),
    ],
)
def test_impossible_teams_are_refused(fields, told):
    with pytest.raises(ValueError, match=told):
        Team(**fields)


# Critics of a team

N = 5
JOINT = JointCritic(critic=Critic(hidden=(6,), activation="tanh"))


@pytest.fixture(scope="module")
def joint():
    return JOINT.init(OBS, ACT, AGENTS, key=KEY)


@pytest.fixture(scope="module")
def batch():
    """Observations, actions and what was done, features first: `[size, n, agents]`."""
    draw = np.random.default_rng(5).uniform(-1, 1, (3, N, AGENTS, OBS)).astype(np.float32)
    obs, action, done = (jnp.asarray(np.moveaxis(x, -1, 0)) for x in draw)
    return obs, action[:ACT], done[:ACT]


def joint_value(networks, agent, obs, action):
    """Q of one agent for a row, `[agents, size]`: all observations, then all actions."""
    w = {name: np.asarray(x[agent], np.float64) for name, x in networks.weights.items()}
    x = np.concatenate([np.ravel(obs), np.ravel(action)]).astype(np.float64)
    return layer(w, 1, np.tanh(layer(w, 0, x)))[0]


def rows(x):
    """`[size, n, agents]` as `[n, agents, size]`."""
    return np.moveaxis(np.asarray(x), 0, -1)


def test_a_joint_critic_has_a_network_per_agent_that_sees_everybody(joint, batch):
    shapes = {name: x.shape for name, x in joint.networks.weights.items()}
    inputs = AGENTS * (OBS + ACT)
    assert shapes == {
        "W_0": (AGENTS, 6, inputs),
        "b_0": (AGENTS, 6),
        "W_1": (AGENTS, 1, 6),
        "b_1": (AGENTS, 1),
    }
    assert joint.action_size == ACT
    assert JointCritic.joint
    assert not Critic.joint
    obs, action, _ = batch
    values = eqx.filter_jit(joint)(obs, action)
    assert values.shape == (N, AGENTS)
    for i, (s, a) in enumerate(zip(rows(obs), rows(action), strict=True)):
        expected = [joint_value(joint.networks, agent, s, a) for agent in range(AGENTS)]
        np.testing.assert_allclose(values[i], expected, atol=1e-5)
    assert np.std(values, axis=1).min() > 1e-3  # agents do not share a critic


def test_own_value_is_that_of_ones_action_among_what_the_others_did(joint, batch):
    obs, action, done = batch
    values = eqx.filter_jit(lambda *x: joint.own(*x))(obs, action, done)
    assert values.shape == (N, AGENTS)
    for i, (s, a, d) in enumerate(zip(rows(obs), rows(action), rows(done), strict=True)):
        for agent in range(AGENTS):
            mixed = d.copy()
            mixed[agent] = a[agent]
            expected = joint_value(joint.networks, agent, s, mixed)
            assert float(values[i, agent]) == pytest.approx(expected, abs=1e-5)
    np.testing.assert_allclose(joint.own(obs, done, done), joint(obs, done), atol=1e-6)


def test_own_value_has_a_gradient_in_ones_own_action_alone(joint, batch):
    obs, action, done = batch
    slopes = np.asarray(jax.jit(jax.jacrev(lambda a: joint.own(obs, a, done)))(action))
    assert slopes.shape == (N, AGENTS, ACT, N, AGENTS)
    step = 1e-5
    for i in range(N):
        for agent in range(AGENTS):
            own = slopes[i, agent, :, i, agent].copy()
            rest = slopes[i, agent].copy()
            rest[:, i, agent] = 0.0
            assert not rest.any()
            for k in range(ACT):
                ends = []
                for side in (step, -step):
                    mixed = rows(done)[i].astype(np.float64)
                    mixed[agent] = rows(action)[i, agent]
                    mixed[agent, k] += side
                    ends.append(joint_value(joint.networks, agent, rows(obs)[i], mixed))
                slope = (ends[0] - ends[1]) / (2 * step)
                assert own[k] == pytest.approx(slope, abs=1e-4)
            assert np.abs(own).max() > 1e-4


def test_a_critic_of_one_agent_knows_no_others(batch):
    critic = Critic(hidden=(4,)).init(OBS, ACT, key=KEY)
    obs, action, done = batch
    np.testing.assert_array_equal(critic.own(obs, action, done), critic(obs, action))
    alone = np.stack([critic(obs[..., k], action[..., k]) for k in range(AGENTS)], axis=1)
    np.testing.assert_allclose(critic(obs, action), alone, atol=1e-6)


# One network for all


@pytest.mark.parametrize("network", [MLP(hidden=(3,)), MMU(hidden=2)], ids=["mlp", "mmu"])
def test_one_network_sees_everybody_and_acts_for_everybody(network):
    policy = made(Centralized(network))
    obs = observations(1, 2)
    carry, alone = policy.start(key=KEY), policy.policy.start(key=KEY)
    for x in obs:
        action, carry = act(policy, x, carry)
        expected, alone = policy.policy(x.reshape(-1), alone)
        assert action.shape == (AGENTS, ACT)
        np.testing.assert_allclose(action.reshape(-1), expected, atol=1e-6)
    other = obs[0].at[0].add(1.0)  # what the first one sees moves what the last one does
    moved = first(policy, other) - first(policy, obs[0])
    assert np.abs(moved[-1]).max() > 1e-4


def test_members_are_all_weights_of_an_agent():
    apart = made(TEAMS["nothing"])
    turned = apart.with_members(apart.members[::-1])
    obs = observations()
    np.testing.assert_allclose(first(turned, obs[::-1])[::-1], first(apart, obs), atol=1e-6)
    assert made(TEAMS["trunk"]).members is None
    assert made(TEAMS["everything"]).members is None


def test_agents_of_a_group_share_all_and_no_more():
    """Two policies in one: what an agent says is what the network of its group says."""
    groups = (0, 1, 0, 1)
    network = Team((5,), Recurrent("gru", 3), "groups", groups=groups)
    policy = network.init(3, 2, 4, key=jax.random.key(0))
    assert len(policy.trunks) == len(policy.heads) == 2
    obs = jax.random.normal(jax.random.key(1), (4, 3))
    for one in (policy, policy.arranged()):
        action, _ = one(obs, one.start(key=jax.random.key(0)))
        for agent, group in enumerate(groups):
            alone = Team((5,), Recurrent("gru", 3), "everything")
            alone = TeamPolicy((policy.trunks[group],), (policy.heads[group],), alone, 4)
            expected = alone(obs, alone.start(key=jax.random.key(0)))[0][agent]
            np.testing.assert_allclose(action[agent], expected, rtol=1e-6)
    alike, _ = policy(jnp.ones((4, 3)), policy.start(key=jax.random.key(0)))
    np.testing.assert_array_equal(alike[0], alike[2])
    assert np.abs(alike[0] - alike[1]).max() > 1e-3
