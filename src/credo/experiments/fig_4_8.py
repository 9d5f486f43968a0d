"""Figure 4.8: who writes what to the shared memory, and when."""

from typing import Any

from ..report.sections import HeatMap, Table
from . import chapter4_fleet, table_4_1
from .base import Cell

TITLE = "writes to the shared memory, by server"
PUBLISHED = (
    "Figure 4.8 of the dissertation: servers write when they are told what their last request was "
    "worth, in the steps behind an action, and hardly when they act; each to cells of its own."
)
BUDGETS = table_4_1.BUDGETS
SHOWN = 2  # configuration NGGN, as in the text of section 4.2.4


def cells(budget: str) -> list[Cell]:
    return table_4_1.cells(budget)


measure = table_4_1.measure


def sections(measured: dict[str, Any]) -> list[Any]:
    row = measured["runs"][measured["best"]][SHOWN]
    steps, servers = len(row["writes"]), len(row["writes"][0])
    cells = len(row["writes"][0][0])
    maps = [
        HeatMap(
            f"Server {'AB'[server]}: magnitude of its writes",
            [[row["writes"][t][server][cell] for t in range(steps)] for cell in range(cells)],
            [f"M{cell + 1}" for cell in range(cells)],
            [
                f"t={t + 1}: device {row['devices'][t][server]}"
                if row["devices"][t][server] >= 0
                else f"t={t + 1}: told"
                for t in range(steps)
            ],
            "step",
            "memory cell",
        )
        for server in range(servers)
    ]
    shares = []
    for i, run in enumerate(measured["runs"]):
        told = acted = 0.0
        for played in run:
            for writes, devices in zip(played["writes"], played["devices"], strict=True):
                for server, device in enumerate(devices):
                    if device < 0:
                        told += sum(writes[server])
                    else:
                        acted += sum(writes[server])
        shares.append([str(i), f"{100 * told / (told + acted):.1f}"])
    return [
        *maps,
        Table(
            "Share of all writing that happens when a server is told what its request was worth",
            ["run", "share, %"],
            shares,
            caption="Over the six configurations; half of the steps are of that kind.",
        ),
        chapter4_fleet.about(
            table_4_1.EPISODES,
            chapter4_fleet.STRONGER,
            "Shown is the configuration of the dissertation's text, NGGN, on a linear scale (there "
            "a logarithmic one).",
        ),
    ]
