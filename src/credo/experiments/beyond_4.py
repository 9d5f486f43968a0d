"""Beyond chapter 4: difference rewards, depth 4, teams of LSTMs and GRUs, noisy observations, and
servers that leave and join while a fleet works."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, PyTree

from ..analysis import fleet, statistics
from ..environments.extended_tmaze import ExtendedTMaze
from ..environments.server_fleet import ServerFleet
from ..environments.wrappers import NoisyObservations
from ..report import sections as page
from ..report.rows import Results, Row, Series, rows
from ..rollout import evaluate
from . import fig_4_2, fig_4_7
from .base import Cell, Experiment, Trained, Value
from .fig_3_4a import rounded
from .views import Of, Runs, Table, known

NOISE = 0.5  # in training; a request that was served is told as 1 or -1
TESTED = (0.0, 0.25, 0.5, 1.0)
QUESTIONS: dict[str, dict[str, Any]] = {  # T-mazes by table
    "Difference reward against global reward": {"task": "spread", "robots": (3, 4)},
    "Depth 4": {"task": "spread", "depth": 4},
    "Robots by the cell of their networks": {
        "task": ("converge", "spread"),
        "depth": 2,
        "robots": (None, 2),
    },
}


def cells(budget: str) -> list[Cell]:
    """Cells of Figures 4.2, 4.4 and 4.7, and beside each what is asked."""
    tiny = budget == "smoke"
    kinds = ("mmu", "lstm") if tiny else ("mmu", "lstm", "gru")
    maze = fig_4_2.cell
    (steady,) = [x for x in fig_4_7.cells(budget) if list(x.labels.values())[1:] == FLEET]
    noisy = replace(steady.algorithm, env=_noisy(steady.algorithm.env, NOISE))
    return [
        *(
            maze(budget, "spread", 2, "mmu", robots=robots, fitness=fitness)
            for robots in ((3,) if tiny else (3, 4))
            for fitness in (None, "difference")
        ),
        *(maze(budget, "spread", 4, x, partner="fsp") for x in ("mmu", "ff")),
        *(maze(budget, "converge", 2, x, partner="fsp") for x in kinds),
        *(maze(budget, "spread", 2, x, robots=2) for x in kinds),
        steady,
        replace(steady, labels={**steady.labels, "noise": NOISE}, algorithm=noisy),
    ]


FLEET = ["synchronous", "dmmu"]


def _noisy(env: ServerFleet, std: float) -> NoisyObservations:
    return NoisyObservations(env, std, spared=1)  # the status


# --------------------------------------------------------------------------------------- measures


def of_mazes(trained: Trained) -> Iterable[Row | Series]:
    """As Figure 4.2."""
    if not isinstance(trained.env, ExtendedTMaze):
        return []
    return [*fig_4_2.levels(trained), *fig_4_2.shares(trained)]


def of_fleets(trained: Trained) -> Iterator[Row | Series]:
    """As Figure 4.7; final champions in every noise, and without noise what becomes of them when
    servers leave and join."""
    if isinstance(trained.env, ExtendedTMaze):
        return
    for measure in (fig_4_7.references, fig_4_7.net, fig_4_7.nobody_writes):
        yield from measure(trained)
    env = fig_4_7.clear(trained.env)
    told = {"labels": trained.labels, "seed": trained.seeds}
    for std in TESTED:
        net = played(_noisy(env, std), trained.champions)
        here = told | {"labels": {**trained.labels, "noise of the test": std}}
        yield from pairs("net requests in noise", net, **here)
    if "noise" not in trained.labels:
        yield from changes(trained, env)


def changes(trained: Trained, env: ServerFleet) -> Iterator[Row]:
    """Net requests by what happens to the fleet, beside baselines and bounds of the same task; and
    the difference that it makes, world by world: classes of devices are the same."""
    before = None
    for name, (task, teams) in variants(env, trained.champions).items():
        net = played(task, teams)
        before = net if before is None else before
        labels = {**trained.labels, "fleet": name}
        yield from pairs("net requests of a fleet", net, labels, seed=trained.seeds)
        yield from pairs("change", net - before, labels, seed=trained.seeds)
        known = fleet.floors_and_ceilings(task, 1000, key=jax.random.key(21_000))
        for policy, found in known.items():
            here = {**labels, "policy": policy}
            for metric, value in zip(names("reference of a fleet"), rounded(found, 3), strict=True):
                yield from rows(metric, value, here)


def variants(env: ServerFleet, team: Any) -> dict[str, tuple[ServerFleet, Any]]:
    """What may happen to a fleet, by name: the task, and who plays it. A part of a DMMU or of a
    population of them leaves, or clones of its first agents join, in mid-episode or before it."""
    n, end = env.servers, env.max_steps
    leave, join, half = max(1, 3 * n // 10), n // 2, end // 2
    left = n - leave
    stays, leaves, joins = ((0, end),), ((0, half),), ((half, end),)
    smaller, larger = team.without(range(left, n)), team.with_clones(range(join))
    fewer = replace(env, servers=left)
    more = replace(env, servers=n + join)
    leaving = replace(env, schedule=stays * left + leaves * leave)
    joining = replace(more, schedule=stays * n + joins * join)
    return {
        f"{n} servers": (env, team),
        f"{leave} of {n} leave at step {half}": (leaving, team),
        f"{left} of {n} from the start": (fewer, smaller),
        f"clones of {join} join at step {half}": (joining, larger),
        f"clones of {join} from the start": (more, larger),
    }


def played(env: ServerFleet | NoisyObservations, champions: PyTree) -> Array:
    """Net requests served in fresh episodes: `[runs, episodes]`. Classes of devices and episodes
    do not depend on how many servers there are."""
    return evaluate(env, champions, fig_4_7.EPISODES, key=jax.random.key(20_002)).of("net")


def names(metric: str) -> tuple[str, str]:
    """Metrics of a mean and of its standard error."""
    return metric, f"{metric}, s.e."


def pairs(metric: str, net: Array, labels: Any, **axes: Any) -> Iterator[Row]:
    """Mean and standard error over the episodes of each run."""
    found = statistics.mean_and_standard_error(net.T)
    for name, values in zip(names(metric), found, strict=True):
        yield from rows(name, rounded(values, 3), labels, **axes)


# ------------------------------------------------------------------------------------------ views


def pair(metric: str, sign: str = "", **labels: Any) -> Of:
    """Mean ± standard error of every run or, of a policy, once; a dash for a champion that says
    NaN."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        mean, error = (results.where(**labels).by_seed(name) for name in names(metric))
        told = [(mean[seed][0], error[seed][0]) for seed in mean]
        return ", ".join("–" if a is None else f"{a:{sign}.1f} ± {b:.1f}" for a, b in told) or None

    return of


def costs(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """What a change of the fleet costs or brings, ours beside a fleet that shares all it finds."""
    first, *others = results.levels("fleet") or [None]

    def gain(fleet: str, policy: str) -> str:
        (after, error), (before, other) = (
            [results.value(x, fleet=name, policy=policy) for x in names("reference of a fleet")]
            for name in (fleet, first)
        )
        return f"{after - before:+.1f} ± {float(np.hypot(error, other)):.1f}"

    body = [
        [
            name,
            pair("change", "+")(results.where(fleet=name), values),
            gain(name, "discovering"),
            gain(name, "oracle"),
        ]
        for name in others
    ]
    if body:
        yield page.Table(
            "Against the first row: what leaving costs and joining brings",
            ["fleet", "each run", "a script that discovers", "an oracle"],
            body,
            caption="Ours: mean ± standard error of the difference, world by world. Script and "
            "oracle: of the difference of two means.",
        )


def of_question(title: str, where: dict[str, Any]) -> list[Any]:
    """Table, curves and pictures of the T-mazes of a question."""
    heading = f"{title}: trials in which the final champion team observes the reward, %"
    return [
        replace(fig_4_2.SCORES, title=heading, where=where),
        replace(fig_4_2.CURVES, where=where),
        lambda results, values: fig_4_2.pictures(results.where(**where), values),
    ]


def about(task: str, text: page.Text) -> Any:
    """A text that is shown if there is anything of its task."""
    return lambda results, values: [text] if results.where(task=task).rows else []


FLEETS = {"task": "server fleet"}
EXPERIMENT = Experiment(
    published="Not in the dissertation, which names noisy observations of the server fleet as "
    "future work (section 4.2.5). The difference reward of a robot is the score minus what it "
    "would have been without it.",
    cells=cells,
    measures=(of_mazes, of_fleets),
    views=(
        *(view for question in QUESTIONS.items() for view in of_question(*question)),
        Runs(
            "Noisy observations: net requests of final champions, by the noise of the test; {panel}",
            {
                f"tested at std {std:g}": pair(
                    "net requests in noise", **{"noise of the test": std}
                )
                for std in TESTED
            },
            panel=("task", "timing", "network", "noise"),
            where=FLEETS,
            caption="Mean ± standard error over 500 fresh episodes, the same for all.",
        ),
        replace(fig_4_7.SCORES, where=FLEETS),
        replace(fig_4_7.CURVES, where=FLEETS),
        Table(
            "Servers that leave and join: net requests of final champions",
            rows=("fleet",),
            columns={
                "baseline: random": pair("reference of a fleet", policy="random"),
                "each run": pair("net requests of a fleet"),
                "a script that discovers": pair("reference of a fleet", policy="discovering"),
                "an oracle": pair("reference of a fleet", policy="oracle"),
            },
            caption="Mean ± standard error over 500 fresh episodes (baseline, script and oracle "
            "1,000). Trained without noise and with nobody leaving or joining, then not changed. "
            "Clones are of the first servers.",
        ),
        costs,
        about(
            "spread",
            fig_4_2.about(
                "Fitness `difference`: that of an individual is its own difference reward; tests "
                "and tables are of the score.",
                f"Converge is trained on the author's bonuses, as in Figure 4.2. {fig_4_2.APART}",
                "LSTMs and GRUs have as many units as an MMU, and the operators that were chosen "
                "for it.",
            ),
        ),
        about(
            "server fleet",
            fig_4_7.about(
                10,
                fig_4_7.GENTLER,
                "In noise every number that a server observes, but not its status, is told with an "
                "error N(0, std²) of its own, in the units in which it is observed: a request's "
                "worth is 1 or -1, a count at most 0.1. The curve of a cell in noise is of tests "
                "in noise.",
            ),
        ),
    ),
    budgets=fig_4_2.BUDGETS,
)
