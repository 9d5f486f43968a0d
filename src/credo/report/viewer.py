"""Episodes that play in the browser: one HTML page for a set of traces, without a network.

A task says by `env.viewer()` how its world is drawn; time and its controls, rewards by name, the
policy's memory and the legend are the same for all (`static/viewer.js`).
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..analysis.memory import known_memory
from ..environments.viewer import Viewer
from ..runs import files
from ..types import Trace
from . import markup

SPEEDS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)  # steps per second to choose from


def write(
    viewer: Viewer, traces: Mapping[str, Trace], path: str | os.PathLike[str], **options: Any
) -> Path:
    """Write the page that plays these episodes to `path` and return it. A reader never sees half a
    file. Arguments and errors otherwise as of `page`."""
    files.write_text(path, page(viewer, traces, **options))
    return Path(path)


def page(
    viewer: Viewer, traces: Mapping[str, Trace], *, title: str, speed: float | None = None
) -> str:
    """The page as HTML.

    **Arguments:** `traces`: by the names of the episodes, as `credo.rollout.record` keeps them;
    `speed`: steps per second at first, more than 0; None: the viewer's.

    **Raises:** `ValueError` if there is no episode, or a number in one is not finite.
    """
    if not traces:
        raise ValueError("there is no episode to play: give at least one")
    active = next(iter(traces.values())).active
    speed = float(f"{speed or viewer.speed:g}")
    data = {
        "agents": None if active is None else active.shape[1],
        "agent": viewer.agent,
        "task": viewer.task,
        "legend": [vars(mark) for mark in viewer.legend],
        "episodes": [{"name": name, **_episode(viewer, trace)} for name, trace in traces.items()],
    }
    own = Path(viewer.drawing)
    known = f"viewer-{viewer.drawing}.js"
    return markup.render(
        "viewer.html",
        title=title,
        viewer=viewer,
        drawing=own.stem,
        data=_short(data),
        speeds=sorted({*SPEEDS, speed}),
        speed=speed,
        style=markup.static("base.css", "viewer.css"),
        player=markup.static("viewer.js"),
        script=files.read_text(own) if own.suffix == ".js" else markup.static(known),
    )


def _episode(viewer: Viewer, trace: Trace) -> dict[str, Any]:
    """What a page holds of an episode: what every task has (its length, how it ended, rewards by
    name and step, the policy's memory), and what this task's drawing needs."""
    shown = viewer.rewards or tuple(trace.rewards)
    return {
        "steps": int(trace.length),
        "ended": "the task ended" if trace.terminated else "time ran out",
        "rewards": {name: trace.rewards[name] for name in shown},
        "memory": _memory(trace),
        **viewer.episode(trace),
    }


def _memory(trace: Trace) -> dict[str, Any] | None:
    """The policy's memory at every moment, `[moments, cells]` or, of each agent, `[moments, agents,
    cells]`; None: it has none, or none that is known."""
    memory = known_memory(trace.carries)
    if memory is None or memory.size == 0 or memory.ndim not in (2, 3):
        return None
    if memory.ndim == 3 and (trace.active is None or memory.shape[1] != trace.active.shape[1]):
        return None
    return {"shared": memory.ndim == 2, "values": np.asarray(memory, np.float32)}


def _short(value: Any) -> Any:
    """What JSON holds: of arrays plain lists of the shortest numbers that are read back as the same
    32 bits; truth values are 0 and 1. Raises `ValueError` for a number that is not finite."""
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, dict):
        return {name: _short(x) for name, x in value.items()}
    if isinstance(value, list | tuple):
        return [_short(x) for x in value]
    x = np.asarray(value)
    if not np.isfinite(x).all():
        raise ValueError("an episode holds a number that is not finite: it cannot be replayed")
    if x.dtype.kind != "f":
        return x.astype(int).tolist()
    return np.vectorize(_number, otypes=[object])(x.astype(str)).tolist()


def _number(text: str) -> float | int:
    """A number without a needless ".0"."""
    number = float(text)
    return int(number) if number.is_integer() else number
