"""Convolutional networks: a trunk that looks at an image, and a network that acts on what it saw.

Observations are flat in Credo, so the config says where in one the image lies; what stands beside
it goes to the head as it is. The trunk is LeCun et al. (1989), "Backpropagation Applied to
Handwritten Zip Code Recognition", without pooling; the default is the network of MinAtar (Young &
Tian 2019), 16 filters of 3×3 and a layer of 128 units.

A layer is one product of its weights with the patches of its input: so a population of networks is
one batched product, where XLA's convolutions with weights of their own are loops on a CPU.
"""

import math
from dataclasses import replace
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .. import require
from .base import ACTIVATIONS, INITIALIZERS, AbstractNetwork, AbstractPolicy
from .mlp import MLP, draw_layers

Shape = tuple[int, int, int]


class Convolutional(AbstractNetwork):
    """Config of a trunk of convolutions below another network."""

    head: AbstractNetwork = MLP(hidden=(128,), activation="relu", initializer="uniform")
    """What acts on the flattened output of the last convolution, and on what stands beside the
    image."""
    shape: Shape | None = eqx.field(static=True, default=None)
    """Height, width and channels of the image; None: `fitted` finds out."""
    start: int = eqx.field(static=True, default=0)  # where the image begins in an observation, ≥ 0
    scale: float = eqx.field(static=True, default=1.0)
    """What the image's numbers are divided by, above 0: 255 of bytes."""
    channels: tuple[int, ...] = eqx.field(static=True, default=(16,))
    """Filters of each layer, at least 1."""
    kernels: tuple[int, ...] = eqx.field(static=True, default=(3,))
    """Height and width of a layer's filters, at least 1 and at most those of what it sees."""
    strides: tuple[int, ...] = eqx.field(static=True, default=(1,))
    """Steps from one patch of a layer to the next, at least 1."""
    activation: str = eqx.field(static=True, default="relu")  # activation of every convolution
    initializer: str = eqx.field(static=True, default="uniform")  # fresh weights, as in MLP

    def __check_init__(self):
        names = ("channels", "kernels", "strides")
        for name in names:
            for i, n in enumerate(getattr(self, name)):
                require.at_least(f"{name}[{i}]", n, 1)
        if len({len(getattr(self, name)) for name in names}) > 1 or not self.channels:
            given = ", ".join(f"{name} {getattr(self, name)}" for name in names)
            raise ValueError(f"{given}: give as many of each, one for every layer")
        require.at_least("start", self.start, 0)
        require.at_least("scale", self.scale, 1e-8)
        require.choice("activation", self.activation, ACTIVATIONS)
        require.choice("initializer", self.initializer, (*INITIALIZERS, "uniform"))
        if self.head.team:
            raise ValueError(
                f"head is {type(self.head).__name__}, which acts for a team: give a network of one"
            )

    def fitted(self, env: Any) -> Self:
        """With the image of a task, where it is not given. It opens a task outside JAX.

        **Raises:** `ValueError` if the task's observations have no image, or not there.
        """
        if self.shape is not None:
            if self.start < env.barrable:
                raise ValueError(
                    f"start is {self.start}, and the first {env.barrable} numbers of an "
                    "observation say which actions are allowed: give the place of the image behind "
                    "them"
                )
            return self
        if env.image is None:
            raise ValueError(
                f"{getattr(env, 'id', type(env).__name__)} shows no image, a Box of height, width "
                "and channels: give shape and start of one, or another network"
            )
        start, *shape = env.image
        task = env.unwrapped  # wrappers add numbers without bounds, none of which is in the image
        high = np.broadcast_to(np.asarray(task.obs_range[1]), task.obs_size)[task.image[0]]
        return replace(
            self, shape=tuple(shape), start=start, scale=255.0 if high == 255 else self.scale
        )

    @property
    def shapes(self) -> list[Shape]:
        """Of the image, and of what each layer says of it. Raises `ValueError` of filters that are
        larger than what they see."""
        if self.shape is None:
            raise ValueError("shape is None: give height, width and channels, or use fitted(task)")
        shapes = [self.shape]
        for n, kernel, stride in zip(self.channels, self.kernels, self.strides, strict=True):
            height, width = ((size - kernel) // stride + 1 for size in shapes[-1][:2])
            if min(height, width) < 1:
                raise ValueError(
                    f"kernels are {self.kernels} with strides {self.strides}, and a layer sees "
                    f"{shapes[-1][0]} × {shapes[-1][1]}: give smaller ones, or fewer layers"
                )
            shapes.append((height, width, n))
        return shapes

    @property
    def least(self) -> tuple[int, ...]:
        return (self.start + math.prod(self.shapes[0]), 1)

    def init(self, obs_size: int, action_size: int, *, key: PRNGKeyArray):
        head_key, *keys = jax.random.split(key, 1 + len(self.channels))
        shapes, weights = self.shapes, {}
        seen = math.prod(shapes[0])
        if self.start + seen > obs_size:
            raise ValueError(
                f"an image of {shapes[0]} from {self.start} on has {seen} numbers, and an "
                f"observation {obs_size}: give shape and start of the one that it has"
            )
        for i, (kernel, key) in enumerate(zip(self.kernels, keys, strict=True)):
            sizes = (kernel * kernel * shapes[i][2], shapes[i + 1][2])
            layer = draw_layers(sizes, self.initializer, key=key)
            weights |= {f"W_{i}": layer["W_0"], f"b_{i}": layer["b_0"]}
        left = obs_size - seen + math.prod(shapes[-1])
        return ConvolutionalPolicy(weights, self.head.init(left, action_size, key=head_key), self)


class ConvolutionalPolicy(AbstractPolicy):
    """Weights by name: `W_l` `[filters, height × width × channels of a patch]` and `b_l` of each
    layer l. Its memory is that of the head."""

    weights: dict[str, Float[Array, "..."]]
    head: AbstractPolicy
    config: Convolutional = eqx.field(static=True)

    def start(self, *, key: PRNGKeyArray) -> PyTree:
        return self.head.start(key=key)

    def remembered(self, carry):
        return self.head.remembered(carry)

    def recalled(self, memory, *, key):
        return self.head.recalled(memory, key=key)

    def __call__(self, obs: Float[Array, " obs"], carry: PyTree):
        return self.head(self.saw(obs), carry)

    def spoken(self, obs, carry):
        return self.head.spoken(self.saw(obs), carry)

    def saw(self, obs: Float[Array, " obs"]) -> Float[Array, " features"]:
        """What stands beside the image, and behind it what the last convolution says."""
        c, shapes = self.config, self.config.shapes
        end = c.start + math.prod(shapes[0])
        x = obs[c.start : end] / c.scale
        for i, shape in enumerate(shapes[:-1]):
            at = patches(shape, c.kernels[i], c.strides[i])
            y = jnp.tensordot(x[at], self.weights[f"W_{i}"], (1, 1)) + self.weights[f"b_{i}"][None]
            x = ACTIVATIONS[c.activation](y).reshape(-1)
        return jnp.concatenate([obs[: c.start], obs[end:], x])


def patches(shape: Shape, kernel: int, stride: int) -> np.ndarray:
    """Of a flat image `[height × width × channels]` the entries of each patch, row by row:
    `[patches, kernel × kernel × channels]`."""
    height, width, channels = shape
    at = np.arange(height * width * channels).reshape(shape)
    windows = np.lib.stride_tricks.sliding_window_view(at, (kernel, kernel), axis=(0, 1))
    windows = windows[::stride, ::stride].transpose(0, 1, 3, 4, 2)
    return np.ascontiguousarray(windows).reshape(-1, kernel * kernel * channels)
