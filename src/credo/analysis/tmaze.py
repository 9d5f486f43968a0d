"""Baselines and upper bounds of the Extended T-Maze: shares of trials with the reward observed.

All are exact: probabilities are counted in integers and returned as fractions; nothing is simulated
or learned. With n = 2^depth endpoints and a reward that moves uniformly:

- The static robot alone observes it in (3n+1)/(6n) of the trials, FSP and RESP alike: 58.3 %,
  54.2 %, 52.1 % at depth 1, 2, 3, and the same where the reward moves as coded. In Spread that is
  the least that a team with it scores. The dissertation's 48 % and 33 % for depth 2 and 3 do not
  follow from its rules.
- A robot alone that counts trials, and so leaves the old place when the reward does, observes it in
  (3n+5)/(6n): 91.7 %, 70.8 %, 60.4 %. The dissertation calls the static policy optimal for one
  robot; that holds for a robot that does not know when the reward moves.
- In Converge no robot beside FSP does better than to imitate it: the static robot's own share.
- In Spread none beside FSP does better than to search from the other end: 100 %, 84.7 %, 79.5 %.
- Without memory one can go to the first endpoint or to the last. Beside FSP the better of them
  scores 68.8 % and 59.9 % in Spread at depth 2 and 3; the dissertation's feed-forward networks
  reach 69.3 % and 60.0 %.

One learning robot beside a static one, at depth 1 and 2, the best that is possible (`optimal`):

| | FSP | RESP |
|---|---|---|
| Converge, feedback "objective" | .583, .542 | .500, .418 |
| Converge, feedback "own" | .583, .542 | .542, .492 |
| Spread | 1.000, .847 | .958, .808 |
"""

import dataclasses
import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable
from fractions import Fraction
from functools import cache

from ..environments.extended_tmaze import ExtendedTMaze
from ..types import Bound

IMITATING = "imitating FSP"  # the one of the `baselines` that needs memory
EXACT_DEPTH = 2  # to which `optimal` takes seconds

World = tuple[int, int, int]  # where the reward is, where the static robot goes, how it counts
Weights = dict[World, int]  # how likely each is, up to a common factor
Belief = tuple[tuple[World, int], ...]  # the same, in order and without a common factor
Follow = Callable[[int, bool, int], int]
"""The next endpoint, from that of this trial, whether feedback said reward, and the trial."""


def static_alone(env: ExtendedTMaze) -> Fraction:
    """The static robot (`env.partner`, or FSP) alone in the maze."""
    return _play(env, None, 0)


def imitating(env: ExtendedTMaze) -> Fraction:
    """FSP's own rules, played by the learning robot beside the static one, if there is one.

    Beside FSP both are always at one endpoint, and in Converge nothing is better (`upper_bound`).
    """
    n = env.endpoints
    return _play(env, lambda at, seen, trial: at if seen else (at + 1) % n, 0)


def memoryless(env: ExtendedTMaze) -> dict[str, Fraction]:
    """The two policies that need no memory: every junction looks the same.

    A feed-forward network that does not draw its actions can play nothing else.
    """
    last = env.endpoints - 1
    return {
        name: _play(env, lambda at, seen, trial: at, at)
        for name, at in (("always left", 0), ("always right", last))
    }


def searching(env: ExtendedTMaze) -> Fraction:
    """The learning robot counts down from the last endpoint, stays where feedback says reward, and
    counts on when the reward moves, which it knows by counting trials.

    If moves are uniform, nothing is better for a robot alone, and in Spread beside FSP
    (`upper_bound`).
    """
    n = env.endpoints

    def follow(at: int, seen: bool, trial: int) -> int:
        moves = (trial + 1) % n == 0
        return at if seen and not moves else (at - 1) % n

    return _play(env, follow, n - 1)


def optimal(env: ExtendedTMaze) -> Fraction:
    """The best that one learning robot can do beside the static one.

    It knows the rules, the kind of its partner, and the trial; of the world only what it was told
    in the feedback steps. It plans over everything that it can believe (a search of the partially
    observable decision process): seconds at depth 2, out of reach at 3.
    """
    return _Plan(env).share()


def shared_information(env: ExtendedTMaze) -> Fraction:
    """A bound for a team of any size: all robots, the static one included, are steered by one mind
    that sees the feedback of all, counts trials, and knows where the reward was when it moves."""
    n, team = env.endpoints, env.robots + (env.partner is not None)
    spread = env.objective == "spread"
    together = {1} if not spread and env.feedback == "objective" else {1, team}

    def won(chances: list[Fraction]) -> Fraction:
        """Trials of one third, the likeliest endpoints being visited first."""
        known = [Fraction(0), *itertools.accumulate(sorted(chances, reverse=True))]

        @cache
        def best(visited: int, left: int) -> Fraction:
            if left == 0 or visited == len(chances):
                return Fraction(0)
            values = []
            for robots in together:
                now = min(visited + robots, len(chances))
                pays = left if spread or robots == 1 else left - 1  # who split must meet first
                found = (known[now] - known[visited]) * pays
                values.append(found + best(now, left - 1))
            return max(values)

        return best(0, n)

    moved = [Fraction(ways, _ways(env)) for _, ways in _moves(env, 0)]
    return (won([Fraction(1, n)] * n) + 2 * won(moved)) / env.trials


def baselines(env: ExtendedTMaze) -> dict[str, float]:
    """Shares of trials that take no learning, for one learning robot or for a team without memory.

    The static robot's own share is one in Spread alone, where it counts without company.

    **Raises:** `ValueError` for a team beside a static robot, of which none is known.
    """
    if env.robots > 1 and env.partner is not None:
        raise ValueError(
            f"{env.robots} robots beside {env.partner!r}: baselines are known of one robot beside "
            "a static one, and of teams alone (partner=None)"
        )
    if env.robots > 1:
        # Every endpoint is as likely as any other; without memory there are the first and the last,
        # and in Converge all must be at the same one.
        if env.objective == "converge":
            return {"all at one end": 1 / env.endpoints}
        return {"one at each end": min(2, env.robots) / env.endpoints}
    named = memoryless(env)
    if env.partner is not None and env.objective == "spread":
        named["static robot alone"] = static_alone(env)
    if env.partner == "fsp":
        named[IMITATING] = imitating(env)
    return {name: float(share) for name, share in named.items()}


def upper_bound(env: ExtendedTMaze) -> Bound:
    """The share of trials that no policy exceeds.

    Beside FSP, at any depth, if the reward moves uniformly or Converge has feedback "own":

    - Converge. With feedback "own" FSP walks as if alone, and where it is not nothing is observed.
      With "objective" a robot that stays away for the last x > 0 trials of a third loses x and
      sends FSP ahead by x; FSP then finds the reward earlier by (n-x)/(n-1) <= x trials on average.
    - Spread. FSP walks as if alone, and after n trials it is at the reward. Until one robot is, two
      robots see at most two new endpoints per trial, but one when FSP starts at the old place; so
      do FSP and `searching`, which is at the reward after n trials too.

    Beside RESP that is a bound: who is told its start and direction has FSP with other numbers.
    Deeper than 2, with a reward that moves as coded, `shared_information` is what is left.

    Without a static robot that bound is reached by one robot; in Converge with feedback "objective"
    by robots that walk together; and in Spread, with uniform moves, if the number of robots
    divides that of endpoints: each has its own share of them, and whoever was at the reward
    leaves that one out.
    """
    if env.partner is None:
        kind = "optimal" if _team_reaches_bound(env) else "upper bound"
        return Bound(float(shared_information(env)), kind)
    if env.robots == 1:
        converge = env.objective == "converge"
        regular = env.moves == "uniform" or (converge and env.feedback == "own")
        if regular and env.partner == "fsp":
            return Bound(float(static_alone(env) if converge else searching(env)), "optimal")
        if env.depth <= EXACT_DEPTH:
            return Bound(float(optimal(env)), "optimal")
        if env.moves == "uniform":
            beside_fsp = upper_bound(dataclasses.replace(env, partner="fsp"))
            return Bound(beside_fsp.value, "upper bound")
    return Bound(float(shared_information(env)), "upper bound")


def _team_reaches_bound(env: ExtendedTMaze) -> bool:
    if env.robots == 1:
        return True
    if env.objective == "converge":
        return env.feedback == "objective"
    divides = env.endpoints % env.robots == 0 and env.moves == "uniform"
    return divides or env.robots >= env.endpoints


def _moves(env: ExtendedTMaze, goal: int) -> list[tuple[int, int]]:
    """Where the reward goes from here: (endpoint, how likely) up to the factor of `_ways`."""
    others = [x for x in range(env.endpoints) if x != goal]
    if env.moves == "uniform":
        return [(x, 1) for x in others]
    return [(x, env.depth + ((x ^ goal).bit_count() == 1)) for x in others]


def _ways(env: ExtendedTMaze) -> int:
    """The sum of what `_moves` counts."""
    return env.endpoints - 1 if env.moves == "uniform" else env.endpoints * env.depth


def _worlds(env: ExtendedTMaze) -> Iterable[World]:
    """The equally likely starts."""
    n = env.endpoints
    static = (
        [(at, way) for at in range(n) for way in (1, -1)] if env.partner == "resp" else [(0, 1)]
    )
    return [(goal, *start) for goal in range(n) for start in static]


def _trial(env: ExtendedTMaze, world: World, at: int | None, alone: bool):
    """One trial with the learning robot at an endpoint, or None: it is not there.

    **Returns:** whether the reward was observed, whether feedback tells the learning robot so, and
    where the static robot goes next. `alone`: there is no static robot.
    """
    goal, static, way = world
    there = [x == goal for x in (at, None if alone else static) if x is not None]
    observed = all(there) if env.objective == "converge" else any(there)
    heard = observed if (env.objective, env.feedback) == ("converge", "objective") else True
    stays = not alone and there[-1] and heard
    following = static if stays or alone else (static + way) % env.endpoints
    return observed, at == goal and heard, following


def _play(env: ExtendedTMaze, follow: Follow | None, start: int) -> Fraction:
    """The share that a script scores; None: without the learning robot."""
    _check(env)
    n, alone = env.endpoints, env.partner is None and follow is not None
    at = None if follow is None else start
    worlds = {(world, at): 1 for world in _worlds(env)}
    total, share = sum(worlds.values()), Fraction(0)
    for trial in range(env.trials):
        after: dict = defaultdict(int)
        won = 0
        for (world, at), weight in worlds.items():
            observed, seen, static = _trial(env, world, at, alone)
            won += weight * observed
            following = None if follow is None or at is None else follow(at, seen, trial)
            after[(world[0], static, world[2]), following] += weight
        share += Fraction(won, total)
        if (trial + 1) % n == 0:
            after, total = _moved(env, after), total * _ways(env)
        worlds = after
    return share / env.trials


def _moved(env: ExtendedTMaze, worlds: dict) -> dict:
    """After the reward has moved; keys are (world, whatever)."""
    after: dict = defaultdict(int)
    for ((goal, static, way), rest), weight in worlds.items():
        for place, ways in _moves(env, goal):
            after[(place, static, way), rest] += weight * ways
    return after


class _Plan:
    """The best value of each belief, by branch and bound.

    A belief is worth no more than being told the world it stands for, so an endpoint whose bound is
    not above the best so far is not looked into. Values are integers: trials won, times the weight
    of the world, times `_ways` for each move that is yet to come.
    """

    def __init__(self, env: ExtendedTMaze):
        _check(env)
        if env.partner is None:
            raise ValueError("partner is None: give 'fsp' or 'resp', or ask shared_information")
        self.env = env
        self.known: dict[tuple[int, Belief], int] = {}
        self.told: dict[tuple[int, World], int] = {}

    def share(self) -> Fraction:
        worlds = dict.fromkeys(_worlds(self.env), 1)
        ways = len(worlds) * _ways(self.env) ** 2
        return Fraction(self.value(0, worlds), ways * self.env.trials)

    def value(self, trial: int, worlds: Weights) -> int:
        """The best of what is left from this trial on."""
        if trial == self.env.trials:
            return 0
        factor = math.gcd(*worlds.values())
        belief = tuple(sorted((world, weight // factor) for world, weight in worlds.items()))
        if (trial, belief) not in self.known:
            self.known[trial, belief] = self._best(trial, belief)
        return factor * self.known[trial, belief]

    def _best(self, trial: int, belief: Belief) -> int:
        certain = len(belief) == 1  # then a bound by being told would be itself
        options = []
        for at in self._sensible(belief):
            won, branches = self._visit(trial, belief, at)
            bounds = [0 if certain else self._bound(trial + 1, branch) for branch in branches]
            options.append((won + sum(bounds), won, bounds, branches))
        best = -1
        for bound, won, bounds, branches in sorted(options, key=lambda option: -option[0]):
            if not certain and bound <= best:
                break
            value = bound if not certain else won
            for limit, branch in zip(bounds, branches, strict=True):
                value += self._next(trial + 1, branch) - limit
                if not certain and value <= best:
                    break
            best = max(best, value)
        return best

    def _sensible(self, belief: Belief) -> list[int]:
        """Endpoints that a robot may be at or seek, and one of the others, which are all alike."""
        used = {x for (goal, static, _), _ in belief for x in (goal, static)}
        unused = [at for at in range(self.env.endpoints) if at not in used]
        return [*sorted(used), *unused[:1]]

    def _visit(self, trial: int, belief: Belief, at: int) -> tuple[int, list[Weights]]:
        """Trials won now, and what can be believed afterwards, by what the robot is told."""
        moves_to_come = 2 - trial // self.env.endpoints
        told: dict[tuple[bool, bool], Weights] = defaultdict(lambda: defaultdict(int))
        won = 0
        for (goal, static, way), weight in belief:
            observed, seen, following = _trial(self.env, (goal, static, way), at, False)
            won += observed * weight
            told[seen, static == at][goal, following, way] += weight
        return won * _ways(self.env) ** moves_to_come, list(told.values())

    def _next(self, trial: int, worlds: Weights) -> int:
        """Value of the belief after a trial, with the reward moved if this is where it moves."""
        if trial % self.env.endpoints or trial == self.env.trials:
            return self.value(trial, worlds)
        moved = _moved(self.env, {(world, None): weight for world, weight in worlds.items()})
        return self.value(trial, {world: weight for (world, _), weight in moved.items()})

    def _bound(self, trial: int, worlds: Weights) -> int:
        """Value if the robot were told the world now, once, before the reward moves."""
        return sum(weight * self._told(trial, world) for world, weight in worlds.items())

    def _told(self, trial: int, world: World) -> int:
        if (trial, world) not in self.told:
            self.told[trial, world] = self._next(trial, {world: 1})
        return self.told[trial, world]


def _check(env: ExtendedTMaze) -> None:
    if env.robots != 1:
        raise ValueError(
            f"robots is {env.robots}: scripts and plans are for one learning robot; give robots=1, "
            "or ask shared_information"
        )
