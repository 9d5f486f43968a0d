"""Feed-forward networks: the actor of learners, and the memoryless baseline of evolution."""

import abc
import itertools
from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.stats import norm
from jaxtyping import Array, Float, PRNGKeyArray

from .. import require
from ..types import Batch
from .base import (
    ACTIVATIONS,
    INITIALIZERS,
    AbstractNetwork,
    AbstractPolicy,
    OutputActivation,
    acted,
    draw,
    features_first,
    matvec,
)
from .values import AbstractValues, Mean

EPSILON = 1e-6  # of LayerNorm, relative to the variance


class MLP(AbstractNetwork):
    """Config of a multi-layer perceptron."""

    hidden: tuple[int, ...] = eqx.field(static=True, default=(20,))
    """Units of each hidden layer, at least 1."""
    activation: str = eqx.field(static=True, default="tanh")  # activation of the hidden layers
    normalization: Literal["none", "before", "after"] = eqx.field(static=True, default="none")
    """LayerNorm of the hidden layers, before their activation or after it."""
    output_activation: OutputActivation = eqx.field(static=True, default="tanh")
    """Activation of the output layer."""
    output_scale: float = eqx.field(static=True, default=1.0)
    """Scale of the fresh output layer's weights, above 0."""
    initializer: str = eqx.field(static=True, default="normal")
    """Fresh weights: normal, fan_in, kaiming, or uniform: U(±fan_in^-1/2), what PyTorch does."""

    def __check_init__(self):
        _check(self)

    def init(self, obs_size: int, action_size: int, *, key: PRNGKeyArray) -> "MLPPolicy":
        sizes = (obs_size, *self.hidden, action_size)
        weights = draw_layers(sizes, self.initializer, self.normalization, key=key)
        return MLPPolicy(weights, self).scaled(self.output_scale)


class MLPPolicy(AbstractPolicy):
    """Weights by name: `W_l` and `b_l` of each layer l, `g_l` and `s_l` (gain and shift) of its
    LayerNorm. The carry is empty."""

    features_first: ClassVar[bool] = True

    weights: dict[str, Float[Array, "..."]]
    config: MLP = eqx.field(static=True)

    def start(self, *, key: PRNGKeyArray | None = None) -> tuple[()]:
        return ()

    def __call__(self, obs, carry):
        return self.action(self.output(self.features(obs))), carry

    def spoken(self, obs, carry):
        features = self.features(obs)
        return features, self.output(features), carry

    def features(self, obs: Float[Array, "obs *batch"]) -> Float[Array, "units *batch"]:
        """The last hidden layer."""
        c = self.config
        return hidden_layers(self.weights, obs, len(c.hidden), c.activation, c.normalization)

    def output(self, features: Float[Array, "units *batch"]) -> Float[Array, "act *batch"]:
        """The last layer, before its activation."""
        return linear(self.weights, len(self.config.hidden), features)

    def scaled(self, factor: Float[Array, ""] | float) -> "MLPPolicy":
        """With the output layer's weights times `factor`."""
        return MLPPolicy(scaled(self.weights, len(self.config.hidden), factor), self.config)

    def action(self, output: Float[Array, "act *batch"]) -> Float[Array, "act *batch"]:
        """The output, before its activation, as an action in [-1, 1]."""
        return acted(output, self.config.output_activation)


class AbstractCritic(eqx.Module):
    """Config of an action-value network Q(s, a).

    Of a team it values each agent's own observation and action, unless it is `joint`.
    """

    joint: ClassVar[bool] = False
    """Whether it sees the whole team; `init` then takes the number of agents behind the sizes."""

    @abc.abstractmethod
    def init(
        self, obs_size: int, action_size: int, *, key: PRNGKeyArray
    ) -> "AbstractCriticNetwork":
        """A network with fresh weights."""


class AbstractCriticNetwork(eqx.Module):
    """What `AbstractCritic.init` makes: weights, and how they value state and action."""

    action_size: eqx.AbstractVar[int]
    values: eqx.AbstractVar[AbstractValues]  # what its outputs say of the return

    def sees(self, batch: Batch, later: bool = False) -> Float[Array, "obs batch *agents"]:
        """What it sees of the rows of a batch, or of what follows them: what `atoms` takes."""
        return features_first(batch.next_obs if later else batch.obs)

    @abc.abstractmethod
    def atoms(
        self, obs: Float[Array, "obs *batch"], action: Float[Array, "act *batch"]
    ) -> Float[Array, "atoms *batch"]:
        """Its outputs, which stand for the return as `values` says."""

    def __call__(self, obs: Array, action: Array) -> Float[Array, "*batch"]:
        """Q(s, a), of the shapes above."""
        return self.values.mean(self.atoms(obs, action))

    def own(self, obs: Array, action: Array, done: Array) -> Float[Array, "*batch"]:
        """Q(s, a) where each agent does `action` while the rest of its team does what was `done`;
        of one agent Q(s, a). Shapes as above."""
        return self(obs, action)


class Critic(AbstractCritic):
    """A multi-layer perceptron."""

    hidden: tuple[int, ...] = eqx.field(static=True, default=(256, 256))
    """Units of each hidden layer, at least 1."""
    branches: tuple[int, ...] = eqx.field(static=True, default=())
    """Units of two layers of their own for state and action, whose outputs are joined; none: state
    and action go into the first hidden layer together."""
    activation: str = eqx.field(static=True, default="relu")  # activation of the hidden layers
    normalization: Literal["none", "before", "after"] = eqx.field(static=True, default="none")
    """LayerNorm: none, or before or after the activation."""
    output_scale: float = eqx.field(static=True, default=1.0)
    """Scale of the fresh output layer's weights, above 0."""
    initializer: str = eqx.field(static=True, default="uniform")  # fresh weights, as in MLP
    values: AbstractValues = Mean()  # what its outputs say of the return

    def __check_init__(self):
        _check(self)
        if len(self.branches) not in (0, 2):
            raise ValueError(f"branches are {self.branches}: give two sizes (state, action) or ()")

    def init(self, obs_size: int, action_size: int, *, key: PRNGKeyArray) -> "CriticNetwork":
        layers_key, *branch_keys = jax.random.split(key, 3)
        weights, inputs = {}, obs_size + action_size
        if self.branches:
            inputs = sum(self.branches)
            fans = (("S", obs_size), ("A", action_size))
            for (name, fan_in), units, k in zip(fans, self.branches, branch_keys, strict=True):
                layer = draw_layers((fan_in, units), self.initializer, key=k)
                weights |= {f"{kind}_{name}": layer[f"{kind}_0"] for kind in "Wb"}
        sizes = (inputs, *self.hidden, self.values.atoms)
        weights |= draw_layers(sizes, self.initializer, self.normalization, key=layers_key)
        weights = scaled(weights, len(self.hidden), self.output_scale)
        made = {"config": self, "values": self.values, "action_size": action_size}
        return CriticNetwork(weights=weights, **made)


class CriticNetwork(AbstractCriticNetwork):
    """Weights by name as in `MLPPolicy`; `W_S`, `b_S` and `W_A`, `b_A` of the branches."""

    weights: dict[str, Float[Array, "..."]]
    config: Critic = eqx.field(static=True)
    values: AbstractValues
    action_size: int = eqx.field(static=True)

    def atoms(self, obs, action):
        c = self.config
        if c.branches:
            obs, action = (linear(self.weights, *x) for x in (("S", obs), ("A", action)))
            obs, action = map(ACTIVATIONS[c.activation], (obs, action))
        x = jnp.concatenate([obs, action])
        x = hidden_layers(self.weights, x, len(c.hidden), c.activation, c.normalization)
        return linear(self.weights, len(c.hidden), x)


class ResidualCritic(AbstractCritic):
    """BroNet: residual blocks, LayerNorm behind every layer (Nauman et al. 2024, "Bigger,
    Regularized, Optimistic", section 3). Its other parts (optimism, quantiles, resets, decay of
    weights) are left out."""

    width: int = eqx.field(static=True, default=256)  # units of every layer, at least 1
    blocks: int = eqx.field(static=True, default=2)  # residual blocks, at least 0
    values: AbstractValues = Mean()  # what its outputs say of the return

    def __check_init__(self):
        require.at_least("width", self.width, 1)
        require.at_least("blocks", self.blocks, 0)

    def init(self, obs_size, action_size, *, key):
        sizes = (obs_size + action_size, *(self.width,) * (1 + 2 * self.blocks), self.values.atoms)
        weights = draw_layers(sizes, "uniform", "before", key=key)
        return ResidualCriticNetwork(weights=weights, values=self.values, action_size=action_size)


class ResidualCriticNetwork(AbstractCriticNetwork):
    """Weights by name as in `MLPPolicy`; of block b the layers 2b + 1 and 2b + 2."""

    weights: dict[str, Float[Array, "..."]]
    values: AbstractValues
    action_size: int = eqx.field(static=True)

    def atoms(self, obs, action):
        def layer(i, x):
            return normalize(self.weights, i, linear(self.weights, i, x))

        last = sum(name.startswith("W_") for name in self.weights) - 1
        x = jax.nn.relu(layer(0, jnp.concatenate([obs, action])))
        for i in range(1, last, 2):
            x = x + layer(i + 1, jax.nn.relu(layer(i, x)))
        return linear(self.weights, last, x)


def draw_layers(
    sizes: tuple[int, ...], initializer: str, normalization: str = "none", *, key: PRNGKeyArray
) -> dict[str, Float[Array, "..."]]:
    """Fresh layers between these sizes; LayerNorms start at gain 1 and shift 0."""
    shapes: dict[str, tuple[int, ...]] = {}
    for layer, (fan_in, fan_out) in enumerate(itertools.pairwise(sizes)):
        shapes |= {f"W_{layer}": (fan_out, fan_in), f"b_{layer}": (fan_out,)}
    weights = draw(shapes, "normal" if initializer == "uniform" else initializer, key=key)
    if initializer == "uniform":
        # The distribution function of a Gaussian draw is uniform.
        bound = {f"{kind}_{i}": n**-0.5 for i, n in enumerate(sizes[:-1]) for kind in "Wb"}
        weights = {k: bound[k] * (2.0 * norm.cdf(w) - 1.0) for k, w in weights.items()}
    if normalization != "none":
        for layer, units in enumerate(sizes[1:-1]):
            weights |= {f"g_{layer}": jnp.ones(units), f"s_{layer}": jnp.zeros(units)}
    return weights


def hidden_layers(weights, x: Array, depth: int, activation: str, normalization: str) -> Array:
    φ = ACTIVATIONS[activation]
    for layer in range(depth):
        x = linear(weights, layer, x)
        if normalization == "before":
            x = normalize(weights, layer, x)
        x = φ(x)
        if normalization == "after":
            x = normalize(weights, layer, x)
    return x


def scaled(weights, layer: int, factor: Float[Array, ""] | float) -> dict[str, Array]:
    """With one layer's weights times `factor`."""
    return weights | {name: factor * weights[name] for name in (f"W_{layer}", f"b_{layer}")}


def linear(weights, layer: int | str, x: Float[Array, "in *batch"]) -> Float[Array, "out *batch"]:
    return matvec(weights[f"W_{layer}"], x) + _like(weights[f"b_{layer}"], x)


def normalize(weights, layer: int, x: Float[Array, "n *batch"]) -> Float[Array, "n *batch"]:
    """LayerNorm (Ba et al. 2016) over the features."""
    x = x - jnp.mean(x, axis=0, keepdims=True)
    scale = jax.lax.rsqrt(jnp.mean(jnp.square(x), axis=0, keepdims=True) + EPSILON)
    return _like(weights[f"g_{layer}"], x) * (x * scale) + _like(weights[f"s_{layer}"], x)


def _like(b: Float[Array, "n *batch"], x: Array) -> Array:
    """A vector of one network for a batch of inputs."""
    return b.reshape(b.shape + (1,) * (x.ndim - b.ndim))


def _check(config: MLP | Critic) -> None:
    for i, units in enumerate((*config.hidden, *getattr(config, "branches", ()))):
        require.at_least(f"hidden[{i}]", units, 1)
    require.above("output_scale", config.output_scale, 0)
    require.choice("activation", config.activation, ACTIVATIONS)
    require.literals(config)
    require.choice("initializer", config.initializer, (*INITIALIZERS, "uniform"))
