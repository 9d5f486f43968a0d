"""Paths of rovers as a figure (Figure 7.5 of the dissertation), and the pictures of a film."""

import io
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from ..environments.rover import Rover
from .figures import inline
from .styles import DARK, LIGHT, Theme

SIDE = 4.2  # inches
SEEN = {LIGHT: "#c8102e", DARK: "#ff6b78"}  # an observed POI
ARROW = np.array([(11, 0), (-7, 6.5), (-4, 0), (-7, -6.5), (11, 0)])  # a rover that heads along +x


def trajectories(
    position: ArrayLike,
    poi: ArrayLike,
    observed: ArrayLike,
    *,
    activation_distance: float,
    size: float,
    title: str = "",
    dark: bool = False,
    prefix: str = "",
) -> str:
    """Where rovers drove, as an `<svg>` element that scales with its box: a dot where each
    started, POIs red if they were observed and black (on a dark page: light) if not, and a ring of
    their activation distance.

    **Arguments:**

    - `position` `[steps + 1, rovers, 2]`, `poi` `[pois, 2]`, `activation_distance`, `size` (a side
      of the field): metres. `observed` `[pois]`: at the end.
    - `title`: for those who cannot see the figure; a page writes its own above it.
    - `prefix`: of every id in it; figures in one page need different ones.

    **Raises:** `ValueError` if shapes do not fit or a number is not finite.
    """
    position, poi = np.asarray(position, np.float64), np.asarray(poi, np.float64)
    observed, theme = np.asarray(observed, bool), DARK if dark else LIGHT
    _check(position, poi, observed)
    svg = io.StringIO()
    with matplotlib.rc_context(theme.rc):
        canvas = Canvas(figsize=(SIDE, SIDE), layout="constrained")
        FigureCanvasAgg(canvas)
        axes = canvas.add_subplot()
        _field(axes, position, poi, activation_distance, size, theme)
        _pois(axes, poi, observed, activation_distance, theme)
        _paths(axes, position, theme)
        canvas.savefig(svg, format="svg", transparent=True)
    label = f"paths of {position.shape[1]} rovers; {np.sum(observed)} of {len(poi)} POIs observed"
    return inline(svg.getvalue(), f"{title}: {label}" if title else label, prefix)


def _check(position: np.ndarray, poi: np.ndarray, observed: np.ndarray) -> None:
    """Raise `ValueError` unless these can be drawn."""
    if position.ndim != 3 or position.shape[2] != 2 or 0 in position.shape:
        raise ValueError(f"position has shape {position.shape}: give [steps + 1, rovers, 2]")
    if poi.ndim != 2 or poi.shape[1] != 2 or observed.shape != poi.shape[:1]:
        raise ValueError(
            f"poi has shape {poi.shape} and observed {observed.shape}: give [pois, 2] and [pois]"
        )
    if not (np.isfinite(position).all() and np.isfinite(poi).all()):
        raise ValueError("a position is not finite: draw an episode without NaN")


def pictures(
    env: Rover,
    shown: Mapping[str, np.ndarray],
    name: str,
    moments: Iterable[int],
    size: tuple[int, int],
) -> Iterator[np.ndarray]:
    """Pictures `[height, width, 3]`, uint8, of an episode at these moments.

    **Arguments:** `shown`: what `Rover.shown` says of it; `name`: of the episode; `size`: width and
    height in pixels.
    """
    reach, side = (float(np.asarray(x)) for x in (env.activation_distance, env.size))
    width, height = size
    left, bottom, top = min(0.2, 44 / width), min(0.2, 44 / height), 1 - min(0.2, 28 / height)
    position, poi, last = shown["position"], shown["poi"], len(shown["position"]) - 1
    for t in moments:
        with matplotlib.rc_context(LIGHT.rc):
            canvas = Canvas(figsize=(width / 100, height / 100), dpi=100, facecolor=LIGHT.page)
            axes = canvas.add_axes((left, bottom, 0.98 - left, top - bottom))
            _field(axes, position, poi, reach, side, LIGHT)
            _pois(axes, poi, shown["observed"][t], reach, LIGHT)
            _counts(axes, env, shown, t)
            _paths(axes, position[: t + 1], LIGHT, shown["heading"][t])
            text = f"{name}, step {t} of {last}: global reward {shown['share'][t]:.2f}"
            axes.set_title(text, fontsize=9.5)
            agg = FigureCanvasAgg(canvas)
            agg.draw()
        yield np.array(agg.buffer_rgba())[:, :, :3]


def _field(
    axes: Axes, position: np.ndarray, poi: np.ndarray, reach: float, size: float, theme: Theme
) -> None:
    """A square view of the field, `size` metres wide, and of what lies outside it: all positions
    and rings fit in. Ticks are in metres; the page shows through."""
    around = [np.zeros((1, 2)), np.full((1, 2), size), position.reshape(-1, 2)]
    points = np.concatenate([*around, poi - reach, poi + reach])
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (low + high) / 2, 0.52 * np.max(high - low)
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
    axes.set(aspect="equal", xlabel="m")
    axes.patch.set_visible(False)  # the page shows through
    axes.spines[:].set_visible(False)
    axes.add_patch(Rectangle((0, 0), size, size, fill=False, ec=theme.muted, lw=0.8, zorder=1))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    axes.grid()


def _pois(axes: Axes, poi: np.ndarray, observed: np.ndarray, reach: float, theme: Theme) -> None:
    """POIs and the rings inside which rovers count: red and solid where `observed[pois]`."""
    for place, seen in zip(poi, observed, strict=True):
        color = SEEN[theme] if seen else theme.ink
        axes.add_patch(Circle(place, reach, fc=color, alpha=0.08, lw=0, zorder=1.5))
        dashes: Any = "solid" if seen else (0, (4, 3))
        axes.add_patch(Circle(place, reach, fill=False, ec=color, lw=0.9, ls=dashes, zorder=1.6))
        # Filled or hollow as well: red and black alone are not told apart by everybody.
        fill = color if seen else "none"
        axes.plot(*place, marker="D", ms=6, mfc=fill, mec=color, mew=1.5, zorder=4)


def _counts(axes: Axes, env: Rover, shown: Mapping[str, np.ndarray], t: int) -> None:
    """Below each POI, how many rovers are inside its ring at step `t`, of those that it takes; or
    that it was observed."""
    offset = {"textcoords": "offset points", "xytext": (0, -16), "ha": "center", "fontsize": 8}
    now = (shown["poi"], shown["observed"][t], shown["inside"][t], env.needed)
    for place, seen, inside, needed in zip(*now, strict=True):
        text = "observed" if seen else f"{inside} of {needed}"
        axes.annotate(text, place, color=SEEN[LIGHT] if seen else LIGHT.ink, zorder=5, **offset)


def _paths(
    axes: Axes, position: np.ndarray, theme: Theme, heading: np.ndarray | None = None
) -> None:
    """A line for each rover of `position[steps, rovers, 2]` and a dot at its start; where
    `heading[rovers]` (radians) is given, a rover at its end instead."""
    for i in range(position.shape[1]):
        x, y = position[:, i].T
        color = theme.curves[i % len(theme.curves)]
        axes.plot(x, y, color=color, linewidth=1.4, zorder=3, solid_joinstyle="round")
        look: dict[str, Any] = {"color": color, "mec": theme.page, "mew": 0.8}
        if heading is None:
            axes.plot(x[0], y[0], marker="o", ms=5, zorder=3.5, **look)
        else:
            cos, sin = np.cos(heading[i]), np.sin(heading[i])
            arrow: Any = ARROW @ np.array([[cos, sin], [-sin, cos]])
            axes.plot(x[-1], y[-1], marker=arrow, ms=13, zorder=6, **look)
