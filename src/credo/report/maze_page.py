"""Episodes of T-maze robots as pictures: plain numbers for a file, sections of a page, a page."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..analysis.maze_trace import MazeTrace, trace_maze
from ..environments.extended_tmaze import ExtendedTMaze
from ..networks.base import AbstractPolicy
from . import pages
from .sections import HeatMap, Page, Section, Track, Tracks

DEEPEST = 4  # 48 trials: more are no picture


def plain(env: ExtendedTMaze, trace: MazeTrace) -> dict[str, Any]:
    """A trace as JSON can hold it: 0 and 1 for no and yes, lists `[trials]`, of robots
    `[robots][trials]`, and of memory `[robots][cells][trials]`."""

    def numbers(x: Any) -> Any:
        return None if x is None else np.asarray(x).astype(int).T.tolist()

    memory = trace.memory
    if memory is not None:
        memory = np.round(np.asarray(memory, np.float64), 2).transpose(1, 2, 0).tolist()
    return {
        "depth": env.depth,
        "goal": numbers(trace.goal),
        "observed": numbers(trace.observed),
        "endpoint": numbers(trace.endpoint),
        "partner": numbers(trace.partner),
        "company": numbers(trace.company),
        "reward": numbers(trace.reward),
        "memory": memory,
    }


def pictures(title: str, episode: dict[str, Any]) -> list[Tracks | HeatMap]:
    """Where everybody went in an episode of `plain`, and the memory of each robot, if it has one.
    `title`: begins the title of each."""
    n, robots = 2 ** episode["depth"], len(episode["endpoint"])
    names = [f"robot {i + 1}" for i in range(robots)] if robots > 1 else ["robot"]
    tracks = [
        Track(name, rows, [_told(*told) for told in zip(company, reward, strict=True)])
        for name, rows, company, reward in zip(
            *(names, episode["endpoint"], episode["company"], episode["reward"]), strict=True
        )
    ]
    if episode["partner"] is not None:
        tracks.append(Track("static robot", episode["partner"], scripted=True))
    trials = [str(trial + 1) for trial in range(3 * n)]
    walk = Tracks(
        title,
        tracks,
        episode["goal"],
        [bool(seen) for seen in episode["observed"]],
        [f"{i} {turns(i, episode['depth'])}" for i in range(n)],
        trials,
        "trial",
        "endpoint",
        goal_label="reward",
        outcomes=("observed", "not observed"),
        breaks=(n, 2 * n),
        caption="Endpoints by the turns to them, left or right. The reward moves at the lines. "
        f"Observed in {sum(episode['observed'])} of {len(trials)} trials.",
    )
    maps = [
        HeatMap(
            f"{title}: memory of {'the robot' if robots == 1 else name}",
            cells,
            [f"M{i + 1}" for i in range(len(cells))],
            trials,
            "trial",
            "memory cell",
            caption="As each trial ends, before the robot is told of it.",
        )
        for name, cells in zip(names, episode["memory"] or (), strict=False)
    ]
    return [walk, *maps]


def turns(endpoint: int, depth: int) -> str:
    """The way to an endpoint: L or R at each junction."""
    return "".join("LR"[endpoint >> i & 1] for i in reversed(range(depth)))


def _told(company: int, reward: int) -> str:
    words = [word for word, told in (("company", company), ("reward", reward)) if told]
    return f"told {' and '.join(words) or 'nothing'}"


def write(
    env: ExtendedTMaze,
    policy: AbstractPolicy,
    seeds: Iterable[int],
    path: str | os.PathLike[str],
    *,
    title: str,
) -> Path:
    """Write a page with pictures of one episode for each seed to `path` and return it.

    **Raises:** `ValueError` if the maze is deeper than a picture can show.
    """
    if env.depth > DEEPEST:
        raise ValueError(
            f"the maze is {env.depth}-deep: up to {DEEPEST} a picture shows its {env.trials} trials"
        )
    beside = f" beside a static one ({env.partner.upper()})" if env.partner else ""
    robots = "1 robot" if env.robots == 1 else f"{env.robots} robots"
    lead = f"The champion: {robots}{beside}, {env.depth}-deep, {env.objective.capitalize()}."
    sections: list[Section] = []
    for seed in seeds:
        trace = trace_maze(env, policy, key=jax.random.key(seed))
        sections += pictures(f"Seed {seed}", plain(env, trace))
    return pages.write(Page(title, lead, command="", sections=sections), path)
