"""Convolutions: those of XLA, where they look, in the runner, and that they see."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo import rollout, tree
from credo.algorithms.neuroevolution import Neuroevolution
from credo.algorithms.off_policy import OffPolicy
from credo.algorithms.ppo import PPO
from credo.environments.base import AbstractEnvironment
from credo.environments.gymnasium import Gymnasium
from credo.environments.hidden import hidden
from credo.environments.last_step import with_last_step
from credo.environments.wrappers import NoisyObservations, delayed
from credo.learners.dqn import DQN
from credo.networks.choosing import choosing
from credo.networks.convolutional import Convolutional
from credo.networks.mlp import MLP
from credo.networks.recurrent import Recurrent
from credo.networks.team import Team
from credo.normalization import Moments
from credo.runner import VERSION, Runner
from credo.runs.export import parts_of
from credo.types import TimeStep

KEY = jax.random.key(0)
DEEP = Convolutional(
    MLP((5,)), (9, 8, 3), 2, 4.0, channels=(4, 6), kernels=(3, 2), strides=(2, 1), activation="elu"
)


class Look(AbstractEnvironment):
    """A dark square somewhere in the upper or the lower half of an image: say where. Pays 1."""

    signals = ("reward",)
    obs_size = 2 + 6 * 6
    action_size = 2
    choices = (2,)
    max_steps = 8
    image = (2, 6, 6, 1)
    obs_range = (0.0, 255.0)

    def _shown(self, *, key):
        row, column = jax.random.randint(key, (2,), 0, jnp.array([4, 5]))
        row = row + row // 2  # 0, 1 or 3, 4
        here = jnp.zeros((6, 6)).at[row, column].set(1).at[row, column + 1].set(1)
        obs = 255.0 - 255.0 * here.reshape(-1)
        return (row >= 3).astype(jnp.int32), jnp.append(jnp.zeros(2), obs)

    def reset(self, *, key):
        where, obs = self._shown(key=key)
        no = jnp.bool_(False)
        return (where, jnp.int32(0)), TimeStep(obs, {"reward": jnp.float32(0.0)}, no, no)

    def step(self, state, action, *, key):
        paid = (jnp.argmax(action) == state[0]).astype(jnp.float32)
        where, obs = self._shown(key=key)
        now = TimeStep(obs, {"reward": paid}, jnp.bool_(False), jnp.bool_(False))
        return (where, state[1] + 1), now.cut(state[1] + 1 >= self.max_steps)


def test_a_layer_is_the_convolution_of_xla():
    policy = DEEP.init(2 + 9 * 8 * 3 + 1, 2, key=KEY)
    obs = jax.random.normal(jax.random.key(1), (2 + 9 * 8 * 3 + 1,))
    x = obs[2:-1].reshape(1, 9, 8, 3) / 4.0
    for i, (kernel, stride) in enumerate(((3, 2), (2, 1))):
        w = policy.weights[f"W_{i}"].reshape(-1, kernel, kernel, x.shape[3])
        how = {"dimension_numbers": ("NHWC", "OHWI", "NHWC"), "padding": "VALID"}
        x = jax.lax.conv_general_dilated(x, w, (stride, stride), **how)
        x = jax.nn.elu(x + policy.weights[f"b_{i}"].reshape(1, 1, 1, -1))
    expected = jnp.concatenate([obs[:2], obs[-1:], x.reshape(-1)])
    np.testing.assert_allclose(policy.saw(obs), expected, rtol=1e-4, atol=1e-5)
    assert DEEP.shapes == [(9, 8, 3), (4, 3, 4), (3, 2, 6)]


@pytest.mark.parametrize("head", [MLP((4,)), Recurrent("gru", 3)])
def test_the_runner_sees_the_same(head):
    network = dataclasses.replace(DEEP, head=head)
    policy = network.init(219, 2, key=KEY)
    described, weights = parts_of(policy)
    sizes = {"obs_size": 219, "action_size": 2, "agents": None, "action": None}
    act = Runner({"version": VERSION, "network": described, **sizes}, weights)
    carry = policy.start(key=KEY)
    for key in jax.random.split(KEY, 5):
        obs = jax.random.normal(key, (219,))
        action, carry = policy(obs, carry)
        np.testing.assert_allclose(act(np.asarray(obs)), action, rtol=0, atol=1e-5)


def test_a_task_says_where_its_image_is():
    network = Convolutional().fitted(Look())
    assert (network.shape, network.start, network.scale) == ((6, 6, 1), 2, 255.0)
    pictures = Gymnasium("pictures:Pictures", in_process=True, max_episode_steps=5)
    assert pictures.image == (3 + 2, 4, 5, 3)
    assert Convolutional().fitted(pictures).scale == 255.0
    assert network.fitted(pictures) is network
    assert hidden(pictures, (0,)).image is None
    for env in (Gymnasium("CartPole-v1", in_process=True), hidden(pictures, (0,))):
        with pytest.raises(ValueError, match="shows no image, a Box of height, width and channels"):
            Convolutional().fitted(env)


def test_an_image_cannot_begin_within_a_mask():
    class Masked(Look):
        masked = True

    with pytest.raises(ValueError, match=r"start is 0, and the first . numbers"):
        Convolutional(shape=(6, 6, 1)).fitted(Masked())


def test_wrappers_change_nothing_of_an_image():
    for env in (with_last_step(Look()), NoisyObservations(Look(), 1.0), delayed(Look())):
        assert Convolutional().fitted(env) == Convolutional().fitted(Look())
    with pytest.raises(ValueError, match="normalize_observations changes every number of an image"):
        Moments.first(Look(), choosing(Look(), Convolutional().fitted(Look())))
    team = Team(trunk=(), head=Convolutional(MLP((4,)), (6, 6, 1)))
    assert not team.remembers
    assert team.init(36, 2, 3, key=KEY).agents == 3


WRONG = {
    "filters": ({"kernels": (7,)}, "kernels are .* a layer sees 6 × 6: give smaller ones"),
    "counts": ({"kernels": (2, 2)}, "give as many of each, one for every layer"),
    "outside": ({"start": 3}, "an image of .* from 3 on has 36 numbers, and an observation 38"),
    "nothing": ({"shape": None}, "shape is None: give height, width and channels"),
    "team": ({"head": Team()}, "head is Team, which acts for a team: give a network of one"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_it_cannot_see_is_named(name):
    fields, told = WRONG[name]
    with pytest.raises(ValueError, match=told):
        Convolutional(**{"shape": (6, 6, 1), "start": 2} | fields).init(38, 2, key=KEY)


NETWORK = Convolutional(MLP((16,), "relu", initializer="uniform"), channels=(4,)).fitted(Look())


def test_it_sees_by_gradient_and_by_evolution():
    """By chance 4 of 8."""
    fast = DQN(learning_rate=3e-3, tau=0.1, gamma=0.0, exploration=100, batch_size=64)
    settings = {"start_frames": 100, "test_every": 200, "test_episodes": 20}
    algorithms = {
        60: OffPolicy.dqn(Look(), NETWORK, learner=fast, replay_capacity=4000, **settings),
        40: PPO.ppo(Look(), NETWORK, horizon=256, copies=32, learning_rate=2e-3),
        25: Neuroevolution(Look(), NETWORK, population_size=60, episodes=8),
    }
    for generations, algorithm in algorithms.items():
        state = algorithm.init(key=KEY)
        step = eqx.filter_jit(lambda s, key, a=algorithm: a.generation(s, key=key))
        for key in jax.random.split(jax.random.key(1), generations):
            state, _ = step(state, key)
        champion = tree.single(state.champion)
        score = rollout.evaluate(Look(), champion, 50, key=KEY).returns["reward"].mean()
        assert score >= 6.0, type(algorithm).__name__
