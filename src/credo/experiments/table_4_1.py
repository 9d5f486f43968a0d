"""Table 4.1: a fleet with three memory cells, in every configuration of the case study."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..analysis import fleet
from ..environments.server_fleet import ServerFleet
from ..networks.dmmu import DMMU
from ..report.sections import Table
from ..runs.store import Run
from . import chapter4_fleet
from .base import Cell
from .chapter3 import rounded

TITLE = "case study of two servers and four devices"
PUBLISHED = (
    "Table 4.1 of the dissertation: rewards 6, 4, 5, 4, 5, 4 in the six configurations, and final "
    "memories whose order, the signature, is another one in each."
)
BUDGETS = chapter4_fleet.BUDGETS
# In the order of the table; True: genuine.
CONFIGURATIONS = tuple(
    tuple(letter == "G" for letter in text)
    for text in ("GGNN", "NNGG", "NGGN", "GNNG", "GNGN", "NGNG")
)
EPISODES = 30  # per fitness: ten may miss a configuration
GIVEN = (6.0, 4.0, 5.0, 4.0, 5.0, 4.0)
PLANS = {
    "smoke": chapter4_fleet.Plan(4, 2),
    "quick": chapter4_fleet.Plan(300, 2),
    "full": chapter4_fleet.Plan(2_000, 10),
    "published": chapter4_fleet.Plan(15_000, 10),
}


def cells(budget: str) -> list[Cell]:
    return [
        chapter4_fleet.cell(
            "case study, dmmu",
            ServerFleet.case_study(),
            DMMU(hidden=3),
            budget,
            PLANS[budget],
            episodes=EPISODES,
        )
    ]


def measure(runs: dict[str, list[Run]], budget: str) -> dict[str, Any]:
    ((_, cell),) = runs.items()
    env = cell[0].algorithm.env
    found = [_played(env, run.champion) for run in cell]
    sums = [sum(row["reward"] for row in rows) for rows in found]
    return {
        "best": int(np.argmax(sums)),
        "runs": found,
        "discoverable": round(fleet.best_discovery(env), 4),
        **chapter4_fleet.references(env),
    }


def _played(env: ServerFleet, champion: Any) -> list[dict[str, Any]]:
    """Every configuration, as one champion plays it."""
    rows = []
    for genuine in CONFIGURATIONS:
        trace = fleet.trace_fleet(env, champion, jnp.array(genuine), key=jax.random.key(0))
        rows.append(
            {
                "reward": float(np.sum(trace.net)),
                "memory": rounded(trace.memory[-1], 4),
                "signature": [int(i) for i in trace.signature],
                "devices": np.where(trace.acting, trace.device, -1).tolist(),
                "writes": rounded(np.abs(trace.writes), 4),
            }
        )
    return rows


def sections(measured: dict[str, Any]) -> list[Any]:
    best = measured["runs"][measured["best"]]
    return [
        Table(
            f"Champion of run {measured['best']}, the best of its cell",
            ["configuration", "published reward", "ours", "final memory", "signature"],
            [
                [
                    name(genuine),
                    given,
                    row["reward"],
                    str([float(f"{x:.3g}") for x in row["memory"]]),
                    str(row["signature"]),
                ]
                for genuine, given, row in zip(CONFIGURATIONS, GIVEN, best, strict=True)
            ],
            caption="G: genuine, N: nefarious. Which configuration is the easy one follows from "
            "the devices that a fleet tries first. Signature: cells in ascending order.",
        ),
        every_run(measured),
        chapter4_fleet.about(
            EPISODES,
            chapter4_fleet.STRONGER,
            "Whoever knows the classes earns 6 in each configuration. A fleet has to find out: "
            f"no fleet earns more than {measured['discoverable']:.3f} on average, the mean of the "
            "published table, 28/6. The script that discovers earns "
            f"{measured['discovering']:.2f}, random servers {measured['random']:.2f}.",
        ),
    ]


def every_run(measured: dict[str, Any]) -> Table:
    """How many runs do as well as the table, whatever they try first."""
    rows = []
    for i, run in enumerate(measured["runs"]):
        rewards = [row["reward"] for row in run]
        pairs = zip(sorted(rewards), sorted(GIVEN), strict=True)
        signatures = {tuple(row["signature"]) for row in run}
        rows.append(
            [
                str(i),
                ", ".join(f"{x:g}" for x in rewards),
                np.mean(rewards),
                "yes" if all(mine >= given for mine, given in pairs) else "no",
                len(signatures),
            ]
        )
    return Table(
        "Every run",
        ["run", "rewards", "mean", "as Table 4.1 or better", "different signatures"],
        rows,
    )


def name(genuine: tuple[bool, ...]) -> str:
    return "".join("G" if x else "N" for x in genuine)
