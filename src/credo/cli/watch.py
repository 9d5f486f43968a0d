"""`credo watch RUN [FILE]`."""

import dataclasses
import math
import pathlib

from .evaluate import in_range
from .export import one_run
from .line import Line


@dataclasses.dataclass
class Watch:
    """Show a run's policy: rovers, mazes, fleets and sequences in a page that plays (.html); tasks
    of Gymnasium, PettingZoo and your own that can draw themselves in a video (.gif, .mp4)."""

    run: str
    file: str | None = None
    _: dataclasses.KW_ONLY
    episodes: int = 1  # at least 1, one after the other
    seed: int = 0  # 0 to 2^32 - 1, of the first episode; the next ones count up
    fps: float | None = None  # steps shown per second, above 0; None: in real time, of rovers 5
    size: tuple[int, int] = (480, 480)  # width and height in pixels, where a task lets us choose
    best: bool = False  # the policy with the highest test score, not the last generation's
    trust: bool = False  # the run was made elsewhere and names code of others: import it

    def __post_init__(self):
        in_range(self)
        if self.fps is not None and not 0 < self.fps < math.inf:
            raise ValueError(f"fps is {self.fps}: it must be more than 0")


def run(line: Line) -> None:
    """Write the page or video, and say where."""
    command = line.command(Watch)
    line.done()
    from ..report import watch

    run = one_run("watch", command.run, trust=command.trust, best=command.best)
    target = pathlib.Path(command.file) if command.file else None
    given = {name: getattr(command, name) for name in ("episodes", "seed", "fps", "size")}
    print(f"wrote {watch.watch(run, target, **given)}")
