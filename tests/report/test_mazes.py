"""Pictures of T-maze episodes: they show what the trace says, and `credo watch` writes them."""

import json
import re

import jax
import numpy as np
import pytest

from credo.algorithms.ccea import CCEA
from credo.analysis.maze_trace import trace_maze
from credo.environments.extended_tmaze import ExtendedTMaze
from credo.environments.wrappers import DelayedReward
from credo.networks.mmu import MMU
from credo.networks.team import Team
from credo.report import mazes
from credo.report.watch import watch
from credo.runs import checkpoint, config, files
from credo.runs.record import RunError
from credo.runs.store import Run

ENV = ExtendedTMaze(depth=1, robots=2, objective="spread")
NETWORK = MMU(hidden=3, output_activation="tanh")


def champion(env=ENV):
    network = Team(trunk=(), head=NETWORK, sharing="nothing")
    return network.init(*env.sizes, key=jax.random.key(1))


def made(path, env=ENV) -> Run:
    """A run on disk whose champion has fresh weights."""
    path.mkdir()
    algorithm = CCEA.ccea(env, NETWORK, population_size=10, elite_fraction=0.1)
    checkpoint.export_policy(path / "champion.safetensors", champion(env))
    files.write_json(path / "config.json", {"algorithm": config.to_tree(algorithm), "seed": 0})
    return Run(path)


@pytest.fixture(scope="module")
def trace():
    return trace_maze(ENV, champion(), key=jax.random.key(0))


def test_plain_numbers_are_those_of_the_trace(trace):
    episode = trace.plain(ENV)
    assert json.loads(json.dumps(episode)) == episode
    for name in ("goal", "observed", "partner"):
        assert episode[name] == np.asarray(getattr(trace, name)).astype(int).tolist()
    for name in ("endpoint", "company", "reward"):
        assert np.transpose(episode[name]).tolist() == np.asarray(getattr(trace, name)).tolist()
    memory = np.transpose(episode["memory"], (2, 0, 1))
    np.testing.assert_allclose(memory, trace.memory, atol=0.0051)


def test_a_picture_and_its_table_show_the_episode(trace):
    walk, *maps = mazes.pictures("Seed 0", trace.plain(ENV))
    assert [track.label for track in walk.tracks] == ["robot 1", "robot 2", "static robot"]
    assert [track.scripted for track in walk.tracks] == [False, False, True]
    assert walk.breaks == (2, 4)
    assert [heat_map.title for heat_map in maps] == [f"Seed 0: memory of robot {i}" for i in (1, 2)]
    assert np.shape(maps[0].values) == (3, 6)
    ways = ("0 L", "1 R")
    for i, row in enumerate(walk.table.rows):
        seen = "observed" if trace.observed[i] else "not observed"
        told = [
            {(0, 0): "nothing", (1, 0): "company", (0, 1): "reward", (1, 1): "company and reward"}[
                int(trace.company[i, robot]), int(trace.reward[i, robot])
            ]
            for robot in (0, 1)
        ]
        assert row == [
            str(i + 1),
            f"{ways[trace.goal[i]]}, {seen}",
            f"{ways[trace.endpoint[i, 0]]}, told {told[0]}",
            f"{ways[trace.endpoint[i, 1]]}, told {told[1]}",
            ways[trace.partner[i]],
        ]


def test_endpoints_are_named_by_their_turns():
    assert [mazes.turns(i, 2) for i in range(4)] == ["LL", "LR", "RL", "RR"]


def test_without_memory_or_static_robot_there_is_no_picture_of_them(trace):
    episode = trace.plain(ENV) | {"memory": None, "partner": None}
    (walk,) = mazes.pictures("Seed 0", episode)
    assert [track.label for track in walk.tracks] == ["robot 1", "robot 2"]


def test_watch_writes_a_page_of_some_episodes(tmp_path):
    run = made(tmp_path / "run", DelayedReward(ENV))
    assert watch(run) == run.path / "champion.html"
    output = watch(run, tmp_path / "new" / "page.html", episodes=2, seed=3)
    assert [child.name for child in output.parent.iterdir()] == ["page.html"]
    html = output.read_text(encoding="utf-8")
    assert "2 robots beside a static one (FSP), 1-deep, Spread: the reward is observed" in html
    (text,) = re.findall(r'<script type="application/json">(.*?)</script>', html, re.S)
    shown = json.loads(text)["episodes"]
    assert [episode["name"] for episode in shown] == ["seed 3", "seed 4"]
    for seed, episode in zip((3, 4), shown, strict=True):
        played = trace_maze(ENV, champion(), key=jax.random.key(seed))
        assert episode["endpoint"] == played.endpoint.tolist()
        assert episode["static"] == played.partner.tolist()
        assert episode["observed"] == played.observed.astype(int).tolist()


def test_what_is_no_page_or_too_deep_is_told(tmp_path):
    run = made(tmp_path / "run")
    with pytest.raises(ValueError, match=r"film\.gif': its name must end in \.html$"):
        watch(run, tmp_path / "film.gif")
    with pytest.raises(RunError, match=r"T-mazes \(up to 6 deep\)"):
        watch(made(tmp_path / "deep", ExtendedTMaze(depth=7)))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["deep", "run"]
