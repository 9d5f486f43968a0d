"""Beyond chapter 4: difference rewards, depth 4, teams of LSTMs and GRUs, noisy observations, and
servers that leave and join while a fleet works.

Not in the dissertation, which names difference rewards (section 4.1.7) and noisy observations
(4.2.5) as future work. Each answer but that for depth 4 stands beside a cell of Figure 4.2, 4.4 or
4.7 of the same budget and seeds; runs of that cell are shared with the figure.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..analysis import fleet, statistics
from ..environments.server_fleet import ServerFleet
from ..environments.wrappers import NoisyObservations
from ..report import sections as page
from ..report.rows import Results, Row
from . import fleets, tmazes
from .base import Cell, Experiment, Trained, Value
from .measures import returns, where
from .views import SEED, Of, Table

NOISE = 0.5  # in training; a request that was served is told as 1 or -1
TESTED = (0.0, 0.25, 0.5, 1.0)
"""Standard deviations of the noise in which final champions are tested, whatever they were trained
in."""
STD, REFERENCE = "noise of the test", "reference of a fleet"
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
    tiny, maze = budget == "smoke", tmazes.cell
    kinds = ("mmu", "lstm") if tiny else ("mmu", "lstm", "gru")
    clear = fleets.cells(budget)[0]  # DMMU, synchronous
    noisy = replace(clear.algorithm, env=_noisy(clear.algorithm.env, NOISE))
    return [
        *(
            maze(budget, "spread", 2, "mmu", robots=robots, fitness=fitness)
            for robots in ((3,) if tiny else (3, 4))
            for fitness in (None, "difference")
        ),
        *(maze(budget, "spread", 4, x, partner="fsp") for x in ("mmu", "ff")),
        *(maze(budget, "converge", 2, x, partner="fsp") for x in kinds),
        *(maze(budget, "spread", 2, x, robots=2) for x in kinds),
        clear,
        replace(clear, labels={**clear.labels, "noise": NOISE}, algorithm=noisy),
    ]


def _noisy(env: ServerFleet, std: float) -> NoisyObservations:
    return NoisyObservations(env, std, spared=1)  # the status


def in_noise(trained: Trained) -> Iterator[Row]:
    """Net requests of the final champions of a fleet in every noise."""
    env = fleets.clear(trained.env)
    for std in TESTED:
        net = played(_noisy(env, std), trained.champions)
        yield from pairs(trained.part(**{STD: std}), "net requests in noise", net)


def changed(trained: Trained) -> Iterator[Row]:
    """Net requests by what happens to the fleet, beside baselines and bounds of the same task; and
    the difference that it makes, world by world: classes of devices are the same."""
    before = None
    for name, (task, teams) in fleet.changes(fleets.clear(trained.env), trained.champions).items():
        net, here = played(task, teams), trained.part(fleet=name)
        before = net if before is None else before
        yield from pairs(here, "net requests of a fleet", net)
        yield from pairs(here, "change", net - before)
        for policy, x in (fleet.played(task) | fleet.played(task, oracle=True)).items():
            found = statistics.mean_and_standard_error(x)
            for metric, value in zip(both(REFERENCE), found, strict=True):
                yield here.fact(metric, round(float(value), 3), policy=policy)


def played(env: ServerFleet | NoisyObservations, champions: Any) -> np.ndarray:
    """Net requests served in fresh episodes: `[runs, episodes]`. Classes of devices and episodes
    do not depend on how many servers there are."""
    return returns(env, champions, fleets.EPISODES, 20_002, "net")


def both(metric: str) -> tuple[str, str]:
    """Metrics of a mean and of its standard error."""
    return metric, f"{metric}, s.e."


def pairs(trained: Trained, metric: str, net: np.ndarray) -> Iterator[Row]:
    """Mean and standard error over the episodes of each run."""
    found = statistics.mean_and_standard_error(net.T)
    for name, values in zip(both(metric), found, strict=True):
        yield from trained.rows(name, values, 3)


def pair(metric: str, sign: str = "", **labels: Any) -> Of:
    """Mean ± standard error of every run or, of a policy, once; a dash for a champion that says
    NaN."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        mean, error = (results.where(**labels).by_seed(name) for name in both(metric))
        found = [(mean[seed][0], error[seed][0]) for seed in mean]
        return ", ".join("–" if a is None else f"{a:{sign}.1f} ± {b:.1f}" for a, b in found) or None

    return of


def gain(policy: str) -> Of:
    """What a change of the fleet brings to a script: the difference of two means."""

    def of(results: Results, values: Sequence[Value]) -> page.Cell:
        mean, error = (results.where(policy=policy).by_seed(x)[None] for x in both(REFERENCE))
        return f"{mean[1] - mean[0]:+.1f} ± {float(np.hypot(*error)):.1f}"

    return of


def costs(results: Results, values: Sequence[Value]) -> Iterable[page.Section]:
    """What a change of the fleet costs or brings, ours beside a fleet that shares all it finds."""
    first, *others = results.levels("fleet") or [None]
    body = []
    for name in others:
        change = pair("change", "+")(results.where(fleet=name), values)
        two = results.where(fleet=(first, name))
        body.append([name, change, *(gain(x)(two, values) for x in ("discovering", "oracle"))])
    if body:
        title = "Against the first row: what leaving costs and joining brings"
        columns = ["fleet", "each run", "a script that discovers", "an oracle"]
        yield page.Table(title, columns, body, caption="World by world; of scripts, of two means.")


def of_question(title: str, labels: dict[str, Any]) -> list[Any]:
    """Table, curves and pictures of the T-mazes of a question."""
    heading = f"{title}: trials in which the final champion team observes the reward, %"
    return [
        replace(tmazes.SCORES, title=heading, where=labels),
        replace(tmazes.CURVES, where=labels),
        lambda results, values: tmazes.pictures(results.where(**labels), values),
    ]


FLEETS = {"task": "server fleet"}
IN_NOISE = Table(
    "Noisy observations: net requests of final champions, by the noise of the test; {panel}",
    [SEED],
    {f"tested at std {x:g}": pair("net requests in noise", "", **{STD: x}) for x in TESTED},
    FLEETS,
    panel=("task", "timing", "network", "noise"),
    caption="Mean ± standard error over 500 fresh episodes, the same for all.",
)
SIZES = Table(
    "Servers that leave and join: net requests of final champions",
    ("fleet",),
    {
        "baseline: random": pair(REFERENCE, policy="random"),
        "each run": pair("net requests of a fleet"),
        "a script that discovers": pair(REFERENCE, policy="discovering"),
        "an oracle": pair(REFERENCE, policy="oracle"),
    },
    caption="Mean ± standard error over 500 fresh episodes (baseline, script and oracle 1,000). "
    "Trained without noise and with no server leaving or joining, then not changed. Clones are of "
    "the first servers.",
)
VIEWS = (
    *(view for question in QUESTIONS.items() for view in of_question(*question)),
    IN_NOISE,
    replace(fleets.SCORES, where=FLEETS),
    replace(fleets.CURVES, where=FLEETS),
    SIZES,
    costs,
)
MEASURES = (
    *(where(measure, timing=None) for measure in tmazes.MEASURES),
    *(where(measure, **FLEETS) for measure in (*fleets.MEASURES, in_noise)),
    where(changed, **FLEETS, noise=None),
)
EXPERIMENTS = {"beyond-4": Experiment(cells, MEASURES, VIEWS, tmazes.BUDGETS)}
