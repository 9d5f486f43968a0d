"""The contract of policies, and the arithmetic they share.

A network is two objects: a config such as `MMU(hidden=5)`, compared by value, and the policy its
`init` makes, which holds the weights: the genome.

Recurrent cells are written *features first*: weights `[out, in, *batch]`, activations
`[features, *batch]`. With no batch that is one network; with the population packed on the last
axis it is the whole population in one contiguous loop, three times faster on a CPU than batched
matrix products.
"""

import abc
import itertools
import math
from typing import Any, ClassVar, Literal, Self

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

ACTIVATIONS = {
    "sigmoid": jax.nn.sigmoid,
    "tanh": jnp.tanh,
    "identity": lambda x: x,
    "relu": jax.nn.relu,
    "elu": jax.nn.elu,
}
OutputActivation = Literal["sigmoid", "tanh"]  # what turns an output into an action in [-1, 1]
INITIALIZERS = {
    "normal": lambda fan_in: 1.0,  # the author's for sequences
    "fan_in": lambda fan_in: fan_in**-0.5,  # the author's for teams
    "kaiming": lambda fan_in: (2.0 / fan_in) ** 0.5,  # He et al. 2015, for gradient
}


class AbstractPolicy(eqx.Module):
    """What acts. Its memory, private or shared, is the carry. A team is one policy.

    The array leaves are the genome, one per matrix of the published equations: operators of
    `credo.evolution` act per leaf.
    """

    features_first: ClassVar[bool] = False
    """Whether weights and activations may carry further axes behind their own."""
    together: ClassVar[bool] = False
    """Whether agents of a team share more than weights, so that what one does depends on the
    others' observations: they can only learn from the frames of one moment."""

    @abc.abstractmethod
    def start(self, *, key: PRNGKeyArray) -> PyTree:
        """The carry before the first step of an episode."""

    @abc.abstractmethod
    def __call__(
        self, obs: Float[Array, "obs *batch"], carry: PyTree
    ) -> tuple[Float[Array, "act *batch"], PyTree]:
        """An action in [-1, 1] and the next carry."""

    def arranged(self) -> "AbstractPolicy":
        """The same policy, laid out for many steps: rollouts in JAX ask for it once."""
        return self

    def remembered(self, carry: PyTree) -> Float[Array, "*agents memory"] | None:
        """What a carry holds, as a vector that a replay buffer keeps; None if that is nothing. Of a
        team each agent's, with what all of them share in each."""
        numbers = jax.tree.leaves(eqx.filter(carry, eqx.is_inexact_array))
        return jnp.concatenate([x.reshape(-1) for x in numbers]) if numbers else None

    def first(self) -> Float[Array, "*agents memory"] | None:
        """What it remembers at the start of an episode."""
        return self.remembered(self.start(key=jax.random.key(0)))

    def recalled(self, memory: Float[Array, "*agents memory"], *, key: PRNGKeyArray) -> PyTree:
        """The carry that holds a vector of `remembered`; `key` is for what it draws."""
        numbers, rest = eqx.partition(self.start(key=key), eqx.is_inexact_array)
        return eqx.combine(jax.flatten_util.ravel_pytree(numbers)[1](memory), rest)

    def spoken(self, obs: Float[Array, " obs"], carry: PyTree) -> tuple[Array, Array, PyTree]:
        """`__call__` in its parts: what the output layer is given, what it says before its
        activation, and the next carry. SAC needs it: its spread is a second output layer."""
        raise NotImplementedError(f"{type(self).__name__} does not tell its output layer apart")


class AbstractNetwork(eqx.Module):
    """The config of a policy."""

    team: ClassVar[bool] = False
    """Whether its policies act for all agents; `init` then takes their number behind the sizes."""

    @property
    def least(self) -> tuple[int, ...]:
        """Sizes that it can be made for, to look at its form: of an observation and an action, and
        of a team the number of agents."""
        return (2, 1, *(2,) * self.team)

    @property
    def remembers(self) -> bool:
        """Whether its policies have memory."""
        first = jax.eval_shape(lambda: self.init(*self.least, key=jax.random.key(0)).first())
        return first is not None

    @property
    def speaks(self) -> bool:
        """Whether its policies tell what they say before their output activation (`spoken`)."""
        obs_size, _, *team = self.least

        def parts():
            policy = self.init(*self.least, key=jax.random.key(0))
            return policy.spoken(jnp.zeros((*team, obs_size)), policy.start(key=jax.random.key(0)))

        try:
            jax.eval_shape(parts)
        except NotImplementedError:
            return False
        return True

    def fitted(self, env: Any) -> Self:
        """With what only a task knows, where it is not given: where its image is, which of its
        agents are alike. It opens a task outside JAX."""
        return self

    @abc.abstractmethod
    def init(self, obs_size: int, action_size: int, *, key: PRNGKeyArray) -> AbstractPolicy:
        """A policy with fresh weights."""


def matvec(w: Float[Array, "out in *batch"], x: Float[Array, "in *batch"]) -> Array:
    """`W x`, features first."""
    if w.ndim == 2:
        return jnp.tensordot(w, x, 1)
    # Written out term by term XLA makes one loop over the contiguous batch; as a sum over an
    # axis it makes a strided reduction, five to ten times slower.
    product = w[:, 0] * x[0][None]
    for j in range(1, w.shape[1]):
        product = product + w[:, j] * x[j][None]
    return product


def draw(
    shapes: dict[str, tuple[int, ...]], initializer: str, *, key: PRNGKeyArray
) -> dict[str, Float[Array, "..."]]:
    """Gaussian weights by name. A vector (bias, start memory) has fan-in 1 except for `kaiming`,
    where it starts at 0."""

    def scale(shape: tuple[int, ...]) -> float:
        if len(shape) == 2:
            return INITIALIZERS[initializer](shape[1])
        return 0.0 if initializer == "kaiming" else INITIALIZERS[initializer](1)

    # One draw cut into leaves: a draw per leaf would compile the generator once per leaf.
    sizes = [math.prod(shape) for shape in shapes.values()]
    noise = jax.random.normal(key, (sum(sizes),))
    cuts = itertools.accumulate(sizes, initial=0)
    return {
        name: scale(shape) * noise[start : start + size].reshape(shape)
        for (name, shape), start, size in zip(shapes.items(), cuts, sizes, strict=False)
    }


def features_first(x: Float[Array, "batch *agents size"]) -> Float[Array, "size batch *agents"]:
    """Observations or actions as critics take them."""
    return jnp.moveaxis(x, -1, 0)


def acted(u: Float[Array, "act *batch"], activation: str) -> Float[Array, "act *batch"]:
    """What an output layer says before its `activation`, as an action in [-1, 1]."""
    return 2.0 * jax.nn.sigmoid(u) - 1.0 if activation == "sigmoid" else ACTIVATIONS[activation](u)


def to_action(output: Float[Array, "act *batch"], activation: str) -> Float[Array, "act *batch"]:
    """An output in [0, 1] (sigmoid) or [-1, 1] (others) as an action in [-1, 1]."""
    return 2.0 * output - 1.0 if activation == "sigmoid" else output
