"""An episode of T-maze robots as figures of a page: who went where, and what they remembered."""

from typing import Any

from .sections import HeatMap, Track, Tracks


def pictures(title: str, episode: dict[str, Any]) -> list[Tracks | HeatMap]:
    """Figures of an episode, trial by trial.

    **Arguments:** `title`: begins the title of each; `episode`: as `MazeTrace.plain` gives it.

    **Returns:** where everybody went, and of each robot with memory that `[cells, trials]`.
    """
    robots = len(episode["endpoint"])
    names = [f"robot {i + 1}" for i in range(robots)] if robots > 1 else ["robot"]
    walk = _walk(title, names, episode)
    maps = [
        HeatMap(
            f"{title}: memory of {'the robot' if robots == 1 else name}",
            cells,
            [f"M{i + 1}" for i in range(len(cells))],
            walk.column_labels,
            "trial",
            "memory cell",
            caption="As each trial ends, before the robot is told of it.",
        )
        for name, cells in zip(names, episode["memory"] or (), strict=False)
    ]
    return [walk, *maps]


def _walk(title: str, names: list[str], episode: dict[str, Any]) -> Tracks:
    """The endpoint of every robot in each trial, what it was told there, and the reward's."""
    n, observed = 2 ** episode["depth"], episode["observed"]
    each = zip(names, episode["endpoint"], episode["company"], episode["reward"], strict=True)
    tracks = [
        Track(name, endpoints, list(map(_told, company, reward)))
        for name, endpoints, company, reward in each
    ]
    if episode["partner"] is not None:
        tracks.append(Track("static robot", episode["partner"], scripted=True))
    return Tracks(
        title,
        tracks,
        episode["goal"],
        list(map(bool, observed)),
        [f"{i} {turns(i, episode['depth'])}" for i in range(n)],
        [str(trial + 1) for trial in range(3 * n)],
        "trial",
        "endpoint",
        goal_label="reward",
        outcomes=("observed", "not observed"),
        breaks=(n, 2 * n),
        caption="Endpoints by the turns to them, left or right. The reward moves at the lines. "
        f"Observed in {sum(observed)} of {3 * n} trials.",
    )


def turns(endpoint: int, depth: int) -> str:
    """The way to an endpoint, L or R at each junction: endpoint 1 at depth 2 is LR."""
    return "".join("LR"[endpoint >> i & 1] for i in reversed(range(depth)))


def _told(company: int, reward: int) -> str:
    """What a robot heard at the end of a trial."""
    words = [word for word, told in (("company", company), ("reward", reward)) if told]
    return f"told {' and '.join(words) or 'nothing'}"
