"""Baselines and upper bound of the server fleet: what a net number of served requests is worth.

Random devices, and one fixed device per server, need no memory. The upper bound is an oracle that
knows the classes. Between them a scripted fleet finds the classes out and shares them: its return
is a lower bound on the best that discovering can reach, which is computed exactly for tiny
synchronous fleets.
"""

import dataclasses
import functools
import itertools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from ..compilation import jit
from ..environments.server_fleet import ACTS, AWAY, FleetState, ServerFleet, span
from ..networks.base import AbstractPolicy
from ..networks.dmmu import DMMUPolicy
from ..rollout import record
from ..types import Bound
from .scripts import Start, random_team, simulate, starts

EPISODES, SEED = 1000, 21_000  # that baselines and upper bound are the means of
HISTORIES = 2_000_000  # joint choices that the exact search may look at


class FixedFleet(AbstractPolicy):
    """Server i always serves device i, modulo their number."""

    servers: int = eqx.field(static=True)
    devices: int = eqx.field(static=True)

    def start(self, *, key: PRNGKeyArray) -> None:
        return None

    def __call__(self, obs: Float[Array, "servers obs"], carry: None):
        return _action(jnp.arange(self.servers) % self.devices, self.devices), carry


class DiscoveringFleet(AbstractPolicy):
    """A fleet that shares what each server was told, and decides for all in one place.

    It sees what the servers observe, no more. Who acts takes, in turn, the device of most worth: a
    genuine request is worth 1 and an empty device 0; a device not served so far is worth p - q
    for the request and p for each further one that the fleet will have time for beyond the genuine
    requests it knows of (p: its probability to be genuine by all that is known, q = 1 - p); a
    nefarious one -1. No two serve an unknown device at the same time unless it pays
    at once. That rule looks ahead by a rough count, so better fleets may exist.
    """

    chance: Float[Array, "devices+1 devices+1"]
    """Probability that an unknown device is genuine, by the genuine and nefarious ones found."""
    devices: int = eqx.field(static=True)
    requests: int = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    cycle: float = 2.0  # steps from one action to the next, on average

    def start(self, *, key: PRNGKeyArray) -> tuple[Float[Array, " devices"], Int[Array, ""]]:
        """What is known of every device (1 genuine, -1 nefarious, 0 nothing), and the step."""
        return jnp.zeros(self.devices), jnp.int32(0)

    def __call__(self, obs: Float[Array, "servers obs"], carry):
        known, step = carry
        pending, told, status = obs[:, : self.devices], obs[:, self.devices : -1], obs[:, -1]
        known = jnp.where(known == 0.0, jnp.sign(jnp.sum(told, axis=0)), known)
        # Only who acts sees the counts; if no server does they are not needed.
        left = jnp.max(pending, axis=0)
        acting, present = status == ACTS, status != AWAY
        rounds = jnp.ceil((self.max_steps - step).astype(jnp.float32) / self.cycle)
        acts = jnp.sum(present.astype(jnp.float32)) * rounds

        def choose(loop, acts_now):
            left, tried = loop
            device = jnp.argmax(self._worth(known, left, tried, acts))
            taken = (jnp.arange(self.devices) == device) & acts_now
            left = jnp.maximum(left - taken.astype(jnp.float32), 0.0)
            return (left, tried | taken), device

        start = (left, jnp.zeros(self.devices, bool))
        _, device = jax.lax.scan(choose, start, acting)
        return _action(device, self.devices), (known, step + 1)

    def _worth(self, known, left, tried, acts) -> Float[Array, " devices"]:
        """What it is worth to serve each device next."""
        found = [jnp.sum((known == sign).astype(jnp.int32)) for sign in (1.0, -1.0)]
        p = self.chance[found[0], found[1]]
        spare = jnp.maximum(acts - jnp.sum(jnp.where(known > 0.0, left, 0.0)), 0.0)
        further = jnp.minimum(spare, self.requests - 1.0)
        now = 2.0 * p - 1.0
        unknown = jnp.where(tried, now, now + p * further)
        return jnp.where(left > 0.0, jnp.where(known == 0.0, unknown, known), 0.0)


def fixed_fleet(env: ServerFleet) -> FixedFleet:
    """The baseline of choices that never change for the servers of `env`."""
    return FixedFleet(env.servers, env.devices)


def without_writing(team: DMMUPolicy) -> DMMUPolicy:
    """A fleet of MMUs whose write gates never open: its memory stays as it begins."""
    shut = [dataclasses.replace(x, b_w=jnp.full_like(x.b_w, -1e9)) for x in team.members]
    return team.with_members(tuple(shut))


def discovering_fleet(env: ServerFleet) -> DiscoveringFleet:
    """The scripted discoverer for `env`; ValueError unless it observes what the script reads."""
    if env.observation != "signed one-hot" or not env.status or env.scale != (1.0, 1.0):
        raise ValueError(
            f"observation is {env.observation!r}, status is {env.status} and scale is {env.scale}: "
            "the scripted fleet reads ServerFleet(observation='signed one-hot', status=True, "
            "scale=(1.0, 1.0)); the game is the same"
        )
    sizes = (env.devices, env.requests, env.max_steps)
    chance = jnp.asarray(_chance(env.devices, *span(env.nefarious)), jnp.float32)
    return DiscoveringFleet(chance, *sizes, cycle=1.0 + sum(span(env.busy)) / 2)


@jit
def play_fleet(
    env: ServerFleet, starts: Start, fleet: AbstractPolicy, *, key: PRNGKeyArray
) -> Float[Array, " episodes"]:
    """Net requests served by a policy `(obs, carry) -> (action, carry)` from each start."""

    def one(start, key):
        start_key, key = jax.random.split(key)
        carry = fleet.start(key=start_key)
        return simulate(env, start, lambda _, obs, carry: fleet(obs, carry), carry, key)

    return jax.vmap(one)(starts, jax.random.split(key, starts[0].step.shape[0]))


@jit
def play_oracle(env: ServerFleet, starts: Start, *, key: PRNGKeyArray) -> Float[Array, " episodes"]:
    """Net requests served from each start by a fleet that knows the classes and never collides.

    No fleet exceeds it on average: how often servers act does not depend on what they choose, each
    act pays 1 as long as a genuine request is pending, and 0 after that. (Where no device is
    genuine all keep to one device, and lose its requests at most, the least that can be lost.)
    """

    def act(state: FleetState, obs, carry):
        acting = env.present(state.step) & (state.busy == 0)
        return _action(_assign(state.genuine, state.pending, acting), env.devices), carry

    keys = jax.random.split(key, starts[0].step.shape[0])
    return jax.vmap(lambda start, key: simulate(env, start, act, (), key))(starts, keys)


def played(
    env: ServerFleet, episodes: int = EPISODES, *, oracle: bool = False
) -> dict[str, Float[np.ndarray, " episodes"]]:
    """Net requests served in each of the same episodes by `random` servers, by `fixed` ones, by the
    `discovering` fleet (a lower bound on what can be reached without knowing the classes); or by
    the `oracle` alone."""
    env = dataclasses.replace(env, observation="signed one-hot", status=True, scale=(1.0, 1.0))
    start_key, play_key = jax.random.split(jax.random.key(SEED))
    begun = starts(env, episodes, key=start_key)
    if oracle:
        return {"oracle": np.asarray(play_oracle(env, begun, key=play_key))}
    fleets = {"random": random_team, "fixed": fixed_fleet, "discovering": discovering_fleet}
    return {
        name: np.asarray(play_fleet(env, begun, fleet(env), key=play_key))
        for name, fleet in fleets.items()
    }


def baselines(env: ServerFleet) -> dict[str, float]:
    """Mean net requests of the fleets of `played`."""
    return {name: _mean(net) for name, net in played(env).items()}


def upper_bound(env: ServerFleet) -> Bound:
    """Mean net requests of the oracle."""
    return Bound(_mean(played(env, oracle=True)["oracle"]), "upper bound")


def _mean(net: Float[np.ndarray, " episodes"]) -> float:
    return float(np.mean(net, dtype=np.float64))


def best_discovery(env: ServerFleet) -> float:
    """The most net requests, on average, that any fleet can serve without knowing the classes.

    By search over all joint choices of a fleet that shares everything at once, which no fleet can
    surpass: 14/3 for the case study, of which the scripted fleet serves 4.3.

    ValueError unless all servers act at the same steps (one number of busy steps, no schedule), or
    if there are too many choices.
    """
    low, high = span(env.busy)
    if low != high or env.schedule is not None:
        raise ValueError(
            f"busy is {env.busy} and schedule is {env.schedule}: the exact search needs one number "
            "of busy steps and schedule=None; play the scripted discovering_fleet instead"
        )
    if env.classes is not None:
        raise ValueError("the classes are the same in every episode: give classes=None")
    rounds = -(-env.max_steps // (1 + low))
    joint = math.comb(env.devices + env.servers - 1, env.servers)
    if joint**rounds > HISTORIES:
        raise ValueError(
            f"{joint} joint choices in {rounds} rounds are {float(joint**rounds):.1e} histories: "
            f"the exact search looks at {HISTORIES:.0e}; play the scripted discovering_fleet"
        )
    return _search(env, rounds)


class FleetTrace(eqx.Module):
    """An episode of a fleet with one memory, step by step."""

    net: Float[Array, " steps"]
    acting: Bool[Array, "steps servers"]
    device: Int[Array, "steps servers"]  # that was chosen, by who acted
    writes: Float[Array, "steps servers cells"]  # what each server added to the memory
    memory: Float[Array, "steps cells"]  # at the end of the step

    @property
    def signature(self) -> Int[Array, " cells"]:
        """The cells in ascending order of what they hold in the end (Table 4.1)."""
        return jnp.argsort(self.memory[-1], stable=True)


def trace_fleet(
    env: ServerFleet, policy: DMMUPolicy, genuine: Bool[Array, " devices"], *, key: PRNGKeyArray
) -> FleetTrace:
    """One episode with these classes."""
    env = dataclasses.replace(env, classes=tuple(np.asarray(genuine).tolist()))
    played = record(env, policy, key=key, padded=True)  # no episode ends early
    before = (played.observations[:-1], jax.tree.map(lambda x: x[:-1], played.carries))
    return FleetTrace(
        played.rewards["net"],
        jnp.asarray(played.active),
        jnp.argmax(played.actions, axis=2),
        _writes(policy, *before),
        played.carries.memory[1:],
    )


@jit
def _writes(policy: DMMUPolicy, obs: Float[Array, "steps servers obs"], carries: PyTree):
    """What each server added to the memory in each step."""
    return jax.vmap(policy.access)(obs, carries)[2]


# Playing


def _action(device: Int[Array, " servers"], devices: int) -> Float[Array, "servers devices"]:
    """The action that chooses these devices."""
    return 2.0 * jax.nn.one_hot(device, devices) - 1.0


def _assign(
    genuine: Bool[Array, " devices"], pending: Int[Array, " devices"], acting: Bool[Array, " n"]
) -> Int[Array, " n"]:
    """A genuine request for each server that acts, as long as there is one; then a device that is
    empty; and if none is, all the same one."""

    def choose(left, acts):
        sought = genuine & (left > 0)
        empty = left <= 0
        device = jnp.where(jnp.any(sought), jnp.argmax(sought), jnp.argmax(empty))
        # Where no device is genuine, one that is taken must not look empty to the next.
        taken = (jnp.arange(left.size) == device) & acts & genuine
        return left - taken.astype(jnp.int32), device

    return jax.lax.scan(choose, pending, acting)[1]


# Knowing


def _chance(devices: int, least: int, most: int) -> Float[np.ndarray, "devices+1 devices+1"]:
    """Probability that one of the unknown devices is genuine when so many genuine (row) and
    nefarious (column) ones were found; 0 where that cannot be or none is unknown."""
    table = np.zeros((devices + 1, devices + 1))
    for genuine, nefarious in itertools.product(range(devices + 1), repeat=2):
        unknown = devices - genuine - nefarious
        if unknown <= 0:
            continue
        totals = range(max(least, nefarious), min(most, devices - genuine) + 1)
        # All sets of one size are equally likely, so each is as likely as they are few.
        weight = [math.comb(unknown, n - nefarious) / math.comb(devices, n) for n in totals]
        good = [w * (devices - genuine - n) for w, n in zip(weight, totals, strict=True)]
        table[genuine, nefarious] = sum(good) / (sum(weight) * unknown) if weight else 0.0
    return table


def _search(env: ServerFleet, rounds: int) -> float:
    """Value of the best joint choice, over what is known and pending, from the last round back."""
    chance = _chance(env.devices, *span(env.nefarious))
    choices = [*itertools.combinations_with_replacement(range(env.devices), env.servers)]

    @functools.cache
    def value(known: tuple[int, ...], pending: tuple[int, ...], left: int) -> float:
        return max(expected(known, pending, choice, left) for choice in choices) if left else 0.0

    def expected(known, pending, choice, left) -> float:
        """The average over the classes of the devices that are served for the first time."""
        claims = {d: min(choice.count(d), pending[d]) for d in set(choice)}
        new = [d for d in claims if known[d] == 0 and claims[d] > 0]
        after = tuple(n - claims.get(d, 0) for d, n in enumerate(pending))
        total = 0.0
        for classes in itertools.product((1, -1), repeat=len(new)):
            told, likely = list(known), 1.0
            for device, sign in zip(new, classes, strict=True):
                p = chance[told.count(1), told.count(-1)]
                likely *= p if sign > 0 else 1.0 - p
                told[device] = sign
            if likely > 0.0:
                earned = sum(told[d] * n for d, n in claims.items())
                total += likely * (earned + value(tuple(told), after, left - 1))
        return total

    return float(value((0,) * env.devices, (env.requests,) * env.devices, rounds))


def changes(env: ServerFleet, team: PyTree) -> dict[str, tuple[ServerFleet, PyTree]]:
    """What may happen to a fleet, by name: the task, and who plays it. Three in ten servers of a
    DMMU, or of a population of them, leave, or clones of its first half join, in mid-episode or
    before it."""
    n, end = env.servers, env.max_steps
    leave, join, half = max(1, 3 * n // 10), n // 2, end // 2
    left = n - leave
    stays, leaves, joins = ((0, end),), ((0, half),), ((half, end),)
    smaller, larger = team.without(range(left, n)), team.with_clones(range(join))
    fewer = dataclasses.replace(env, servers=left)
    more = dataclasses.replace(env, servers=n + join)
    leaving = dataclasses.replace(env, schedule=stays * left + leaves * leave)
    joining = dataclasses.replace(more, schedule=stays * n + joins * join)
    return {
        f"{n} servers": (env, team),
        f"{leave} of {n} leave at step {half}": (leaving, team),
        f"{left} of {n} from the start": (fewer, smaller),
        f"clones of {join} join at step {half}": (joining, larger),
        f"clones of {join} from the start": (more, larger),
    }
