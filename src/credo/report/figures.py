"""Figures of a page drawn with matplotlib, as SVG that stands in a page or in a file."""

import io
import itertools
import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from html import escape
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.text import Text as Words
from matplotlib.ticker import EngFormatter, MaxNLocator
from matplotlib.transforms import offset_copy
from numpy.typing import NDArray

from .sections import Curve, Drawing, Figure, HeatMap, Reference, Tracks
from .styles import DARK, DASHES, LIGHT, Look, Theme, assign
from .tables import mean

Floats = NDArray[np.float64]
Plot = Figure | HeatMap | Tracks
Looks = Mapping[str, Look]  # of curves, by label
Paint = Callable[[Canvas, Axes, Theme], None]

WIDTH, HEIGHT = 4.8, 3.1  # inches, without the legend
LINE = 1.8  # points
MOST_POINTS = 250  # drawn per line
MOST_SEED_POINTS = 4_000  # drawn per figure by the lines of single seeds
MOST_TIPS = 100  # points of a curve that a tooltip tells of
FEW_POINTS = 25  # are marked
RESAMPLES = 500  # of a curve's interval, for every point at once
FONT = "system-ui,-apple-system,'Segoe UI',Roboto,'Helvetica Neue',Arial,'DejaVu Sans',sans-serif"
MARKERS = ("o", "^", "D", "v", "p", "P")  # of tracks
WALKERS, GOAL = (0, 2, 3, 1, 5), 4  # their colours, and that of their goal, of a theme's curves


class Picture(NamedTuple):
    """A figure as drawn: an `<svg>` element, and what `tips` says of it."""

    svg: str
    tips: dict[str, Any] | None


class Sampled(NamedTuple):
    """What is drawn of a curve: `x`, `centre`, `low`, `high` `[points]`, `runs[seeds, points]`."""

    x: Floats
    runs: Floats
    centre: Floats
    low: Floats
    high: Floats


def picture(
    figure: Plot, theme: Theme, *, prefix: str = "", looks: Looks | None = None, legend: bool = True
) -> Picture:
    """The figure, without its title, as an `<svg>` element that scales with its box.

    Text stays text, and the background is transparent.

    **Arguments:**

    - `prefix`: of every id; several figures in one page need different ones, or their clip paths
      are mixed up.
    - `looks`: of curves by their label, as in the other figures of the page; None: of this figure
      alone.
    - `legend`: whether the picture has one; that of tracks always has.
    """
    with matplotlib.rc_context(theme.rc):
        text = io.StringIO()
        canvas = draw(figure, theme, looks, legend)
        canvas.savefig(text, format="svg", transparent=True)
    return Picture(
        inline(text.getvalue(), description(figure), prefix), tips(figure, canvas.axes[0])
    )


# ------------------------------------------------------------------------------- what it says


def note(figure: Plot) -> str:
    """How to read the figure, below it: what its lines, bands and colours stand for, which curves
    lie on each other, and whether points were left out. "" where there is nothing to say."""
    if isinstance(figure, HeatMap):
        missing = not np.isfinite(np.asarray(figure.values, dtype=np.float64)).all()
        return "Grey: no value." if missing else ""
    if isinstance(figure, Tracks):
        return ""  # its legend says all
    seeds = sorted({np.shape(curve.runs)[0] for curve in figure.curves})
    parts = ["One run per line." if figure.joined else "One run per point."]
    if seeds[-1] > 1:
        count = str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
        band, each = ("Band", "Thin lines") if figure.joined else ("Bars", "Dots")
        parts = [f"Mean over {count} runs. {band}: its 95 % bootstrap interval. {each}: each run."]
    for group in coinciding(figure):
        *others, last = [figure.curves[i].label for i in group]
        parts.append(f"{', '.join(others)} and {last} coincide.")
    longest = max(np.shape(curve.x)[0] for curve in figure.curves)
    if longest > drawn_points(figure):
        parts.append(f"Up to {drawn_points(figure)} of {longest:,} points are drawn, unsmoothed.")
    return " ".join(parts)


def coinciding(figure: Figure) -> list[list[int]]:
    """Indices of curves that lie on each other, each group in the order of the curves.

    Two coincide if nine tenths of their points are within half a percent of the figure's height,
    and they share half of the x-axis or more. A curve is compared with the first one of a group.
    """
    drawn = [sampled(c, drawn_points(figure)) for c in figure.curves]
    centres = np.concatenate([curve.centre for curve in drawn])
    levels = [level.value for level in figure.references]
    present = [*centres[np.isfinite(centres)], *levels] or [0.0]
    near = 0.005 * (max(present) - min(present))
    groups: list[list[int]] = []
    for i, curve in enumerate(drawn):
        alike = (group for group in groups if near_each_other(curve, drawn[group[0]], near))
        group = next(alike, None)
        if group is None:
            groups.append([i])
        else:
            group.append(i)
    return [group for group in groups if len(group) > 1]


def near_each_other(curve: Sampled, other: Sampled, near: float) -> bool:
    """Whether nine tenths of a curve are no further than `near` from another one, which is read
    between its points. At least half of its points must lie beside the other curve."""
    inside = (curve.x >= other.x[0]) & (curve.x <= other.x[-1])
    apart = np.abs(curve.centre - np.interp(curve.x, other.x, other.centre))[inside]
    apart, count = apart[np.isfinite(apart)], np.isfinite(curve.centre).sum()
    return bool(2 * len(apart) >= count > 0 and np.mean(apart <= near) >= 0.9)


def description(figure: Plot) -> str:
    """One sentence for those who cannot see the figure: what is drawn against what, and the names
    of curves and levels. It is the label of the `<svg>` element."""
    what = f"{figure.title}: " if figure.title else ""
    if isinstance(figure, HeatMap):
        rows, columns = np.shape(figure.values)
        return (
            f"{what}heat map, {rows} rows ({figure.y_label}), {columns} columns ({figure.x_label})"
        )
    if isinstance(figure, Tracks):
        who, (good, _) = ", ".join(track.label for track in figure.tracks), figure.outcomes
        return (
            f"{what}{figure.y_label} of {who} against {figure.x_label}; {figure.goal_label} {good} "
            f"in {sum(bool(x) for x in figure.reached)} of {len(figure.reached)}"
        )
    curves = ", ".join(curve.label for curve in figure.curves)
    levels = ", ".join(f"{line.label} at {line.value:.4g}" for line in figure.references)
    return f"{what}{figure.y_label} against {figure.x_label}; curves: {curves}" + (
        f"; references: {levels}" if levels else ""
    )


def tips(figure: Plot, axes: Axes) -> dict[str, Any] | None:
    """What a tooltip tells, as JSON can hold it, for `static/page.js`.

    `box` is the axes' left, top, width and height as shares of the picture's. Of curves, `x` is the
    range of the axis and `curves` has their values in words; of a heat map, `rows` and `columns`
    are names and `values[rows, columns]` words. None of tracks, beside which is a table.
    """
    place = axes.get_position()
    box = [round(v, 4) for v in (place.x0, 1 - place.y1, place.width, place.height)]
    if isinstance(figure, HeatMap):
        values = [[f"{v:.4g}" for v in row] for row in np.asarray(figure.values, np.float64)]
        rows, columns = (
            [f"{name} {label}" for label in labels]
            for name, labels in (
                (figure.y_label, figure.row_labels),
                (figure.x_label, figure.column_labels),
            )
        )
        return {"box": box, "rows": rows, "columns": columns, "values": values}
    if isinstance(figure, Tracks):
        return None
    range_ = [float(v) for v in axes.get_xlim()]
    curves = [curve_tips(curve, figure) for curve in figure.curves]
    return {"box": box, "x": range_, "name": figure.x_label, "curves": curves}


def curve_tips(curve: Curve, figure: Figure) -> dict[str, Any]:
    """The values of one curve in words, at no more than `MOST_TIPS` of its points: the mean with
    its interval, `0.53 [0.51, 0.55]`; "" where a seed has no value."""
    shown = sampled(curve, drawn_points(figure))
    every = -(-len(shown.x) // MOST_TIPS)
    texts = []
    for value, low, high in zip(shown.centre, shown.low, shown.high, strict=True):
        band = f" [{low:.4g}, {high:.4g}]" if math.isfinite(low) else ""
        texts.append(f"{value:.4g}{band}".replace("-", "−") if math.isfinite(value) else "")
    return {"x": [float(f"{x:.6g}") for x in shown.x[::every]], "text": texts[::every]}


def drawing(title: str, label: str, paint: Paint, caption: str, height: float = 2.9) -> Drawing:
    """A picture in both colourings, `height` inches high; `paint` draws it. `label`: for those who
    cannot see it."""
    prefix, made = re.sub(r"\W+", "-", title.lower()), []
    for name, theme in (("light", LIGHT), ("dark", DARK)):
        text = io.StringIO()
        with matplotlib.rc_context(theme.rc):
            canvas = Canvas(figsize=(WIDTH, height), layout="constrained")
            FigureCanvasAgg(canvas)
            paint(canvas, canvas.add_subplot(), theme)
            canvas.savefig(text, format="svg", transparent=True)
        made.append(inline(text.getvalue(), label, f"{name}-{prefix}-"))
    return Drawing(title, made[0], made[1], caption)


def inline(svg: str, label: str, prefix: str) -> str:
    """matplotlib's SVG file as an element that can stand in a page beside others.

    **Arguments:** `svg`: the file's text; `label`: for those who cannot see the picture; `prefix`:
    of every id, and of what refers to one.
    """
    svg = svg[svg.index("<svg") :]
    # The style sheet would act on the whole page: its two rules move to the root.
    svg = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>|<style.*?</style>", "", svg, flags=re.S)
    opening, rest = svg.split(">", 1)
    box = re.search(r'viewBox="[^"]*"', opening)
    root = (
        f'<svg xmlns="http://www.w3.org/2000/svg" {box[0] if box else ""} role="img" '
        f'aria-label="{escape(label)}" stroke-linejoin="round" stroke-linecap="butt">'
    )
    # Inside tags only: a label may hold anything.
    rest = re.sub(r"<[^>]+>", lambda tag: compact(tag[0], prefix), rest)
    return root + re.sub(r">\s*\n\s*<", "><", rest).strip()


def compact(tag: str, prefix: str) -> str:
    """A tag with its ids prefixed, generic fonts, and coordinates to a tenth of a point."""
    tag = re.sub(r'\b(id="|xlink:href="#|url\(#)', rf"\g<1>{prefix}", tag)
    tag = tag.replace("xlink:href", "href").replace("base64,\n", "base64,")
    tag = re.sub(r"font-family: [^;\"]*", f"font-family: {FONT}", tag)
    return re.sub(r"(\.\d)\d+| \n", r"\1", tag) if tag.startswith("<path") else tag


# ------------------------------------------------------------------------------------ drawing


def draw(figure: Plot, theme: Theme, looks: Looks | None = None, legend: bool = True) -> Canvas:
    """The figure on a canvas of its own, with no title. Arguments as of `picture`, which sets the
    theme's settings of matplotlib around it."""
    canvas = Canvas(figsize=(WIDTH, HEIGHT), layout="constrained")
    FigureCanvasAgg(canvas)  # measures text; saving as SVG brings its own
    axes = canvas.add_subplot()
    axes.set_xlabel(textwrap.fill(figure.x_label, 54))
    axes.set_ylabel(textwrap.fill(figure.y_label, 34))
    if isinstance(figure, HeatMap):
        draw_heat_map(canvas, axes, figure, theme)
    elif isinstance(figure, Tracks):
        add_legend(canvas, draw_tracks(canvas, axes, figure, theme))
    else:
        lines = draw_curves(canvas, axes, figure, theme, looks)
        if legend:
            named = zip(lines, figure.curves, strict=True)
            add_legend(canvas, [line for line, curve in named if curve.label.strip()])
        label_references(canvas, axes, figure.references, theme)
    return canvas


def side_by_side(figures: Sequence[Figure], titles: Sequence[str], theme: Theme) -> Canvas:
    """Several figures with one legend, for a README or a paper; a curve looks the same in all.
    Their levels have no names. To be called with the theme's settings of matplotlib."""
    canvas = Canvas(figsize=(3.0 * len(figures), 2.4), layout="constrained")
    FigureCanvasAgg(canvas)
    looks = assign(curve.label for figure in figures for curve in figure.curves)
    legend: dict[str, Line2D] = {}
    panels = canvas.subplots(1, len(figures), squeeze=False)[0]
    for axes, figure, title in zip(panels, figures, titles, strict=True):
        axes.set_title(title)
        axes.set_xlabel(figure.x_label)
        for curve, line in zip(
            figure.curves, draw_curves(canvas, axes, figure, theme, looks), strict=True
        ):
            legend.setdefault(curve.label, line)
    panels[0].set_ylabel(figures[0].y_label)
    add_legend(canvas, list(legend.values()))
    return canvas


def draw_curves(
    canvas: Canvas, axes: Axes, figure: Figure, theme: Theme, looks: Looks | None
) -> list[Line2D]:
    """All curves and levels on one pair of axes.

    **Returns:** the line of each curve, which stands for it in a legend. What belongs to curve `i`
    has ids that begin with `curve-i-`, by which the page's script hides it.
    """
    looks = looks or assign(curve.label for curve in figure.curves)
    together = coinciding(figure)
    lines: list[Line2D] = []
    for i, curve in enumerate(figure.curves):
        # Of curves that coincide each is drawn inside the one before; dots stand beside others'.
        inside = sum(len(group) - 1 - group.index(i) for group in together if i in group)
        shift = 3.0 * (i - (len(figure.curves) - 1) / 2)  # points
        beside = offset_copy(axes.transData, fig=canvas, x=shift, units="points")
        place = {} if figure.joined else {"transform": beside}
        artists = draw_curve(
            axes, curve, figure, theme, looks[curve.label], LINE + 2.0 * inside, place
        )
        for count, artist in enumerate(artists):
            artist.set_gid(f"curve-{i}-{count}")
        lines.append(artists[-1])
    axes.grid(axis="y")
    axes.margins(x=0.02)
    scale(axes, figure)
    for line in figure.references:
        axes.axhline(line.value, color=theme.muted, linewidth=1, dashes=(4, 3), zorder=1.5)
    return lines


def scale(axes: Axes, figure: Figure) -> None:
    """Ticks that a reader expects, and the range that was asked for, widened for the levels."""
    places = np.unique(np.concatenate([np.asarray(c.x, np.float64) for c in figure.curves]))
    if not figure.joined and len(places) <= 9:
        axes.set_xticks(places)
        beside = 0.06 * (places[-1] - places[0]) or 0.5  # room for dots that are moved aside
        axes.set_xlim(places[0] - beside, places[-1] + beside)
    elif np.all(places == np.round(places)):
        axes.xaxis.set_major_locator(MaxNLocator(8, integer=True, steps=[1, 2, 2.5, 5, 10]))
    if figure.y_range is not None:
        levels = [*figure.y_range, *(line.value for line in figure.references)]
        low, high = min(levels), max(levels)
        axes.set_ylim(low - 0.03 * (high - low), high + 0.03 * (high - low))
    shorten_ticks(axes.xaxis)
    shorten_ticks(axes.yaxis)


def draw_curve(
    axes: Axes,
    curve: Curve,
    figure: Figure,
    theme: Theme,
    look: Look,
    width: float,
    place: Mapping[str, Any],
) -> list[Any]:
    """Runs, interval and, last, the mean of one curve.

    **Arguments:** `width`: of the line, in points; `place`: a transform for dots and bars that
    stand beside those of other curves, {} where runs are lines.
    """
    shown = sampled(curve, drawn_points(figure))
    color = theme.curves[look.color]
    artists: list[Any] = []
    if len(shown.runs) > 1:
        artists = (draw_lines if figure.joined else draw_dots)(axes, shown, figure, color, place)
    few = np.isfinite(shown.centre).sum() <= FEW_POINTS
    style: dict[str, Any] = {"marker": "o", "ms": 2.0 + width} if few else {}
    style |= {} if figure.joined else {"alpha": 0.9}
    # Dashes are in widths of the line, and as long as those of any other.
    dashes = [x * LINE / width for x in DASHES[look.dash]]
    label = textwrap.fill(curve.label, 56)
    style |= {"color": color, "lw": width, "dashes": dashes, "label": label, "zorder": 3}
    if place:  # Matplotlib leaves what has a transform of its own out of the limits
        values = np.vstack(shown[1:])
        axes.update_datalim(np.column_stack([np.tile(shown.x, len(values)), values.ravel()]))
        axes.autoscale_view()
    return [*artists, *axes.plot(shown.x, shown.centre, **style, **place)]


def draw_lines(
    axes: Axes, shown: Sampled, figure: Figure, color: str, place: Mapping[str, Any]
) -> list[Artist]:
    """A thin line for each run, fainter where there are many, and the band of their interval."""
    several = sum(np.shape(other.runs)[0] for other in figure.curves) > 20
    thin: dict[str, Any] = {"lw": 0.6, "alpha": 0.2 if several else 0.35, "zorder": 2}
    band: dict[str, Any] = {"alpha": 0.18, "lw": 0, "zorder": 2.5}
    return [
        *axes.plot(shown.x, shown.runs.T, color=color, **thin, **place),
        axes.fill_between(shown.x, shown.low, shown.high, color=color, **band, **place),
    ]


def draw_dots(
    axes: Axes, shown: Sampled, figure: Figure, color: str, place: Mapping[str, Any]
) -> list[Artist]:
    """A dot for each run, and a bar for their interval."""
    dots: dict[str, Any] = {"lw": 0, "marker": "o", "mew": 0, "ms": 3, "alpha": 0.45}
    bars: dict[str, Any] = {"lw": 1.2, "zorder": 2.5}
    return [
        *axes.plot(shown.x, shown.runs.T, color=color, zorder=2, **dots, **place),
        axes.vlines(shown.x, shown.low, shown.high, colors=color, **bars, **place),
    ]


def drawn_points(figure: Figure) -> int:
    """Points per line, between 40 and `MOST_POINTS`, so that many lines do not make a heavy
    page."""
    lines = sum(np.shape(curve.runs)[0] for curve in figure.curves)
    return int(np.clip(MOST_SEED_POINTS // lines, 40, MOST_POINTS))


@lru_cache(maxsize=64)
def sampled(curve: Curve, points: int) -> Sampled:
    """At most `points` of a curve, evenly spread over the axis, the ends among them.

    Points are picked, not averaged: a smoothed curve would be another result.
    """
    x = np.asarray(curve.x, dtype=np.float64)
    runs = np.asarray(curve.runs, dtype=np.float64)
    if len(x) > points:
        chosen = np.searchsorted(x, np.linspace(x[0], x[-1], points))
        chosen = np.union1d(np.clip(chosen, 0, len(x) - 1), [0, len(x) - 1])
        x, runs = x[chosen], runs[:, chosen]
    runs = np.where(np.isfinite(runs), runs, np.nan)
    return Sampled(x, runs, *mean(runs, RESAMPLES))


def shorten_ticks(axis: Axis) -> None:
    """20k and 1M for 20000 and 1e6, on an axis that reaches 10,000 or more."""
    if np.max(np.abs(axis.get_view_interval())) >= 1e4:
        axis.set_major_formatter(EngFormatter(sep=""))


def add_legend(canvas: Canvas, handles: Sequence[Artist]) -> None:
    """A legend below the axes, in as many columns as fit, four at most; the canvas grows by its
    height. None without handles."""
    for most in range(min(len(handles), 4), 0, -1):
        rows = math.ceil(len(handles) / most)
        columns = math.ceil(len(handles) / rows)
        legend = canvas.legend(handles=handles, ncols=columns, loc="outside lower center")
        extent = legend.get_window_extent()
        if columns == 1 or extent.width <= 0.96 * canvas.bbox.width:
            canvas.set_figheight(canvas.get_figheight() + extent.height / canvas.dpi)
            return
        legend.remove()


def label_references(
    canvas: Canvas, axes: Axes, references: Sequence[Reference], theme: Theme
) -> None:
    """Names at the right end of the reference lines, moved apart where they would overlap; a thin
    line leads from each to its level. Constrained layout makes room for them."""
    lines = sorted(references, key=lambda line: line.value)
    bottom, top = axes.get_ylim()
    ends = [(line.value - bottom) / (top - bottom) for line in lines]
    leader = {"arrowstyle": "-", "color": theme.muted, "linewidth": 0.8, "shrinkA": 0, "shrinkB": 0}
    leader["relpos"] = (0.0, 0.5)  # it ends at the left of the name, not in the middle of it
    style: dict[str, Any] = {"va": "center", "fontsize": 9, "color": theme.muted}
    style |= {"xycoords": "axes fraction", "annotation_clip": False, "arrowprops": leader}
    labels = [
        axes.annotate(textwrap.fill(line.label, 15), (1.0, end), (1.05, end), **style)
        for line, end in zip(lines, ends, strict=True)
    ]
    canvas.draw_without_rendering()
    height = axes.get_window_extent().height
    # The extent of an annotation includes its leader line, that of its text does not.
    heights = [Words.get_window_extent(label).height / height for label in labels]
    places = spread_out(ends, [share + 0.015 for share in heights])
    for label, place in zip(labels, places, strict=True):
        label.xyann = (1.05, place)


def spread_out(centres: Sequence[float], heights: Sequence[float]) -> list[float]:
    """`centres`, ascending, moved as little as a sweep up and a sweep down need so that boxes
    of these heights do not overlap and, if there is room, stay within [0, 1]."""
    places = list(centres)
    for i in range(1, len(places)):
        places[i] = max(places[i], places[i - 1] + (heights[i] + heights[i - 1]) / 2)
    for i in reversed(range(len(places))):
        limit = 1.0 if i == len(places) - 1 else places[i + 1] - heights[i + 1] / 2
        places[i] = min(places[i], limit - heights[i] / 2)
    return places


def draw_heat_map(canvas: Canvas, axes: Axes, figure: HeatMap, theme: Theme) -> None:
    """One rectangle a cell, a bar that explains their colours, and labels. The canvas is as high as
    the rows need: 0.2 inches each, within limits."""
    values = np.asarray(figure.values, dtype=np.float64)
    values = np.where(np.isfinite(values), values, np.nan)
    height = float(np.clip(0.65 + 0.2 * len(values), 1.65, 5.35))  # inches, of the cells
    canvas.set_size_inches(WIDTH, height + 0.65)
    cmap, low, high = color_scale(values, theme)
    # "none" embeds one pixel per cell, which the browser enlarges without blurring it.
    look: dict[str, Any] = {"cmap": cmap, "aspect": "auto", "interpolation": "none"}
    image = axes.imshow(values, vmin=low, vmax=high, **look)
    axes.spines[:].set(visible=True, color=theme.grid)
    bar = canvas.colorbar(image, ax=axes, fraction=0.1, pad=0.02, aspect=height / 0.12)
    # The bar's own 256 rectangles would be most of the file.
    bar.solids.remove()  # type: ignore[union-attr]
    scale = np.linspace(low, high, 256)[:, None]
    bar.ax.imshow(scale, origin="lower", extent=(0.0, 1.0, low, high), **look)
    bar.outline.set(edgecolor=theme.grid, linewidth=0.8)  # type: ignore[operator]
    bar.ax.tick_params(length=3)
    shorten_ticks(bar.ax.yaxis)
    label_cells(canvas, axes, figure, height)


def draw_tracks(canvas: Canvas, axes: Axes, figure: Tracks, theme: Theme) -> list[Artist]:
    """Everybody, the goals and the breaks.

    Marks in one cell stand beside and below each other, in as many columns as make them largest;
    a faint line joins those of one track. Scripted ones are crosses of the text's colour.

    **Returns:** what stands for goals and tracks in the legend.
    """
    rows, columns = len(figure.row_labels), len(figure.column_labels)
    cell = 3.9 / columns  # inches; about what the axes have
    height = float(np.clip(rows * max(cell, 0.24), 1.3, 4.0))
    canvas.set_size_inches(WIDTH, height + 0.6)
    draw_cells(axes, figure, theme)
    # Everybody has a place of their own in a cell: who are in one cell do not hide each other.
    n, row = len(figure.tracks), height / rows
    wide = max(range(n, 0, -1), key=lambda wide: min(cell / wide, row / -(-n // wide)))
    high = -(-n // wide)
    size = min(0.8 * 72 * min(cell / wide, row / high), 9.0)
    handles = draw_goals(axes, figure, theme)
    colors = itertools.cycle(theme.curves[i] for i in WALKERS)
    learners = zip(itertools.cycle(MARKERS), colors, strict=False)
    for i, track in enumerate(figure.tracks):
        x = np.arange(columns) + (i % wide + 0.5) / wide - 0.5
        y = np.asarray(track.rows) + (i // wide + 0.5) / high - 0.5
        marker, color = ("X", theme.ink) if track.scripted else next(learners)
        look: dict[str, Any] = {"marker": marker, "color": color, "mec": theme.page}
        axes.plot(x, y, **look, lw=0.8, alpha=0.3, ms=0, zorder=3)
        axes.plot(x, y, **look, lw=0, ms=size, mew=0.12 * size, zorder=4)
        label = textwrap.fill(track.label, 56)
        handles.append(Line2D([], [], **look, lw=0, ms=7, mew=0.7, label=label))
    label_cells(canvas, axes, figure, height)
    return handles


def draw_cells(axes: Axes, figure: Tracks, theme: Theme) -> None:
    """The grid of tracks, row 0 at the top, and a line at each break."""
    rows, columns = len(figure.row_labels), len(figure.column_labels)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
    axes.spines[:].set(visible=True, color=theme.grid)
    axes.set_xticks(np.arange(0.5, columns - 1), minor=True)
    axes.set_yticks(np.arange(0.5, rows - 1), minor=True)
    axes.tick_params(which="minor", length=0)
    axes.grid(which="minor")
    for at in figure.breaks:
        axes.axvline(at - 0.5, color=theme.ink, linewidth=1.2, zorder=2.5)


def draw_goals(axes: Axes, figure: Tracks, theme: Theme) -> list[Artist]:
    """The goal of each column as a square, filled and in a coloured column where it was reached;
    and what stands for both in the legend."""
    gold = theme.curves[GOAL]
    labels = (f"{figure.goal_label}, {outcome}" for outcome in figure.outcomes)
    # Of full colour or dashed as well: not everybody tells colours apart.
    looks: dict[bool, dict[str, Any]] = {
        True: {"fc": gold, "ec": gold, "alpha": 0.75, "lw": 0},
        False: {"fc": theme.grid, "ec": theme.muted, "ls": (0, (2, 1.5)), "lw": 0.8},
    }
    for x, (row, reached) in enumerate(zip(figure.goals, figure.reached, strict=True)):
        if reached:
            column = (x - 0.5, -0.5), 1, len(figure.row_labels)
            axes.add_patch(Rectangle(*column, fc=gold, alpha=0.16, lw=0, zorder=1))
        square = (x - 0.46, row - 0.46), 0.92, 0.92
        axes.add_patch(Rectangle(*square, **looks[bool(reached)], zorder=2))
    return [
        Rectangle((0, 0), 1, 1, **looks[reached], label=textwrap.fill(label, 56))
        for reached, label in zip((True, False), labels, strict=True)
    ]


def color_scale(values: Floats, theme: Theme) -> tuple[Colormap, float, float]:
    """Colours of a heat map, and the values of the first and the last one.

    From the page's own colour to a strong one; values of both signs meet at zero, where the page's
    colour is. NaN is grey. Where all values are one, the scale is one wide.
    """
    present = values[~np.isnan(values)]
    low, high = (present.min(), present.max()) if present.size else (0.0, 1.0)
    stops = [theme.page, theme.cold]
    if low < 0.0 < high:
        high = max(-low, high)
        low, stops = -high, [theme.cold, theme.page, theme.warm]
    elif high <= 0.0 and low < 0.0:
        stops.reverse()
    if low == high:
        low, high = low - 0.5, high + 0.5
    colors = LinearSegmentedColormap.from_list("page", stops).with_extremes(bad=theme.muted)
    return colors, float(low), float(high)


def label_cells(canvas: Canvas, axes: Axes, figure: HeatMap | Tracks, height: float) -> None:
    """As many row and column labels as are readable: all, turned, or every n-th. `height`: of all
    rows, in inches. The canvas grows where labels are turned."""
    rows, columns = len(figure.row_labels), len(figure.column_labels)
    every = nice_step(rows * 0.17 / height)
    axes.set_yticks(range(0, rows, every), [shortened(x) for x in figure.row_labels[::every]])
    labels = [shortened(label) for label in figure.column_labels]
    cell = 3.4 * 72 / columns  # points; 3.4 inches are about what the axes have
    needed = 5.5 * max(map(len, labels)) + 6
    turned = needed > cell >= 11 and columns <= 24
    every = 1 if turned else nice_step(needed / cell)
    axes.set_xticks(range(0, columns, every), labels[::every])
    if turned:
        canvas.set_figheight(canvas.get_figheight() + needed / 72)
        for label in axes.get_xticklabels():
            label.set(rotation=90, rotation_mode="anchor", ha="right", va="center")


def shortened(label: object) -> str:
    """A label of at most 24 characters."""
    text = str(label)
    return text if len(text) <= 24 else f"{text[:23].rstrip()}…"


def nice_step(least: float) -> int:
    """The first of 1, 2, 5, 10, 20, 50, … that is `least` or more."""
    steps = (step * 10**power for power in itertools.count() for step in (1, 2, 5))
    return next(step for step in steps if step >= least)
