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
from .figures import DARK, LIGHT, STYLE, Theme, inline

SIDE = 4.2  # inches
SEEN = {LIGHT: "#c8102e", DARK: "#ff6b78"}  # an observed POI
ARROW = ((11, 0), (-7, 6.5), (-4, 0), (-7, -6.5))  # a rover that heads along +x


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
    svg = io.StringIO()
    with matplotlib.rc_context(STYLE):
        canvas = _drawn(position, poi, observed, activation_distance, size, dark)
        canvas.savefig(svg, format="svg", transparent=True)
    seen, pois, rovers = np.sum(observed), len(np.asarray(poi)), np.shape(position)[1]
    label = f"paths of {rovers} rovers; {seen} of {pois} POIs observed"
    return inline(svg.getvalue(), f"{title}: {label}" if title else label, prefix)


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
    canvas = Canvas(figsize=(width / 100, height / 100), dpi=100, facecolor=LIGHT.page)
    agg = FigureCanvasAgg(canvas)
    left, bottom, top = min(0.2, 44 / width), min(0.2, 44 / height), 1 - min(0.2, 28 / height)
    position, last = shown["position"], len(shown["position"]) - 1
    for t in moments:
        with matplotlib.rc_context(STYLE):
            canvas.clear()
            axes = canvas.add_axes((left, bottom, 0.98 - left, top - bottom))
            _field(axes, position, shown["poi"], reach, side, LIGHT)
            _pois(axes, shown["poi"], shown["observed"][t], reach, LIGHT)
            _counts(axes, env, shown, t)
            _paths(axes, position[: t + 1], LIGHT, shown["heading"][t])
            text = f"{name}, step {t} of {last}: global reward {shown['share'][t]:.2f}"
            axes.set_title(text, color=LIGHT.ink, fontsize=9.5)
            agg.draw()
        yield np.array(agg.buffer_rgba())[:, :, :3]


def _drawn(position, poi, observed, reach: float, size: float, dark: bool) -> Canvas:
    position, poi = np.asarray(position, np.float64), np.asarray(poi, np.float64)
    observed, theme = np.asarray(observed, bool), DARK if dark else LIGHT
    if position.ndim != 3 or position.shape[2] != 2 or 0 in position.shape:
        raise ValueError(f"position has shape {position.shape}: give [steps + 1, rovers, 2]")
    if poi.ndim != 2 or poi.shape[1] != 2 or observed.shape != poi.shape[:1]:
        raise ValueError(
            f"poi has shape {poi.shape} and observed {observed.shape}: give [pois, 2] and [pois]"
        )
    if not (np.isfinite(position).all() and np.isfinite(poi).all()):
        raise ValueError("a position is not finite: draw an episode without NaN")
    canvas = Canvas(figsize=(SIDE, SIDE), layout="constrained")
    FigureCanvasAgg(canvas)
    axes = canvas.add_subplot()
    _field(axes, position, poi, reach, size, theme)
    _pois(axes, poi, observed, reach, theme)
    _paths(axes, position, theme)
    return canvas


def _field(axes: Axes, position, poi, reach: float, size: float, theme: Theme) -> None:
    """A square view of the field and of what lies outside it."""
    around = [np.zeros((1, 2)), np.full((1, 2), size), position.reshape(-1, 2)]
    points = np.concatenate([*around, poi - reach, poi + reach])
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (low + high) / 2, 0.52 * np.max(high - low)
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
    axes.set_aspect("equal")
    axes.patch.set_visible(False)  # the page shows through
    axes.spines[:].set_visible(False)
    axes.add_patch(Rectangle((0, 0), size, size, fill=False, ec=theme.muted, lw=0.8, zorder=1))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    axes.tick_params(color=theme.muted, labelcolor=theme.ink, length=3)
    axes.set_xlabel("m", color=theme.ink)
    axes.grid(color=theme.grid, linewidth=0.7)
    axes.set_axisbelow(True)


def _pois(axes: Axes, poi, observed, reach: float, theme: Theme) -> None:
    for place, seen in zip(poi, observed, strict=True):
        color = SEEN[theme] if seen else theme.ink
        axes.add_patch(Circle(place, reach, fc=color, alpha=0.08, lw=0, zorder=1.5))
        dashes: Any = "solid" if seen else (0, (4, 3))
        axes.add_patch(Circle(place, reach, fill=False, ec=color, lw=0.9, ls=dashes, zorder=1.6))
        # Filled or hollow as well: red and black alone are not told apart by everybody.
        fill = color if seen else "none"
        axes.plot(*place, marker="D", ms=6, mfc=fill, mec=color, mew=1.5, zorder=4)


def _counts(axes: Axes, env: Rover, shown: Mapping[str, np.ndarray], t: int) -> None:
    offset = {"textcoords": "offset points", "xytext": (0, -16), "ha": "center", "fontsize": 8}
    now = (shown["poi"], shown["observed"][t], shown["inside"][t])
    for place, seen, inside in zip(*now, strict=True):
        text = "observed" if seen else f"{inside} of {env.coupling}"
        axes.annotate(text, place, color=SEEN[LIGHT] if seen else LIGHT.ink, zorder=5, **offset)


def _paths(axes: Axes, position, theme: Theme, heading=None) -> None:
    """A line per rover and a dot at its start; where a heading is given, a rover at its end."""
    for i in range(position.shape[1]):
        x, y = position[:, i].T
        color = theme.curves[i % len(theme.curves)]
        axes.plot(x, y, color=color, linewidth=1.4, zorder=3, solid_joinstyle="round")
        if heading is None:
            axes.plot(
                x[0], y[0], marker="o", ms=5, color=color, mec=theme.page, mew=0.8, zorder=3.5
            )
            continue
        cos, sin = np.cos(heading[i]), np.sin(heading[i])
        arrow: Any = np.array([*ARROW, ARROW[0]]) @ np.array([[cos, sin], [-sin, cos]])
        axes.plot(x[-1], y[-1], marker=arrow, ms=13, color=color, mec=theme.page, mew=0.8, zorder=6)
