"""Environment steps per second of one core: the rover domain, 8 rovers × 4 POIs, random actions.

Beside the same rover written in plain NumPy, one world at a time, which must agree with it; and
VMAS's discovery with its default five agents and seven targets, its task nearest to this one. They
are not the same: VMAS simulates collisions and casts rays. Credo plays whole episodes of 50 steps
in one program, starts included; the others only step, which spares them the starts.

And the growth of a step with the number of rovers and POIs, which is to be no faster than
rovers · (rovers + POIs): the time per such pair must not rise.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from credo.compilation import jit
from credo.environments.rover import Rover

from . import peers
from .td3_update import seconds

WORLDS = (1, 32, 1_024)
SIZES = ((8, 4), (25, 12), (100, 25), (400, 100))  # rovers, POIs
STEPS, ROUNDS, LEAST = 50, 5, 0.2  # s, of one measurement
AUTHOR = 2_560  # steps per second of the author's Python with 8 rovers, measured once
GOALS = {"vmas": 10, "author": 100}
SECONDS = "3"


class NumpyRover:
    """One world as most people write it: the same task, observation and rewards as `Rover`."""

    def __init__(self, position, heading, poi, coupling=3, reach=3.0, steps=STEPS):
        self.position, self.heading, self.poi = position.copy(), heading.copy(), poi
        self.coupling, self.reach, self.steps = coupling, reach, steps
        self.observed, self.step_count = np.zeros(len(poi), bool), 0

    def step(self, action):
        action = np.clip(action, -1.0, 1.0)
        heading = self.heading + np.pi * action[:, 0]
        self.heading = heading - 2 * np.pi * np.round(heading / (2 * np.pi))
        speed = 0.5 * (action[:, 1] + 1.0)
        ahead = np.stack([np.cos(self.heading), np.sin(self.heading)], axis=1)
        self.position = self.position + speed[:, None] * ahead
        self.step_count += 1
        to_poi, distance = self.apart(self.poi)
        self.observed = self.observed | (np.sum(distance <= self.reach, axis=0) >= self.coupling)
        ended = self.observed.all() or self.step_count >= self.steps
        left = np.where(self.observed, np.inf, distance).min(axis=1)
        rewards = {
            "global": self.observed.mean() if ended else 0.0,
            "local": np.zeros(len(left)) if self.observed.all() else -left,
        }
        to_rover, gap = self.apart(self.position)
        alone = np.eye(len(self.position), dtype=bool)
        gone = np.broadcast_to(self.observed, distance.shape)
        rings = [self.ring(to_rover, gap, alone), self.ring(to_poi, distance, gone)]
        return np.concatenate(rings, axis=1), rewards, ended

    def apart(self, targets):
        way = targets[None] - self.position[:, None]
        return way, np.sqrt(np.sum(way * way, axis=2))

    def ring(self, way, distance, hidden):
        """The closest target in each of 36 brackets, as 1/(1 + metres)."""
        cos, sin = np.cos(self.heading)[:, None], np.sin(self.heading)[:, None]
        x, y = way[..., 0], way[..., 1]
        angle = np.arctan2(cos * y - sin * x, cos * x + sin * y) % (2 * np.pi)
        bracket = np.minimum((angle * 18 / np.pi).astype(int), 35)
        ring = np.zeros((len(way), 36), np.float32)
        rovers = np.arange(len(way))[:, None]
        np.maximum.at(ring, (rovers, bracket), np.where(hidden, 0.0, 1 / (1 + distance)))
        return ring


@jit
def episodes(env: Rover, worlds, steps, key):
    """Random actions for `steps` steps in so many worlds. Returns sums of all that was said, so
    that none of it can be left out of the program."""
    start_key, *keys = jax.random.split(key, steps + 1)
    state, first = jax.vmap(lambda key: env.reset(key=key))(jax.random.split(start_key, worlds))
    total = jax.tree.map(jnp.zeros_like, (first.obs, first.rewards))
    loop = eqx.filter_vmap(lambda s, a: env.step(s, a, key=key))

    def step(carry, key):
        state, total = carry
        action = jax.random.uniform(key, (worlds, env.agents, 2), minval=-1.0, maxval=1.0)
        state, said = loop(state, action)
        return (state, jax.tree.map(jnp.add, total, (said.obs, said.rewards))), None

    (_, total), _ = jax.lax.scan(step, (state, total), jnp.stack(keys))
    return total


def per_step(run, steps: int) -> float:
    """CPU seconds of one step; `run` makes `steps` of them and is repeated for long enough."""
    repeats = max(1, round(LEAST / max(seconds(run), 1e-6)))
    return seconds(lambda: [run() for _ in range(repeats)]) / (repeats * steps)


def medians(runs: dict, steps: int) -> dict:
    """CPU seconds of a step of each, the median of rounds in turn."""
    for run in runs.values():
        run()  # compiles
    times = {name: [] for name in runs}
    for _ in range(ROUNDS):
        for name, run in runs.items():
            times[name].append(per_step(run, steps))
    return {name: float(np.median(t)) for name, t in times.items()}


def start(env: Rover):
    """A world of Credo's and the same one in NumPy."""
    state, _ = env.reset(key=jax.random.key(2))
    position, heading, poi = (np.asarray(x) for x in (state.position, state.heading, state.poi))
    return state, NumpyRover(position, heading, poi, coupling=env.coupling)


def agreement() -> tuple[float, int]:
    """Share of the numbers that NumPy and Credo say alike, over episodes of the same actions; and
    how many POIs were observed in them: with a coupling of 3 random actions observe none."""
    alike, observed = [], 0
    for coupling in (1, 2, 3):
        env = Rover(rovers=8, pois=4, coupling=coupling)
        state, world = start(env)
        rng, step, ended = np.random.default_rng(0), jit(env.step), False
        while not ended:
            action = rng.uniform(-1, 1, (env.agents, 2)).astype(np.float32)
            state, said = step(state, action, key=jax.random.key(0))
            obs, rewards, ended = world.step(action)
            pairs = [(said.obs, obs), *((said.rewards[name], rewards[name]) for name in rewards)]
            pairs.append((said.terminated | said.truncated, ended))
            alike += [np.isclose(np.asarray(a), b, atol=1e-3).ravel() for a, b in pairs]
        observed += int(world.observed.sum())
    return float(np.mean(np.concatenate(alike))), observed


def numpy_episode(env: Rover):
    """Steps of one world from a start that is made once."""
    _, world = start(env)
    arrays, rng = (world.position, world.heading, world.poi), np.random.default_rng(0)

    def run():
        world = NumpyRover(*arrays)
        for _ in range(STEPS):
            world.step(rng.uniform(-1, 1, (env.agents, 2)).astype(np.float32))

    return run


def main() -> None:
    env = Rover(rovers=8, pois=4)
    key = jax.random.key(0)
    print("rover domain, 8 rovers × 4 POIs, random actions, steps per CPU second of one core")
    runs = {n: lambda n=n: episodes(env, n, STEPS, key) for n in WORLDS}
    times = medians(runs | {"numpy": numpy_episode(env)}, STEPS)
    ours = {n: n / times[n] for n in WORLDS}
    numpy_rate, best = 1 / times["numpy"], ours[WORLDS[-1]]
    vmas = peers.ask("vmas", "vmas_discovery.py", SECONDS, *map(str, WORLDS))
    for n, rate in ours.items():
        text = f"  {f'Credo, worlds: {n:,}':<34}{rate:10,.0f}  NumPy {rate / numpy_rate:8.1f} ×"
        if vmas:
            text += f"  VMAS {vmas[str(n)]:9,.0f}: {rate / vmas[str(n)]:7.1f} ×"
            text += f"  goal {GOALS['vmas']} ×" if n == WORLDS[-1] else ""
        print(text)
    alike, observed = agreement()
    print(
        f"  {'NumPy, one world':<34}{numpy_rate:10,.0f}  {100 * alike:.2f} % of numbers alike, "
        f"{observed} POIs observed"
    )
    print(
        f"  {'Python of the author, once':<34}{AUTHOR:10,}  Credo {best / AUTHOR:8.1f} ×  "
        f"goal {GOALS['author']} ×"
    )
    growth(key)


def growth(key) -> None:
    print("rover domain, one world: growth of a step")
    envs = {size: Rover(rovers=size[0], pois=size[1]) for size in SIZES}
    runs = {size: lambda env=env: episodes(env, 1, STEPS, key) for size, env in envs.items()}
    for (rovers, pois), step in medians(runs, STEPS).items():
        pair = 1e9 * step / (rovers * (rovers + pois))
        print(
            f"  {f'{rovers} rovers × {pois} POIs':<34}{1 / step:10,.0f} steps/s"
            f"{1e6 * step:10.1f} µs  {pair:6.2f} ns per rovers·(rovers + POIs)"
        )


if __name__ == "__main__":
    main()
