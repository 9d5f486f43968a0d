"""Fitness critics: what they learn, how CCEA and learners use them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.algorithms import criticism
from credo.algorithms.ccea import BREEDER, CCEA, drafted
from credo.algorithms.merl import MERL
from credo.environments.probes import Meet
from credo.environments.rover import Rover
from credo.learners.credit import Even
from credo.learners.fitness_critic import Criticised, FitnessCritic
from credo.learners.td3 import TD3, TEAM
from credo.networks.mlp import Critic
from credo.networks.team import Team
from credo.runs import loop
from credo.types import Batch

TINY = FitnessCritic(hidden=(16,), updates=40, batch_size=64, capacity=2_000)
ROVERS = Rover(rovers=3, pois=2, coupling=2, size=8.0, max_steps=6, rewards=("global",))
SMALL = {"population_size": 6, "teams": 1, "episodes": 2, "test_episodes": 2}
CROWD = replace(BREEDER, elite_fraction=0.2)


@pytest.mark.parametrize("sharing", ["everything", "nothing"])
def test_it_learns_what_places_are_worth(sharing):
    """Agent 1 is paid the opposite; one critic for both cannot know, unless it is told apart."""
    critic = replace(TINY, sharing=sharing, learning_rate=1e-2)
    state = critic.init(1, 1, 2, key=jax.random.key(0))
    place = jax.random.uniform(jax.random.key(1), (256, 2, 1))
    returns = (place > 0.5).astype(jnp.float32)[..., 0] * jnp.array([[1.0, -1.0]])
    learn = jax.jit(lambda s: critic.update(s, place, 0 * place, returns, None))
    for _ in range(200):
        state, _ = learn(state)
    said = critic.value(state, jnp.array([[[0.1], [0.1]], [[0.9], [0.9]]]), jnp.zeros((2, 2, 1)))
    if sharing == "nothing":
        np.testing.assert_allclose(said, [[0, 0], [1, -1]], atol=0.2)
    else:
        np.testing.assert_allclose(said, 0.0, atol=0.2)


def test_actions_are_seen_only_if_asked_for():
    obs, action = jnp.ones((1, 2, 1)), jnp.array([[[0.3], [0.9]]])
    blind = TINY.init(1, 1, 2, key=jax.random.key(0))
    said = TINY.value(blind, obs, action)
    assert float(said[0, 0]) == float(said[0, 1])
    seeing = replace(TINY, actions=True)
    said = seeing.value(seeing.init(1, 1, 2, key=jax.random.key(0)), obs, action)
    assert float(said[0, 0]) != float(said[0, 1])


class Known(FitnessCritic):
    """Says the first number of an observation."""

    def value(self, state, obs, action):
        return obs[..., 0]

    def update(self, state, obs, action, returns, active):
        return state, jnp.float32(0.0)


def test_fitness_is_the_most_that_was_said_of_any_step():
    ccea = CCEA(ROVERS, critic=Known(updates=1), breeder=CROWD, **SMALL)
    state = ccea.init(key=jax.random.key(0))
    teams = drafted(ccea, state.populations, ccea.drawn(key=jax.random.key(2)))
    played, _, after, fitness, _ = criticism.judged(ccea, teams, state, key=jax.random.key(1))
    assert fitness.shape == (6, 2, 3)
    kept = after.replay.data
    n = int(after.replay.size)
    assert n == int(played.steps.sum())
    ends = np.cumsum(np.asarray(played.steps).reshape(-1))
    starts = np.concatenate([[0], ends[:-1]])
    obs, label = np.asarray(kept.obs[:n, :, 0]), np.asarray(kept.rewards["return"][:n])
    flat = np.asarray(fitness).reshape(-1, 3)
    returns = np.asarray(played.returns["global"]).reshape(-1)
    for i, (a, b) in enumerate(zip(starts, ends, strict=True)):
        np.testing.assert_array_equal(flat[i], obs[a:b].max(axis=0))
        np.testing.assert_array_equal(label[a:b], returns[i])


def test_without_a_critic_nothing_changes():
    ccea = CCEA(Meet(), breeder=CROWD, **SMALL)
    state, metrics = ccea.generation(ccea.init(key=jax.random.key(0)), key=jax.random.key(1))
    assert state.criticism is None
    assert "critic_loss" not in metrics


def test_ccea_resumes_bit_for_bit(tmp_path):
    ccea = CCEA(ROVERS, critic=TINY, breeder=CROWD, **SMALL)
    straight = loop.train(ccea, seed=3, generations=4, path=tmp_path / "a", tensorboard=False)
    loop.train(ccea, seed=3, generations=2, path=tmp_path / "b", tensorboard=False)
    loop.resume(tmp_path / "b", generations=4)
    for name in ("metrics.csv", "champion.safetensors"):
        files = [(tmp_path / run / name).read_bytes() for run in "ab"]
        assert files[0] == files[1]
    assert (straight.metrics["critic_loss"] > 0).any()


def test_a_learner_is_paid_by_the_critic():
    """The reward in the batch is what the critic learns; the learner sees what the critic says."""
    inner = TD3(**(TEAM | {"critic": Critic(hidden=(8,)), "gamma": 0.0, "critic_lr": 0.01}))
    learner = Criticised(inner, Known(), gain=True)
    state = learner.init(Team(trunk=(4,)), 2, 1, 3, key=jax.random.key(0))
    obs = jax.random.normal(jax.random.key(1), (5, 3, 2))
    none, what = jnp.zeros((5, 3), bool), jnp.full((5, 3), 7.0)
    batch = Batch(obs, jnp.zeros((5, 3, 1)), what, obs + 2.0, none, none)
    update = jax.jit(learner.update)
    for _ in range(300):
        state, metrics = update(state, batch, key=jax.random.key(2))
    assert float(metrics["q"]) == pytest.approx(2.0, abs=0.1)  # what it rose by, not 7
    assert set(metrics) == set(learner.metrics)


def test_a_scale_that_follows_the_buffer_is_refused():
    with pytest.raises(ValueError, match="reward_scale is None"):
        Criticised(TD3(reward_scale=None))


def test_merl_on_a_critic_trains():
    inner = TD3(**(TEAM | {"critic": Critic(hidden=(8,)), "reward_scale": 6.0, "batch_size": 16}))
    small = {"population_size": 5, "episodes": 1, "workers": 2, "warmup_frames": 1}
    merl = MERL(
        ROVERS,
        Team(trunk=(8,)),
        (Criticised(inner, TINY),),
        redistribute=Even(),
        replay_capacity=500,
        test_episodes=2,
        **small,
    )
    state = merl.init(key=jax.random.key(0))
    for g in range(2):
        state, metrics = merl.generation(state, key=jax.random.key(g))
    assert np.isfinite(float(metrics["fitness_critic_loss_0"]))
    assert int(metrics["updates"]) > 0
