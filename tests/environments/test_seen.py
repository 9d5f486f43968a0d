"""What a policy sees: a part of an observation, or more than that; in JAX and outside."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.algorithms.off_policy import OffPolicy
from credo.environments.gymnasium import Gymnasium
from credo.environments.hidden import VELOCITIES, hidden
from credo.environments.host import Episodes
from credo.environments.last_step import with_last_step
from credo.environments.pettingzoo import PettingZoo
from credo.environments.probes import Copy, Meet
from credo.environments.wrappers import delayed
from credo.networks.recurrent import Recurrent

PENDULUM = Gymnasium("Pendulum-v1", in_process=True, max_episode_steps=20)
SPREAD = PettingZoo("mpe2.simple_spread_v3", in_process=True, max_episode_steps=5)


def host_episode(env, steps=4):
    """Observations, actions and rewards of one episode of two copies, with given actions."""
    told = Episodes(env, 2, True)
    obs, seen, done = told.begin(np.array([3, 4], np.uint32), np.ones(2, bool)), [], []
    for t in range(steps):
        action = np.sin(np.arange(2 * np.prod(env.sizes[1:])) + t).astype(np.float32)
        action = action.reshape(2, *env.sizes[2:], env.sizes[1])
        seen.append(obs)
        done.append(action)
        obs = told.advance(action)
    return np.stack(seen), np.stack(done)


@pytest.mark.parametrize("task", [PENDULUM, SPREAD], ids=["one", "team"])
def test_hidden_entries_are_those(task):
    whole, _ = host_episode(task)
    env = hidden(task, (1,))
    assert env.obs_size == task.obs_size - 1
    assert env.task_record()["obs_size"] == env.obs_size
    part, _ = host_episode(env)
    np.testing.assert_array_equal(part, np.delete(whole, 1, axis=-1))
    assert part.dtype == np.float32


@pytest.mark.parametrize("task", [PENDULUM, SPREAD], ids=["one", "team"])
def test_the_last_step_is_told_outside_jax(task):
    whole, done = host_episode(task)
    env = with_last_step(task)
    assert env.obs_size == task.obs_size + task.action_size + 1
    more, _ = host_episode(env)
    np.testing.assert_array_equal(more[..., : task.obs_size], whole)
    assert not more[0, ..., task.obs_size :].any()
    np.testing.assert_array_equal(more[1:, ..., task.obs_size : -1], done[:-1])
    assert np.abs(more[1:, ..., -1]).min() > 0  # of a team each is told what all earned
    told = Episodes(env, 2, True)
    told.begin(np.array([3, 4], np.uint32), np.ones(2, bool))
    np.testing.assert_array_equal(told.advance(done[0]), more[1])
    earned = told.returns()[task.signals[0]]
    np.testing.assert_allclose(more[1][..., -1].reshape(2, -1)[:, 0], earned.reshape(2, -1)[:, 0])


@pytest.mark.parametrize("task", [Copy(), Meet()], ids=["one", "team"])
def test_both_in_jax(task):
    state, first = task.reset(key=jax.random.key(0))
    action = jnp.full((*first.obs.shape[:-1], task.action_size), 0.25)
    _, now = task.step(state, action, key=jax.random.key(1))
    env = with_last_step(task)
    state, begun = env.reset(key=jax.random.key(0))
    np.testing.assert_array_equal(begun.obs[..., : task.obs_size], first.obs)
    assert not begun.obs[..., task.obs_size :].any()
    _, told = env.step(state, action, key=jax.random.key(1))
    earned = np.broadcast_to(now.rewards[task.signals[0]], first.obs.shape[:-1])[..., None]
    np.testing.assert_array_equal(told.obs, np.concatenate([now.obs, action, earned], axis=-1))
    if task.obs_size > 1:
        part = hidden(task, (0,))
        state, begun = part.reset(key=jax.random.key(0))
        np.testing.assert_array_equal(begun.obs, first.obs[..., 1:])
        _, told = part.step(state, action, key=jax.random.key(1))
        np.testing.assert_array_equal(told.obs, now.obs[..., 1:])


def test_views_are_put_on_top_of_each_other():
    env = with_last_step(delayed(hidden(PENDULUM, "velocities")))
    assert env.obs_size == 2 + 1 + 1
    assert env.unwrapped == PENDULUM
    alone = OffPolicy(env, Recurrent("gru", 4), start_frames=10**6, replay_capacity=100)
    state, metrics = alone.generation(alone.init(key=jax.random.key(0)), key=jax.random.key(1))
    obs = np.asarray(state.replay.data.obs)[: int(metrics["frames"])]
    assert not obs[:, -1].any()  # paid behind the last of them
    assert obs[1:, -2].all()


@pytest.mark.parametrize("short", VELOCITIES)
def test_what_is_known_as_a_velocity_is_one(short, tmp_path, monkeypatch):
    """Positions are told the same from the same state at another speed."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file where it is
    import gymnasium

    versions = {"Pendulum": "v1", "MountainCarContinuous": "v0"}
    env = gymnasium.make(f"{short}-{versions.get(short, 'v5')}")
    env.reset(seed=0)
    task = env.unwrapped

    def told(speed):
        if short in versions:
            task.state = np.array([1.0, speed])
            return task._get_obs() if short == "Pendulum" else task.state
        task.set_state(0.1 + task.init_qpos, np.full_like(task.init_qvel, speed))
        return task._get_obs()

    changed = np.flatnonzero(np.abs(told(1.0) - told(2.0)) > 1e-6)
    assert tuple(changed) == VELOCITIES[short]
    env.close()
