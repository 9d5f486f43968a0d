"""Off-policy learning in NumPy, in float64: networks row by row, gradients by differences."""

import numpy as np


def relu(x):
    return np.maximum(x, 0.0)


def elu(x):
    return np.where(x > 0, x, np.expm1(x))


def numpy_of(network):
    """The weights of an `MLPPolicy` or a `CriticNetwork`."""
    return {name: np.asarray(w, np.float64) for name, w in network.weights.items()}


def layer(w, name, x):
    return x @ w[f"W_{name}"].T + w[f"b_{name}"]


def layer_norm(w, name, x):
    mean, variance = x.mean(axis=1, keepdims=True), x.var(axis=1, keepdims=True)
    return w[f"g_{name}"] * (x - mean) / np.sqrt(variance + 1e-6) + w[f"s_{name}"]


def mlp(w, x, φ, *, normalized=False):
    """One hidden layer, linear output."""
    x = layer(w, 0, x)
    return layer(w, 1, φ(layer_norm(w, 0, x) if normalized else x))


def actor(w, obs, φ=np.tanh, *, normalized=False):
    return np.tanh(mlp(w, obs, φ, normalized=normalized))


def critic(w, obs, action, φ=relu, *, normalized=False):
    if "W_S" in w:
        obs, action = φ(layer(w, "S", obs)), φ(layer(w, "A", action))
    return mlp(w, np.concatenate([obs, action], axis=1), φ, normalized=normalized)[:, 0]


def gradient(loss, weights):
    """Central differences of `loss(weights)`; weights are a list of dicts of arrays."""
    found = []
    for w in weights:
        found.append({})
        for name, values in w.items():
            slope = np.zeros_like(values)
            for i in np.ndindex(values.shape):
                kept, ends = values[i], []
                for step in (1e-6, -1e-6):
                    values[i] = kept + step
                    ends.append(loss(weights))
                values[i] = kept
                slope[i] = (ends[0] - ends[1]) / 2e-6
            found[-1][name] = slope
    return found


class Adam:
    """Kingma & Ba (2015), Algorithm 1, on a list of dicts of arrays."""

    def __init__(self, rate, max_norm=np.inf):
        self.rate, self.max_norm, self.t, self.m, self.v = rate, max_norm, 0, {}, {}

    def __call__(self, weights, gradients):
        norm = np.sqrt(sum(np.sum(g**2) for group in gradients for g in group.values()))
        self.t += 1
        for i, (w, g) in enumerate(zip(weights, gradients, strict=True)):
            for name in w:
                clipped = g[name] * min(1.0, self.max_norm / norm)
                at = (i, name)
                self.m[at] = 0.9 * self.m.get(at, 0.0) + 0.1 * clipped
                self.v[at] = 0.999 * self.v.get(at, 0.0) + 0.001 * clipped**2
                m, v = self.m[at] / (1 - 0.9**self.t), self.v[at] / (1 - 0.999**self.t)
                w[name] = w[name] - self.rate * m / (np.sqrt(v) + 1e-8)


def follow(targets, sources, tau):
    """θ' ← τθ + (1-τ)θ', in place."""
    for target, source in zip(targets, sources, strict=True):
        for name in target:
            target[name] = tau * source[name] + (1 - tau) * target[name]


def assert_weights(networks, weights, atol=2e-5):
    for network, w in zip(networks, weights, strict=True):
        assert network.weights.keys() == w.keys()
        for name, values in w.items():
            np.testing.assert_allclose(network.weights[name], values, atol=atol, err_msg=name)
