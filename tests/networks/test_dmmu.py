"""DMMU: its equations in NumPy for each order of access, who takes part, and other team sizes."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import rollout, tree
from credo.environments.server_fleet import ServerFleet
from credo.networks.dmmu import DMMU

OBS, ACT, AGENTS, STEPS = 3, 2, 3, 4  # numbers an agent observes, the status beside
KEY = jax.random.key(0)
SAME = DMMU(hidden=4)
ORDERS = {
    name: dataclasses.replace(SAME, order=name) for name in ("sequential", "simultaneous", "random")
}
UNEQUAL = DMMU(hidden=(2, 4, 5), memory=4)
STATUS = np.array([[1, 1, 1], [0, 1, 0], [-1, 0, 1], [1, -1, -1]], np.float32)  # [steps, agents]


def made(config, seed=0, agents=AGENTS):
    return config.init(OBS + 1, ACT, agents, key=jax.random.key(seed))


def observations(status=STATUS, seed=1):
    draw = np.random.default_rng(seed).normal(size=(*status.shape, OBS))
    return jnp.asarray(np.concatenate([draw, status[..., None]], axis=2), jnp.float32)


@eqx.filter_jit
def play(policy, obs):
    """Actions, carries and writes of each step."""

    def body(carry, x):
        action, carry, writes = policy.access(x, carry)
        kept = (carry.private, carry.memory)
        return carry, (action, *kept, writes)

    return jax.lax.scan(body, policy.start(key=KEY), obs)[1]


def σ(x):
    return 1 / (1 + np.exp(-x))


def access_by_hand(agent, x, y, m):
    """Equations 3.1 to 3.5 of one agent, in float64: its output and its write."""
    w = {
        f.name: np.asarray(getattr(agent, f.name), np.float64)
        for f in dataclasses.fields(agent)
        if f.name != "config" and getattr(agent, f.name) is not None
    }
    gates = (w[f"K_{g}"] @ x + w[f"R_{g}"] @ y + w[f"N_{g}"] @ m + w[f"b_{g}"] for g in "irw")
    i, r, write_gate = (σ(gate) for gate in gates)
    p = σ(w["K_p"] @ x + w["N_p"] @ m + w["b_p"])
    d = w["N_d"] @ m + w["b_d"] if "N_d" in w else m
    h = r * d + p * i
    f = w["Z_f"] @ h + w["b_f"] if "Z_f" in w else h
    return np.tanh(w["Z_y"] @ h + w["b_y"]), write_gate * np.tanh(f)


def play_by_hand(policy, obs, order):
    """The whole team, agent by agent."""
    n, cells, key = len(policy.agents), policy.config.cells, KEY
    least = {"everyone": -2, "present": -0.5, "acting": 0.5}[policy.config.access]
    y, m, told = np.zeros((n, ACT)), np.zeros(cells), []
    for x in np.asarray(obs, np.float64):
        turns = range(n)
        if order == "random":
            key, order_key = jax.random.split(key)
            turns = np.asarray(jax.random.permutation(order_key, n))
        action, writes, read = np.zeros((n, ACT)), np.zeros((n, cells)), m.copy()
        for k in turns:
            if x[k, -1] > least:
                seen = read if order == "simultaneous" else m
                sensed = x[k] if policy.config.access == "everyone" else x[k, :-1]
                y[k], writes[k] = access_by_hand(policy.agents[k], sensed, y[k], seen)
                action[k] = y[k]
                m = m + writes[k]
        told.append((action, y.copy(), m.copy(), writes))
    return [np.stack(x) for x in zip(*told, strict=True)]


def assert_equal(a, b, atol=2e-6):
    for x, y in zip(a, b, strict=True):
        np.testing.assert_allclose(x, y, atol=atol)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("sizes", [SAME, UNEQUAL], ids=["same", "unequal"])
def test_the_equations(order, sizes):
    policy, obs = made(dataclasses.replace(sizes, order=order)), observations()
    assert_equal(play(policy, obs), play_by_hand(policy, obs, order))


@pytest.mark.parametrize("access", ["everyone", "acting"])
def test_who_takes_part(access):
    policy, obs = made(dataclasses.replace(SAME, access=access)), observations()
    assert_equal(play(policy, obs), play_by_hand(policy, obs, "sequential"))


def test_orders_differ():
    actions = [np.asarray(play(made(config), observations())[0]) for config in ORDERS.values()]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(actions[a] - actions[b]).max() > 1e-3


@pytest.mark.parametrize("config", [*ORDERS.values(), UNEQUAL], ids=[*ORDERS, "unequal"])
def test_who_is_away_changes_nothing(config):
    policy = made(config)
    obs = observations(np.array([[1, 1, 1], [-1, -1, -1], [1, -1, 1]], np.float32))
    action, outputs, memory, writes = (np.asarray(x) for x in play(policy, obs))
    assert (action[1] == 0).all()
    assert (writes[1] == 0).all()
    np.testing.assert_array_equal(memory[1], memory[0])
    np.testing.assert_array_equal(outputs[1], outputs[0])
    np.testing.assert_array_equal(outputs[2, 1], outputs[0, 1])
    assert np.abs(writes[[0, 2]][:, [0, 2]]).min() > 0
    other = np.array(obs)
    other[2, 1, :-1] += 9.0  # what one who is away might see
    assert_equal(play(policy, jnp.asarray(other)), (action, outputs, memory, writes), atol=0)


@pytest.mark.parametrize("order", ["simultaneous", "sequential"])
def test_at_once_nobody_is_the_first(order):
    policy, obs, turn = made(ORDERS[order]), observations(), [2, 0, 1]
    turned = dataclasses.replace(policy, agents=tuple(policy.agents[i] for i in turn))
    action, _, memory, _ = play(policy, obs)
    after, _, memory_after, _ = play(turned, obs[:, np.array(turn)])
    difference = np.abs(np.asarray(action)[:, turn] - np.asarray(after)).max()
    difference = max(difference, np.abs(np.asarray(memory - memory_after)).max())
    assert (difference < 1e-5) == (order == "simultaneous")


@pytest.mark.parametrize("config", [ORDERS["sequential"], ORDERS["simultaneous"], UNEQUAL], ids=str)
def test_a_team_without_an_agent_is_one_whose_agent_is_away(config):
    policy = made(config)
    status = STATUS.copy()
    status[:, 1] = -1
    obs = observations(status)
    smaller = policy.without([1])
    assert len(smaller.agents) == 2
    action, _, memory, writes = play(policy, obs)
    left = np.array([0, 2])
    got = play(smaller, obs[:, left])
    assert_equal((got[0], got[2], got[3]), (action[:, left], memory, writes[:, left]))


def test_clones():
    policy = made(ORDERS["simultaneous"])
    larger = policy.with_clones([1, 1])
    obs = observations(np.ones((1, 3), np.float32))
    action, _, _, writes = play(larger, obs[:, np.array([0, 1, 2, 1, 1])])
    assert action.shape == (1, 5, ACT)
    np.testing.assert_array_equal(action[0, 1], action[0, 3])
    np.testing.assert_array_equal(writes[0, 1], writes[0, 4])
    assert_equal((action[:, :3],), play(policy, obs)[:1])
    assert eqx.tree_equal(larger.without([3, 4]), policy)
    unequal = made(UNEQUAL).with_clones([0])
    assert unequal.config.hidden == (2, 4, 5, 2)
    assert play(unequal, observations(np.ones((1, 4), np.float32)))[0].shape == (1, 4, ACT)


def test_the_genome_has_a_leaf_per_matrix_and_agent():
    policy = made(DMMU(hidden=30), agents=4)
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(policy)]
    assert len(paths) == len(set(paths)) == 4 * 17
    assert ".agents[3].N_w" in paths
    agent = policy.agents[0]
    assert (agent.K_i.shape, agent.N_r.shape, agent.Z_y.shape) == ((30, 3), (30, 30), (2, 30))
    matrices = np.concatenate([np.ravel(a.N_w) for a in policy.agents])
    biases = np.concatenate([np.ravel(b) for a in policy.agents for b in (a.b_i, a.b_r, a.b_w)])
    assert abs(matrices.std() * 30**0.5 - 1) < 0.1
    assert abs(biases.std() - 0.1) < 0.02


def test_sizes_of_agents_may_differ_from_the_memory():
    policy = made(UNEQUAL)
    assert [a.Z_f is None for a in policy.agents] == [False, True, False]
    assert policy.agents[2].N_d.shape == (5, 4)
    assert policy.start(key=KEY).memory.shape == (4,)
    assert DMMU(hidden=(2, 6)).cells == 6


@pytest.fixture(scope="module")
def fleet():
    """A task whose second server leaves, a population for it, and what the population earns."""
    env = ServerFleet(
        servers=3,
        devices=2,
        requests=2,
        nefarious=1,
        max_steps=4,
        schedule=((0, 4), (0, 2), (1, 4)),
    )
    init = jax.vmap(lambda key: SAME.init(*env.sizes, key=key))
    population = init(jax.random.split(KEY, 4))
    return env, population, rollout.evaluate(env, population, 3, key=KEY)


def test_a_population_plays(fleet):
    env, population, played = fleet
    net = np.asarray(played.returns["net"])
    assert net.shape == (4, 3)
    assert np.abs(net).max() <= 2
    assert len(np.unique(net)) > 1
    alone = rollout.evaluate(env, tree.stack(tree.take(population, 2)), 3, key=KEY)
    np.testing.assert_array_equal(alone.returns["net"][0], net[2])


def test_a_trained_population_plays_in_another_number(fleet):
    env, population, _ = fleet
    for team, schedule in (
        (population.without([1]), ((0, 4), (1, 4))),
        (population.with_clones([0]), (*env.schedule, (2, 4))),
    ):
        other = dataclasses.replace(env, servers=len(schedule), schedule=schedule)
        net = np.asarray(rollout.evaluate(other, team, 3, key=KEY).returns["net"])
        assert np.isfinite(net).all()
        assert net.shape == (4, 3)


@pytest.mark.parametrize("order", ["sequential", "random"])
def test_vmap_equals_single(order):
    members = [made(ORDERS[order], seed) for seed in range(3)]
    obs = observations()
    together = eqx.filter_vmap(lambda p: play(p, obs))(tree.stack(*members))
    for i, member in enumerate(members):
        assert_equal([x[i] for x in together], play(member, obs))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"hidden": 0}, "hidden is 0"),
        ({"hidden": (3, 0)}, "hidden is 0"),
        ({"memory": 0}, "memory is 0"),
        ({"order": "any"}, "order is 'any'"),
        ({"access": "nobody"}, "access is 'nobody'"),
        ({"bias_std": -1.0}, "bias_std is -1.0"),
        ({"start_weights": "open"}, "start_weights is 'open'"),
        ({"start_weights": "shut", "cell": "lstm"}, "only MMUs have write gates"),
    ],
)
def test_wrong_arguments_are_named(given, told):
    with pytest.raises(ValueError, match=told):
        DMMU(**given)


def test_wrong_agents_are_named():
    policy = made(SAME)
    with pytest.raises(ValueError, match=r"no agent 3: this team has 0\.\.2"):
        policy.without([3])
    with pytest.raises(ValueError, match="no agent -1"):
        policy.with_clones([-1])
    with pytest.raises(ValueError, match="no agent is left"):
        policy.without([0, 1, 2])
    with pytest.raises(ValueError, match="3 sizes for 2 agents"):
        UNEQUAL.init(OBS, ACT, 2, key=KEY)
    with pytest.raises(ValueError, match="inputs beside the status is 0"):
        SAME.init(1, ACT, 2, key=KEY)


# Other cells around one memory


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("cell", ["lstm", "gru", "rnn"])
def test_the_state_of_other_cells_is_the_memory_of_all(cell, order):
    """By hand: the agents' own networks, in turn, with what the last one left."""
    config = DMMU(cell=cell, hidden=4, order=order, access="everyone")
    policy, obs = made(config), observations()
    actions, private, memory, writes = (np.asarray(x) for x in play(policy, obs))
    key, m = KEY, jnp.zeros(4)
    own = [jnp.zeros(4)] * AGENTS
    for t, x in enumerate(obs):
        turns = list(range(AGENTS))
        if order == "random":
            key, order_key = jax.random.split(key)
            turns = np.asarray(jax.random.permutation(order_key, AGENTS)).tolist()
        read = m
        for k in turns:
            seen = read if order == "simultaneous" else m
            agent = policy.agents[k]
            if cell == "lstm":
                action, (own[k], after) = agent(x[k], (own[k], seen))
                np.testing.assert_allclose(private[t, k], own[k], atol=1e-6)
            else:
                action, after = agent(x[k], seen)
            np.testing.assert_allclose(actions[t, k], action, atol=1e-6)
            np.testing.assert_allclose(writes[t, k], after - seen, atol=1e-6)
            m = m + (after - seen)
        np.testing.assert_allclose(memory[t], m, atol=1e-5)


def test_a_state_has_one_unit_for_each_memory_cell():
    with pytest.raises(ValueError, match="memory is 3: agents of cell 'lstm' have one unit for"):
        DMMU(cell="lstm", hidden=2, memory=3)
    with pytest.raises(ValueError, match="cell is 'ntm'"):
        DMMU(cell="ntm")


def test_agents_that_start_shut_write_nothing_that_they_are_not_taught_to():
    drawn, shut = (
        made(DMMU(hidden=4, initializer="normal", start_weights=start))
        for start in ("drawn", "shut")
    )
    for before, after in zip(drawn.agents, shut.agents, strict=True):
        np.testing.assert_allclose(after.b_w, before.b_w - 20.0)
        np.testing.assert_array_equal(after.K_w, before.K_w)
    moved = [np.max(np.abs(play(team, observations())[3])) for team in (drawn, shut)]
    assert moved[0] > 0.1
    assert moved[1] < 1e-5
