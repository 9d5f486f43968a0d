"""An episode of T-maze robots as figures of a page: who went where, and what they remembered."""

from typing import Any

from .sections import HeatMap, Track, Tracks


def pictures(title: str, episode: dict[str, Any]) -> list[Tracks | HeatMap]:
    """Where everybody went in an episode of `MazeTrace.plain`, and the memory of each
    robot, if it has one. `title`: begins the title of each."""
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
