"""Baselines and upper bound of the rover domain: what a share of observed POIs is worth.

Random actions, straight lines, and a greedy team that heads for the POI it sees closest, act by
the sensors alone. Two numbers know all positions: a scripted team whose share was really achieved,
and an upper bound that is proven. Between the two lies the best policy for that world.
"""

import dataclasses
import functools
import itertools
import math
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .. import require
from ..compilation import jit
from ..environments.rover import BRACKETS, CODED_SPEED, Rover, RoverState
from ..networks.base import AbstractPolicy
from ..types import Bound
from .scripts import Start, random_team, simulate, starts

WORLDS, SEED = 50, 21_000  # that baselines and upper bound are the means of
EXHAUSTIVE = 4  # POIs up to which every division among the groups is tried
KEPT = 16  # plans per world that are played in the environment
STATES = 100_000  # coverages of the POIs that the exact bound may tell apart
AROUND = 24  # meeting points per POI that a plan chooses from


class StraightLines(AbstractPolicy):
    """Every rover draws one heading and drives there."""

    agents: int = eqx.field(static=True)
    coded: bool = eqx.field(static=True, default=False)  # the motion is "as-coded"
    drive: float = 1.0  # share of the full speed, in [0, 1]

    def __check_init__(self):
        require.within("drive", self.drive, 0, 1)

    def start(self, *, key: PRNGKeyArray) -> Float[Array, " agents"]:
        """The turn in radians that is left to make."""
        return jax.random.uniform(key, (self.agents,), minval=-math.pi, maxval=math.pi)

    def __call__(self, obs: Float[Array, "agents obs"], carry: Float[Array, " agents"]):
        made = _possible(carry, self.coded)
        return _action(made, jnp.full(self.agents, self.drive), self.coded), carry - made


class GreedyTeam(AbstractPolicy):
    """Every rover heads for the POI that it sees closest, and straight on if it sees none.

    It turns to the middle of the bracket and halts at the POI. Needs the "relative" observation.
    """

    max_speed: float  # m per step
    coded: bool = eqx.field(static=True, default=False)  # the motion is "as-coded"

    def start(self, *, key: PRNGKeyArray) -> None:
        return None

    def __call__(self, obs: Float[Array, "agents obs"], carry: None):
        seen = obs[:, BRACKETS : 2 * BRACKETS]
        strength = jnp.max(seen, axis=1)
        bracket = jnp.argmax(seen, axis=1).astype(jnp.float32)
        turn = _wrapped((bracket + 0.5) * (2 * math.pi / BRACKETS))
        distance = 1.0 / jnp.maximum(strength, 1e-6) - 1.0
        turn = jnp.where(strength > 0, turn, 0.0)
        drive = jnp.minimum(1.0, distance / self.max_speed)
        return _action(_possible(turn, self.coded), drive, self.coded), carry


def straight_lines(env: Rover) -> StraightLines:
    """The baseline of straight lines for the rovers of `env`."""
    return StraightLines(env.agents, env.motion == "as-coded")


def greedy_team(env: Rover) -> GreedyTeam:
    """The greedy baseline for `env`; ValueError unless its observation is "relative"."""
    if env.observation != "relative":
        raise ValueError(
            f"observation is {env.observation!r}: the greedy team reads brackets around its own "
            "heading; give a Rover(observation='relative')"
        )
    return GreedyTeam(env.max_speed, env.motion == "as-coded")


@jit
def play_team(
    env: Rover, starts: Start, team: AbstractPolicy, *, key: PRNGKeyArray
) -> Float[Array, " worlds"]:
    """Global reward, in [0, 1], of a policy `(obs, carry) -> (action, carry)` from each start.
    `env` and its starts must have the reward "global"."""

    def one(start, key):
        carry = team.start(key=key)
        return simulate(env, start, lambda _, obs, carry: team(obs, carry), carry, key)

    return jax.vmap(one)(starts, jax.random.split(key, starts[0].step.shape[0]))


def scripted_team(env: Rover, starts: Start) -> Float[np.ndarray, " worlds"]:
    """Global reward, in [0, 1], that a team with full knowledge achieved from each start.

    It forms floor(rovers / coupling) groups, at most as many as POIs, and spare rovers join them.
    Up to 4 POIs every division among the groups in every order is rated by the way to go, and the
    best 16 are played in the environment; beyond, each POI in turn goes to the group that gets
    there first; where POIs differ in coupling, and 4 or fewer need a whole group, divisions of
    these are played too, with the others behind them. A group drives to the near side of its next
    POI and waits there for all its rovers.
    Groups never mix, so where time is short a better team may exist; the bound says how much.
    """
    state = starts[0]
    rovers, poi = (np.asarray(x, np.float64) for x in (state.position, state.poi))
    plans = [_plan(env, *world) for world in zip(rovers, poi, strict=True)]
    table = Plans(*(jnp.asarray(np.stack(parts)) for parts in zip(*plans, strict=True)))
    return np.asarray(_play_plans(env, starts, table)).max(axis=1)


def bound_from(env: Rover, state: RoverState) -> float:
    """A share of the global reward, in [0, 1], that no policy exceeds from this start.

    Proof. Who was within d_a of POI a and later of POI b has driven at least |ab| - 2·d_a between,
    and |sa| - d_a from its start s to the first: where the sum over a sequence of POIs exceeds
    `max_steps` times the highest speed, no rover visits them in that sequence, so each rover visits
    one of the sets for which some sequence remains. An observed POI was visited by as many rovers
    as it needs or more, so the observed ones are covered that often by one choice of such a set per
    rover, and the greatest value over all choices bounds the reward. Where there are too many
    POIs for that the sets are forgotten, and each POI counts that enough rovers reach alone.

    With `graded` each POI counts d_a / max(d_a, m): m is the mean over its closest rovers, as many
    as it needs, of how near each could come at all. The mean at any step is no smaller, and an
    observed POI has m <= d_a.
    """
    position, poi = (np.asarray(x, np.float64) for x in (state.position, state.poi))
    values = np.asarray(env.values, np.float64)
    d_a = float(env.activation_distance)
    range_ = _speed(env) * env.max_steps * (1 + 1e-5) + 1e-4  # beyond the rounding of float32
    way = _distances(position, poi)
    if env.graded:
        nearest = np.sort(np.maximum(way - range_, 0.0), axis=0).T
        nearest = np.array([x[:n].mean() for x, n in zip(nearest, env.needed, strict=True)])
        return min(1.0, float(values @ (d_a / np.maximum(d_a, nearest))))
    if math.prod(n + 1 for n in env.needed) > STATES:
        reached = (way - d_a <= range_).sum(axis=0) >= np.array(env.needed)
        return min(1.0, float(values @ reached))
    between = np.maximum(_distances(poi, poi) - 2 * d_a, 0.0)
    sets = [_visitable(np.maximum(row - d_a, 0.0), between, range_) for row in way]
    return min(1.0, _best_cover(sets, values, env.needed))


def baselines(env: Rover, worlds: int = WORLDS, *, draws: int = 10) -> dict[str, float]:
    """Mean global rewards, in [0, 1], from the same starts: random, straight, greedy (if `env` has
    the "relative" observation) and scripted.

    **Arguments:** `draws`: games per world that "random" and "straight" are the mean of.
    """
    env, begun, (random_key, straight_key, greedy_key) = _worlds(env, worlds)
    found = {}
    drawn = (("random", random_team, random_key), ("straight", straight_lines, straight_key))
    for name, team, team_key in drawn:
        keys = jax.random.split(team_key, draws)
        found[name] = np.mean([play_team(env, begun, team(env), key=key) for key in keys], axis=0)
    if env.observation == "relative":
        found["greedy"] = play_team(env, begun, greedy_team(env), key=greedy_key)
    found["scripted"] = scripted_team(env, begun)
    return {name: float(np.mean(np.asarray(x, np.float64))) for name, x in found.items()}


def upper_bound(env: Rover, worlds: int = WORLDS) -> Bound:
    """The mean of `bound_from` over the worlds of `baselines`."""
    env, (states, _), _ = _worlds(env, worlds)
    each = [bound_from(env, jax.tree.map(operator.itemgetter(i), states)) for i in range(worlds)]
    return Bound(float(np.mean(each)), "upper bound")


def _worlds(env: Rover, worlds: int) -> tuple[Rover, Start, list[PRNGKeyArray]]:
    """The task with the global reward alone, so many starts of it, and keys of what is played."""
    env = dataclasses.replace(env, rewards=("global",))
    start_key, *keys = jax.random.split(jax.random.key(SEED), 4)
    return env, starts(env, worlds, key=start_key), keys


# Acting


def _wrapped(angle: Float[Array, " agents"]) -> Float[Array, " agents"]:
    """The same direction within half a turn, rad."""
    return angle - 2 * math.pi * jnp.round(angle / (2 * math.pi))


def _possible(turn: Float[Array, " agents"], coded: bool) -> Float[Array, " agents"]:
    """How much of a turn one step can make, rad."""
    most = 0.5 * math.pi if coded else math.pi
    return jnp.clip(turn, -most, most)


def _action(turn: Float[Array, " agents"], drive: Float[Array, " agents"], coded: bool):
    """The action for a possible turn in rad and a share of the full speed."""
    if coded:
        return jnp.stack([2.0 * drive - 1.0, turn / (0.5 * math.pi)], axis=1)
    return jnp.stack([turn / math.pi, 2.0 * drive - 1.0], axis=1)


def _speed(env: Rover) -> float:
    return CODED_SPEED if env.motion == "as-coded" else float(env.max_speed)


# Planning


class Plans(eqx.Module):
    """Who goes where in one world; a row per plan."""

    route: Int[Array, "plans groups pois"]  # POIs in the order of the visits, -1 behind the last
    aim: Float[Array, "plans groups pois 2"]  # where the group meets for each of them, m
    group: Int[Array, "plans rovers"]


@jit
def _play_plans(env: Rover, starts: Start, plans: Plans) -> Float[Array, "worlds plans"]:
    def follow(state: RoverState, plan: Plans):
        open_ = (plan.route >= 0) & ~state.observed[plan.route]
        next_ = jnp.argmax(open_, axis=1)
        aim = plan.aim[jnp.arange(plan.route.shape[0]), next_]
        busy = jnp.any(open_, axis=1)[plan.group]
        way = aim[plan.group] - state.position
        turn = _wrapped(jnp.arctan2(way[:, 1], way[:, 0]) - state.heading)
        drive = jnp.minimum(1.0, jnp.sqrt(jnp.sum(way**2, axis=1)) / env.max_speed)
        coded = env.motion == "as-coded"
        turn = _possible(jnp.where(busy, turn, 0.0), coded)
        return _action(turn, jnp.where(busy, drive, 0.0), coded)

    def one(start, plan):
        def act(state, obs, carry):
            return follow(state, plan), carry

        return simulate(env, start, act, (), jax.random.key(0))  # a step draws nothing

    return jax.vmap(lambda start, plans: jax.vmap(lambda p: one(start, p))(plans))(starts, plans)


def _plan(env: Rover, rovers: Float[np.ndarray, "rovers 2"], poi: Float[np.ndarray, "pois 2"]):
    """The plans for one world that are worth playing: the fields of `Plans`."""
    groups = min(env.agents // env.coupling, env.pois)
    way = np.linalg.norm(poi - rovers.mean(axis=0), axis=1)
    between, chosen = _distances(poi, poi), np.empty((0, groups, env.pois), np.int32)
    if env.pois > EXHAUSTIVE:
        chosen = _nearest_next(groups, way, between)[None]
    whole = np.flatnonzero(np.array(env.needed) == env.coupling)  # groups
    if len(whole) <= EXHAUSTIVE:
        routes = _with_rest(_divisions(groups, len(whole)), whole, env.pois)
        best = _best(env, routes[..., : len(whole)], way, between)
        chosen = np.concatenate([chosen, routes[best]])[:KEPT]
    made = [_lay_out(env, route, rovers, poi) for route in chosen]
    aim, group = (np.stack(x) for x in zip(*made, strict=True))
    return chosen, aim.astype(np.float32), group


@functools.lru_cache(maxsize=32)
def _divisions(groups: int, pois: int) -> Int[np.ndarray, "plans groups pois"]:
    """Every division of the POIs among the groups in every order, -1 behind the last."""
    plans = []
    for order in itertools.permutations(range(pois)):
        for cuts in itertools.combinations_with_replacement(range(pois + 1), groups - 1):
            edges = (0, *cuts, pois)
            parts = [order[a:b] for a, b in itertools.pairwise(edges)]
            plans.append([(*part, *[-1] * (pois - len(part))) for part in parts])
    return np.array(plans, np.int32)


def _with_rest(routes: np.ndarray, whole: np.ndarray, pois: int) -> Int[np.ndarray, "plans g p"]:
    """Divisions of the POIs `whole`, by their numbers there, and behind them in turn the others."""
    rest = [p for p in range(pois) if p not in whole]
    plans, groups, _ = routes.shape
    routes = np.where(routes >= 0, whole[routes], -1)
    behind = np.full((groups, len(rest)), -1)
    for turn, poi in enumerate(rest):
        behind[turn % groups, turn // groups] = poi
    behind = np.broadcast_to(behind, (plans, *behind.shape))
    routes = np.concatenate([routes, behind], axis=2)
    order = np.argsort(routes < 0, axis=2, kind="stable")  # -1 behind the last
    return np.take_along_axis(routes, order, axis=2).astype(np.int32)


def _best(env: Rover, routes, way, between) -> Int[np.ndarray, " plans"]:
    """The plans that get to the most value in time and, among these, are done first."""
    d_a = float(env.activation_distance)
    there = routes >= 0
    leg = np.concatenate(
        [way[routes[..., :1]] - d_a, between[routes[..., :-1], routes[..., 1:]] - 2 * d_a], axis=-1
    )
    arrival = np.cumsum(np.where(there, np.maximum(leg, 0.0), 0.0), axis=-1)
    in_time = there & (arrival <= _speed(env) * env.max_steps)
    value = (np.asarray(env.values)[routes] * in_time).sum(axis=(1, 2)).round(5)
    done = arrival.max(axis=(1, 2))
    return np.lexsort((done, -value))[:KEPT]


def _nearest_next(groups: int, way, between) -> Int[np.ndarray, "groups pois"]:
    """One plan: the group that gets to an unassigned POI first takes it, until none is left."""
    pois = len(way)
    route, visited = np.full((groups, pois), -1, np.int32), np.zeros(groups, int)
    arrival = np.tile(way, (groups, 1))  # of each group at each POI, as its next one
    for _ in range(pois):
        group, poi = np.unravel_index(np.argmin(arrival), arrival.shape)
        route[group, visited[group]] = poi
        visited[group] += 1
        taken = np.isinf(arrival[group])
        arrival[group] = np.where(taken, np.inf, arrival[group, poi] + between[poi])
        arrival[:, poi] = np.inf
    return route


def _lay_out(env: Rover, route, rovers, poi):
    """Meeting points `[groups, pois, 2]` of a plan, and the group of each rover."""
    centre = rovers.mean(axis=0)
    first = np.where(route[:, :1] >= 0, poi[route[:, 0]], centre[None])
    group = _join(_distances(rovers, first), env.coupling)
    # Who cannot halt circles within 0.75 m of the point.
    d_a = float(env.activation_distance)
    radius = max(d_a - 0.75, 0.0) if env.motion == "as-coded" else 0.95 * d_a
    angle = np.arange(AROUND) * (2 * math.pi / AROUND)
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    aim = np.zeros((*route.shape, 2))
    for g, pois in enumerate(route):
        here = rovers[group == g].mean(axis=0)
        for k, p in enumerate(pois[pois >= 0]):
            choices = poi[p] + ring
            detour = np.linalg.norm(choices - here, axis=1)
            if k + 1 < len(pois) and pois[k + 1] >= 0:
                detour += np.linalg.norm(choices - poi[pois[k + 1]], axis=1)
            here = aim[g, k] = choices[np.argmin(detour)]
    return aim, group


def _join(way: Float[np.ndarray, "rovers groups"], members: int) -> Int[np.ndarray, " rovers"]:
    """The group of each rover: `members` each, by who gains most from it; the rest anywhere."""
    rovers, groups = way.shape
    group, left = np.full(rovers, -1, np.int32), np.full(groups, members)
    gain = way - way.mean(axis=1, keepdims=True)
    for rover, g in zip(*np.unravel_index(np.argsort(gain, axis=None), way.shape), strict=True):
        if group[rover] < 0 and left[g] > 0:
            group[rover], left[g] = g, left[g] - 1
    return np.where(group < 0, np.argmin(way, axis=1), group).astype(np.int32)


# Bounding


def _distances(
    a: Float[np.ndarray, "a 2"], b: Float[np.ndarray, "b 2"]
) -> Float[np.ndarray, "a b"]:
    return np.linalg.norm(a[:, None] - b[None], axis=2)


def _visitable(first: np.ndarray, between: np.ndarray, range_: float) -> list[int]:
    """The largest sets of POIs, as bits, that one rover has the range for.

    **Arguments:** `first` `[pois]` and `between` `[pois, pois]`: metres at least to a POI.
    """
    pois = len(first)
    shortest = np.full((2**pois, pois), np.inf)  # of the sequences of a set that end at a POI
    shortest[2 ** np.arange(pois), np.arange(pois)] = first
    for visited in range(1, 2**pois):
        for poi in range(pois):
            if not visited >> poi & 1:
                grown = visited | 1 << poi
                way = (shortest[visited] + between[:, poi]).min()
                shortest[grown, poi] = min(shortest[grown, poi], way)
    able = [visited for visited in range(2**pois) if shortest[visited].min() <= range_]
    return [a for a in able if not any(a != b and a & b == a for b in able)]


def _best_cover(sets: list[list[int]], values: np.ndarray, needed: tuple[int, ...]) -> float:
    """The greatest value of POIs that lie in as many sets as each needs, one set per rover."""
    pois = len(values)
    counts = np.zeros([n + 1 for n in needed], bool)
    counts[(0,) * pois] = True  # reachable numbers of visitors, more than needed as needed
    for choices in sets:
        reached = np.zeros_like(counts) if choices else counts
        for chosen in choices:
            grown = counts
            for poi in range(pois):
                if chosen >> poi & 1:
                    before = np.moveaxis(grown, poi, 0)
                    after = np.zeros_like(before)
                    after[1:] = before[:-1]
                    after[-1] |= before[-1]
                    grown = np.moveaxis(after, 0, poi)
            reached = reached | grown
        counts = reached
    return float(((np.argwhere(counts) >= np.array(needed)) @ values).max())
