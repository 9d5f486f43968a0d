"""A champion, drawn: the graph of a network of NEAT; of a network with memory what it keeps in one
episode, or where the heads of an NTM or a DNC are, how long that lasts, and which cells count.

The episode is played on Credo's own tasks in JAX alone: no code that a record names is imported.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch
from matplotlib.transforms import Affine2D, ScaledTranslation

from .. import tree
from ..analysis.memory import known_memory, weightings
from ..analysis.probes import TIMES, reach, worth_of_cells
from ..compilation import float32
from ..environments.base import AbstractEnvironment, AbstractSequenceTask
from ..environments.wrappers import Given
from ..networks.graph import GraphPolicy
from ..networks.normalized import Normalized
from ..rollout import record
from ..runs import policy as policies
from ..runs.store import Run
from .figures import drawing
from .sections import Cell, Curve, Drawing, Figure, HeatMap, Section, Table
from .styles import Theme

MOST = 10_000  # steps of an episode that is played for it
LONGEST = 120  # moments of an episode that a heat map shows
FAINT = 0.01  # rows behind the last that reaches this are left out
PLAYED = 50  # episodes of a probe
STEPS = 20_000_000  # of all episodes by which cells are judged, at most: some seconds
ROWS = 16  # cells in a table
DRAWN = 16  # sequences, of which one is shown
SEED = 1_000_003  # of the episodes of probes
PORTS = ("block input", "input gate", "forget gate", "output gate")
DASHES: tuple[Any, ...] = ("solid", (0, (5, 2)), (0, (1, 1.2)), (0, (5, 1.5, 1, 1.5)))
Place = tuple[float, float]


def pictures(run: Run) -> list[Section]:
    """`sections`, with numbers of 32 bits as in training."""
    with float32():
        return list(sections(run))


def sections(run: Run) -> Iterator[Section]:
    """Of a finished policy what can be shown; nothing of a network that is not Credo's own, or has
    neither a graph nor a memory."""
    own = run.config["algorithm"]["class"].startswith("credo.") and "task" in run.config
    if not own or run.part("network") is None or run.part("env") is None:
        return
    policy = policies.champion(run)
    inner = policy.policy if isinstance(policy, Normalized) else policy
    if isinstance(inner, GraphPolicy):
        yield from graph(inner)
    env = run.part("env")
    if isinstance(env, AbstractEnvironment) and env.max_steps <= MOST:
        yield from _memories(env, policy)
        if policy.first() is not None:
            yield from horizon(env, policy)
            yield from cells(env, policy)


# ----------------------------------------------------------------------------------------- graphs


class Edge(NamedTuple):
    """A connection."""

    start: str  # where it begins
    end: str
    port: int  # of `PORTS`, where it ends
    weight: float


def graph(policy: GraphPolicy) -> tuple[Drawing, Table]:
    """The network as a picture, and its connections as a table, heaviest first."""
    edges = edges_of(policy)
    places = placed(fixed_of(policy), edges)
    hidden = sum(name.startswith("h") for name in places)
    what = f"{_many(len(edges), 'connection')}, {_many(hidden, 'hidden unit')}"
    columns = [x for x, _ in places.values()]
    picture = drawing(
        "Network of the champion",
        f"graph of the champion's network: {what}",
        lambda _, axes, theme: _paint(axes, theme, places, edges),
        f"{what}. Inputs x and the bias 1 are on the left, outputs y on the right; hidden units h, "
        "squares where they have gates, by the number of connections to them from an input. Warm: "
        "weights above 0, cold: below; the wider, the larger. Bent: to a unit that is not further "
        "to the right; a loop: to itself.",
        height=max(2.6, 0.42 * max(map(columns.count, columns))),
    )
    return picture, _table(edges)


def _many(n: int, what: str) -> str:
    return f"{n} {what}{'s' * (n != 1)}"


def _table(edges: Sequence[Edge]) -> Table:
    gates = any(edge.port for edge in edges)
    rows = [
        [edge.start, edge.end, *([PORTS[edge.port]] * gates), edge.weight]
        for edge in sorted(edges, key=lambda edge: -abs(edge.weight))
    ]
    columns = ["from", "to", *(["ends at"] * gates), "weight"]
    return Table("Connections of the champion", columns, rows, folded=True)


def fixed_of(policy: GraphPolicy) -> list[str]:
    """Names of what every network of these sizes has: inputs, the bias and outputs."""
    y = policy.action_size
    inputs = policy.W.shape[1] - 1 - y - policy.config.hidden
    return [*(f"x{i + 1}" for i in range(inputs)), "1", *(f"y{i + 1}" for i in range(y))]


def edges_of(policy: GraphPolicy) -> list[Edge]:
    """All connections of a weight other than 0."""
    weights, c = np.asarray(policy.W), policy.config
    fixed, hidden = fixed_of(policy), [f"h{i + 1}" for i in range(c.hidden)]
    sources = [*fixed, *hidden]
    ends: list[tuple[str, int]] = [(name, 0) for name in fixed[len(fixed) - policy.action_size :]]
    ends += [(name, port) for port in range(c.ports) for name in hidden]
    return [
        Edge(sources[j], *ends[i], weight=float(weights[i, j])) for i, j in np.argwhere(weights)
    ]


def placed(fixed: Sequence[str], edges: Sequence[Edge]) -> dict[str, Place]:
    """Where each unit stands in a picture of width and height 1: inputs on the left, outputs on the
    right, and hidden units that have a connection in columns by their distance from the inputs."""
    column = _columns(fixed, edges)
    last = max(column.values(), default=0) + 1
    column |= {name: last for name in fixed if name.startswith("y")}
    places: dict[str, Place] = {}
    for x in range(last + 1):
        members = sorted((name for name in column if column[name] == x), key=_order)
        for i, name in enumerate(members):
            places[name] = (x / last, 1.0 - (i + 0.5) / len(members))
    return places


def _columns(fixed: Sequence[str], edges: Sequence[Edge]) -> dict[str, int]:
    """How many connections lead from an input to each hidden unit, at least; 0 for inputs. What no
    input feeds stands in the last column."""
    column = {name: 0 for name in fixed if not name.startswith("y")}
    hidden = {name for edge in edges for name in edge[:2] if name.startswith("h")}
    for far in range(1, len(hidden) + 1):
        found = {edge.end for edge in edges if column.get(edge.start) == far - 1} & hidden
        column |= dict.fromkeys(found - column.keys(), far)
    return column | dict.fromkeys(hidden - column.keys(), max(1, *column.values()))


def _order(name: str) -> tuple[str, int]:
    return (name[0].replace("1", "~"), int(name[1:] or 0))  # the bias below the inputs


def _paint(axes: Axes, theme: Theme, places: dict[str, Place], edges: Sequence[Edge]) -> None:
    """Arrows, and units over them."""
    axes.set(xlim=(-0.06, 1.06), ylim=(-0.04, 1.04))
    axes.set_axis_off()
    most = max((abs(edge.weight) for edge in edges), default=1.0)
    for edge in edges:
        axes.add_patch(_arrow(axes, edge, places, abs(edge.weight) / most, theme))
    gated = {edge.end for edge in edges if edge.port}
    for name, (x, y) in places.items():
        look: dict[str, Any] = {"mfc": theme.page, "mec": theme.ink, "mew": 0.9, "zorder": 3}
        axes.plot(x, y, marker="s" if name in gated else "o", ms=15, **look)
        text: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7, "zorder": 4}
        axes.text(x, y, name, color=theme.ink, **text)
    ports = sorted({edge.port for edge in edges})
    if len(ports) > 1:
        lines = [Line2D([], [], color=theme.muted, linestyle=DASHES[port]) for port in ports]
        axes.legend(lines, [PORTS[port] for port in ports], loc="lower center", ncols=4, fontsize=8)


def _arrow(
    axes: Axes, edge: Edge, places: dict[str, Place], share: float, theme: Theme
) -> FancyArrowPatch:
    """`share`: of the largest weight."""
    start, end = places[edge.start], places[edge.end]
    # Those of two units that end at different gates lie side by side.
    bend, shrink = (0.0 if end[0] > start[0] else 0.35) + 0.1 * edge.port, (7.0, 8.0)
    place: dict[str, Any] = {}
    if edge.start == edge.end:
        # Out of the top of the unit and back, in points, so that its marker does not hide it.
        data: Any = axes.transData
        points = Affine2D().scale(1 / 72) + axes.figure.dpi_scale_trans
        place = {"transform": points + ScaledTranslation(*start, data), "clip_on": False}
        start, end, shrink, bend = (-5.0, 6.0), (5.0, 6.0), (0.0, 0.0), -(1.7 + 0.8 * edge.port)
    return FancyArrowPatch(
        start,
        end,
        connectionstyle=f"arc3,rad={bend}",
        arrowstyle="-|>",
        mutation_scale=7,
        shrinkA=shrink[0],
        shrinkB=shrink[1],
        lw=0.5 + 1.7 * share,
        color=theme.warm if edge.weight > 0 else theme.cold,
        linestyle=DASHES[edge.port],
        alpha=0.85,
        zorder=2,
        **place,
    )


# --------------------------------------------------------------------------------------- memories


def _memories(env: AbstractEnvironment, policy: Any) -> Iterator[HeatMap]:
    """Heat maps of one episode: the weightings of every head, or the memory cells."""
    trace = record(_shown(env), policy, key=jax.random.key(0))
    heads = weightings(policy, trace.carries)
    memory = None if heads else known_memory(trace.carries)
    if memory is not None and memory.ndim == 2 and memory.size:
        yield from _map("What the champion remembers", memory, "memory cell")
    for name, rows in heads.items():
        yield from _map(f"Where the champion's {name} is", rows, "row of the memory")


def horizon(env: AbstractEnvironment, policy: Any) -> Iterator[Figure]:
    """How the score falls where something has to be remembered for longer than in training;
    nothing of a task that has no setting for it."""
    tasks = {n: env.longer(n) for n in TIMES}
    times = [n for n, longer in tasks.items() if longer is not None and longer.max_steps <= MOST]
    if not times:
        return
    found = reach(env, tree.single(policy), times, PLAYED, key=jax.random.key(SEED))
    scores = np.array([[step.scores.mean() for step in found]])
    settings = "; ".join(f"× {step.times}: {step.changed}" for step in found)
    yield Figure(
        "How far the champion's memory reaches",
        "times as long as in training",
        env.reported,
        [Curve("champion", [step.times for step in found], scores)],
        caption=f"{settings}. {PLAYED} fresh episodes of each, without more training; "
        "`credo evaluate RUN --horizon` plays more.",
        joined=False,
    )


def cells(env: AbstractEnvironment, policy: Any) -> Iterator[Table]:
    """What each memory cell is worth: the most needed first, at most `ROWS` of them."""
    memory = known_memory(policy.start(key=jax.random.key(0)))
    lanes = 0 if memory is None or not memory.ndim else 2 * memory.shape[-1] + 2
    if not 0 < lanes * PLAYED * env.max_steps <= STEPS:
        return
    found = worth_of_cells(env, policy, PLAYED, key=jax.random.key(SEED))
    if found is None:
        return
    order = np.lexsort((-found.alone, found.without))[:ROWS]
    rows: list[list[Cell]] = [
        [str(i + 1), float(found.without[i]), float(found.alone[i])] for i in order
    ]
    cut = f" The {ROWS} most needed of {len(found.alone)} cells." if len(found.alone) > ROWS else ""
    yield Table(
        "What its memory cells are worth",
        ["cell", f"{env.reported} without it", f"{env.reported} with it alone"],
        rows,
        caption=f"{env.reported} is {found.score:.3g} with all cells and {found.nothing:.3g} with "
        f"none: a cell that is left out is held at 0. The same {PLAYED} fresh episodes every "
        f"time.{cut} Where no cell is missed, several hold the same.",
    )


def _shown(env: AbstractEnvironment) -> AbstractEnvironment:
    """The task; of sequences the longest of a few that can be shown whole, if there is one."""
    if not isinstance(env, AbstractSequenceTask):
        return env
    drawn = (env.sample(key=key) for key in jax.random.split(jax.random.key(0), DRAWN))
    fitting = [sequence for sequence in drawn if int(sequence.length) < LONGEST]
    longest = max(fitting, key=lambda sequence: int(sequence.length), default=None)
    return env if longest is None else Given.alone(env, longest)


def _map(says: str, values: Any, what: str) -> Iterator[HeatMap]:
    """What is there at each moment, `[moments, rows]`; nothing if a number is not finite."""
    moments = len(values)
    shown = np.asarray(values, np.float64)[:LONGEST].T
    if not np.isfinite(shown).all() or not np.abs(shown).max(initial=0.0) >= FAINT:
        return  # a network may have room for cells of which it uses none
    cut = f" The first {LONGEST} of {moments} moments." if moments > LONGEST else ""
    used = 1 + int(np.max(np.flatnonzero(np.max(np.abs(shown), axis=1) >= FAINT), initial=0))
    if used < len(shown):
        cut += f" Nothing reaches {FAINT:g} in the {len(shown) - used} rows behind the last one."
        shown = shown[:used]
    yield HeatMap(
        f"{says} in one episode",
        shown,
        [str(i + 1) for i in range(len(shown))],
        [str(i) for i in range(shown.shape[1])],
        "moment",
        what,
        caption=f"A fresh episode, of sequences a long one; moment 0 is its start.{cut}",
    )
