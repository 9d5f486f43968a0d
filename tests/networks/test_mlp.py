"""Feed-forward networks: LayerNorm, critics with branches, and fresh weights."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from credo.compilation import jit
from credo.learners.sac import SAC
from credo.learners.td3 import TD3
from credo.networks.mlp import MLP, Critic, ResidualCritic, draw_layers
from credo.types import Batch

OBS, ACT, N = 3, 2, 7
KEY = jax.random.key(0)


def shaken(network):
    """Every weight different from its fresh value, gains and shifts too."""
    leaves, structure = jax.tree.flatten(network)
    keys = jax.random.split(jax.random.key(5), len(leaves))
    moved = [x + 0.5 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(structure, moved)


def elu(x):
    return np.where(x > 0, x, np.expm1(x))


def by_hand(weights, x, φ, depth, normalization):
    """The output of one input, before its activation."""
    w = {name: np.asarray(value, np.float64) for name, value in weights.items()}

    def norm(layer, x):
        return w[f"g_{layer}"] * (x - x.mean()) / np.sqrt(x.var() + 1e-6) + w[f"s_{layer}"]

    for layer in range(depth):
        x = w[f"W_{layer}"] @ x + w[f"b_{layer}"]
        if normalization == "before":
            x = φ(norm(layer, x))
        elif normalization == "after":
            x = norm(layer, φ(x))
        else:
            x = φ(x)
    return w[f"W_{depth}"] @ x + w[f"b_{depth}"]


@pytest.fixture(scope="module")
def inputs():
    draw = np.random.default_rng(1).normal(size=(N, OBS + ACT)).astype(np.float32)
    return draw[:, :OBS], draw[:, OBS:]


@pytest.mark.parametrize("normalization", ["none", "before", "after"])
def test_actors_follow_the_equations(inputs, normalization):
    network = MLP(hidden=(4, 3), activation="elu", normalization=normalization)
    policy = shaken(network.init(OBS, ACT, key=KEY))
    batch = np.asarray(policy(jnp.asarray(inputs[0].T), ())[0])
    assert batch.shape == (ACT, N)
    for i, obs in enumerate(inputs[0]):
        expected = np.tanh(by_hand(policy.weights, obs, elu, 2, normalization))
        np.testing.assert_allclose(batch[:, i], expected, atol=1e-5)
        np.testing.assert_allclose(policy(jnp.asarray(obs), ())[0], expected, atol=1e-5)


@pytest.mark.parametrize("normalization", ["none", "before", "after"])
@pytest.mark.parametrize("branches", [(), (3, 2)])
def test_critics_follow_the_equations(inputs, branches, normalization):
    config = Critic(hidden=(4,), branches=branches, activation="elu", normalization=normalization)
    critic = shaken(config.init(OBS, ACT, key=KEY))
    obs, action = (jnp.asarray(x.T) for x in inputs)
    values = np.asarray(critic(obs, action))
    assert values.shape == (N,)
    w = critic.weights
    for i, (s, a) in enumerate(zip(*inputs, strict=True)):
        if branches:
            s = elu(np.asarray(w["W_S"]) @ s + np.asarray(w["b_S"]))
            a = elu(np.asarray(w["W_A"]) @ a + np.asarray(w["b_A"]))
        expected = by_hand(w, np.concatenate([s, a]), elu, 1, normalization)
        np.testing.assert_allclose(values[i], expected[0], atol=1e-5)
        alone = critic(obs[:, i], action[:, i])
        assert alone.shape == ()
        np.testing.assert_allclose(alone, expected[0], atol=1e-5)
    assert np.std(values) > 0.01


def test_a_critic_says_its_sizes():
    config = Critic(hidden=(300,), branches=(200, 100))
    critic = eqx.filter_eval_shape(config.init, OBS, ACT, key=KEY)
    assert {name: w.shape for name, w in critic.weights.items()} == {
        "W_S": (200, OBS),
        "b_S": (200,),
        "W_A": (100, ACT),
        "b_A": (100,),
        "W_0": (300, 300),
        "b_0": (300,),
        "W_1": (1, 300),
        "b_1": (1,),
    }
    assert critic.action_size == ACT
    joined = eqx.filter_eval_shape(Critic(hidden=(4,)).init, OBS, ACT, key=KEY)
    assert joined.weights["W_0"].shape == (4, OBS + ACT)


def test_uniform_weights_fill_the_interval_of_their_fan_in():
    weights = draw_layers((25, 400, 4), "uniform", "before", key=KEY)
    for name, bound in (("W_0", 0.2), ("b_0", 0.2), ("W_1", 0.05), ("b_1", 0.05)):
        w = np.asarray(weights[name])
        assert np.abs(w).max() <= bound
        if w.size > 100:
            assert np.abs(w).max() > 0.95 * bound
            assert w.std() == pytest.approx(bound / np.sqrt(3), rel=0.06)
            assert np.mean(np.abs(w) < bound / 2) == pytest.approx(0.5, abs=2 * w.size**-0.5)
    assert (weights["g_0"].tolist(), weights["s_0"].tolist()) == ([1.0] * 400, [0.0] * 400)
    assert "g_1" not in weights
    assert not {"g_0", "s_0"} & draw_layers((2, 3, 1), "uniform", key=KEY).keys()


@pytest.mark.parametrize("config", [MLP, Critic])
def test_the_output_layer_starts_at_its_scale(config):
    whole, small = (
        config(hidden=(3,), output_scale=scale).init(OBS, ACT, key=KEY).weights
        for scale in (1.0, 0.1)
    )
    for name in whole:
        factor = 0.1 if name.endswith("_1") else 1.0
        np.testing.assert_allclose(small[name], factor * whole[name], rtol=1e-6)


def test_normalized_layers_do_not_feel_the_size_of_their_inputs(inputs):
    """Without bias the first layer's LayerNorm takes a common factor out."""
    policy = MLP(hidden=(4,), normalization="before").init(OBS, ACT, key=KEY)
    policy.weights["b_0"] = jnp.zeros(4)
    obs = jnp.asarray(inputs[0].T)
    np.testing.assert_allclose(policy(obs, ())[0], policy(100.0 * obs, ())[0], atol=1e-4)


@pytest.mark.parametrize(
    ("build", "told"),
    [
        (lambda: MLP(normalization="batch"), "normalization is 'batch'.*after, before, none"),
        (lambda: Critic(branches=(3,)), r"branches are \(3,\).*two sizes"),
        (lambda: Critic(branches=(3, 0)), r"is 0: it must be at least 1"),
        (lambda: Critic(hidden=(4, 0)), r"hidden\[1\] is 0"),
        (lambda: Critic(activation="swish"), "activation is 'swish'"),
        (lambda: Critic(initializer="flat"), "initializer is 'flat'"),
    ],
)
def test_impossible_networks_are_refused(build, told):
    with pytest.raises(ValueError, match=told):
        build()


def test_a_residual_critic_follows_the_equations(inputs):
    config = ResidualCritic(width=5, blocks=2)
    critic = shaken(config.init(OBS, ACT, key=KEY))
    w = {name: np.asarray(value, np.float64) for name, value in critic.weights.items()}
    assert {name: x.shape for name, x in w.items() if name[0] == "W"} == {
        "W_0": (5, OBS + ACT),
        **{f"W_{i}": (5, 5) for i in range(1, 5)},
        "W_5": (1, 5),
    }

    def dense(i, x):
        x = w[f"W_{i}"] @ x + w[f"b_{i}"]
        return w[f"g_{i}"] * (x - x.mean()) / np.sqrt(x.var() + 1e-6) + w[f"s_{i}"]

    values = np.asarray(critic(*(jnp.asarray(x.T) for x in inputs)))
    for i, x in enumerate(np.concatenate(inputs, axis=1)):
        h = np.maximum(dense(0, x), 0)
        h = h + dense(2, np.maximum(dense(1, h), 0))
        h = h + dense(4, np.maximum(dense(3, h), 0))
        np.testing.assert_allclose(values[i], (w["W_5"] @ h + w["b_5"])[0], atol=1e-5)
    assert critic.action_size == ACT


def test_td3_and_sac_learn_with_a_residual_critic(inputs):
    obs, action = (x.astype(np.float32) for x in inputs)
    batch = Batch(obs, action, obs[:, 0], obs, obs[:, 1] > 9, obs[:, 1] > 9)
    for learner in (TD3(critic=ResidualCritic(width=8)), SAC(critic=ResidualCritic(width=8))):
        state = learner.init(MLP(hidden=(4,)), OBS, ACT, key=KEY)
        losses = []
        for i in range(30):
            state, metrics = jit(learner.update)(state, batch, key=jax.random.key(i))
            losses.append(float(metrics["critic_loss"]))
        assert losses[-1] < 0.9 * losses[0]
