"""What is exported acts as the champion does, for every network and every option."""

import json

import gymnasium
import jax
import numpy as np
import pytest
from safetensors import safe_open

from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments import adapters
from credo.environments.gymnasium import Gymnasium
from credo.environments.sequence_recall import SequenceRecall
from credo.environments.wrappers import DelayedHostReward
from credo.networks.base import ACTIVATIONS, AbstractNetwork, AbstractPolicy
from credo.networks.mlp import MLP, NORMALIZATIONS
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent
from credo.runner import DESCRIPTION, Runner
from credo.runs import checkpoint, config
from credo.runs.export import export
from credo.runs.loop import Run, RunError

STEPS = 60
NETWORKS = [
    *(MLP((6, 5), a, n) for a in ACTIVATIONS for n in NORMALIZATIONS),
    MLP((), output_activation="sigmoid"),
    MLP((4,), "relu", "before", "sigmoid", initializer="uniform"),
    MMU(4),
    *(MMU(4, block_activation=a, encoder_activation="tanh") for a in ("tanh", "relu", "elu")),
    MMU(4, encoder_activation="sigmoid", decoder_activation="tanh", output_activation="tanh"),
    MMU(4, 3, encoder="learned", decoder="learned", start_memory="zero"),
    MMU(4, alpha=0.3),
    MMU(4, 6, alpha=1.0, encoder="learned", decoder="learned", decoder_activation="elu"),
    MMU(4, start_weights="saturated"),
    *(Recurrent(c, 4, o) for c in ("rnn", "gru", "lstm") for o in ("sigmoid", "tanh")),
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


def made(path, env, network, seed=0) -> Run:
    """A run on disk whose champion has fresh weights."""
    path.mkdir()
    algorithm = Neuroevolution(env, network, population_size=10)
    policy = network.init(env.obs_size, env.action_size, key=jax.random.key(seed))
    checkpoint.export_policy(path / "champion.safetensors", policy)
    config.write_json(path / "config.json", {"algorithm": config.to_tree(algorithm), "seed": seed})
    return Run(path, trust=True)


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


def test_without_reset_a_recurrent_network_remembers(tmp_path):
    run = made(tmp_path / "run", plant("unit"), Recurrent("gru", 4))
    act = Runner.load(export(run, tmp_path / "p.safetensors"))
    obs = np.ones(3)
    first, second = act(obs), act(obs)
    assert np.abs(first - second).max() > 1e-3


@pytest.mark.parametrize("space", ["box", "whole", "discrete"])
def test_actions_are_those_that_the_worker_gives_the_environment(tmp_path, space):
    run = made(tmp_path / "run", DelayedHostReward(plant(space)), MLP((5,)))
    policy, act = run.policy(), Runner.load(export(run, tmp_path / "p.safetensors"))
    _, read = adapters._actions(Plant.spaces[space])
    expected = [read(policy(obs)[None])[0] for obs in observations()]
    actions = [act(obs) for obs in observations()]
    assert all(Plant.spaces[space].contains(action) for action in actions)
    assert len(np.unique(actions)) > 1
    np.testing.assert_allclose(actions, expected, rtol=1e-5, atol=1e-5)


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
    path = export(made(tmp_path / "run", plant("box"), MLP((5,))), tmp_path / "p.safetensors")
    with safe_open(path, "numpy") as file:  # the format's own library reads it
        assert sorted(file.keys()) == ["W_0", "W_1", "b_0", "b_1"]
        assert file.get_tensor("W_0").shape == (5, 3)
        description = json.loads(file.metadata()[DESCRIPTION])
    assert description["version"] == 1
    assert description["task"] == "test_export:Plant"
    assert description["network"] == "MLP"
    assert description["config"]["hidden"] == [5]
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
    network = MLP((5,), output_scale=float("nan"))
    run = made(tmp_path / "run", plant("unit"), network)
    target = tmp_path / "p.safetensors"
    target.write_text("the one before")
    with pytest.raises(ValueError, match="holds NaN or inf"):
        export(run, target)
    assert target.read_text() == "the one before"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p.safetensors", "run"]
