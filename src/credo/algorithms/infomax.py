"""Info-max: at first, networks are evolved for what their memory knows of the input, and for no
reward; then for the task.

Source: Rawal & Miikkulainen (2016), "Evolving deep LSTM-based memory networks using an information
maximization objective"; for MMUs the future work of Khadka (2019), section 3.3.1. The features of a
network are what its memory cells hold as an episode ends. They are functions of the input, so that
the information of a feature about the input is its own entropy. Independent features are asked
for: of each counts what no earlier one says already.

Departures, and what the abstract alone does not settle:

- Entropies are those of histograms over some episodes, each cell's between its lowest and its
  highest value. What two cells share is their mutual information by the same histograms.
- Of a cell counts its entropy less the most that it shares with one earlier cell; information that
  only several together have in common is not seen.
- Modules are not evolved one by one and frozen: the whole network is evolved in both phases, and
  the population of the first goes on in the second.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from .. import require
from ..compilation import jit, when
from ..environments.base import AbstractSequenceTask
from ..networks.base import AbstractNetwork
from ..networks.graph import GraphPolicy
from ..rollout import remembered

ROUNDING = 1e-6  # of a cell's largest value: what differs by less is the same


class InfoMax(eqx.Module):
    """Fitness in bits for the first generations of a run: what memory cells know of the input."""

    generations: int = 500  # so many of the run, at least 1
    episodes: int = eqx.field(static=True, default=100)  # per network and generation, at least 2
    bins: int = eqx.field(static=True, default=4)  # values of a cell told apart, at least 2

    def __check_init__(self):
        require.at_least("generations", self.generations, 1)
        for name in ("episodes", "bins"):
            require.at_least(name, getattr(self, name), 2)

    def check(self, env: Any, network: AbstractNetwork, normalized: bool) -> None:
        """Raise `ValueError` if a network's memory cannot be read on this task."""
        if not isinstance(env, AbstractSequenceTask):
            raise ValueError(
                f"infomax is for labelled sequences, whose inputs no action changes, and "
                f"{type(env).__name__} has none: train without it"
            )
        if normalized:
            raise ValueError(
                "infomax sees observations as they are, and normalize_observations is True: give "
                "one of the two"
            )
        policy = eqx.filter_eval_shape(network.init, *env.sizes, key=jax.random.key(0))
        cells = eqx.filter_eval_shape(lambda p: features(p, p.start(key=None)), policy)
        if not policy.features_first or cells is None:
            raise ValueError(
                f"infomax needs a network whose memory cells are known, and "
                f"{type(network).__name__} has none that are: take mmu, lstm, gru or rnn, or neat"
            )

    def after(self, generation: Int[Array, ""] | None, then: Array, before: Array) -> Array:
        """`then` where a generation is behind the first ones, else `before`."""
        assert generation is not None
        return jnp.where(generation < self.generations, before, then)

    def __call__(
        self,
        env: Any,
        networks: PyTree,
        generation: Int[Array, ""] | None,
        fitness: Float[Array, " pop"],
        *,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, " pop"], Int[Array, ""]]:
        """In the first generations the information of each network, then its `fitness`; and the
        frames that were played for it. `env`: a sequence task, as `check` demands."""
        assert generation is not None

        def known() -> tuple[Float[Array, " pop"], Int[Array, ""]]:
            return information(self, env, networks, key=key)

        skipped = (fitness, jnp.int32(0))
        return when(generation < self.generations, known, lambda: skipped)


@jit
def information(
    infomax: InfoMax, env: AbstractSequenceTask, networks: PyTree, *, key: PRNGKeyArray
) -> tuple[Float[Array, " pop"], Int[Array, ""]]:
    """Bits that each network's memory has of the sequences, the same ones for all; and the frames
    of all networks together."""
    carries, lengths = remembered(env, networks, infomax.episodes, key=key)
    kept = features(networks, carries)
    bits = jax.vmap(lambda x: stored(x.T, infomax.bins), in_axes=2)(kept)
    return bits, jnp.sum(lengths) * len(bits)


def features(policy: Any, carry: PyTree) -> Any:
    """The memory cells in a carry, `[cells, ...]`: what LSTM cells or an MMU keep, or the units of
    a network that has neither. None: none are known in it."""
    if isinstance(policy, GraphPolicy):
        units, cells = carry
        return units[policy.action_size :] if cells is None else cells
    if isinstance(carry, tuple):
        memory = carry[1] if len(carry) == 2 else None
        return memory if hasattr(memory, "ndim") else None
    return carry if hasattr(carry, "ndim") else None


def stored(values: Float[Array, "samples cells"], bins: int) -> Float[Array, ""]:
    """The sum over cells of their entropy, each less the most that it shares with an earlier one,
    in bits. A cell that is not finite everywhere counts as constant, and so does one that differs
    by rounding alone."""
    values = jnp.where(jnp.all(jnp.isfinite(values), axis=0, keepdims=True), values, 0.0)
    largest = jnp.max(jnp.abs(values), axis=0, keepdims=True)
    shrunk = jnp.where(largest > 1e19, 1e-19, 1.0)  # so that widths, and one over them, are finite
    values, largest = shrunk * values, shrunk * largest
    low, high = (f(values, axis=0, keepdims=True) for f in (jnp.min, jnp.max))
    differs = high - low > ROUNDING * largest
    values, width = jnp.where(differs, values, low), jnp.where(differs, high - low, 1.0)
    place = jnp.clip(((values - low) / width * bins).astype(jnp.int32), 0, bins - 1)
    hot = jax.nn.one_hot(place, bins)  # [samples, cells, bins]
    n = values.shape[0]
    alone = entropy(jnp.mean(hot, axis=0))
    pairs = jnp.einsum("nib,njc->ijbc", hot, hot) / n
    both = entropy(pairs.reshape(*pairs.shape[:2], -1))
    shared = alone[:, None] + alone[None] - both
    earlier = jnp.tril(jnp.ones_like(shared), -1)
    return jnp.sum(alone - jnp.max(shared * earlier, axis=1, initial=0.0))


def entropy(shares: Float[Array, "*batch bins"]) -> Float[Array, "*batch"]:
    """In bits."""
    logs = jnp.log2(jnp.where(shares > 0.0, shares, 1.0))
    return -jnp.sum(shares * logs, axis=-1)
