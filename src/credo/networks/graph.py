"""Networks of any topology: what a genome of NEAT is expressed as.

Source: Stanley & Miikkulainen (2002), "Evolving neural networks through augmenting topologies".
All units are updated together: at one step each sees what the others were one step before. A signal
that passes through a hidden unit so takes one update more than one that does not.

Hidden units can be LSTM cells (Hochreiter & Schmidhuber 1997, with the forget gate of Gers et al.
2000), as in Rawal & Miikkulainen (2016), "Evolving deep LSTM-based memory networks using an
information maximization objective". Connections end at their block input or at one of their gates.
A gate without connections is open: a cell adds up its block input, keeps it, and shows it.
"""

from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from .. import require
from .base import ACTIVATIONS, AbstractNetwork, AbstractPolicy, matvec, to_action

SLOPE = 4.9  # of the sigmoid: nearly linear between -0.5 and 0.5


class Graph(AbstractNetwork):
    """Config of a network of any topology, recurrent or not."""

    hidden: int = eqx.field(static=True, default=20)  # most hidden units, at least 1
    cells: Literal["rnn", "lstm"] = eqx.field(static=True, default="rnn")
    """What hidden units are: rnn, plain units, or lstm, cells with gates."""
    activation: Literal["sigmoid", "tanh"] = eqx.field(static=True, default="sigmoid")
    """Activation of all units that are no LSTM cells; the sigmoid is 1 / (1 + exp(-4.9 x))."""
    recurrent: bool = eqx.field(static=True, default=True)
    """Whether connections may close loops. Without them the network has no memory beyond the time
    that signals take."""
    passes: int = eqx.field(static=True, default=1)
    """Updates of all units for each observation, at least 1. With p of them a path through p - 1
    hidden units is quick enough to decide the action on what it has just seen."""

    def __check_init__(self):
        require.literals(self)
        require.at_least("hidden", self.hidden, 1)
        require.at_least("passes", self.passes, 1)

    @property
    def ports(self) -> int:
        """Places where a connection can end in a hidden unit: block input, and of an LSTM cell its
        input, forget and output gate."""
        return 4 if self.cells == "lstm" else 1

    def sockets(self, action_size: int) -> int:
        """Number of places where a connection can end: one for each output, and the ports."""
        return action_size + self.ports * self.hidden

    def sources(self, obs_size: int, action_size: int) -> int:
        """Number of places where a connection can begin: inputs, bias, and all units."""
        return obs_size + 1 + action_size + self.hidden

    def init(self, obs_size: int, action_size: int, *, key: PRNGKeyArray) -> "GraphPolicy":
        """Inputs and bias on all outputs, with weights uniform in [-1, 1]; no hidden unit has a
        connection."""
        shape = (self.sockets(action_size), self.sources(obs_size, action_size))
        drawn = jax.random.uniform(key, (action_size, obs_size + 1), minval=-1.0, maxval=1.0)
        weights = jnp.zeros(shape).at[:action_size, : obs_size + 1].set(drawn)
        return GraphPolicy(weights, action_size, self)


class GraphPolicy(AbstractPolicy):
    """All connections as one matrix, 0 where there is none. Of its rows, where connections end, the
    outputs come first, then hidden units, of LSTM cells all block inputs, input gates, forget gates
    and output gates; of its columns, where they begin, the inputs, the bias, the outputs, then
    hidden units. The carry is the units' activations and the LSTM cells' contents."""

    features_first: ClassVar[bool] = True

    W: Float[Array, "sockets sources"]
    action_size: int = eqx.field(static=True)
    config: Graph = eqx.field(static=True)

    def start(self, *, key: PRNGKeyArray | None = None):
        c = self.config
        units = jnp.zeros_like(self.W[: self.action_size + c.hidden, 0])
        return units, (jnp.zeros_like(self.W[: c.hidden, 0]) if c.cells == "lstm" else None)

    def __call__(self, obs, carry):
        n, (units, cells) = obs.shape[0], carry
        seen = matvec(self.W[:, :n], obs) + self.W[:, n]
        for _ in range(self.config.passes):
            units, cells = self._updated(seen + matvec(self.W[:, n + 1 :], units), cells)
        return to_action(units[: self.action_size], self.config.activation), (units, cells)

    def _updated(self, total: Float[Array, "sockets *batch"], cells: Array | None):
        kind, y = self.config.activation, self.action_size
        φ, slope = ACTIVATIONS[kind], SLOPE if kind == "sigmoid" else 1.0
        if cells is None:
            return φ(slope * total), None
        σ, h = ACTIVATIONS["sigmoid"], self.config.hidden
        i = y + h  # where the gates begin: input, forget, output
        gates = jnp.where(jnp.any(self.W[i:] != 0.0, axis=1), σ(total[i:]), 1.0)
        cells = gates[h : 2 * h] * cells + gates[:h] * jnp.tanh(total[y:i])
        return jnp.concatenate([φ(slope * total[:y]), gates[2 * h :] * jnp.tanh(cells)]), cells
