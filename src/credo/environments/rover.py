"""The rover domain: a team must bring several rovers to the same place at the same time.

Source: Khadka (2019), chapter 7 and section 7.4. Rovers drive over a square field without walls and
observe points of interest (POIs). A POI is observed once at least `coupling` rovers are within
`activation_distance` of it at the end of one step (of `harvest_period` consecutive steps), and
vanishes then.

The dissertation leaves out the size of the field, the activation distance and the length of an
episode; the defaults are those of the author's published code ("as coded" below).

Departures from the dissertation:

- Whether an observed POI counts as the closest one the text leaves open; it says "the closest POI",
  so by default it does. Other local rewards are options, and what each of them teaches differs: see
  `local`.
- "Outside the centre" leaves the shape open: the centre is a square of a tenth of the field's area.

Departures of the code from the dissertation are options: its speed is 0.5 whatever the action and
its turn ±90° (`motion`), its sensors look in fixed directions of the world (`observation`), it
starts on integer cells (`start`), and its local reward is a closeness (`local`). Where it shows an
observed POI for one step more, here it vanishes in the step that observes it; where it counts steps
of harvesting in total, here they are consecutive.
"""

import math
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from .. import require
from ..types import TimeStep, Trace
from .base import AbstractEnvironment
from .viewer import Mark, Viewer

BRACKETS = 36  # of 10° each, a ring of sensors
CENTRE = 0.1  # share of the field's area in which rovers start
CLEARANCE = 2.0  # m, least distance of a rover and a POI at the start
CANDIDATES = 32  # places that are drawn per POI
CODED_SPEED = 0.5  # m per step, whatever the action
ATAN = (  # of t, t³, t⁵, ...
    1.0,
    -0.3333314528,
    0.1999355085,
    -0.1420889944,
    0.1065626393,
    -0.0752896400,
    0.0429096138,
    -0.0161657367,
    0.0028662257,
)
REWARDS = ("global", "local", "mixed", "difference", "dpp")

LEGEND = (
    Mark("arrow", "c0", "a rover, in its own colour, and its path so far"),
    Mark("ring", "muted", "activation distance of a POI, in as many arcs as rovers it needs"),
    Mark("ring", "ink", "an arc stands out for each rover inside"),
    Mark("rhombus", "ink", "POI that is not observed yet"),
    Mark("diamond", "bad", "observed POI, with the step in which it was"),
    Mark("line", "c0", "sensors, inner ring: other rovers"),
    Mark("line", "c1", "sensors, outer ring: POIs not observed yet"),
)

Point = tuple[float, float]


class RoverState(eqx.Module):
    """A world between two steps. The ledgers of rewards that are not paid are None.

    "Without i": had rover i never been there, all else equal.
    """

    position: Float[Array, "rovers 2"]  # m
    heading: Float[Array, " rovers"]  # rad, anticlockwise from +x
    speed: Float[Array, " rovers"]  # m in the last step
    poi: Float[Array, "pois 2"]  # m
    observed: Bool[Array, " pois"]
    held: Int[Array, " pois"] | None  # consecutive steps that enough rovers were there
    nearness: Float[Array, " pois"] | None  # the best so far, in [0, 1]
    observed_without: Bool[Array, "rovers pois"] | None
    held_without: Int[Array, "rovers pois"] | None
    nearness_without: Float[Array, "rovers pois"] | None
    company: Int[Array, "rovers pois"] | None
    """The most rovers that were ever within reach of a POI together with this one, itself
    included."""
    step: Int[Array, ""]


class Rover(AbstractEnvironment):
    """Rovers observe POIs that need `coupling` of them at once.

    **Actions** `[rovers, 2]` in [-1, 1]: a0 turns by a0·180°, anticlockwise; then the rover drives
    (a1+1)/2 · `max_speed` ahead. `motion="as-coded"`: a1 turns by a1·90°, the speed is 0.5, and a0
    does nothing.

    **Observation** `"relative"` `[rovers, 72]`. Index b = 0..35: the closest other rover whose
    direction lies in [10b°, 10b+10°), anticlockwise from the own heading; 36 + b: the closest
    unobserved POI there. The value is 1/(1+d) at a distance of d metres, in [0, 1]; 0: no target.
    A target at the very same place is in bracket 0.

    **Observation** `"as-coded"` `[rovers, 75]`. 0: index of the rover; 1 + b: rovers; 37 + b: POIs;
    73: speed of the last step; 74: heading in half turns, in `"as-coded"` motion without bound.
    The value is 1/d² (POIs: value/d²; d = 0 counts as 0.001) and -1 for none; bracket b holds
    directions [10b°, 10b+10°) *clockwise from +y of the world*, whatever the heading.

    **Signals**, those named in `rewards`:

    - `global`: share of the POIs' value that was observed, in [0, 1]; paid at the last step.
    - `local` `[rovers]`, each step, as the field `local` says.
    - `mixed` `[rovers]`: local + `mixed_weight` · global.
    - `difference` `[rovers]`: D, global minus what it would be without rover i on the same
      trajectories (Agogino & Tumer 2004); paid at the last step.
    - `dpp` `[rovers]`: D++ (Rahmattalabi et al. 2016): if as many copies of rover i at its own
      place as it has team mates would have gained more per copy than D, then that gain per copy for
      the smallest number m >= 1 of copies that has more of it than m - 1 (for m - 1 = 0: than D);
      else D. Paid at the last step. More copies than `coupling` - 1 gain nothing more.

    `terminated` once all POIs are observed, `truncated` at `max_steps`.
    """

    action_size: ClassVar[int] = 2

    rovers: int | None = eqx.field(static=True, default=None)
    """Agents, at least `coupling`; None: 2·coupling."""
    pois: int = eqx.field(static=True, default=4)  # points of interest (POIs), at least 1
    coupling: int = eqx.field(static=True, default=3)
    """Rovers that must be near a POI at once to observe it, 1 to `rovers`."""
    size: float = 20.0  # side of the field in metres, above 0
    activation_distance: float = 3.0  # metres from which a POI is observed, above 0
    max_steps: int = eqx.field(static=True, default=50)
    """Length of an episode in steps of 1 s, at least 1."""
    max_speed: float = 1.0  # metres per step, above 0
    harvest_period: int = eqx.field(static=True, default=1)
    """Consecutive steps that observing a POI takes, at least 1."""
    poi_values: tuple[float, ...] | None = None  # value of each POI, above 0; None: all 1
    poi_couplings: tuple[int, ...] | None = eqx.field(static=True, default=None)
    """Rovers that each POI needs, 1 to `coupling`; None: `coupling`, and decoys one."""
    poi_rings: tuple[tuple[float, float], ...] | None = None
    """For each POI the least and the greatest distance from the field's centre at which it lies, in
    metres, not within `activation_distance` of a rover; None: anywhere outside the centre."""
    decoys: int = eqx.field(static=True, default=0)
    """The first so many POIs are decoys, which one rover observes and which the local reward
    `decoys` tells from the others; 0 to `pois`."""
    mislead: float = 0.5
    """Share of the local reward `decoys` that points at decoys, in [0, 1]; 0: all of it points at
    the other POIs."""
    graded: bool = eqx.field(static=True, default=False)
    """An unobserved POI pays the share max over time of d_a / max(d_a, mean distance of the
    `coupling` closest rovers) of its value (d_a: `activation_distance`)."""
    local: Literal["distance", "unobserved", "closeness", "progress", "decoys"] = eqx.field(
        static=True, default="distance"
    )
    """distance: minus the metres to the closest POI, observed or not; a rover may stay there.
    unobserved: to the closest of those unobserved before the step; it falls after an observation,
    so that to hover outside the ring pays. closeness: min(1, d_a / distance) to that one, as coded;
    the same, and to end the episode costs. progress: metres by which the step came closer to that
    one; nothing is lost by observing it. decoys: `mislead` times the closeness to decoys alone, 0
    once all of them are observed, and 1 - `mislead` times the progress to the other POIs alone."""
    rewards: tuple[str, ...] = eqx.field(static=True, default=("global", "local"))
    """Rewards by name: global, local, mixed, difference, dpp; the first is what training
    maximises."""
    mixed_weight: float = 10.0
    """Weight of the global reward in `mixed`, which is local + weight · global."""
    observation: Literal["relative", "as-coded"] = eqx.field(static=True, default="relative")
    """Sensors: `relative` to the heading, or `as-coded` by the author."""
    motion: Literal["as-written", "as-coded"] = eqx.field(static=True, default="as-written")
    """Actions: turn and speed (`as-written`), or a turn at fixed speed."""
    start: Literal["continuous", "as-coded"] = eqx.field(static=True, default="continuous")
    """`"continuous"`: rovers uniform in the central square, POIs uniform outside it and 2 m or more
    from every rover, headings uniform. `"as-coded"`: integer cells, POIs left, right, and above or
    below in turn. Headings are 0 if start or motion is `"as-coded"`."""
    placed: tuple[tuple[Point, ...], tuple[Point, ...]] | None = None
    """Start positions (of the rovers, of the POIs) in metres, the same in every episode."""

    def __check_init__(self):
        for name in ("pois", "coupling", "max_steps", "harvest_period"):
            require.at_least(name, getattr(self, name), 1)
        require.literals(self)
        for name in ("size", "activation_distance", "max_speed"):
            require.at_least(name, getattr(self, name), 1e-6)
        if self.agents < self.coupling:
            raise ValueError(
                f"coupling is {self.coupling} and there are {self.agents} rovers: no POI could "
                "ever be observed; give at least as many rovers as the coupling"
            )
        require.within("mislead", self.mislead, 0, 1)
        _check_rewards(self)
        _check_pois(self)

    @classmethod
    def motivating(cls, **overrides) -> "Rover":
        """The motivating example (section 7.2): rover 0 can reach either POI, rover 1 only POI 1,
        which is also closer to rover 0. Best global reward 1: rover 0 must take the farther one.

        Positions are from the author's code; start headings are random. `overrides`: fields.
        """
        preset = {
            "rovers": 2,
            "pois": 2,
            "coupling": 1,
            "activation_distance": 2.0,
            "max_steps": 30,
            "max_speed": 0.5,
            "placed": (((9.0, 10.0), (14.0, 17.0)), ((1.0, 1.0), (1.0, 18.0))),
        }
        return cls(**(preset | overrides))

    @classmethod
    def misleading(cls, coupling: int = 3, mislead: float = 0.5, **overrides) -> "Rover":
        """Four decoys near the start, worth a fifth of all, which one rover observes, and four POIs
        farther away that need `coupling`. The local reward pays a rover to stay beside a decoy that
        is not observed, the more the greater `mislead` is. `overrides`: fields."""
        preset = {
            "pois": 8,
            "decoys": 4,
            "poi_values": (1.0,) * 4 + (4.0,) * 4,
            "poi_rings": ((4.0, 7.0),) * 4 + ((8.0, 10.0),) * 4,
            "local": "decoys",
        }
        return cls(**(preset | {"coupling": coupling, "mislead": mislead} | overrides))

    @property
    def agents(self) -> int:
        return 2 * self.coupling if self.rovers is None else self.rovers

    @property
    def obs_size(self) -> int:
        return 2 * BRACKETS if self.observation == "relative" else 2 * BRACKETS + 3

    @property
    def obs_range(self) -> tuple[float, float]:
        return (0.0, 1.0) if self.observation == "relative" else (-math.inf, math.inf)

    @property
    def signals(self) -> tuple[str, ...]:
        return self.rewards

    @property
    def reported(self) -> str:
        """The signal that results are given in."""
        return "global" if "global" in self.rewards else self.rewards[-1]

    @property
    def values(self) -> Float[Array, " pois"]:
        """The POIs' shares of the global reward; their sum is 1."""
        if self.poi_values is None:
            return jnp.full(self.pois, 1.0 / self.pois)
        values = jnp.stack([jnp.asarray(value, jnp.float32) for value in self.poi_values])
        return values / jnp.sum(values)

    @property
    def needed(self) -> tuple[int, ...]:
        """Rovers that each POI needs."""
        alike = (1,) * self.decoys + (self.coupling,) * (self.pois - self.decoys)
        return self.poi_couplings or alike

    def reset(self, *, key: PRNGKeyArray) -> tuple[RoverState, TimeStep]:
        place_key, heading_key = jax.random.split(key)
        position, poi = self._places(place_key)
        heading = jnp.zeros(self.agents)
        if "as-coded" not in (self.start, self.motion):
            heading = jax.random.uniform(
                heading_key, (self.agents,), minval=-math.pi, maxval=math.pi
            )
        return self.begin(position, heading, poi)

    def begin(
        self,
        position: Float[Array, "rovers 2"],
        heading: Float[Array, " rovers"],
        poi: Float[Array, "pois 2"],
    ) -> tuple[RoverState, TimeStep]:
        """An episode from this start; metres and radians."""
        n, p = self.agents, self.pois
        pays = bool({"difference", "dpp"} & set(self.rewards))
        harvests = self.harvest_period > 1
        state = RoverState(
            position,
            heading,
            jnp.zeros(n),
            poi,
            jnp.zeros(p, bool),
            jnp.zeros(p, jnp.int32) if harvests else None,
            jnp.zeros(p) if self.graded else None,
            jnp.zeros((n, p), bool) if pays else None,
            jnp.zeros((n, p), jnp.int32) if pays and harvests else None,
            jnp.zeros((n, p)) if pays and self.graded else None,
            jnp.zeros((n, p), jnp.int32) if "dpp" in self.rewards else None,
            jnp.int32(0),
        )
        rewards = {name: jnp.zeros(() if name == "global" else n) for name in self.rewards}
        going = jnp.bool_(False)
        obs = self._observe(state, *_apart(position, poi))
        return state, TimeStep(obs, rewards, going, going, jnp.ones(n, bool))

    def step(
        self, state: RoverState, action: Float[Array, "rovers 2"], *, key: PRNGKeyArray
    ) -> tuple[RoverState, TimeStep]:
        before, (_, was) = state.observed, _apart(state.position, state.poi)
        position, heading, speed = self._move(state, jnp.clip(action, -1.0, 1.0))
        apart, distance = _apart(position, state.poi)
        ledgers = self._record(state, distance)
        state = RoverState(position, heading, speed, state.poi, *ledgers, state.step + 1)
        terminated = jnp.all(state.observed)
        truncated = ~terminated & (state.step >= self.max_steps)
        local = self._local(before, was, distance)
        rewards = self._pay(state, local, terminated | truncated)
        obs = self._observe(state, apart, distance)
        return state, TimeStep(obs, rewards, terminated, truncated, jnp.ones(self.agents, bool))

    def render(self, state: RoverState, pixels: int = 256) -> UInt8[np.ndarray, "h w 3"]:
        """A picture of the field, north up: rings of the activation distance around POIs, red once
        observed and black before, rovers as blue dots."""
        metre = pixels / float(self.size)
        x, y = np.meshgrid(np.arange(pixels) + 0.5, pixels - np.arange(pixels) - 0.5)
        picture = np.full((pixels, pixels, 3), 255, np.uint8)

        def away(place):
            return np.hypot(x / metre - place[0], y / metre - place[1])

        for place, seen in zip(np.asarray(state.poi), np.asarray(state.observed), strict=True):
            color = (200, 16, 46) if seen else (0, 0, 0)
            d = away(place)
            picture[np.abs(d - float(self.activation_distance)) < 1 / metre] = color
            picture[d < 0.35] = color
        for place in np.asarray(state.position):
            picture[away(place) < 0.3] = (0, 92, 175)
        return picture

    def viewer(self) -> Viewer:
        """Rovers from above, and what each senses."""
        counts = sorted(set(self.needed))
        several = " or ".join(map(str, counts)) + f" rover{'s' * (counts != [1])}"
        return Viewer(
            "rover",
            f"{self.agents} rovers and {self.pois} POIs, each of which is observed once {several} "
            f"{'is' if counts == [1] else 'are'} within {float(self.activation_distance):g} m "
            "of it at the same time.",
            self.shown,
            {
                "size": np.float32(self.size),
                "activation_distance": np.float32(self.activation_distance),
                "needed": np.array(self.needed),
                "observation": self.observation,
            },
            LEGEND,
            agent="rover",
        )

    def shown(self, trace: Trace) -> dict[str, Any]:
        """What is drawn of an episode, leaves `[moments, ...]`: `position` (m) and `heading` (rad)
        of the rovers, `observed`, how many rovers are `inside` of each POI's activation distance,
        `share`, the global reward if the episode ended there, and `sensors` `[moments, rovers, 2,
        36]`, of rovers and of POIs as in an observation; and `poi` `[pois, 2]` (m)."""
        state = trace.states
        paid = state.observed.astype(np.float32)
        if state.nearness is not None:
            paid = np.maximum(paid, state.nearness)
        way = state.poi[:, None] - state.position[:, :, None]  # [moments, rovers, pois, 2]
        near = np.sqrt(np.sum(way**2, axis=3)) <= np.float32(self.activation_distance)
        start = 0 if self.observation == "relative" else 1  # of the first ring
        rings = np.asarray(trace.observations)[:, :, start : start + 2 * BRACKETS]
        return {
            "position": state.position,
            "heading": state.heading,
            "poi": state.poi[0],
            "observed": state.observed,
            "inside": near.sum(axis=1),
            "share": paid @ np.asarray(self.values),
            "sensors": rings.reshape(*rings.shape[:2], 2, BRACKETS),
        }

    def _places(self, key: PRNGKeyArray):
        """Start positions of rovers and POIs."""
        if self.placed is not None:
            rovers, pois = (
                jnp.stack([jnp.asarray(x, jnp.float32) for point in points for x in point])
                for points in self.placed
            )
            return rovers.reshape(-1, 2), pois.reshape(-1, 2)
        rover_key, poi_key = jax.random.split(key)
        if self.start == "as-coded":
            return _coded_places(self.agents, self.pois, self.size, rover_key, poi_key)
        middle, half = 0.5 * self.size, 0.5 * CENTRE**0.5 * self.size
        spread = jax.random.uniform(rover_key, (self.agents, 2), minval=-1.0, maxval=1.0)
        position = middle + half * spread
        drawn = self.size * jax.random.uniform(poi_key, (self.pois, CANDIDATES, 2))
        outside, away = jnp.max(jnp.abs(drawn - middle), axis=2) > half, CLEARANCE
        if self.poi_rings is not None:
            drawn, away = self._in_rings(drawn / self.size), self.activation_distance
            outside = jnp.ones_like(outside)
        # One reduction, so that nothing of [pois, candidates, rovers] is ever in memory.
        x = drawn[:, :, None, 0] - position[None, None, :, 0]
        y = drawn[:, :, None, 1] - position[None, None, :, 1]
        clear = jnp.sqrt(jnp.min(x * x + y * y, axis=2))
        valid = outside & (clear >= away)
        # The first valid one is uniform over what is valid. If none is, as on a tiny field, the
        # farthest one comes closest to what was asked.
        chosen = jnp.argmax(jnp.where(valid, jnp.inf, jnp.where(outside, clear, -1.0)), axis=1)
        return position, drawn[jnp.arange(self.pois), chosen]

    def _in_rings(self, u: Float[Array, "pois n 2"]) -> Float[Array, "pois n 2"]:
        """Places, uniform in the ring of each POI, from numbers uniform in [0, 1]."""
        assert self.poi_rings is not None
        rings = jnp.stack([jnp.asarray(x, jnp.float32) for ring in self.poi_rings for x in ring])
        least, most = rings.reshape(-1, 2).T[:, :, None] ** 2
        radius, angle = jnp.sqrt(least + (most - least) * u[..., 0]), 2 * math.pi * u[..., 1]
        way = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=2)
        return 0.5 * self.size + radius[..., None] * way

    def _move(self, state: RoverState, action: Float[Array, "rovers 2"]):
        """Positions (m), headings (rad) and speeds (m per step) after clipped actions."""
        if self.motion == "as-coded":
            heading = state.heading + 0.5 * math.pi * action[:, 1]
            speed = jnp.full(self.agents, CODED_SPEED)
        else:
            heading = state.heading + math.pi * action[:, 0]
            heading = heading - 2 * math.pi * jnp.round(heading / (2 * math.pi))
            speed = 0.5 * (action[:, 1] + 1.0) * self.max_speed
        way = speed[:, None] * jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=1)
        return state.position + way, heading, speed

    def _record(self, state: RoverState, distance: Float[Array, "rovers pois"]):
        """The fields from `observed` to `company` after a step."""
        there = (distance <= self.activation_distance).astype(jnp.int32)
        count = jnp.sum(there, axis=0)
        observed, held = self._harvest(state.observed, state.held, count)
        near = state.nearness
        near_without, company = state.nearness_without, state.company
        without, held_without = state.observed_without, state.held_without
        if without is not None:
            others = count[None] - there
            without, held_without = self._harvest(without, held_without, others)
        if near is not None:
            now, now_without = self._nearness(distance)
            near = jnp.maximum(near, now)
            if near_without is not None:
                near_without = jnp.maximum(near_without, now_without)
        if company is not None:
            company = jnp.maximum(company, there * count[None])
        return observed, held, near, without, held_without, near_without, company

    def _harvest(self, observed, held, count):
        """Who is observed, and for how long already, when `count` rovers are there."""
        enough = count >= jnp.broadcast_to(jnp.array(self.needed), count.shape)
        if held is None:
            return observed | enough, None
        held = jnp.where(enough, held + 1, 0)
        return observed | (held >= self.harvest_period), held

    def _nearness(self, distance: Float[Array, "rovers pois"]):
        """d_a / max(d_a, mean distance of the closest rovers) of each POI; the same without each
        rover."""
        n, d_a = self.coupling, self.activation_distance
        far = jnp.full((1, self.pois), jnp.inf)  # who would replace the last rover
        padded = jnp.concatenate([distance, far])
        closest = -jax.lax.top_k(-padded.T, n + 1)[0]  # [pois, n + 1], the closest first
        if set(self.needed) == {n}:
            total = jnp.sum(closest[:, :n], axis=1)
            last, next_ = closest[:, n - 1], closest[:, n]
            count = count_without = n
        else:
            needed = jnp.array(self.needed)
            among = jnp.arange(n + 1)[None] < needed[:, None]
            total = jnp.sum(closest, axis=1, where=among)
            ends = [jnp.take_along_axis(closest, needed[:, None] - 1 + i, axis=1) for i in (0, 1)]
            last, next_ = (x[:, 0] for x in ends)
            count = needed.astype(jnp.float32)
            count_without = count[None]
        total_without = jnp.where(
            distance <= last[None], total[None] - distance + next_[None], total[None]
        )
        near = d_a / jnp.maximum(d_a, total / count)
        return near, d_a / jnp.maximum(d_a, total_without / count_without)

    def _local(
        self,
        observed: Bool[Array, " pois"],
        was: Float[Array, "rovers pois"],
        distance: Float[Array, "rovers pois"],
    ) -> Float[Array, " rovers"]:
        """Each rover's own reward; `observed` and distances `was` before the step."""
        if self.local == "distance":
            return -jnp.min(distance, axis=1)
        if self.local == "decoys":
            decoy = jnp.arange(self.pois) < self.decoys
            stay = self._closeness(observed | ~decoy, distance)  # 0 if all are left out
            come = _progress(observed | decoy, was, distance)
            return self.mislead * stay + (1.0 - self.mislead) * come
        left = jnp.where(jnp.all(observed), jnp.zeros_like(observed), observed)
        if self.local == "progress":
            return _progress(left, was, distance)
        if self.local == "unobserved":
            return -_closest(left, distance)
        return self._closeness(left, distance)

    def _closeness(self, left_out: Bool[Array, " pois"], distance) -> Float[Array, " rovers"]:
        closest = _closest(left_out, distance)
        return self.activation_distance / jnp.maximum(self.activation_distance, closest)

    def _pay(
        self, state: RoverState, local: Float[Array, " rovers"], ended: Bool[Array, ""]
    ) -> dict[str, Array]:
        """The named rewards of a step: `local` in every step, the others once the episode has
        `ended`."""
        share = self._share(state.observed, state.nearness)
        rewards = {"local": local, "global": jnp.where(ended, share, 0.0)}
        if "mixed" in self.rewards:
            rewards["mixed"] = rewards["local"] + self.mixed_weight * rewards["global"]
        if state.observed_without is not None:
            difference = share - self._share(state.observed_without, state.nearness_without)
            rewards["difference"] = jnp.where(ended, difference, 0.0)
            if state.company is not None:
                rewards["dpp"] = jnp.where(
                    ended, self._dpp(state.company, state.observed, difference), 0.0
                )
        return {name: rewards[name] for name in self.rewards}

    def _share(self, observed: Bool[Array, "*rovers pois"], nearness) -> Float[Array, "*rovers"]:
        """Share of the POIs' value that is observed, or of what `nearness` pays for the others."""
        paid = observed.astype(jnp.float32)
        if nearness is not None:
            paid = jnp.maximum(paid, nearness)
        return paid @ self.values

    def _dpp(
        self,
        company: Int[Array, "rovers pois"],
        observed: Bool[Array, " pois"],
        difference: Float[Array, " rovers"],
    ) -> Float[Array, " rovers"]:
        """With m copies of rover i a POI gains if its company with i was ever `coupling` - m."""
        new = (company > 0) & ~observed[None]
        missing = jnp.where(new, jnp.array(self.needed)[None] - company, self.coupling)
        gains = [difference]  # per copy, for m = 0 (see the class), 1, 2, ...
        for copies in range(1, self.coupling):
            gains.append(self._share(missing <= copies, None) / copies)
        result = difference
        for more, fewer in reversed(list(zip(gains[1:], gains[:-1], strict=True))):
            result = jnp.where(more > fewer, more, result)  # the smallest m is written last
        most = self._share(missing < self.coupling, None) / max(self.agents - 1, 1)
        return jnp.where(most > difference, result, difference)

    def _observe(self, state: RoverState, apart, distance) -> Float[Array, "rovers obs"]:
        """What the sensors say; `apart` and `distance` of rovers and POIs are known already."""
        apart_rovers, distance_rovers = _apart(state.position, state.position)
        coded = self.observation == "as-coded"
        nothing = -1.0 if coded else 0.0
        itself = jnp.eye(self.agents, dtype=bool)
        gone = jnp.broadcast_to(state.observed[None], distance.shape)
        worth = 1.0
        if coded and self.poi_values is not None:
            worth = jnp.stack([jnp.asarray(v, jnp.float32) for v in self.poi_values])[None]
        rings = []
        for (x, y), d, hidden, factor in (
            (apart_rovers, distance_rovers, itself, 1.0),
            (apart, distance, gone, worth),
        ):
            if coded:
                strength, ahead, left = factor / jnp.where(d == 0, 1e-3, d) ** 2, y, x
            else:
                cos, sin = jnp.cos(state.heading)[:, None], jnp.sin(state.heading)[:, None]
                strength, ahead, left = 1.0 / (1.0 + d), cos * x + sin * y, cos * y - sin * x
            strength = jnp.where(hidden, nothing, strength)
            rings.append(_ring(_bracket(ahead, left), strength, nothing))
        if coded:
            index = jnp.arange(self.agents, dtype=jnp.float32)[:, None]
            rings = [index, *rings, state.speed[:, None], state.heading[:, None] / math.pi]
        return jnp.concatenate(rings, axis=1)


def _apart(a: Float[Array, "a 2"], b: Float[Array, "b 2"]):
    """The way from each `a` to each `b`, (x, y) of `[a, b]`, and its length."""
    x = b[None, :, 0] - a[:, None, 0]
    y = b[None, :, 1] - a[:, None, 1]
    return (x, y), jnp.sqrt(x * x + y * y)


def _closest(left_out: Bool[Array, " pois"], distance) -> Float[Array, " rovers"]:
    """Metres to the closest POI of those that are not left out."""
    return jnp.min(jnp.where(left_out[None], jnp.inf, distance), axis=1)


def _progress(left_out: Bool[Array, " pois"], was, distance) -> Float[Array, " rovers"]:
    """Metres by which the step came closer to what was the closest POI of those that are not left
    out; 0 if all are."""
    was = jnp.where(jnp.all(left_out), distance, was)
    mine = jnp.argmin(jnp.where(left_out[None], jnp.inf, was), axis=1)[:, None]
    return jnp.take_along_axis(was - distance, mine, axis=1)[:, 0]


def _bracket(ahead: Float[Array, "..."], left: Float[Array, "..."]) -> Int[Array, "..."]:
    """The number of the 10° bracket, 0..35 anticlockwise, in which a direction lies.

    By a polynomial, as calls of atan2 would take most of a step.
    """
    x, y = jnp.abs(ahead), jnp.abs(left)
    t = jnp.minimum(x, y) / jnp.maximum(jnp.maximum(x, y), 1e-30)
    angle = BRACKETS / (2 * math.pi) * _atan(t)
    angle = jnp.where(y > x, BRACKETS / 4 - angle, angle)
    angle = jnp.where(ahead < 0, BRACKETS / 2 - angle, angle)
    angle = jnp.where(left < 0, BRACKETS - angle, angle)
    # Just below a full turn the difference rounds up to it.
    return jnp.minimum(jnp.floor(angle).astype(jnp.int32), BRACKETS - 1)


def _atan(t: Float[Array, "..."]) -> Float[Array, "..."]:
    """atan for t in [0, 1], in radians; error 2e-8 (Abramowitz & Stegun 1964, 4.4.49)."""
    s = t * t
    p = jnp.full_like(t, ATAN[-1])
    for coefficient in reversed(ATAN[:-1]):
        p = p * s + coefficient
    return t * p


def _ring(
    bracket: Int[Array, "rovers targets"], strength: Float[Array, "rovers targets"], nothing: float
) -> Float[Array, "rovers 36"]:
    """The strongest target in each bracket.

    A scatter visits each target once; a mask of `[rovers, targets, 36]` takes three times as long.
    """
    rovers = bracket.shape[0]
    return (
        jnp.full((rovers, BRACKETS), nothing).at[jnp.arange(rovers)[:, None], bracket].max(strength)
    )


def _coded_places(rovers: int, pois: int, size, rover_key: PRNGKeyArray, poi_key: PRNGKeyArray):
    """The author's start: whole metres. For a field of 20: rovers in 7..13; POIs in turn left
    (x 0..3), right (x 15..19), and above or below the middle (x 4..14, y 0..3 or 15..19)."""
    radius = jnp.floor(jnp.asarray(size, jnp.float32) / (2 * math.sqrt(10.0)))
    centre = jnp.floor(jnp.asarray(size, jnp.float32) / 2)

    def cells(key, low, high):
        """Uniform over the whole numbers low..high; key and bounds per cell."""
        u = jax.random.uniform(key, jnp.shape(low))
        return jnp.minimum(jnp.floor(low + u * (high - low + 1)), high)

    lower = jnp.broadcast_to(centre - radius, (rovers, 2))
    position = cells(rover_key, lower, lower + 2 * radius)
    side_key, cell_key = jax.random.split(poi_key)
    end = jnp.floor(jnp.asarray(size, jnp.float32)) - 1
    middle, reach = jnp.floor(end / 2), radius + 2
    zero = jnp.zeros(pois)
    kind = jnp.arange(pois) % 3
    below = jax.random.bernoulli(side_key, shape=(pois,))
    low_side, high_side = middle - reach - 1, middle + reach + 1
    x_low = jnp.select([kind == 0, kind == 1], [zero, zero + high_side], zero + middle - reach)
    x_high = jnp.select(
        [kind == 0, kind == 1], [zero + low_side, zero + end], zero + middle + reach
    )
    y_low = jnp.where((kind < 2) | below, 0.0, high_side)
    y_high = jnp.where((kind == 2) & below, low_side, end)
    low, high = jnp.stack([x_low, y_low], axis=1), jnp.stack([x_high, y_high], axis=1)
    return position, cells(cell_key, low, high)


def _check_rewards(env: Rover) -> None:
    """Raise `ValueError` unless each reward is known, named once, and defined for these options."""
    if not env.rewards or len(set(env.rewards)) < len(env.rewards):
        raise ValueError(f"rewards is {env.rewards}: name at least one, and each only once")
    for name in env.rewards:
        require.choice("a reward", name, REWARDS)
    if "dpp" in env.rewards and (env.harvest_period > 1 or env.graded):
        raise ValueError(
            f"D++ with harvest_period {env.harvest_period} and graded {env.graded}: it is computed "
            "for harvest_period=1 and graded=False only; take the reward 'difference'"
        )


def _check_pois(env: Rover) -> None:
    """Raise `ValueError` unless values and places are as many as POIs and rovers."""
    lists = {"poi_values": "numbers", "poi_couplings": "numbers", "poi_rings": "pairs"}
    for name, what in lists.items():
        given = getattr(env, name)
        if given is not None and len(given) != env.pois:
            told = f"{name} has {len(given)} {what} for {env.pois} POIs"
            raise ValueError(f"{told}: give one each")
    for value in env.poi_values or ():
        require.at_least("poi_values' value", value, 1e-6)
    for needed in env.poi_couplings or ():
        require.within("a POI's coupling", needed, 1, env.coupling)
    require.within("decoys", env.decoys, 0, env.pois)
    for least, most in env.poi_rings or ():
        require.at_least("the least distance of a ring", least, 0)
        require.at_least("the greatest distance of a ring", most, least)
    if env.placed is not None and tuple(map(len, env.placed)) != (env.agents, env.pois):
        raise ValueError(
            f"placed has {len(env.placed[0])} rovers and {len(env.placed[1])} POIs: there are "
            f"{env.agents} and {env.pois}; give (rovers, POIs), a pair (x, y) of metres each"
        )
