"""Figure 7.5: paths of teams at coupling 3.

Section 7.5 shows MERL before and after it learned that three rovers must meet, and MATD3 on the
mixed reward. Fully trained is the budget's frames of `rovers.PLANS`, partly trained `PARTLY`.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import jax
import numpy as np

from ..report import trajectories
from ..report.rows import Results, Row, Series, rows
from ..report.sections import Drawing
from ..rollout import record
from .base import Cell, Experiment, Trained, Value, named
from .rovers import MEASURES, PLANS, cell, rovers, table
from .views import Table, plain, present

PARTLY = {"smoke": 1_000, "quick": 25_000, "full": 25_000, "published": 100_000}  # frames
SEED = 7  # of the one world that all are shown in
TEAMS = ("method", "coupling", "training")


def cells(budget: str) -> list[Cell]:
    """MERL partly and fully trained, and MATD3, one run each."""
    plan, env = PLANS[budget]._replace(runs=1), rovers("matd3 mixed", coupling=3)
    partly = plan._replace(frames=PARTLY[budget])
    place: dict[str, Any] = {"coupling": 3, "paths": True}
    return [
        cell("merl", budget, partly, env, **place, training="partly trained"),
        cell("merl", budget, plan, env, **place),
        cell("matd3 mixed", budget, plan, env, **place),
    ]


def paths(cell: Trained) -> list[Row | Series]:
    """Where rovers of each run drove in one world (m), and which POIs they observed.

    **Returns:** series "x" and "y" by `rover` over "step"; "observed", 1 or 0, by `poi`; and of the
    cell "POI x" and "POI y" by `poi`, "activation distance" and "size" of the world, all in metres.
    """
    key, found = jax.random.key(SEED), []
    worlds = [cell.env.shown(record(cell.env, run.champion, key=key)) for run in cell.runs]
    place = np.array([world["position"] for world in worlds], np.float64)
    poi = np.round(np.asarray(worlds[0]["poi"], np.float64), 2)
    for axis, name in enumerate(("x", "y")):
        along = np.moveaxis(place[..., axis], 1, 2)  # [runs, rovers, steps]
        found += cell.series(name, ("step", np.arange(place.shape[1])), along, 2, rover=None)
        found += rows(f"POI {name}", poi[:, axis], cell.labels, poi=None)
    observed = [np.asarray(world["observed"][-1]).astype(int) for world in worlds]
    found += cell.rows("observed", observed, poi=None)
    found.append(cell.fact("activation distance", float(cell.env.activation_distance)))
    return [*found, cell.fact("size", float(cell.env.size))]


def drawings(results: Results, values: Sequence[Value]) -> Iterable[Drawing]:
    """The paths of every team, of its first run."""
    for i, team in enumerate(results.cells):
        told = {name: team["labels"].get(name) for name in TEAMS}
        here, title = results.where(**told), named(present(told))
        along = [here.array(axis, "seed", "rover")[0].T for axis in ("x", "y")]
        poi = [here.array(f"POI {axis}", "poi") for axis in ("x", "y")]
        colours = (
            trajectories.trajectories(
                np.stack(along, axis=-1).astype(np.float64),
                np.stack(poi, axis=-1).astype(np.float64),
                here.array("observed", "seed", "poi")[0].astype(bool),
                activation_distance=here.value("activation distance"),
                size=here.value("size"),
                title=title,
                dark=dark,
                prefix=f"t{i}{dark:d}-",
            )
            for dark in (False, True)
        )
        yield Drawing(title, *colours)


OBSERVED = Table(
    "POIs observed in the world that is drawn", TEAMS, {"observed, of 4": plain("observed", 4)}
)
VIEWS = (drawings, OBSERVED, table(*TEAMS))
EXPERIMENTS = {"fig-7.5": Experiment(cells, (*MEASURES, paths), VIEWS, PLANS)}
