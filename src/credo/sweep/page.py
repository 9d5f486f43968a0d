"""The page of a sweep: its best trial, how it got there, what mattered, and every trial."""

import pathlib
import shlex
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

from ..report.figures import add_legend, drawing, shorten_ticks, shortened
from ..report.pages import write as write_page
from ..report.sections import Cell, Page, Section, Table
from ..report.styles import Theme
from ..report.tables import number
from .journal import COMPLETE, FAILED, PRUNED, RUNNING, Journal, Trial, best
from .plan import Plan
from .space import Drawn, Range

NAME = "report.html"
ORDER = (COMPLETE, PRUNED, RUNNING, FAILED)


def write(folder: pathlib.Path, journal: Journal, what: str, seeds: Sequence[int]) -> pathlib.Path:
    """Write the page of a sweep into its folder, and return its path.

    **Arguments:** `what`: the algorithm and its task, in words. `seeds`: those of every trial.
    """
    return write_page(describe(folder, journal, what, seeds), folder / NAME)


def describe(folder: pathlib.Path, journal: Journal, what: str, seeds: Sequence[int]) -> Page:
    """The page of a sweep, as far as it is."""
    plan, trials = journal.plan, journal.trials
    top = best(trials, plan)
    return Page(
        title=f"Credo: sweep {folder.absolute().name}",
        lead=_lead(trials, plan, what, seeds),
        command=f"credo sweep {shlex.quote(str(folder))}",
        sections=[
            *_history(trials, plan),
            *_importance(journal),
            *([] if top is None else [_winner(top, journal.ranges, plan)]),
            *_coordinates(trials, journal.ranges, plan),
            _table(trials, journal.ranges, plan, seeds),
        ],
        facts={
            "score": f"{plan.metric}, mean of a run's last {100 * plan.last:g} % of generations",
            "sampler": f"{plan.sampler}, seed {plan.seed}, rounds of {plan.together}",
            "seeds of runs": ", ".join(map(str, seeds)),
            "pruning": _rule(plan),
        },
    )


def _lead(trials: Sequence[Trial], plan: Plan, what: str, seeds: Sequence[int]) -> str:
    counts = [(state, sum(trial.state == state for trial in trials)) for state in ORDER]
    states = ", ".join(f"{count} {state}" for state, count in counts if count)
    told = f"{what}: {len(trials)} of {plan.trials} trials ({states}), {len(seeds)} seeds each."
    top = best(trials, plan)
    if top is None:
        return told
    return (
        f"{told} Best: trial {top.number} with {number(top.value)}, the interquartile mean over "
        "its seeds. These seeds chose it, so the number flatters: report fresh ones."
    )


def _rule(plan: Plan) -> str:
    """When trials are pruned."""
    if not plan.prune:
        return "none"
    return (
        "a trial whose interquartile mean after a seed is worse than the median of the trials "
        f"before it with as many seeds; not the first {plan.startup}"
    )


# ------------------------------------------------------------------------------------------ tables


def _winner(top: Trial, ranges: Sequence[Range], plan: Plan) -> Table:
    rows: list[list[Cell]] = [
        [one.name, _shown(one, top.drawn[one.name]), _range(one)]
        for one in ranges
        if one.name in top.drawn
    ]
    caption = "`credo sweep FOLDER --best FILE.toml` writes all of its settings."
    return Table(f"Best trial: {top.number}", ["flag", "value", "of"], rows, caption)


def _range(one: Range) -> str:
    """A range in words."""
    if one.choices:
        return " or ".join(one.choices)
    how = ", logarithmic" if one.log else f" by {one.step:g}" if one.step else ""
    return f"{_shown(one, one.low)} … {_shown(one, one.high)}{how}"


def _shown(one: Range, value: Any) -> str:
    """A value as a table shows it: `credo sweep --best` writes all digits."""
    return str(value) if one.choices or one.whole else f"{value:.4g}".replace("-", "−")


def _table(
    trials: Sequence[Trial], ranges: Sequence[Range], plan: Plan, seeds: Sequence[int]
) -> Table:
    """Every trial, the best first; below the complete ones those that are not."""
    sign = -1.0 if plan.direction == "maximize" else 1.0
    ranked = sorted(
        trials,
        key=lambda t: (
            ORDER.index(t.state),
            -len(t.scores),
            sign * np.nan_to_num(t.value),
            t.number,
        ),
    )
    columns = ["trial", *(one.name for one in ranges), *(f"seed {seed}" for seed in seeds)]
    rows: list[list[Cell]] = []
    for trial in ranked:
        drawn = [
            _shown(one, trial.drawn[one.name]) if one.name in trial.drawn else None
            for one in ranges
        ]
        scores = [*trial.scores, *[None] * (len(seeds) - len(trial.scores))]
        why = f"{trial.state}: {trial.why}" if trial.why else trial.state
        rows.append([str(trial.number), *drawn, *scores, trial.value, why])
    top = best(trials, plan)
    return Table(
        "Trials",
        [*columns, "IQM", "state"],
        rows,
        "Best first. IQM: interquartile mean over the seeds so far, the value that is searched. "
        "A dash: not trained, or a flag that the others leave out.",
        marked=[i for i, trial in enumerate(ranked) if top and trial.number == top.number],
    )


# ----------------------------------------------------------------------------------------- drawings


def _history(trials: Sequence[Trial], plan: Plan) -> list[Section]:
    """Values of trials in their order, and the best of those that are complete so far."""
    valued = [trial for trial in trials if trial.scores]
    complete = [trial for trial in valued if trial.state == COMPLETE]
    if not complete:
        return []
    others = [trial for trial in valued if trial.state != COMPLETE]
    tops = [best(trials[: trial.number + 1], plan) for trial in complete]

    def paint(canvas: Canvas, axes: Axes, theme: Theme) -> None:
        at = [trial.number for trial in complete]
        color, line = theme.curves[0], theme.curves[1]
        steps = [*(top.value for top in tops if top)]
        handles = axes.step(
            [*at, len(trials) - 1], [*steps, steps[-1]], where="post", color=line, label="best"
        )
        dots: dict[str, Any] = {"lw": 0, "marker": "o", "ms": 4.5, "zorder": 3}
        values = [trial.value for trial in complete]
        handles += axes.plot(at, values, color=color, mew=0, label="complete", **dots)
        if others:
            given = [x.number for x in others], [x.value for x in others]
            look = {"mfc": "none", "mec": theme.muted, "label": "pruned or failed: seeds so far"}
            handles += axes.plot(*given, **look, **dots)
        axes.set(xlabel="trial", ylabel=f"{plan.metric}, IQM over seeds")
        axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        axes.grid(axis="y")
        shorten_ticks(axes.yaxis)
        add_legend(canvas, handles)

    label = f"values of {len(valued)} trials in their order, and the best so far"
    return [drawing("History of the search", label, paint, "")]


def _importance(journal: Journal) -> list[Section]:
    """Bars of the importance of ranges, where there are trials enough."""
    shares = journal.importance()
    if not shares:
        return []
    names = sorted(shares, key=lambda name: shares[name])

    def paint(canvas: Canvas, axes: Axes, theme: Theme) -> None:
        bars = axes.barh([shortened(x) for x in names], [shares[x] for x in names], height=0.62)
        for bar in bars:
            bar.set_color(theme.curves[0])
        axes.bar_label(bars, [f"{shares[x]:.2f}" for x in names], padding=4, color=theme.ink)
        axes.set(xlabel="share of importance", xlim=(0, 1.12 * max(shares.values())))
        axes.tick_params(axis="y", length=0)

    told = ", ".join(f"{name} {shares[name]:.2f}" for name in reversed(names))
    caption = (
        "PED-ANOVA: how much what the best quarter of trials drew for a flag differs from what all "
        "of them drew, pruned ones with the value that they had. Of few trials it is a hint."
    )
    height = max(1.2, 0.75 + 0.3 * len(names))
    return [drawing("Importance of flags", told, paint, caption, height)]


def _coordinates(trials: Sequence[Trial], ranges: Sequence[Range], plan: Plan) -> list[Section]:
    """Parallel coordinates: a line a complete trial, over an axis for each flag and its value."""
    complete = [trial for trial in trials if trial.state == COMPLETE]
    top = best(trials, plan)
    if len(complete) < 2 or top is None:
        return []
    rows = len(ranges)
    values = [trial.value for trial in complete]
    low, high = min(values), max(values)

    def place(value: float) -> float:
        return 0.5 if low == high else (value - low) / (high - low)

    def paint(canvas: Canvas, axes: Axes, theme: Theme) -> None:
        good = LinearSegmentedColormap.from_list("good", [theme.grid, theme.curves[0]])
        order = sorted(complete, key=lambda t: (t == top, place(t.value)))
        if plan.direction == "minimize":
            order = [*reversed(order[:-1]), order[-1]]
        for trial in order:
            share = place(trial.value)
            share = share if plan.direction == "maximize" else 1 - share
            look: dict[str, Any] = {"lw": 1.1, "marker": "o", "ms": 3, "color": good(share)}
            look |= {"lw": 2.2, "color": theme.curves[1]} if trial == top else {}
            x = [*(_at(one, trial.drawn) for one in ranges), place(trial.value)]
            axes.plot(x, range(rows + 1), **look)
        for row, one in enumerate(ranges):
            _axis(axes, row, _ticks(one), theme)
        ends = [(place(x), number(x)) for x in dict.fromkeys((low, high))]
        _axis(axes, rows, ends, theme)
        names = [*(shortened(one.name) for one in ranges), "value"]
        axes.set_yticks(range(rows + 1), names)
        axes.set(xlim=(-0.04, 1.04), ylim=(rows + 0.55, -0.35))
        axes.xaxis.set_visible(False)
        axes.tick_params(axis="y", length=0)
        axes.spines[:].set_visible(False)

    caption = (
        "One line per complete trial, over an axis for each flag; the bottom one is the value. The "
        f"better, the stronger the colour; trial {top.number}, the best, stands out. A gap: a flag "
        "that a trial left out."
    )
    label = (
        f"parallel coordinates of {len(complete)} trials over {', '.join(x.name for x in ranges)}"
    )
    return [drawing("Parallel coordinates", label, paint, caption, 0.4 + 0.52 * (rows + 1))]


def _axis(axes: Axes, row: int, ticks: Sequence[tuple[float, str]], theme: Theme) -> None:
    """A line across the picture with names below it, those at its ends inside."""
    axes.axhline(row, color=theme.muted, lw=0.8, zorder=1)
    for at, name in ticks:
        side = "left" if at < 0.02 else "right" if at > 0.98 else "center"
        style: dict[str, Any] = {"ha": side, "va": "top", "fontsize": 7.5, "color": theme.muted}
        style["bbox"] = {"fc": theme.page, "ec": "none", "alpha": 0.75, "pad": 0.5}
        axes.annotate(name, (at, row), (0, -4), textcoords="offset points", **style)


def _ticks(one: Range) -> list[tuple[float, str]]:
    """Names along the axis of a range, and where they stand."""
    ends = one.choices or (one.low, one.high)
    return [(_at(one, {one.name: end}), shortened(_shown(one, end))) for end in ends]


def _at(one: Range, drawn: Drawn) -> float:
    """Where a value stands on the axis of its range, in [0, 1]; NaN if it was not drawn."""
    if one.name not in drawn:
        return float("nan")
    value = drawn[one.name]
    if one.choices:
        return one.choices.index(value) / max(1, len(one.choices) - 1)
    scale: Callable[[float], float] = np.log if one.log else float
    return float((scale(value) - scale(one.low)) / (scale(one.high) - scale(one.low)))
