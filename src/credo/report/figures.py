"""Figures of a page drawn with matplotlib: SVG for the page, PNG for the rest."""

import io
import math
import os
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from pathlib import Path
from typing import Any

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
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from ..analysis.statistics import bootstrap_interval
from ..runs import files
from .page import Curve, Figure, HeatMap, Reference, Tracks

Floats = NDArray[np.float64]
Plot = Figure | HeatMap | Tracks

WIDTH, HEIGHT = 4.8, 3.1  # inches, without the legend
MOST_POINTS = 400  # drawn per line
MOST_SEED_POINTS = 24_000  # drawn per figure by the lines of single seeds
FONT = "system-ui,-apple-system,'Segoe UI',Roboto,'Helvetica Neue',Arial,'DejaVu Sans',sans-serif"
MARKERS = ("o", "^", "D", "v", "p", "P")  # of tracks
WALKERS, GOAL = (0, 2, 3, 1, 5), 4  # their colours, and that of their goal, of a theme's curves
DASHES = ((1, 0), (5, 1.6), (1.3, 1.3), (6, 1.5, 1.3, 1.5))

# `hashsalt` makes the same figure the same text; `parse_math` keeps a $ in a label a $.
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "credo",
    "svg.image_inline": True,
    "text.parse_math": False,
    "text.usetex": False,
    "font.family": ["DejaVu Sans"],
    "font.size": 9.5,
    "axes.labelsize": 9.5,
    "axes.titlesize": 11,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "legend.fontsize": 9,
    "axes.linewidth": 0.8,
    "axes.formatter.limits": (-4, 5),
    "axes.formatter.useoffset": False,
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
}


@dataclass(frozen=True)
class Theme:
    """Colours. The curves are those of Okabe & Ito (2008) without the yellow, told apart by the
    colour-blind; on a dark page the same hues, lighter."""

    ink: str
    muted: str
    grid: str
    page: str
    cold: str  # lowest value of a heat map with both signs
    warm: str  # highest value
    curves: tuple[str, ...]


LIGHT = Theme(
    ink="#1c1f23",
    muted="#59616b",
    grid="#e6e9ec",
    page="#ffffff",
    cold="#005b96",
    warm="#c24a00",
    curves=("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#333333"),
)
DARK = Theme(
    ink="#e4e7eb",
    muted="#a0a8b2",
    grid="#2b3037",
    page="#14171b",
    cold="#58b2f0",
    warm="#f08a4b",
    curves=("#4aa3e6", "#f07f3c", "#22bd8f", "#e097c2", "#f2b441", "#93d3f7", "#e8e8e8"),
)


def figure_svg(figure: Plot, dark: bool = False, *, prefix: str = "") -> str:
    """The figure, without its title, as an `<svg>` element that scales with its box.

    Text stays text. Every id begins with `prefix`: several figures in one page need different
    ones, or their clip paths are mixed up. The background is transparent.
    """
    with matplotlib.rc_context(STYLE):
        text = io.StringIO()
        draw(figure, DARK if dark else LIGHT).savefig(text, format="svg", transparent=True)
    return inline(text.getvalue(), description(figure), prefix)


def save_png(
    figure: Plot, path: str | os.PathLike[str], dark: bool = False, *, dpi: int = 200
) -> Path:
    """Write the figure with its title to `path`; 960 pixels wide at 200 dpi."""
    theme = DARK if dark else LIGHT
    with matplotlib.rc_context(STYLE):
        canvas = draw(figure, theme)
        if figure.title:
            canvas.suptitle(textwrap.fill(figure.title, 56), color=theme.ink, fontsize=11)
        with files.whole(path) as draft:
            canvas.savefig(draft, format="png", dpi=dpi, facecolor=theme.page)
    return Path(path)


def note(figure: Plot) -> str:
    """How to read the figure: what its lines, bands and colours stand for."""
    if isinstance(figure, HeatMap):
        missing = not np.isfinite(np.asarray(figure.values, dtype=np.float64)).all()
        return "Grey: no value." if missing else ""
    if isinstance(figure, Tracks):
        return ""  # its legend says all
    seeds = sorted({np.shape(curve.runs)[0] for curve in figure.curves})
    count = str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]}–{seeds[-1]}"
    parts = ["One seed per line."]
    if seeds[-1] > 1:
        parts = [
            f"Thick: {figure.centre} of {count} seeds; thin: each seed; "
            f"band: 95 % bootstrap interval of the {figure.centre}."
        ]
    longest = max(np.shape(curve.x)[0] for curve in figure.curves)
    if longest > drawn_points(figure):
        parts.append(f"Up to {drawn_points(figure)} of {longest:,} points are drawn, unsmoothed.")
    return " ".join(parts)


def description(figure: Plot) -> str:
    """One sentence for those who cannot see the figure."""
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


def inline(svg: str, label: str, prefix: str) -> str:
    """matplotlib's SVG file as an element that can stand in a page beside others."""
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
    return re.sub(r'(?<=\bd=")[^"]*', short_path, tag)


def short_path(path: re.Match[str]) -> str:
    rounded = re.sub(r"-?\d+\.\d+", lambda number: f"{float(number[0]):.1f}", path[0])
    return re.sub(r"\s*\n\s*|(?<=[A-Za-z]) ", "", rounded.replace(".0", ""))


def draw(figure: Plot, theme: Theme) -> Canvas:
    """The figure on a canvas of its own, with no title."""
    canvas = Canvas(figsize=(WIDTH, HEIGHT), layout="constrained")
    FigureCanvasAgg(canvas)  # measures text; saving as SVG brings its own
    axes = canvas.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(theme.muted)
    axes.tick_params(color=theme.muted, labelcolor=theme.ink, length=3)
    axes.set_xlabel(textwrap.fill(figure.x_label, 54), color=theme.ink)
    axes.set_ylabel(textwrap.fill(figure.y_label, 34), color=theme.ink)
    if isinstance(figure, HeatMap):
        draw_heat_map(canvas, axes, figure, theme)
    elif isinstance(figure, Tracks):
        draw_tracks(canvas, axes, figure, theme)
    else:
        draw_curves(canvas, axes, figure, theme)
    return canvas


def draw_curves(canvas: Canvas, axes: Axes, figure: Figure, theme: Theme) -> None:
    lines = [
        draw_curve(axes, index, curve, figure, theme) for index, curve in enumerate(figure.curves)
    ]
    axes.grid(axis="y", color=theme.grid, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.margins(x=0.02)
    if figure.log_x:
        axes.set_xscale("log")
        axes.xaxis.set_minor_formatter(NullFormatter())
        first, last = axes.get_xlim()
        if last < 300 * first:  # powers of ten alone would be two labels or none
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    if figure.y_range is not None:
        levels = [*figure.y_range, *(line.value for line in figure.references)]
        low, high = min(levels), max(levels)
        axes.set_ylim(low - 0.03 * (high - low), high + 0.03 * (high - low))
    for line in figure.references:
        axes.axhline(line.value, color=theme.muted, linewidth=1, dashes=(4, 3), zorder=1.5)
    shorten_ticks(axes.xaxis, always=figure.log_x)
    shorten_ticks(axes.yaxis)
    named = [line for line, curve in zip(lines, figure.curves, strict=True) if curve.label.strip()]
    add_legend(canvas, named, theme)
    label_references(canvas, axes, figure.references, theme)


def draw_curve(axes: Axes, index: int, curve: Curve, figure: Figure, theme: Theme) -> Line2D:
    """Seeds, interval and centre of one curve; the line that stands for it in the legend."""
    color = theme.curves[index % len(theme.curves)]
    dashes = DASHES[index % len(DASHES)] if len(figure.curves) > 3 else DASHES[0]
    shown = sampled(curve, figure.centre, figure.log_x, drawn_points(figure))
    seeds = sum(np.shape(other.runs)[0] for other in figure.curves)
    marker = {"marker": "o", "markersize": 3.5} if len(shown.x) <= 25 else {}
    if len(shown.runs) > 1:
        alpha = 0.35 if seeds <= 20 else 0.2
        axes.plot(shown.x, shown.runs.T, color=color, linewidth=0.6, alpha=alpha, zorder=2)
        axes.fill_between(shown.x, shown.low, shown.high, color=color, alpha=0.18, lw=0, zorder=2.5)
    (line,) = axes.plot(
        *(shown.x, shown.centre),
        **{"color": color, "linewidth": 1.8, "dashes": dashes, "zorder": 3, **marker},
        label=textwrap.fill(curve.label, 56),
    )
    return line


@dataclass(frozen=True)
class Sampled:
    """What is drawn of a curve: `x`, `centre`, `low`, `high` `[points]`, `runs[seeds, points]`."""

    x: Floats
    runs: Floats
    centre: Floats
    low: Floats
    high: Floats


def drawn_points(figure: Figure) -> int:
    """Points per line, so that many lines do not make a heavy page."""
    lines = sum(np.shape(curve.runs)[0] for curve in figure.curves)
    return int(np.clip(MOST_SEED_POINTS // lines, 100, MOST_POINTS))


@lru_cache(maxsize=64)
def sampled(curve: Curve, centre: str, log_x: bool, points: int) -> Sampled:
    """At most `points` of a curve, evenly spread over the axis, the ends among them.

    Points are picked, not averaged: a smoothed curve would be another result.
    """
    x = np.asarray(curve.x, dtype=np.float64)
    runs = np.asarray(curve.runs, dtype=np.float64)
    if len(x) > points:
        spread = np.geomspace if log_x else np.linspace
        targets = spread(x[0], x[-1], points)
        chosen = np.unique(np.clip(np.searchsorted(x, targets), 0, len(x) - 1))
        chosen = np.union1d(chosen, [0, len(x) - 1])
        x, runs = x[chosen], runs[:, chosen]
    runs = np.where(np.isfinite(runs), runs, np.nan)
    statistic = np.mean if centre == "mean" else np.median
    low, high = bootstrap_interval(runs, statistic)
    return Sampled(x, runs, statistic(runs, axis=0), low, high)


def shorten_ticks(axis: Axis, always: bool = False) -> None:
    """20k and 1M for 20000 and 1e6."""
    if always or np.abs(axis.get_view_interval()).max() >= 1e4:
        axis.set_major_formatter(FuncFormatter(lambda value, _: short_number(value)))


def short_number(value: float) -> str:
    for size, suffix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{suffix}".replace("-", "−")
    return f"{value:g}".replace("-", "−")


def add_legend(canvas: Canvas, handles: Sequence[Artist], theme: Theme) -> None:
    """A legend below the axes, in as many columns as fit; the canvas grows by its height."""
    if not handles:
        return
    for most in range(min(len(handles), 4), 0, -1):
        rows = math.ceil(len(handles) / most)
        columns = math.ceil(len(handles) / rows)
        legend = canvas.legend(
            handles=handles,
            ncols=columns,
            loc="outside lower center",
            frameon=False,
            labelcolor=theme.ink,
            handlelength=2.6,
            columnspacing=1.4,
            borderpad=0,
        )
        extent = legend.get_window_extent()
        if columns == 1 or extent.width <= 0.96 * canvas.bbox.width:
            canvas.set_figheight(canvas.get_figheight() + extent.height / canvas.dpi)
            return
        legend.remove()


def label_references(
    canvas: Canvas, axes: Axes, references: Sequence[Reference], theme: Theme
) -> None:
    """Names at the right end of the reference lines, moved apart where they would overlap."""
    lines = sorted(references, key=lambda line: line.value)
    bottom, top = axes.get_ylim()
    ends = [(line.value - bottom) / (top - bottom) for line in lines]
    leader = {
        "arrowstyle": "-",
        "color": theme.muted,
        "linewidth": 0.8,
        "shrinkA": 0,
        "shrinkB": 0,
        "relpos": (0.0, 0.5),  # it ends at the left of the name, not in the middle of it
    }
    labels = [
        axes.annotate(
            textwrap.fill(line.label, 15),
            xy=(1.0, end),
            xytext=(1.05, end),
            xycoords="axes fraction",
            textcoords="axes fraction",
            va="center",
            fontsize=9,
            color=theme.muted,
            annotation_clip=False,
            arrowprops=leader,
        )
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
    bar.ax.tick_params(color=theme.muted, labelcolor=theme.ink, length=3)
    shorten_ticks(bar.ax.yaxis)
    label_cells(canvas, axes, figure, height)


def draw_tracks(canvas: Canvas, axes: Axes, figure: Tracks, theme: Theme) -> None:
    rows, columns = len(figure.row_labels), len(figure.column_labels)
    cell = 3.9 / columns  # inches; about what the axes have
    height = float(np.clip(rows * max(cell, 0.24), 1.3, 4.0))
    canvas.set_size_inches(WIDTH, height + 0.6)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
    axes.spines[:].set(visible=True, color=theme.grid)
    axes.set_xticks(np.arange(0.5, columns - 1), minor=True)
    axes.set_yticks(np.arange(0.5, rows - 1), minor=True)
    axes.tick_params(which="minor", length=0)
    axes.grid(which="minor", color=theme.grid, linewidth=0.7)
    axes.set_axisbelow(True)
    for at in figure.breaks:
        axes.axvline(at - 0.5, color=theme.ink, linewidth=1.2, zorder=2.5)
    # Everybody has a place of their own in a cell: who are in one cell do not hide each other.
    n = len(figure.tracks)
    room = {wide: min(cell / wide, height / rows / -(-n // wide)) for wide in range(n, 0, -1)}
    wide = max(room, key=room.__getitem__)
    high = -(-n // wide)
    size = min(0.8 * 72 * room[wide], 9.0)
    handles, learners = draw_goals(axes, figure, theme), 0
    for i, track in enumerate(figure.tracks):
        x = np.arange(columns) + (i % wide + 0.5) / wide - 0.5
        y = np.asarray(track.rows) + (i // wide + 0.5) / high - 0.5
        marker, color = "X", theme.ink
        if not track.scripted:
            marker = MARKERS[learners % len(MARKERS)]
            color = theme.curves[WALKERS[learners % len(WALKERS)]]
            learners += 1
        look: dict[str, Any] = {"marker": marker, "color": color, "mec": theme.page}
        axes.plot(x, y, **look, lw=0.8, alpha=0.3, ms=0, zorder=3)
        axes.plot(x, y, **look, lw=0, ms=size, mew=0.12 * size, zorder=4)
        label = textwrap.fill(track.label, 56)
        handles.append(Line2D([], [], **look, lw=0, ms=7, mew=0.7, label=label))
    label_cells(canvas, axes, figure, height)
    add_legend(canvas, handles, theme)


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
    """From the page's own colour to a strong one; values of both signs meet at zero."""
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
    """As many row and column labels as are readable: all, turned, or every n-th."""
    rows, columns = len(figure.row_labels), len(figure.column_labels)
    every = nice_step(rows * 0.17 / height)
    axes.set_yticks(
        range(0, rows, every),
        [shortened(label) for label in figure.row_labels[::every]],
    )
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


def shortened(label: object, most: int = 24) -> str:
    text = str(label)
    return text if len(text) <= most else f"{text[: most - 1].rstrip()}…"


def nice_step(least: float) -> int:
    """The first of 1, 2, 5, 10, 20, 50, … that is `least` or more."""
    size = 1
    while True:
        for step in (size, 2 * size, 5 * size):
            if step >= least:
                return step
        size *= 10
