"""The Extended T-Maze: robots search a tree of corridors for a reward that moves twice.

Source: Khadka (2019), section 4.1.1. A maze of depth d has 2^d endpoints; robots walk it side by
side, on planes of their own that share the endpoints. Going once from the start to an endpoint is a
trial. An episode is one evaluation of 3·2^d trials; after every 2^d of them the reward moves to
another endpoint.

The dissertation leaves out how long corridors are, what a robot sees while it walks, and how the
reward is placed; here that is as in the author's published code ("as coded" below).

Departures of the code from the dissertation are options: a robot is told whether *all* robots took
one path (`presence`) and whether its *own* endpoint had the reward even where the team failed
(`feedback`); the reward's new place is not uniform (`moves`); and Converge was trained with bonuses
(`shaping`). The code turns left at an output of exactly 0, here that is right. It draws start and
direction of a randomly exploring robot once and keeps them; here every evaluation draws them.
"""

from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .. import require
from ..types import TimeStep, Trace
from .base import AbstractEnvironment
from .viewer import Mark, Viewer

SAME_PATH = 0.1  # as coded: the bonus of a trial in which all robots took one path, over T
EXPLORING = 0.05  # as coded: the bonus of a trial with a new path, over T - 1
PICTURED = 6  # junctions: deeper mazes are no picture
DEEPEST = 24  # numbers of endpoints and trials stay far from the limits of int32


class TMazeState(eqx.Module):
    """A maze between two steps. What the options of the task do not need is None."""

    goals: Int[Array, " 3"]  # the endpoint with the reward, one per third of the trials
    lengths: Int[Array, " depth"] | None  # steps of the corridor to each junction
    trial: Int[Array, ""]
    junction: Int[Array, ""]  # that is ahead; -1: it is the feedback step
    distance: Int[Array, ""]  # to that junction; 0 in the feedback step
    endpoint: Int[Array, " robots"]  # the turns since the start, as a binary number
    partner: Int[Array, ""] | None  # the endpoint to which the static robot goes in this trial
    direction: Int[Array, ""] | None  # in which it counts: 1 or -1
    visited: Int[Array, "robots endpoints"] | None
    """The last trial that ended there; long ago: not since this robot was last at the reward."""


class ExtendedTMaze(AbstractEnvironment):
    """Learning robots, alone or with one static robot, look for a reward in a maze.

    **Endpoints** are numbered 0..2^depth - 1 by the turns on the way, the first junction being the
    highest bit: left is 0, right is 1. Number 0 is left at every junction.

    **Time.** All robots walk in step. A trial is one feedback step, whose action does nothing, and
    then L steps towards each junction: it is L - 1, ..., 1, 0 ahead, and the action at 0 turns. So
    it takes 1 + (sum of L over `depth` junctions) steps, and `3 * 2**depth` trials are an episode,
    which then is `terminated`. Each L is uniform in `corridor`, both ends included, is drawn once
    per episode, and holds for all robots and trials.

    **Actions** `[robots, 1]`: 0 or more turns right, below 0 left.

    **Observation** `[robots, 3]`. In a corridor and at its junction: [distance to the junction,
    0, 0], in steps. In the feedback step: [0, company, reward] of the trial before, 0 or 1 each,
    and both 0 before the first trial.

    - company (`presence`): `"others"`, another robot was at this robot's endpoint; `"as-coded"`,
      all robots were at one endpoint.
    - reward (`feedback`): `"objective"`, this robot's endpoint had the reward and the team observed
      it; `"own"` (as coded), this robot's endpoint had the reward. They differ in Converge alone.

    **Objectives.** The reward is observed in a trial if all robots are at its endpoint
    (`"converge"`), or if at least one is (`"spread"`). The static robot counts as one of them.

    **Static robot** (`partner`): it visits endpoints in the order of their numbers, modulo
    2^depth, stays while its own feedback says reward, and counts on from there when it does not.
    `"fsp"` starts at 0 and counts up. `"resp"` draws start and direction per episode.

    **The reward** starts at a uniform endpoint. `moves` `"uniform"`: then uniform among the others.
    `"as-coded"`: uniform among all, and if that is where it was, one random turn of it is changed.

    **Signals**, paid at the last step of a trial; T is the number of trials:

    - `score`: 1/T if the reward was observed. The return is the share of trials, in [0, 1]; it is
      what is reported.
    - `difference` `[robots]`: score minus what it would have been in this trial, all others being
      where they were, with robot i taken out (`counterfactual="absent"`) or sent to a uniformly
      random endpoint (`"random"`, the exact mean). That the others would have learned something
      else from it is not counted. In Converge "absent" pays at most 0: a robot can only spoil it.
    - `shaped` `[robots]`, last of the signals with `shaping`: score plus the bonuses with which the
      code trained Converge: 0.1/T if all robots took one path, and, but for the first trial,
      0.05/(T-1) if this robot's endpoint is none that it saw since it was last at the reward, over
      the last 2^depth trials at most.
    """

    obs_size: ClassVar[int] = 3
    action_size: ClassVar[int] = 1
    reported: ClassVar[str] = "score"

    depth: int = eqx.field(static=True, default=2)  # junctions on the way, 1..24
    robots: int = eqx.field(static=True, default=1)  # robots that learn, at least 1
    objective: Literal["converge", "spread"] = eqx.field(static=True, default="converge")
    """The reward is observed if all robots are at it (converge) or one is (spread)."""
    partner: Literal["fsp", "resp"] | None = eqx.field(static=True, default="fsp")
    """Static robot: from the first endpoint up (fsp), drawn (resp), or None."""
    corridor: tuple[int, int] = eqx.field(static=True, default=(2, 2))
    """Steps between junctions, least and most, at least 1."""
    presence: Literal["others", "as-coded"] = eqx.field(static=True, default="others")
    """Company: a robot at the same endpoint, or `as-coded` all at one."""
    feedback: Literal["objective", "own"] = eqx.field(static=True, default="objective")
    """Reward that is seen: as the objective says, or at the own endpoint."""
    moves: Literal["uniform", "as-coded"] = eqx.field(static=True, default="uniform")
    """Where the reward moves: to another endpoint, or `as-coded`."""
    rewards: tuple[str, ...] = eqx.field(static=True, default=("score",))
    """Rewards by name: score and perhaps difference; the first is what training maximises."""
    counterfactual: Literal["absent", "random"] = eqx.field(static=True, default="absent")
    """`difference` takes a robot out (absent), or moves it at random."""
    shaping: bool = eqx.field(static=True, default=False)
    """Whether `shaped` is a reward too: score plus the author's bonuses."""

    def __check_init__(self):
        require.within("depth", self.depth, 1, DEEPEST)
        require.at_least("robots", self.robots, 1)
        require.literals(self)
        if len(self.corridor) != 2 or not 1 <= self.corridor[0] <= self.corridor[1]:
            raise ValueError(
                f"corridor is {self.corridor}: give (shortest, longest) in steps, at least 1 each, "
                "as in (2, 2)"
            )
        if sorted(self.rewards) not in (["score"], ["difference", "score"]):
            raise ValueError(
                f"rewards is {self.rewards}: it must be ('score',), ('score', 'difference') or "
                "('difference', 'score'); the shaped one comes with shaping=True"
            )

    @property
    def agents(self) -> int:
        """Learning robots; the static one is part of the world."""
        return self.robots

    @property
    def endpoints(self) -> int:
        """Where the paths end, numbered from 0."""
        return 2**self.depth

    @property
    def trials(self) -> int:
        """Walks from the start to an endpoint in one episode."""
        return 3 * self.endpoints

    @property
    def max_steps(self) -> int:
        return self.trials * (1 + self.depth * self.corridor[1])

    @property
    def signals(self) -> tuple[str, ...]:
        return (*self.rewards, "shaped") if self.shaping else self.rewards

    @property
    def obs_range(self) -> tuple[float, float]:
        return 0.0, float(max(1, self.corridor[1] - 1))

    def reset(self, *, key: PRNGKeyArray) -> tuple[TMazeState, TimeStep]:
        goal_key, length_key, start_key, direction_key = jax.random.split(key, 4)
        low, high = self.corridor
        lengths = None
        if low < high:
            lengths = jax.random.randint(length_key, (self.depth,), low, high + 1)
        partner = direction = visited = None
        if self.partner == "fsp":
            partner = jnp.int32(0)
        elif self.partner == "resp":
            partner = jax.random.randint(start_key, (), 0, self.endpoints)
            direction = jax.random.rademacher(direction_key, (), jnp.int32)
        if self.shaping:
            visited = jnp.full((self.robots, self.endpoints), -1 - self.endpoints)
        state = TMazeState(
            self._goals(goal_key),
            lengths,
            jnp.int32(0),
            jnp.int32(-1),
            jnp.int32(0),
            jnp.zeros(self.robots, jnp.int32),
            partner,
            direction,
            visited,
        )
        rewards = {name: jnp.zeros(self._shape(name)) for name in self.signals}
        going, nothing = jnp.bool_(False), jnp.zeros(self.robots, bool)
        return state, self._time_step(state, nothing, nothing, rewards, going)

    def step(
        self, state: TMazeState, action: Float[Array, "robots 1"], *, key: PRNGKeyArray
    ) -> tuple[TMazeState, TimeStep]:
        reached = state.distance == 0  # a junction, or the start of the first corridor
        arrived = reached & (state.junction == self.depth - 1)
        turn = (action[:, 0] >= 0).astype(jnp.int32)
        turned = jnp.where(state.junction < 0, 0, 2 * state.endpoint + turn)
        endpoint = jnp.where(reached, turned, state.endpoint)
        junction = jnp.where(arrived, -1, state.junction + reached.astype(jnp.int32))
        ahead = jnp.where(reached, self._length(state, junction), state.distance) - 1

        everybody = endpoint if state.partner is None else jnp.append(endpoint, state.partner)
        there = everybody == state.goals[jnp.minimum(state.trial >> self.depth, 2)]
        seen = there
        if (self.objective, self.feedback) == ("converge", "objective"):
            seen = there & jnp.all(there)
        rewards = self._pay(state, everybody, there)
        rewards = {name: jnp.where(arrived, x, 0.0) for name, x in rewards.items()}
        state = TMazeState(
            state.goals,
            state.lengths,
            state.trial + arrived.astype(jnp.int32),
            junction,
            jnp.where(arrived, 0, ahead),
            endpoint,
            self._count(state, arrived & ~seen[-1]),
            state.direction,
            self._visit(state, endpoint, there[: self.robots], arrived),
        )
        company, seen = arrived & self._company(everybody), arrived & seen[: self.robots]
        return state, self._time_step(state, company, seen, rewards, state.trial >= self.trials)

    def viewer(self) -> Viewer | None:
        """Robots in the maze, and all trials of the episode; None deeper than 6."""
        if self.depth > PICTURED:
            return None
        robots = "1 robot" if self.robots == 1 else f"{self.robots} robots"
        beside = f" beside a static one ({self.partner.upper()})" if self.partner else ""
        rule = "all robots are" if self.objective == "converge" else "a robot is"
        marks = [
            Mark("dot", "c0", "a robot, in its own colour"),
            Mark("square", "muted", "static robot"),
            Mark("star", "c4", "endpoint with the reward: an outline, filled once it is observed"),
            Mark("square", "c4", "in the trials: where the reward is"),
            Mark("tick", "good", "below a trial: the reward was observed"),
            Mark("cross", "bad", "below a trial: it was not"),
        ]
        return Viewer(
            "maze",
            f"{robots}{beside}, {self.depth}-deep, {self.objective.capitalize()}: the reward is "
            f"observed if {rule} at its endpoint.",
            self.shown,
            {"depth": self.depth},
            tuple(mark for mark in marks if self.partner or mark.text != "static robot"),
            agent="robot",
        )

    def shown(self, trace: Trace) -> dict[str, Any]:
        """At every moment: the trial, how far each robot is on the way (`part` of the corridor
        behind `level` turns, of which `turns` has the bits), and where the static robot goes; for
        every trial where each robot went (`static`: the static one), and what they were told."""
        state = trace.states
        ends = np.flatnonzero(np.diff(state.trial)) + 1  # moments at which a trial is over
        over = np.isin(np.arange(len(state.trial)), ends)
        level = np.where(over, self.depth, state.junction)
        lengths = state.lengths
        if lengths is None:
            lengths = np.full((len(level), self.depth), self.corridor[0])
        long = lengths[np.arange(len(level)), np.clip(level, 0, self.depth - 1)]
        part = np.where(over, 1.0, 1.0 - state.distance / long)
        goal, everybody = state.goals[0][np.arange(self.trials) >> self.depth], state.endpoint[ends]
        partner = state.partner
        if partner is not None:  # at the end of a trial it is already that of the next one
            everybody = np.column_stack([everybody, partner[ends - 1]])
        there = everybody == goal[:, None]
        shown = {
            "trial": state.trial - over,
            "level": level,
            "part": part.astype(np.float32),
            "turns": state.endpoint,
            "goal": goal,
            "endpoint": state.endpoint[ends],
            "observed": there.all(axis=1) if self.objective == "converge" else there.any(axis=1),
            "company": trace.observations[ends, :, 1] > 0.0,
            "reward": trace.observations[ends, :, 2] > 0.0,
        }
        if partner is not None:
            before = np.maximum(np.arange(len(level)) - over, 0)
            shown |= {"static": partner[ends - 1], "partner": partner[before]}
        return shown

    def _goals(self, key: PRNGKeyArray) -> Int[Array, " 3"]:
        """Endpoints of the reward in the three thirds of the trials."""
        n = self.endpoints
        first_key, *move_keys = jax.random.split(key, 3)
        goals = [jax.random.randint(first_key, (), 0, n)]
        for move_key in move_keys:
            if self.moves == "uniform":
                goals.append((goals[-1] + jax.random.randint(move_key, (), 1, n)) % n)
                continue
            goal_key, turn_key = jax.random.split(move_key)
            goal = jax.random.randint(goal_key, (), 0, n)
            changed = goal ^ (1 << jax.random.randint(turn_key, (), 0, self.depth))
            goals.append(jnp.where(goal == goals[-1], changed, goal))
        return jnp.stack(goals)

    def _length(self, state: TMazeState, junction: Int[Array, ""]) -> Int[Array, ""] | int:
        return self.corridor[0] if state.lengths is None else state.lengths[junction]

    def _company(self, everybody: Int[Array, " team"]) -> Bool[Array, " robots"]:
        """Which robots are told that they were not alone at their endpoint."""
        if self.presence == "as-coded":
            return jnp.broadcast_to(jnp.all(everybody == everybody[0]), self.robots)
        same = everybody[: self.robots, None] == everybody[None]
        return jnp.sum(same, axis=1) > 1  # the robot itself is one of them

    def _count(self, state: TMazeState, moves: Bool[Array, ""]) -> Int[Array, ""] | None:
        """Where the static robot goes next."""
        if state.partner is None:
            return None
        direction = 1 if state.direction is None else state.direction
        return jnp.where(moves, (state.partner + direction) % self.endpoints, state.partner)

    def _pay(
        self, state: TMazeState, everybody: Int[Array, " team"], there: Bool[Array, " team"]
    ) -> dict[str, Float[Array, "..."]]:
        """What this trial is worth, should it end now."""
        converge = self.objective == "converge"
        observed = jnp.all(there) if converge else jnp.any(there)
        score = observed.astype(jnp.float32) / self.trials
        rewards = {"score": score}
        if "difference" in self.rewards:
            others = jnp.sum(there) - there[: self.robots].astype(jnp.int32)
            # Only where the others leave it to this robot does it matter where it is.
            matters = others == (there.shape[0] - 1 if converge else 0)
            absent = 1.0 if converge else 0.0
            without = absent if self.counterfactual == "absent" else 1.0 / self.endpoints
            gain = there[: self.robots].astype(jnp.float32) - without
            rewards["difference"] = jnp.where(matters, gain, 0.0) / self.trials
        if state.visited is not None:
            same = jnp.all(everybody == everybody[0]).astype(jnp.float32)
            last = jnp.take_along_axis(state.visited, everybody[: self.robots, None], axis=1)
            new = (state.trial - last[:, 0] > self.endpoints) & (state.trial > 0)
            bonus = EXPLORING / (self.trials - 1) * new.astype(jnp.float32)
            rewards["shaped"] = score + SAME_PATH / self.trials * same + bonus
        return rewards

    def _visit(
        self,
        state: TMazeState,
        endpoint: Int[Array, " robots"],
        there: Bool[Array, " robots"],
        arrived: Bool[Array, ""],
    ) -> Int[Array, "robots endpoints"] | None:
        """The last visits to each endpoint, after this step; None without `shaping`."""
        if state.visited is None:
            return None
        here = endpoint[:, None] == jnp.arange(self.endpoints)[None]
        visited = jnp.where(here, state.trial, state.visited)
        # As coded: what is at the reward starts a new search, to which this visit does not belong.
        visited = jnp.where(there[:, None], -1 - self.endpoints, visited)
        return jnp.where(arrived, visited, state.visited)

    def _shape(self, signal: str) -> tuple[int, ...]:
        return () if signal == "score" else (self.robots,)

    def _time_step(
        self,
        state: TMazeState,
        company: Bool[Array, " robots"],
        seen: Bool[Array, " robots"],
        rewards: dict[str, Float[Array, "..."]],
        terminated: Bool[Array, ""],
    ) -> TimeStep:
        distance = jnp.broadcast_to(state.distance, self.robots)
        obs = jnp.stack([x.astype(jnp.float32) for x in (distance, company, seen)], axis=1)
        active = jnp.ones(self.robots, bool)
        return TimeStep(obs, rewards, terminated, jnp.bool_(False), active)
