"""Credo's tasks for Gymnasium: its own checker passes, and episodes are those of a rollout."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import credo.environments.gymnasium as adapter
from credo import rollout, tree
from credo.environments.probes import Meet
from credo.environments.sequence_classification import SequenceClassification
from credo.environments.wrappers import Given
from credo.networks.mmu import MMU

TASKS = {
    "credo/SequenceClassification-v0": {"depth": 3, "min_gap": 1, "max_gap": 3},
    "credo/SequenceRecall-v0": {"depth": 2, "min_corridor": 1, "max_corridor": 3},
    "credo/SequenceCopy-v0": {"bits": 2, "max_length": 3},
    "credo/EndlessTMaze-v0": {"corridors": 2, "min_length": 1, "max_length": 2},
    "credo/DistractedCue-v0": {"min_distractors": 1, "max_distractors": 2},
    "credo/DoublePole-v0": {"max_steps": 5, "spread": 1.0},
}


@pytest.fixture(scope="module", params=TASKS)
def env(request):
    return gymnasium.make(request.param, **TASKS[request.param])


def play(env, seed, act=None):
    """Observations and rewards of one episode, and how it ended."""
    obs, info = env.reset(seed=seed)
    seen, rewards, ended = [obs], [], False
    act = act or (lambda obs: np.ones(env.action_space.shape, np.float32))
    while not ended:
        obs, reward, terminated, truncated, info = env.step(act(obs))
        ended = terminated or truncated
        seen.append(obs)
        rewards.append((reward, info["rewards"]))
    return np.array(seen), rewards, (terminated, truncated)


@pytest.mark.filterwarnings("default::UserWarning")
def test_gymnasiums_checker_finds_nothing_wrong(env):
    check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space.contains(env.reset(seed=0)[0])


def test_spaces_are_those_of_the_task(env):
    task = env.unwrapped.env
    assert env.observation_space.shape == (task.obs_size,)
    assert env.observation_space.dtype == np.float32
    low, high = task.obs_range
    assert np.all(env.observation_space.low == low)
    assert np.all(env.observation_space.high == high)
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (task.action_size,), np.float32)


def test_a_seed_is_an_episode(env):
    once, rewards, _ = play(env, seed=3)
    again, same_rewards, _ = play(env, seed=3)
    np.testing.assert_array_equal(once, again)
    assert [r for r, _ in rewards] == [r for r, _ in same_rewards]
    others = [play(env, seed)[0] for seed in range(8)]
    assert len({other.tobytes() for other in others}) > 2


def test_without_a_seed_the_next_episode_is_another(env):
    env.reset(seed=0)
    starts = {play(env, None)[0].tobytes() for _ in range(8)}
    assert len(starts) > 2


def test_an_episode_ends_where_its_sequence_does(env):
    seen, rewards, ended = play(env, seed=1)
    assert ended == (True, False)
    assert len(rewards) <= env.unwrapped.env.max_steps
    assert all(env.observation_space.contains(obs) for obs in seen)


@pytest.mark.parametrize("signal", ["fitness", "accuracy", "success"])
def test_the_reward_is_the_signal_asked_for(signal):
    name, fields = next(iter(TASKS.items()))
    env = gymnasium.make(name, signal=signal, **fields)
    _, rewards, _ = play(env, seed=2)
    assert [reward for reward, _ in rewards] == [float(every[signal]) for _, every in rewards]
    assert set(rewards[0][1]) == {"fitness", "accuracy", "success"}
    assert env.unwrapped.signal == signal


def test_the_first_signal_is_the_default(env):
    assert env.unwrapped.signal == env.unwrapped.env.signals[0]


def test_an_unknown_signal_is_refused():
    with pytest.raises(ValueError, match="no reward signal 'speed': there is fitness, accuracy"):
        adapter.GymnasiumEnvironment(SequenceClassification(depth=2), signal="speed")


def test_a_team_task_is_refused():
    with pytest.raises(ValueError, match="Meet is a team task: Gymnasium takes one agent"):
        adapter.GymnasiumEnvironment(Meet())


def test_a_step_before_the_first_reset_is_refused():
    env = adapter.GymnasiumEnvironment(SequenceClassification(depth=2))
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        env.step(np.float32([0.0]))


def test_gymnasium_imports_the_module_itself():
    env = gymnasium.make("credo.environments.gymnasium:credo/SequenceRecall-v0", depth=1)
    assert env.unwrapped.env.depth == 1  # pyright: ignore[reportAttributeAccessIssue]


def test_an_episode_earns_what_a_rollout_of_the_same_sequence_does():
    """A policy plays through Gymnasium, and the same sequence in `evaluate`."""
    task = SequenceClassification(depth=3, min_gap=1, max_gap=3)
    env = adapter.GymnasiumEnvironment(task)
    policy = MMU(hidden=3).init(1, 1, key=jax.random.key(1))
    step = jax.jit(lambda obs, carry: policy(obs, carry))
    for seed in range(3):
        carry = policy.start(key=jax.random.key(0))

        def act(obs):
            nonlocal carry
            action, carry = step(jnp.asarray(obs), carry)
            return np.asarray(action)

        seen, rewards, _ = play(env, seed, act)
        episode = int(np.random.Generator(np.random.PCG64(seed)).integers(2**31))
        reset_key = jax.random.split(jax.random.key(episode))[0]
        sequence = task.sample(key=reset_key)
        np.testing.assert_array_equal(seen[:-1], sequence.inputs[: len(rewards)])
        same = Given.alone(task, sequence)
        evaluation = rollout.evaluate(same, tree.stack(policy), 1, key=jax.random.key(0))
        for name, returns in evaluation.returns.items():
            total = sum(float(every[name]) for _, every in rewards)
            assert total == pytest.approx(float(returns[0, 0]), rel=1e-5, abs=1e-6)
        assert len(rewards) == int(evaluation.steps[0, 0])
