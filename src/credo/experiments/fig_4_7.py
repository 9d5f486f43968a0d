"""Figure 4.7: DMMU and its baselines on the server fleet, synchronous and asynchronous."""

from typing import Any

from ..runs.store import Run
from . import chapter4_fleet
from .base import Cell

TITLE = "server fleet, DMMU and baselines"
PUBLISHED = (
    "Figure 4.7 of the dissertation, 10 runs, net requests served: DMMU 11.93 ± 0.63 synchronous "
    "and 8.25 ± 0.39 asynchronous; LSTM ensemble 5.8 ± 0.73 and about 0; feed-forward ensemble, "
    "centralized network and LSTMs with shared memory about 0."
)
BUDGETS = chapter4_fleet.BUDGETS
GIVEN = {
    "synchronous, dmmu": "11.93 ± 0.63",
    "asynchronous, dmmu": "8.25 ± 0.39",
    "synchronous, lstmne": "5.8 ± 0.73",
    **{
        f"{where}, {name}": "~0"
        for where in ("synchronous", "asynchronous")
        for name in ("ffne", "cnf", "lstmsm")
    },
    "asynchronous, lstmne": "~0",
}
TASKS = {"synchronous": 1, "asynchronous": (0, 2)}


def cells(budget: str) -> list[Cell]:
    tiny = budget == "smoke"
    sizes: dict[str, Any] = {"servers": 2, "devices": 4, "nefarious": 2} if tiny else {}
    found = chapter4_fleet.networks(2 if tiny else 30)
    if budget == "full":  # as far as compute goes
        found = {name: found[name] for name in ("dmmu", "lstmne", "ffne")}
    tasks = {where: chapter4_fleet.large(busy=busy, **sizes) for where, busy in TASKS.items()}
    return [
        chapter4_fleet.cell(
            f"{where}, {name}",
            env,
            network,
            budget,
            chapter4_fleet.PLANS[budget],
            mutation=chapter4_fleet.gentle(env, network),
        )
        for where, env in tasks.items()
        for name, network in found.items()
    ]


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    known = {}
    for name, cell in runs.items():
        where = name.partition(",")[0]
        known.setdefault(where, None)
        known[where] = known[where] or chapter4_fleet.references(cell[0].algorithm.env)
    return {
        name: chapter4_fleet.outcome(name, cell, known[name.partition(",")[0]])
        for name, cell in runs.items()
    }


def sections(measured: dict[str, Any]) -> list[Any]:
    return [
        chapter4_fleet.scores(measured, GIVEN),
        *chapter4_fleet.curves(measured),
        chapter4_fleet.about(
            10,
            chapter4_fleet.GENTLER,
            "The author's generations are 15,000, the budget `published` here. He let several "
            "servers take the last request; here a request is served once.",
        ),
    ]
