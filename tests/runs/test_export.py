"""What is exported acts as the champion does, for every network and every option."""

import json

import gymnasium
import jax
import numpy as np
import pytest
from safetensors import safe_open

from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments import spaces
from credo.environments.gymnasium import Gymnasium
from credo.environments.probes import Copy
from credo.environments.sequence_recall import SequenceRecall
from credo.environments.simple_spread import SimpleSpread
from credo.environments.wrappers import DelayedHostReward
from credo.networks.base import ACTIVATIONS, AbstractNetwork, AbstractPolicy
from credo.networks.choosing import Choosing
from credo.networks.convolutional import Convolutional
from credo.networks.dmmu import DMMU
from credo.networks.dnc import DNC
from credo.networks.graph import Graph
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.normalized import Normalized
from credo.networks.ntm import NTM
from credo.networks.recurrent import Recurrent
from credo.networks.team import Centralized, Team
from credo.runner import DESCRIPTION, VERSION, Runner
from credo.runs import checkpoint, config, files
from credo.runs.export import _task, export, parts_of
from credo.runs.policy import Policy
from credo.runs.record import RunError
from credo.runs.store import Run

STEPS = 60
ORDERS = ("sequential", "simultaneous")
NETWORKS = [
    *(MLP((6, 5), a, n) for a in ACTIVATIONS for n in ("none", "before", "after")),
    MLP((), output_activation="sigmoid"),
    MLP((4,), "relu", "before", "sigmoid", initializer="uniform"),
    MMU(4),
    *(MMU(4, block_activation=a, encoder_activation="tanh") for a in ("tanh", "relu", "elu")),
    MMU(4, encoder_activation="sigmoid", decoder_activation="tanh", output_activation="tanh"),
    MMU(4, 3, encoder="learned", decoder="learned", start_memory="zero"),
    MMU(4, alpha=0.3),
    MMU(4, 6, alpha=1.0, encoder="learned", decoder="learned", decoder_activation="elu"),
    MMU(4, start_weights="saturated"),
    *(Graph(4, activation=a, passes=p) for a in ("sigmoid", "tanh") for p in (1, 3)),
    Graph(4, "lstm"),
    Convolutional(MLP((4,)), (1, 3, 1), channels=(2,), kernels=(1,), scale=2.0),
    *(Recurrent(c, 4, o) for c in ("rnn", "gru", "lstm") for o in ("sigmoid", "tanh")),
    NTM("lstm", hidden=4, rows=6, width=3),
    NTM("feedforward", 4, 5, 3, 2, 2, 2, start_memory="constant", output_activation="tanh"),
    DNC(hidden=4, rows=5, width=3, read_heads=2),
    DNC("feedforward", 4, 4, 3, 1, "tanh", "fan_in"),
]
TELLING = [
    MLP((4,)),
    MMU(4),
    Recurrent("gru", 4),
    NTM(hidden=4, rows=5, width=3),
    DNC(hidden=4, rows=4, width=3),
]
AGENTS = 3
HEADS = (MLP((), initializer="uniform"), MMU(3), Recurrent("gru", 3), Recurrent("lstm", 3))
TEAMS = [
    *(Team((5,), head, sharing) for head in HEADS for sharing in ("trunk", "nothing")),
    *(Team((5, 4), head, "everything", "relu") for head in HEADS[:2]),
    Team((), MMU(3), "nothing"),  # what CCEA drafts
    *(Team((4,), head, "groups", groups=(0, 1, 0)) for head in HEADS[1:3]),
    *(DMMU(cell, 4, order=order) for cell in ("mmu", "lstm", "gru", "rnn") for order in ORDERS),
    *(DMMU(cell, 4, access=a) for cell in ("mmu", "gru") for a in ("everyone", "acting")),
    DMMU("mmu", (3, 4, 5), 4),
    *(Centralized(network) for network in (MLP((6,)), MMU(4), Recurrent("rnn", 4))),
]


class Plant(gymnasium.Env):
    """Three numbers in; out go actions of a space of its own."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
    spaces = {
        "unit": gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32),
        "box": gymnasium.spaces.Box(np.float32([[-3.0], [10.0]]), np.float32([[1.0], [30.0]])),
        "whole": gymnasium.spaces.Box(-7, 9, (2,), np.int64),
        "discrete": gymnasium.spaces.Discrete(3, start=4),
    }

    def __init__(self, space="unit"):
        self.action_space = self.spaces[space]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action):
        return np.zeros(3, np.float32), 0.0, False, False, {}


def plant(space):
    return Gymnasium("test_export:Plant", {"space": space}, max_episode_steps=5, in_process=True)


def made(path, env, network, seed=0, action=None, champion=None, **settings) -> Run:
    """A run on disk whose champion has fresh weights. `action`: the space in its record."""
    path.mkdir()
    algorithm = Neuroevolution(env, network, population_size=10, **settings)
    champion = champion or network.init(*env.sizes, key=jax.random.key(seed))
    checkpoint.export_policy(path / "champion.safetensors", champion)
    task = {name: getattr(env, name) for name in ("obs_size", "action_size", "agents", "discrete")}
    task["actions"] = action and spaces.described(action)
    record = {"algorithm": config.to_tree(algorithm), "seed": seed, "task": task}
    files.write_json(path / "config.json", record)
    return Run(path, trust=True)


def loaded(policy, agents=None, obs_size=4, action_size=2) -> Runner:
    """What a runner reads of a policy that was exported."""
    network, weights = parts_of(policy)
    sizes = {"obs_size": obs_size, "action_size": action_size, "agents": agents}
    description = {"version": VERSION, "network": network, "action": None, **sizes}
    return Runner(json.loads(json.dumps(description)), weights)


def fleet(n=STEPS, size=4):
    """Observations of a team, whose last number says who acts, is busy or away."""
    random = np.random.default_rng(1)
    obs = random.normal(size=(n, AGENTS, size)).astype(np.float32)
    obs[..., -1] = random.integers(-1, 2, (n, AGENTS))
    return obs


def observations(n=STEPS, size=3):
    return np.random.default_rng(1).normal(size=(n, size)).astype(np.float32)


@pytest.mark.parametrize("network", NETWORKS, ids=str)
def test_the_runner_acts_as_the_champion_over_an_episode(tmp_path, network):
    run = made(tmp_path / "run", plant("unit"), network)
    policy, act = run.policy(), Runner.load(export(run, tmp_path / "p.safetensors"))
    ours = np.array([policy(obs) for obs in observations()])
    theirs = np.array([act(obs) for obs in observations()])
    assert ours.std(axis=0).max() > 1e-3  # it does something
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-5)
    act.reset()
    again = np.array([act(obs) for obs in observations()])
    np.testing.assert_array_equal(again, theirs)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("network", TELLING, ids=str)
def test_the_runner_chooses_as_the_champion(network, masked):
    """Two choices and a number; of a mask at least one option of each choice is allowed."""
    network = Choosing(network, (3, 2), masked)
    champion = network.init(7, 6, key=jax.random.key(0))
    policy, act = Policy(champion), loaded(champion, obs_size=7, action_size=6)
    seen = observations(size=7)
    seen[:, :5] = np.abs(seen[:, :5]) > 0.5
    seen[:, [1, 4]] = 1.0
    ours = np.array([policy(obs) for obs in seen])
    assert (ours[:, :3].max(axis=1) == 0).all()
    assert (ours[:, 3:5].max(axis=1) == 0).all()
    assert ours.std(axis=0).max() > 1e-3
    barred = ours[:, :5][seen[:, :5] < 0.5]
    assert barred.size > 20
    assert (barred == -1.0).all() == masked
    np.testing.assert_allclose([act(obs) for obs in seen], ours, rtol=0, atol=1e-5)


@pytest.mark.parametrize("sharing", ["trunk", "everything", "nothing"])
def test_the_runner_chooses_as_a_team(sharing):
    network = Choosing(Team((5,), MMU(3), sharing), (3,), masked=True)
    champion = network.init(5, 3, AGENTS, key=jax.random.key(0))
    policy, act = Policy(champion), loaded(champion, AGENTS, obs_size=5, action_size=3)
    seen = fleet(size=5)
    seen[..., :3] = seen[..., :3] > 0
    seen[..., 1] = 1.0
    ours = np.array([policy(obs) for obs in seen])
    assert (ours[..., :3][seen[..., :3] < 0.5] == -1.0).all()
    np.testing.assert_allclose([act(obs) for obs in seen], ours, rtol=0, atol=1e-5)


@pytest.mark.parametrize("network", TEAMS, ids=str)
def test_the_runner_acts_as_a_team_over_an_episode(network):
    champion = network.init(4, 2, AGENTS, key=jax.random.key(0))
    policy, act = Policy(champion), loaded(champion, AGENTS)
    ours = np.array([policy(obs) for obs in fleet()])
    theirs = np.array([act(obs) for obs in fleet()])
    assert ours.shape == (STEPS, AGENTS, 2)
    assert ours.std(axis=0).max(axis=1).min() > 1e-3  # everybody does something
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-5)
    act.reset()
    np.testing.assert_array_equal([act(obs) for obs in fleet()], theirs)


@pytest.mark.parametrize("network", [MMU(4), Team((5,), Recurrent("gru", 3))], ids=str)
def test_normalised_observations_are_those_of_training(tmp_path, network):
    agents = AGENTS if network.team else None
    env = SimpleSpread(agents=AGENTS) if network.team else SequenceRecall(depth=2)
    _, _, *team = env.sizes
    policy = network.init(*env.sizes, key=jax.random.key(0))
    random = np.random.default_rng(3)
    mean = random.normal(size=(*team, env.obs_size)).astype(np.float32)
    std = random.uniform(0.05, 2.0, mean.shape).astype(np.float32)
    champion = Normalized(policy, jax.numpy.asarray(mean), jax.numpy.asarray(std))
    run = made(tmp_path / "run", env, network, normalize_observations=True, champion=champion)
    ours, act = run.policy(), Runner.load(export(run, tmp_path / "p.safetensors"))
    assert act.agents == agents
    plain = Policy(policy)
    obs = random.normal(size=(STEPS, *mean.shape)).astype(np.float32)
    actions = np.array([ours(x) for x in obs])
    np.testing.assert_allclose([act(x) for x in obs], actions, rtol=0, atol=1e-5)
    expected = [plain(np.clip((x - mean) / std, -10.0, 10.0)) for x in obs]
    np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("cell", ["mmu", "gru"])
def test_random_orders_are_drawn_by_numpy(cell):
    """JAX's generator is not NumPy's: the same step, in orders that `reset(seed)` decides."""
    champion = DMMU(cell, 4, order="random").init(4, 2, AGENTS, key=jax.random.key(0))
    act, carry = loaded(champion, AGENTS), champion.start(key=jax.random.key(0))
    act.reset(seed=7)
    orders, seen = np.random.default_rng(7), set()
    private, memory = list(carry.private), carry.memory
    for obs in fleet(20):
        expected, order = np.zeros((AGENTS, 2)), orders.permutation(AGENTS)
        seen.add(tuple(order))
        for i in order:
            expected[i], private[i], memory = champion._one(
                champion.agents[i], obs[i, :-1], private[i], memory, obs[i, -1] > -0.5
            )
        np.testing.assert_allclose(act(obs), expected, rtol=0, atol=1e-5)
    assert len(seen) > 2


def test_a_team_in_a_file_acts_in_each_agents_units_and_opens_nothing(tmp_path):
    """Neither run nor policy imports what the run names: there is no such module."""
    spread = SimpleSpread(agents=3)
    run = made(tmp_path / "run", spread, Team((5,), MMU(3)))
    env = {"class": "credo.environments.pettingzoo:PettingZoo", "id": "not_there:Crew"}
    boxes = [
        gymnasium.spaces.Box(-3.0, 1.0, (2,), np.float64),
        gymnasium.spaces.Box(0, 9, (1,), np.int64),
        gymnasium.spaces.Box(np.float32([[10.0, 20.0]]), np.float32([[20.0, 60.0]])),
    ]
    wrapped = {"class": "credo.environments.wrappers:DelayedHostReward", "env": env}
    run.config["algorithm"]["env"] = wrapped
    run.config["task"] |= {
        "actions": [spaces.described(box) for box in boxes],
        "names": ["a", "b", "c"],
    }
    policy, act = run.policy(), Runner.load(export(run, tmp_path / "p.safetensors"))
    assert act.description["task"] == "not_there:Crew"
    for rows in np.random.default_rng(0).normal(size=(20, 3, spread.obs_size)):
        ours, theirs = policy(rows), act(rows)
        for box, mine, other in zip(boxes, ours, theirs, strict=True):
            assert box.contains(mine)
            assert box.contains(other)
            np.testing.assert_allclose(other, mine, rtol=0, atol=1e-5 * (box.high - box.low).max())
        assert policy({"b": rows[1]})["b"] == act({"b": rows[1]})["b"]


def test_without_reset_a_recurrent_network_remembers(tmp_path):
    run = made(tmp_path / "run", plant("unit"), Recurrent("gru", 4))
    act = Runner.load(export(run, tmp_path / "p.safetensors"))
    obs = np.ones(3)
    first, second = act(obs), act(obs)
    assert np.abs(first - second).max() > 1e-3


@pytest.mark.parametrize("space", ["box", "whole", "discrete"])
def test_actions_are_those_that_the_worker_gives_the_environment(tmp_path, space):
    own = Plant.spaces[space]
    run = made(tmp_path / "run", DelayedHostReward(plant(space)), MLP((5,)), action=own)
    raw, act = run.policy(raw=True), Runner.load(export(run, tmp_path / "p.safetensors"))
    read = spaces.as_actions(own).read
    expected = [read(raw(obs)[None])[0] for obs in observations()]
    actions, policy = [act(obs) for obs in observations()], run.policy()
    assert all(own.contains(action) for action in actions)
    assert len(np.unique(actions)) > 1
    np.testing.assert_allclose(actions, expected, rtol=1e-5, atol=1e-5)
    ours = [policy(obs) for obs in observations()]
    np.testing.assert_allclose(ours, expected, rtol=1e-6)
    assert all(own.contains(action) for action in ours)


def test_a_task_of_ours_keeps_actions_between_minus_one_and_one(tmp_path):
    task = SequenceRecall(depth=2)
    run = made(tmp_path / "run", task, MMU(3))
    act = Runner.load(export(run, tmp_path / "p.safetensors"))
    assert act.description["task"] == "SequenceRecall"
    assert act.description["action"] is None
    policy = run.policy()
    for obs in observations(10, task.obs_size):
        np.testing.assert_allclose(act(obs), policy(obs), rtol=0, atol=1e-5)


def test_the_file_says_what_it_is(tmp_path):
    run = made(tmp_path / "run", plant("box"), MLP((5,)), action=Plant.spaces["box"])
    path = export(run, tmp_path / "p.safetensors")
    with safe_open(path, "numpy") as file:  # the format's own library reads it
        assert sorted(file.keys()) == ["W_0", "W_1", "b_0", "b_1"]
        assert file.get_tensor("W_0").shape == (5, 3)
        description = json.loads(file.metadata()[DESCRIPTION])
    assert description["version"] == 3
    assert description["task"] == "test_export:Plant"
    assert description["network"]["type"] == "MLP"
    assert description["network"]["config"]["hidden"] == [5]
    assert description["network"]["parts"] == []
    assert (description["obs_size"], description["action_size"]) == (3, 2)
    assert description["action"] == {
        "low": [-3.0, 10.0],
        "high": [1.0, 30.0],
        "shape": [2, 1],
        "dtype": "float32",
    }


class Constant(AbstractPolicy):
    """Always the same."""

    w: jax.Array

    def start(self, *, key):
        return ()

    def __call__(self, obs, carry):
        return self.w, carry


class ConstantNetwork(AbstractNetwork):
    def init(self, obs_size, action_size, *, key):
        return Constant(jax.random.normal(key, (action_size,)))


def test_a_network_that_the_runner_does_not_know_is_refused(tmp_path):
    run = made(tmp_path / "run", plant("unit"), ConstantNetwork())
    with pytest.raises(RunError, match="Constant cannot be exported: the runner knows MLP, MMU"):
        export(run, tmp_path / "p.safetensors")
    assert not (tmp_path / "p.safetensors").exists()


def test_a_champion_that_cannot_act_is_not_written(tmp_path):
    network = MLP((5,), output_scale=float("inf"))
    run = made(tmp_path / "run", plant("unit"), network)
    target = tmp_path / "p.safetensors"
    target.write_text("the one before")
    with pytest.raises(ValueError, match="holds NaN or inf"):
        export(run, target)
    assert target.read_text() == "the one before"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p.safetensors", "run"]


def test_a_folder_that_is_not_there_is_not_made(tmp_path):
    run = made(tmp_path / "run", Copy(), MLP(hidden=(4,)))
    with pytest.raises(RunError, match=r"nowhere is no folder: make it first"):
        export(run, tmp_path / "nowhere" / "policy.safetensors")
    assert not (tmp_path / "nowhere").exists()


def test_a_task_of_a_package_is_called_by_both():
    of = lambda name, **more: {"class": f"credo.environments.{name}"} | more  # noqa: E731
    assert _task(of("brax:Brax", id="hopper", backend="spring")) == "brax:hopper"
    assert _task(of("gymnasium:Gymnasium", id="Hopper-v5")) == "Hopper-v5"
    assert _task(of("rover:Rover")) == "Rover"
    assert _task({"class": "mine.brax:Mine", "id": "x"}) == "x"
