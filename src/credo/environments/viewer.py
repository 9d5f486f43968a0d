"""How a task is drawn on a page that plays: a plain record, filled by `env.viewer()`.

The page brings what every task has: time and its controls, rewards by name, the policy's memory.
A task says what its world looks like at each moment, and which drawing shows that.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from .. import require
from ..types import Trace

Shape = Literal[
    *("dot", "ring", "square", "box", "diamond", "rhombus", "star", "arrow"),
    *("line", "dashed", "tick", "cross", "plus", "minus"),
]


@dataclass(frozen=True)
class Mark:
    """A line of the legend."""

    shape: Shape
    color: str  # a colour of the page: "ink", "muted", "good", "bad", "c0" … "c6"
    text: str  # what it means


@dataclass(frozen=True)
class Viewer:
    """How episodes of one task are drawn."""

    drawing: str
    """One of Credo's ("rover", "maze", "fleet", "sequence"), or the path of a script of one's own
    that calls `credo.draw(world)`: see `credo/report/static/viewer.js`."""
    lead: str  # one sentence: what is to be seen
    episode: Callable[[Trace], dict[str, Any]]
    """What the drawing needs of an episode that was recorded: names, numbers and arrays. An array
    with one entry for each moment is the drawing's to look up."""
    task: dict[str, Any] = field(default_factory=dict)  # what it needs of the task
    legend: tuple[Mark, ...] = ()  # every mark that is drawn
    agent: str = "agent"  # what one of a team is called
    rewards: tuple[str, ...] = ()  # those to be shown; (): all
    speed: float = 5.0  # steps per second at first, above 0

    def __post_init__(self):
        require.above("speed", self.speed, 0)
