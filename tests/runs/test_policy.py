"""A run's policy acts in its task's own units, from what the run recorded alone."""

import json
import sys

import gymnasium
import jax
import numpy as np
import pytest

from credo.algorithms.ccea import CCEA
from credo.algorithms.neuroevolution import Neuroevolution
from credo.environments.gymnasium import Gymnasium
from credo.environments.sequence_recall import SequenceRecall
from credo.environments.simple_spread import SimpleSpread
from credo.networks.mlp import MLP
from credo.networks.mmu import MMU
from credo.networks.recurrent import Recurrent
from credo.networks.team import Team
from credo.runner import Runner
from credo.runs import checkpoint, config, files
from credo.runs.config import ConfigError
from credo.runs.export import export
from credo.runs.policy import Policy
from credo.runs.record import RunError
from credo.runs.store import Run

OBS, ACTIONS = 3, 2
BOX = {"low": [-3.0, 10.0], "high": [1.0, 30.0], "shape": [2, 1], "dtype": "float32"}
SPACE = gymnasium.spaces.Box(np.float32([[-3.0], [10.0]]), np.float32([[1.0], [30.0]]))


def task(actions, **more):
    sizes = {"obs_size": OBS, "action_size": ACTIONS, "agents": None, "discrete": False}
    return sizes | {"actions": actions, "observations": None} | more


@pytest.fixture(scope="module")
def champion():
    return Recurrent("gru", 3).init(OBS, ACTIONS, key=jax.random.key(0))


def inputs(n=6, size=OBS):
    return np.random.default_rng(0).normal(size=(n, size)).astype(np.float32)


def recorded(path, algorithm, policy, **record):
    """A run on disk, as training leaves it."""
    path.mkdir()
    checkpoint.export_policy(path / "champion.safetensors", policy)
    tree = json.loads(json.dumps(config.to_tree(algorithm)))
    files.write_json(path / "config.json", {"algorithm": tree, "seed": 0} | record)
    return Run(path)


def test_a_box_gets_its_own_units_shape_and_dtype(champion):
    raw, policy = Policy(champion), Policy(champion, task(BOX))
    for obs in inputs():
        own, plain = policy(obs), raw(obs)
        assert SPACE.contains(own)
        np.testing.assert_allclose(own[:, 0], [-1.0, 20.0] + plain * [2.0, 10.0], rtol=1e-6)


def test_raw_actions_lie_between_minus_one_and_one(champion):
    raw, policy = Policy(champion), Policy(champion, task(BOX), raw=True)
    for obs in inputs():
        np.testing.assert_array_equal(policy(obs.reshape(1, 3)), raw(obs))


def test_a_discrete_gets_an_integer_from_its_start_that_a_mask_allows(champion):
    raw, policy = Policy(champion), Policy(champion, task({"n": 2, "start": 5}))
    masked, chosen = Policy(champion, task({"n": 2, "start": 5})), []
    for obs in inputs():
        chosen.append(policy(obs))
        assert type(chosen[-1]) is int
        assert chosen[-1] == 5 + np.argmax(raw(obs))
        assert masked(obs, mask=[True, False]) == 5
    assert set(chosen) == {5, 6}
    with pytest.raises(ValueError, match="must allow at least one of 2 entries"):
        policy(obs, mask=[0, 0])


def test_a_discrete_observation_may_be_its_integer(champion):
    policy = Policy(champion, task(None, observations={"n": OBS, "start": 1}))
    raw = Policy(champion)
    for k in (3, 1, np.int64(2)):
        np.testing.assert_array_equal(policy(k), raw(np.eye(3, dtype=np.float32)[k - 1]))
    with pytest.raises(ValueError, match="must be an integer from 1 to 3"):
        policy(0)


def test_an_observation_that_does_not_fit_is_refused_in_a_sentence(champion):
    policy = Policy(champion, task(BOX))
    with pytest.raises(ValueError, match="the observation has 4 numbers: it must have 3"):
        policy(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="NaN and inf are no observations"):
        policy([0.0, np.inf, 0.0])


def test_the_memory_goes_with_a_reset(champion):
    policy = Policy(champion, task(BOX))
    first = [policy(obs) for obs in inputs()]
    policy.reset()
    np.testing.assert_array_equal([policy(obs) for obs in inputs()], first)
    assert np.abs(policy(inputs()[0]) - first[0]).max() > 1e-3


def test_a_task_of_ones_own_in_jax_needs_no_units(tmp_path):
    env = SequenceRecall(depth=2)
    policy = MMU(3).init(*env.sizes, key=jax.random.key(0))
    run = recorded(tmp_path / "run", Neuroevolution(env, MMU(3), population_size=10), policy)
    ours, raw = run.policy(), Policy(policy)
    for obs in inputs(size=env.obs_size):
        np.testing.assert_array_equal(ours(obs), raw(obs))


def test_a_strangers_run_acts_and_is_exported_without_an_import(tmp_path, monkeypatch):
    """Its environment is a module that leaves a mark when it is imported."""
    code = (
        f"open({str(tmp_path / 'mark')!r}, 'w')\nimport gymnasium\nclass Task(gymnasium.Env): ..."
    )
    (tmp_path / "strangers_own.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    policy = MLP((4,)).init(OBS, ACTIONS, key=jax.random.key(0))
    algorithm = Neuroevolution(SequenceRecall(depth=2), MLP((4,)), population_size=10)
    run = recorded(tmp_path / "run", algorithm, policy, task=task(BOX))
    env = {"class": "credo.environments.gymnasium:Gymnasium", "id": "strangers_own:Task"}
    run.config["algorithm"]["env"] = env
    files.write_json(run.path / "config.json", run.config)
    run = Run(tmp_path / "run")
    ours, act = run.policy(), Runner.load(export(run, tmp_path / "p.safetensors"))
    assert act.description["task"] == "strangers_own:Task"
    for obs in inputs():
        np.testing.assert_allclose(act(obs), ours(obs), rtol=1e-5)
        assert SPACE.contains(act(obs))
    assert "strangers_own" not in sys.modules
    assert not (tmp_path / "mark").exists()


def test_a_team_that_ccea_drafted_acts_agent_by_agent(tmp_path):
    spread, network = SimpleSpread(agents=2), MLP((3,))
    algorithm = CCEA.ccea(spread, network, population_size=10, elite_fraction=0.2)
    drafted = Team(trunk=(), head=network, sharing="nothing")
    policy = drafted.init(*spread.sizes, key=jax.random.key(0))
    boxes = [{"low": [0.0] * n, "high": [9.0] * n, "shape": [n], "dtype": "int32"} for n in (1, 2)]
    sizes = {"obs_size": spread.obs_size, "action_size": 2, "agents": 2, "actions": boxes}
    run = recorded(tmp_path / "run", algorithm, policy, task=sizes)
    ours, raw, act = run.policy(), Policy(policy), Runner.load(export(run, tmp_path / "p"))
    for rows in inputs(n=12, size=spread.obs_size).reshape(6, 2, -1):
        expected = np.rint(4.5 + 4.5 * raw(rows).astype(np.float64))
        first, second = ours(rows)
        assert first.dtype == np.int32
        assert (first.tolist(), second.tolist()) == (expected[0, :1].tolist(), expected[1].tolist())
        alone = act([None, rows[1]])
        assert alone[0] is None
        assert alone[1].tolist() == expected[1].tolist()


def test_of_an_older_run_a_public_task_is_opened_for_its_units(tmp_path):
    env = Gymnasium("Pendulum-v1", in_process=True)
    policy = MLP((4,)).init(3, 1, key=jax.random.key(0))
    run = recorded(tmp_path / "run", Neuroevolution(env, MLP((4,)), population_size=10), policy)
    ours, raw = run.policy(), Policy(policy)
    for obs in inputs():
        np.testing.assert_allclose(ours(obs), 2.0 * raw(obs), rtol=1e-6)


def test_of_an_older_run_somebodys_own_code_is_opened_if_it_is_trusted(tmp_path):
    env = Gymnasium("gymnasium.envs.classic_control:PendulumEnv", max_episode_steps=9)
    policy = MLP((4,)).init(3, 1, key=jax.random.key(0))
    run = recorded(tmp_path / "run", Neuroevolution(env, MLP((4,)), population_size=10), policy)
    with pytest.raises(ConfigError, match=r"names gymnasium\.envs\.classic_control:Pendulum"):
        run.policy()
    ours = Run(run.path, trust=True).policy()
    np.testing.assert_allclose(ours(inputs()[0]), 2.0 * Policy(policy)(inputs()[0]), rtol=1e-6)


@pytest.mark.parametrize(
    "wrong",
    [{"actions": {"low": [0.0]}}, {"actions": [BOX]}, {"agents": 10**9}, {"obs_size": None}],
    ids=str,
)
def test_a_record_that_makes_no_sense_names_its_file(tmp_path, wrong):
    policy = MLP((4,)).init(OBS, ACTIONS, key=jax.random.key(0))
    algorithm = Neuroevolution(SequenceRecall(depth=2), MLP((4,)), population_size=10)
    run = recorded(tmp_path / "run", algorithm, policy, task=task(BOX) | wrong)
    for use in (run.policy, lambda: export(run, tmp_path / "p.safetensors")):
        with pytest.raises(RunError, match=r"config\.json is damaged: its task cannot be read"):
            use()
    assert not (tmp_path / "p.safetensors").exists()
