"""Pictures of `docs/media` that show committed results.

python docs/extensions/pictures.py      # draws those whose results are there
"""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import matplotlib

from credo.experiments.base import describe
from credo.report.figures import side_by_side
from credo.report.rows import read
from credo.report.sections import Figure
from credo.report.styles import LIGHT

ROOT = pathlib.Path(__file__).resolve().parents[2]
MEDIA = ROOT / "docs" / "media"


class Panel(NamedTuple):
    """A figure of an experiment: the first whose title begins so."""

    experiment: str
    budget: str
    begins: str
    title: str


TASKS = ("Swimmer", "HalfCheetah", "Hopper", "Walker2d")
DENSE, LATE = (
    [Panel(name, "full", f"{task}-v5", task) for task in TASKS]
    for name in ("hybrid-dense", "hybrid-late")
)
SHARED = [Panel("beyond-7-decoys", "full", f"Coupling {n}", f"coupling {n}") for n in (3, 4)]
PICTURES = {
    "hybrid-dense": DENSE,
    "hybrid-late": LATE,
    "hybrid-shared": SHARED,
}


def figure(panel: Panel) -> Figure | None:
    """The figure, or None where there are no results."""
    path = ROOT / "results" / panel.experiment / panel.budget / "results.json"
    sections = describe(read(path)).sections if path.exists() else ()
    found = (x for x in sections if isinstance(x, Figure) and x.title.startswith(panel.begins))
    return next(found, None)


def draw(name: str, panels: Sequence[Panel]) -> bool:
    """Draw a picture; False where results are missing."""
    found = [figure(panel) for panel in panels]
    figures = [x for x in found if x is not None]
    if len(figures) < len(panels):
        return False
    with matplotlib.rc_context(LIGHT.rc):
        canvas = side_by_side(figures, [panel.title for panel in panels], LIGHT)
        canvas.savefig(MEDIA / f"{name}.png", dpi=160, facecolor=LIGHT.page)
    return True


if __name__ == "__main__":
    for name, panels in PICTURES.items():
        print(f"{name}: {'drawn' if draw(name, panels) else 'no results yet'}")
