"""Beyond chapter 4: difference rewards, depth 4, teams of LSTMs and GRUs, noisy observations, and
servers that leave and join while a fleet works."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, PyTree

from .. import tree
from ..analysis import attribution, fleet, statistics
from ..environments.extended_tmaze import ExtendedTMaze
from ..environments.server_fleet import ServerFleet
from ..environments.wrappers import NoisyObservations
from ..networks.recurrent import Recurrent
from ..report.sections import Table
from ..rollout import evaluate
from ..runs.store import Run
from . import chapter4, chapter4_fleet, fig_4_7
from .base import Cell

TITLE = "difference rewards, depth 4, LSTM teams, noise, fleets that change"
PUBLISHED = (
    "Not in the dissertation, which names noisy observations of the server fleet as future work "
    "(section 4.2.5). The difference reward of a robot is the score minus what it would have been "
    "without it."
)
BUDGETS = chapter4.BUDGETS
FLEET = "synchronous, dmmu"  # a cell of Figure 4.7
NOISE = 0.5  # in training; a request that was served is told as 1 or -1
TESTED = (0.0, 0.25, 0.5, 1.0)
QUESTIONS = {  # T-mazes by table
    "Difference reward against global reward": (
        "spread 2-deep, 3 robots",
        "spread 2-deep, 4 robots",
    ),
    "Depth 4": ("spread 4-deep, fsp",),
    "Robots by the cell of their networks": ("converge 2-deep, fsp", "spread 2-deep, 2 robots"),
}


def cells(budget: str) -> list[Cell]:
    return [*by_reward(budget), *deep(budget), *by_network(budget), *fleets(budget)]


def by_reward(budget: str) -> list[Cell]:
    """The score as everybody's fitness (cells of Figure 4.4), and each robot's own difference."""
    found = []
    for robots in (3,) if budget == "smoke" else (3, 4):
        where, env = f"spread 2-deep, {robots} robots", _spread(robots)
        both = dataclasses.replace(env, rewards=("score", "difference"))
        found += [
            chapter4.cell(f"{where}, mmu", env, "mmu", budget),
            chapter4.cell(f"{where}, mmu on difference", both, "mmu", budget, fitness="difference"),
        ]
    return found


def deep(budget: str) -> list[Cell]:
    env = chapter4.beside("fsp", "spread", 4)
    return [
        chapter4.cell(f"spread 4-deep, fsp, {network}", env, network, budget)
        for network in chapter4.NETWORKS
    ]


def by_network(budget: str) -> list[Cell]:
    """One beside a static robot and teams of two: MMUs (cells of Figures 4.2 and 4.4), LSTMs and
    GRUs."""
    tasks = {
        "converge 2-deep, fsp": chapter4.beside("fsp", "converge", 2),
        "spread 2-deep, 2 robots": _spread(2),
    }
    found = []
    tiny = budget == "smoke"
    for where, env in tasks.items():
        mmu = chapter4.cell(f"{where}, mmu", env, "mmu", budget)
        found.append(mmu)
        for kind in ("lstm",) if tiny else ("lstm", "gru"):
            network = Recurrent(kind, 3 if tiny else 20, "tanh")
            algorithm = dataclasses.replace(mmu.algorithm, network=network)
            found.append(dataclasses.replace(mmu, name=f"{where}, {kind}", algorithm=algorithm))
    return found


def fleets(budget: str) -> list[Cell]:
    """DMMU as in Figure 4.7, and in noise."""
    (clear,) = (cell for cell in fig_4_7.cells(budget) if cell.name == FLEET)
    env = _noisy(clear.algorithm.env, NOISE)
    algorithm = dataclasses.replace(clear.algorithm, env=env)
    name = f"{FLEET} in noise {NOISE}"
    return [clear, dataclasses.replace(clear, name=name, algorithm=algorithm)]


def _spread(robots: int) -> ExtendedTMaze:
    return ExtendedTMaze(depth=2, robots=robots, objective="spread", partner=None)


def _noisy(env: ServerFleet, std: float) -> NoisyObservations:
    return NoisyObservations(env, std, spared=1)  # the status


# ---------------------------------------------------------------------------------------- scores


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    tasks = {name: cell[0].algorithm.env for name, cell in runs.items()}
    mazes = {name: runs[name] for name, env in tasks.items() if isinstance(env, ExtendedTMaze)}
    measured = chapter4.measure(mazes, budget)
    for name in runs.keys() - mazes.keys():
        measured[name] = _fleet(name, runs[name], tasks[name])
    return {name: measured[name] for name in runs}


def _fleet(name: str, runs: list[Run], env: ServerFleet | NoisyObservations) -> dict[str, Any]:
    """Learning of a cell of fleets, its final champions in every noise, and without noise what
    becomes of them when servers leave and join."""
    noise = env.std if isinstance(env, NoisyObservations) else 0.0
    clear = env.env if isinstance(env, NoisyObservations) else env
    assert isinstance(clear, ServerFleet)
    champions = tree.stack(*(run.champion for run in runs))
    found = chapter4_fleet.outcome(name, runs, chapter4_fleet.references(clear))
    found |= {"noise": noise, "in noise": in_noise(clear, champions)}
    return found if noise else found | {"changes": changes(clear, champions)}


def in_noise(env: ServerFleet, champions: PyTree) -> dict[str, Any]:
    """Net requests per episode of every champion, mean and standard error, by the noise of the
    test: `{std: [runs, 2]}`. All play in the same worlds."""
    return {str(std): _means(played(_noisy(env, std), champions)) for std in TESTED}


def changes(env: ServerFleet, champions: PyTree) -> dict[str, Any]:
    """The same by what happens to the fleet, beside floors and ceilings of the same task; and the
    difference that it makes, world by world: classes of devices are the same."""
    found, before = {}, None
    for name, (task, teams) in variants(env, champions).items():
        net = played(task, teams)
        before = net if before is None else before
        known = fleet.floors_and_ceilings(task, 1000, key=jax.random.key(21_000))
        found[name] = {
            "ours": _means(net),
            "change": _means(net - before),
            "known": {who: attribution.plain(pair, 3) for who, pair in known.items()},
        }
    return found


def variants(env: ServerFleet, team: Any) -> dict[str, tuple[ServerFleet, Any]]:
    """What may happen to a fleet, by name: the task, and who plays it. A part of a DMMU or of a
    population of them leaves, or clones of its first agents join, in mid-episode or before it."""
    n, end = env.servers, env.max_steps
    leave, join, half = max(1, 3 * n // 10), n // 2, end // 2
    left = n - leave
    stays, leaves, joins = ((0, end),), ((0, half),), ((half, end),)
    smaller, larger = team.without(range(left, n)), team.with_clones(range(join))
    fewer = dataclasses.replace(env, servers=left)
    more = dataclasses.replace(env, servers=n + join)
    leaving = dataclasses.replace(env, schedule=stays * left + leaves * leave)
    joining = dataclasses.replace(more, schedule=stays * n + joins * join)
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
    return evaluate(env, champions, chapter4_fleet.EPISODES, key=jax.random.key(20_002)).of("net")


def _means(net: Array) -> list[list[float]]:
    """Mean and standard error over the episodes of each run."""
    return attribution.plain(np.stack(statistics.mean_and_standard_error(net.T), axis=1), 3)


# ----------------------------------------------------------------------------------------- pages


def sections(measured: dict[str, Any]) -> list[Any]:
    mazes = {name: cell for name, cell in measured.items() if "ceiling" in cell}
    of_fleets = {name: cell for name, cell in measured.items() if "noise" in cell}
    found = []
    for question, places in QUESTIONS.items():
        chosen = {name: cell for name, cell in mazes.items() if cell["where"] in places}
        if chosen:
            found += [shares(question, chosen), *chapter4.curves(chosen)]
            found += chapter4.pictures(chosen)
    if of_fleets:
        found += [noise(of_fleets), *chapter4_fleet.curves(of_fleets)]
    for cell in of_fleets.values():
        if "changes" in cell:
            found += [sizes(cell["changes"]), costs(cell["changes"])]
    if mazes:
        found.append(
            chapter4.about(
                "`on difference`: the fitness of an individual is its own difference reward; tests "
                "and tables are of the score.",
                f"Converge is trained on the author's bonuses, as in Figure 4.2. {chapter4.APART}",
                "LSTMs and GRUs have as many units as an MMU, and the operators that were chosen "
                "for it.",
            )
        )
    if of_fleets:
        found.append(
            chapter4_fleet.about(
                10,
                chapter4_fleet.GENTLER,
                "In noise every number that a server observes, but not its status, is told with an "
                "error N(0, std²) of its own, in the units in which it is observed: a request's "
                "worth is 1 or -1, a count at most 0.1. The curve of a cell in noise is of tests "
                "in noise.",
            )
        )
    return found


def shares(question: str, measured: dict[str, Any]) -> Table:
    """Scores of some cells, without a column for what was published."""
    table = chapter4.scores(measured, {})
    kept = [i for i, column in enumerate(table.columns) if column != "published"]
    return Table(
        f"{question}: trials in which the final champion team observes the reward, %",
        [table.columns[i] for i in kept],
        [[row[i] for i in kept] for row in table.rows],
        table.caption,
    )


def noise(measured: dict[str, Any]) -> Table:
    """Every champion of fleets, by the noise it is tested in."""
    known = next(iter(measured.values()))["reference"]
    return Table(
        "Noisy observations: net requests of final champions, by the noise of the test",
        ["std in training", "run", *(f"tested at std {std:g}" for std in TESTED)],
        [
            [
                f"{cell['noise']:g}",
                str(run),
                *(_pair(net[run]) for net in cell["in noise"].values()),
            ]
            for cell in measured.values()
            for run in range(len(cell["final"]))
        ],
        caption=f"Mean ± standard error over {chapter4_fleet.EPISODES} fresh episodes, the same "
        f"for all. Without noise random servers earn {known['random']}, a script that discovers "
        f"{known['discovering']}, an oracle {known['oracle']}.",
    )


def sizes(changed: dict[str, Any]) -> Table:
    """Fleets that change, beside floors and ceilings of the same task."""
    runs = range(len(next(iter(changed.values()))["ours"]))
    return Table(
        "Servers that leave and join: net requests of final champions",
        [
            "fleet",
            "floor: random",
            *(f"run {run}" for run in runs),
            "a script that discovers",
            "an oracle",
        ],
        [
            [
                name,
                _pair(row["known"]["random"]),
                *(_pair(row["ours"][run]) for run in runs),
                _pair(row["known"]["discovering"]),
                _pair(row["known"]["oracle"]),
            ]
            for name, row in changed.items()
        ],
        caption=f"Mean ± standard error over {chapter4_fleet.EPISODES} fresh episodes (floor, "
        "script and oracle 1,000). Trained without noise and with nobody leaving or joining, then "
        "not changed. Clones are of the first servers.",
    )


def costs(changed: dict[str, Any]) -> Table:
    """What a change of the fleet costs or brings, ours beside a fleet that shares all it finds."""
    (_, first), *others = changed.items()
    runs = range(len(first["ours"]))

    def gain(row: dict[str, Any], who: str) -> str:
        after, before = row["known"][who], first["known"][who]
        return _pair((after[0] - before[0], float(np.hypot(after[1], before[1]))), "+")

    return Table(
        "Against the first row: what leaving costs and joining brings",
        ["fleet", *(f"run {run}" for run in runs), "a script that discovers", "an oracle"],
        [
            [
                name,
                *(_pair(row["change"][run], "+") for run in runs),
                gain(row, "discovering"),
                gain(row, "oracle"),
            ]
            for name, row in others
        ],
        caption="Ours: mean ± standard error of the difference, world by world. Script and oracle: "
        "of the difference of two means.",
    )


def _pair(found: Sequence[float | None], sign: str = "") -> str:
    mean, error = found
    if mean is None:  # a champion that says NaN
        return "–"
    return f"{mean:{sign}.1f} ± {error:.1f}"
