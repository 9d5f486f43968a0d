"""Evolution strategies of evosax as a breeder: OpenAI-ES, PGPE, CMA-ES, SNES and their kin.

Source: Lange (2022), "evosax: JAX-based evolution strategies" (arXiv:2212.04180); needs evosax 0.3
or later, `pip install 'credo[strategies]'`. A strategy is asked for a population and told its
fitness, from which it moves the distribution that it draws from. evosax minimises, and is told the
negative. Of its strategies those are here that see ranks alone, so that neither the scale of a
fitness nor a NaN changes what they do, and that find the least of a sum of squares at 6, 40 and 200
weights alike, which LM_MA_ES, Rm_ES and xNES of 0.3.2 do not.

Departures: the first mean is a newly drawn policy, not zero. A run's champion is the fittest member
of a generation, not the mean. Actors of learners are refused: a strategy takes every member for a
draw of its own, and one that lies far away would blow up its variance (Hansen 2011, "Injecting
external solutions into CMA-ES"); mirrored pairs would not be pairs any more.
"""

import contextlib
import dataclasses
import functools
import importlib
import importlib.util
import warnings
from collections.abc import Iterator
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, PyTree

from .. import require, tree
from .breeder import AbstractBreeder
from .descent import Descent
from .selection import rankable, ranking

Method = Literal[
    "CMA_ES",
    "CR_FM_NES",
    "MA_ES",
    "Open_ES",
    "PGPE",
    "SNES",
    "Sep_CMA_ES",
    "SimpleES",
]
MIRRORED = ("CR_FM_NES", "Open_ES", "PGPE")  # draw pairs, one on each side of the mean
SQUARE = ("CMA_ES", "MA_ES")  # remember a matrix of weights times weights
MOST = 20_000  # weights of these; a matrix then has 1.6 GB


def _pairs(settings: Any) -> tuple[tuple[str, Any], ...]:
    return tuple(sorted(dict(settings).items()))


class Strategy(AbstractBreeder):
    """Draw the next population from the distribution of a strategy of evosax. Its memory is the
    state of that strategy, of which evosax's own `tell` and `ask` make the next one."""

    method: Method = eqx.field(static=True, default="CMA_ES")
    """The strategy, by evosax's name. CMA_ES and MA_ES take the square of the number of weights in
    memory and its cube in time; the others are linear in it."""
    std: float = eqx.field(static=True, default=0.3)
    """Standard deviation of every weight in the first population, above 0. That of Open_ES
    stays."""
    learning_rate: float | None = eqx.field(static=True, default=None)
    """Step size of Open_ES (Adam) and of PGPE (ClipUp, Toklu et al. 2020, of which no step is
    longer than twice that), above 0. None: of Open_ES std / 2, of PGPE a thirtieth of the first
    sample's radius, std·√weights; the latter is a choice of ours."""
    settings: tuple[tuple[str, Any], ...] = eqx.field(static=True, converter=_pairs, default=())
    """Parameters of the strategy by evosax's names, such as std_lr=0.05 of PGPE; others stay."""

    def __check_init__(self):
        require.literals(self)
        for name in ("std", "learning_rate"):
            require.above(name, getattr(self, name), 0)
        if self.learning_rate is not None and self.method not in ("Open_ES", "PGPE"):
            raise ValueError(f"{self.method} has no learning_rate: leave it out")

    def check(self, population, network, least=1, learners=0):
        require.at_least("population_size", population, 4)
        if population % 2 and self.method in MIRRORED:
            raise ValueError(f"population_size is {population}: {self.method} draws pairs")
        if learners:
            raise ValueError(
                f"{self.method} draws every member itself and cannot take in actors of learners: "
                "give CEM() (--breeder cem), which can, or learners=() (--learners none)"
            )

    def elites(self, population):
        """None: every member is drawn anew."""
        return 0

    def first(self, population, *, key):
        """The mean is the first member of those that were drawn."""
        (rows, rest), _, unpack = tree.packed(population)
        start_key, ask_key = jax.random.split(key)
        es, params = self._made(rows)
        with _theirs():
            state = es.init(start_key, rows[0], params).replace(best_solution=rows[0])
            drawn, state = es.ask(ask_key, state, params)
        return unpack((drawn, rest)), _plain(state)

    def next(self, memory, population, fitness, draw, *, key):
        """Where no member has a fitness, or the distribution has shrunk to a point, so that evosax
        divides by nothing, the next are drawn as these were."""
        (rows, rest), _, unpack = tree.packed(population)
        tell_key, ask_key = jax.random.split(key)
        es, params = self._made(rows)
        with _theirs():
            told, _ = es.tell(tell_key, rows, -rankable(fitness), memory, params)
            sound = _finite(told) & ~jnp.all(jnp.isnan(fitness))
            state = tree.where(sound, _plain(told), memory)
            drawn, state = es.ask(ask_key, state, params)
        descent = _descent(rows, parent := jnp.full(len(rows), ranking(fitness)[0]))
        return unpack((drawn, tree.take(rest, parent))), descent, _plain(state)

    def warm(self, memory, population, policy):
        """The same sample around the policy."""
        (rows, rest), _, unpack = tree.packed(population)
        (row, _), _, _ = tree.packed(tree.single(policy))
        return unpack((rows + (row - memory.mean[None]), rest)), memory.replace(mean=row[0])

    def _made(self, rows: Float[Array, "pop weights"]) -> tuple[Any, Any]:
        """evosax's strategy for such a population, and its parameters."""
        size, weights = rows.shape
        if weights > MOST and self.method in SQUARE:
            raise ValueError(
                f"{self.method} of {weights:,} weights has a matrix of {weights:,} rows: give "
                f"Sep_CMA_ES or SNES, or a network of {MOST:,} at most"
            )
        return _made(self, size, weights)


@functools.cache
def _made(strategy: Strategy, size: int, weights: int) -> tuple[Any, Any]:
    """The same for so many members and weights. Made once, since evosax compiles for each object;
    and of numbers, not as part of the program that is traced meanwhile."""
    cls = getattr(require_evosax(), strategy.method)
    with _theirs(), jax.ensure_compile_time_eval():
        es = cls(size, np.zeros(weights, np.float32), **_options(strategy, weights))
        params = es.default_params
        known = [field.name for field in dataclasses.fields(params)]
        for name, _ in strategy.settings:
            require.choice("setting", name, known)
        start = {"std_init": jnp.float32(strategy.std)} if "std_init" in known else {}
        return es, params.replace(**start | dict(strategy.settings))


def _options(strategy: Strategy, weights: int) -> dict[str, Any]:
    """What the strategy is made with: its optimizer, and a deviation that stays."""
    std, rate = strategy.std, strategy.learning_rate
    if strategy.method == "Open_ES":
        schedule = optax.constant_schedule(std)
        return {"optimizer": optax.adam(rate or std / 2), "std_schedule": schedule}
    if strategy.method == "PGPE":
        clipup = importlib.import_module("evosax.core.optimizer").clipup
        rate = rate or std * weights**0.5 / 30
        return {"optimizer": clipup(learning_rate=rate, max_velocity=2 * rate)}
    return {}


def require_evosax() -> Any:
    """Its algorithms. Raises `ModuleNotFoundError` that says how to get them."""
    if importlib.util.find_spec("evosax") is None:
        raise ModuleNotFoundError(
            "evolution strategies need evosax: `pip install 'credo[strategies]'`"
        )
    return importlib.import_module("evosax.algorithms")


@contextlib.contextmanager
def _theirs() -> Iterator[None]:
    """Others' code relies on dtypes and ranks that JAX may be told to refuse, starts from NaN, and
    calls what optax will rename."""
    standard, allow = jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow")
    with standard, allow, jax.debug_nans(False), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield


def _plain(state: PyTree) -> PyTree:
    """Without weak types, which evosax's first state has in other places than its later ones: the
    second generation would be another program."""
    return jax.tree.map(lambda x: jnp.asarray(x, x.dtype), state)


def _finite(state: PyTree) -> Bool[Array, ""]:
    """Whether all of it is. The best fitness so far, which nothing here reads, may be infinite."""
    leaves = jax.tree.leaves(state.replace(best_fitness=jnp.float32(0.0)))
    return jnp.stack([jnp.all(jnp.isfinite(x)) for x in leaves]).all()


def _descent(rows: Array, parent: Array) -> Descent:
    """Of a sample. No learner has a part in it, so it does not matter how much each member has."""
    parts = jnp.full((len(rows), len(rows)), 1.0 / len(rows))
    unchanged = Descent.unchanged(parent, False, 0)
    return eqx.tree_at(lambda d: d.parts, unchanged, parts, is_leaf=lambda x: x is None)
